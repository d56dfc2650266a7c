//! The feed of a node elsewhere, passed on as it is.

use std::sync::Arc;
use std::time::Duration;

use flockmap_feed::{Address, Message};
use flockmap_view::{Control, Series, Source};
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt, DuplexStream, copy_bidirectional};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::timeout;

/// For a connection to be made.
const CONNECT_MAX: Duration = Duration::from_secs(5);

/// A node that gives its map out at an address. Each browser is a reader of its own there.
#[derive(Clone)]
pub struct Forwarded {
    /// Id of the robot.
    pub id: u16,
    /// Its name.
    pub name: String,
    /// Where its map is.
    pub address: Address,
}

impl Source for Forwarded {
    fn id(&self) -> u16 {
        self.id
    }

    fn name(&self) -> String {
        self.name.clone()
    }

    fn connect(&self, mut browser: DuplexStream, _: mpsc::Receiver<Control>) {
        let address = self.address.clone();
        tokio::spawn(async move {
            let node = timeout(CONNECT_MAX, connect(&address)).await;
            match node.unwrap_or_else(|_| Err(std::io::ErrorKind::TimedOut.into())) {
                // Either end may go as it likes.
                Ok(mut node) => drop(copy_bidirectional(&mut browser, &mut node).await),
                Err(error) => {
                    let end = Message::End(format!("{address} cannot be reached: {error}"));
                    let _ = browser.write_all(&end.emit()).await;
                }
            }
        });
    }

    fn series(&self) -> Option<Arc<Series>> {
        None
    }
}

trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Stream for T {}

async fn connect(address: &Address) -> std::io::Result<Box<dyn Stream>> {
    match address {
        Address::Tcp(address) => Ok(Box::new(TcpStream::connect(address).await?)),
        #[cfg(unix)]
        Address::Unix(path) => Ok(Box::new(tokio::net::UnixStream::connect(path).await?)),
        #[cfg(not(unix))]
        Address::Unix(_) => Err(std::io::ErrorKind::Unsupported.into()),
    }
}
