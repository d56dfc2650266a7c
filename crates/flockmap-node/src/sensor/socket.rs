//! The socket where sensor programs connect, over TCP or as a file.

use std::io;

use tokio::io::AsyncRead;
use tokio::net::TcpListener;

use super::connections::Listener;
use super::{MessageLimits, Sensor};
use crate::advice::listen_error;
#[cfg(unix)]
use crate::unix_socket::UnixSocket;

/// A socket where sensor programs connect.
pub(crate) enum SensorSocket {
    Tcp(TcpListener),
    #[cfg(unix)]
    Unix(UnixSocket),
}

impl SensorSocket {
    /// Opens the socket that `sensor` names, for messages within these limits; `None` if it names none.
    /// Within a tokio runtime.
    ///
    /// # Errors
    /// Says what is wrong with the address or the path, and what to do.
    pub(crate) async fn open(sensor: &Sensor) -> io::Result<Option<(Self, MessageLimits)>> {
        let (socket, limits) = match sensor {
            Sensor::Tcp(address, limits) => {
                let listener = TcpListener::bind(address).await;
                (Self::Tcp(listener.map_err(|error| listen_error("[sensor] listen_tcp", error))?), limits)
            }
            #[cfg(unix)]
            Sensor::Unix { path, mode, limits } => {
                (Self::Unix(UnixSocket::bind("[sensor] listen_unix", path, *mode)?), limits)
            }
            #[cfg(not(unix))]
            Sensor::Unix { .. } => {
                return Err(io::Error::new(io::ErrorKind::Unsupported, "no Unix sockets here; use TCP"));
            }
            _ => return Ok(None),
        };
        Ok(Some((socket, *limits)))
    }

    /// Where programs can connect.
    pub(crate) fn address(&self) -> String {
        match self {
            Self::Tcp(listener) => listener.local_addr().map_or_else(|e| e.to_string(), |a| a.to_string()),
            #[cfg(unix)]
            Self::Unix(socket) => socket.path().display().to_string(),
        }
    }
}

impl Listener for SensorSocket {
    type Stream = Box<dyn AsyncRead + Send + Unpin>;

    async fn accept(&mut self) -> io::Result<Self::Stream> {
        Ok(match self {
            Self::Tcp(listener) => Box::new(listener.accept().await?.0),
            #[cfg(unix)]
            Self::Unix(socket) => Box::new(socket.accept().await?),
        })
    }
}
