//! The sockets, and who has a place at them.

use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use flockmap_feed::Message;
use flockmap_view::serve::{Closed, Connection, Given, Identity, Reader, Tally};
use socket2::SockRef;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{sleep, timeout};

use super::MapOutput;
use super::giver::Driver;
use crate::Log;
use crate::advice::listen_error;
use crate::command::Command;
#[cfg(unix)]
use crate::unix_socket::UnixSocket;
use crate::warnings::Warnings;

/// What the system keeps for a reader before it has gone out. It doubles this, and takes no more: what waits
/// there grows old.
const SEND_BUFFER_BYTES: usize = 1 << 16;

/// Data that nobody takes for so long ends a connection, also where the other machine is gone.
#[cfg(target_os = "linux")]
const UNTAKEN_MAX: Duration = Duration::from_secs(60);

/// Refusals that are being said; of more, the connection just ends.
const REFUSALS_MAX: usize = 16;
/// For one to be heard.
const REFUSAL_TIME: Duration = Duration::from_secs(1);

/// At the end of the node, for readers to get the rest.
const END_TIME: Duration = Duration::from_secs(2);

/// After a connection could not be accepted.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// The sockets that are open.
pub(super) struct Listeners {
    /// Readers of the same process.
    inside: mpsc::Receiver<Box<dyn Connection>>,
    tcp: Option<TcpListener>,
    #[cfg(unix)]
    unix: Option<UnixSocket>,
}

impl Listeners {
    pub(super) async fn open(
        output: &MapOutput,
        inside: mpsc::Receiver<Box<dyn Connection>>,
    ) -> Result<Self, (String, io::Error)> {
        let mut tcp = None;
        if let Some(address) = output.tcp {
            let listener = TcpListener::bind(address).await;
            let fail = |error| (address.to_string(), listen_error("[map_output] listen_tcp", error));
            tcp = Some(listener.map_err(fail)?);
        }
        #[cfg(unix)]
        {
            let bind = |(path, mode): &(std::path::PathBuf, u32)| {
                let socket = UnixSocket::bind("[map_output] listen_unix", path, *mode);
                socket.map_err(|error| (path.display().to_string(), error))
            };
            Ok(Self { inside, tcp, unix: output.unix.as_ref().map(bind).transpose()? })
        }
        #[cfg(not(unix))]
        match &output.unix {
            None => Ok(Self { inside, tcp }),
            Some((path, _)) => {
                let error = io::Error::new(io::ErrorKind::Unsupported, "no Unix sockets here; use TCP");
                Err((path.display().to_string(), error))
            }
        }
    }

    /// As [`flockmap_feed::Address`] takes them.
    pub(super) fn addresses(&self) -> Vec<String> {
        let tcp = self.tcp.as_ref().and_then(|listener| listener.local_addr().ok());
        let addresses = tcp.map(|address| address.to_string()).into_iter();
        #[cfg(unix)]
        let addresses =
            addresses.chain(self.unix.as_ref().map(|socket| format!("unix:{}", socket.path().display())));
        addresses.collect()
    }

    /// The next connection, with bounds on what waits in it.
    async fn accept(&mut self) -> io::Result<Box<dyn Connection>> {
        let inside = self.inside.recv();
        let tcp = async {
            let Some(listener) = &self.tcp else { return std::future::pending().await };
            let (stream, _) = listener.accept().await?;
            let socket = SockRef::from(&stream);
            // What the system does not do costs nothing but freshness.
            let _ = socket.set_send_buffer_size(SEND_BUFFER_BYTES);
            let _ = socket.set_tcp_nodelay(true);
            #[cfg(target_os = "linux")]
            let _ = socket.set_tcp_user_timeout(Some(UNTAKEN_MAX));
            Ok(Box::new(stream) as Box<dyn Connection>)
        };
        #[cfg(unix)]
        {
            let unix = async {
                let Some(socket) = &self.unix else { return std::future::pending().await };
                let stream = socket.accept().await?;
                let _ = SockRef::from(&stream).set_send_buffer_size(SEND_BUFFER_BYTES);
                Ok(Box::new(stream) as Box<dyn Connection>)
            };
            tokio::select! { Some(inside) = inside => Ok(inside), tcp = tcp => tcp, unix = unix => unix }
        }
        #[cfg(not(unix))]
        tokio::select! { Some(inside) = inside => Ok(inside), tcp = tcp => tcp }
    }
}

/// Serves readers until the node ends.
pub(super) struct Server {
    identity: Arc<Identity>,
    readers_max: usize,
    given: watch::Receiver<Option<Arc<Given>>>,
    tally: Arc<Tally>,
    driver: Arc<Driver>,
    log: Log,
    warnings: Warnings,
    places: Vec<Place>,
    tasks: JoinSet<Closed>,
    refusals: Arc<Semaphore>,
}

/// A connection that is served.
struct Place {
    /// It has said what it wants.
    has_said_hello: Arc<AtomicBool>,
    task: AbortHandle,
}

impl Server {
    pub(super) fn new(
        identity: Identity,
        readers_max: usize,
        given: watch::Receiver<Option<Arc<Given>>>,
        tally: Arc<Tally>,
        commands: mpsc::WeakUnboundedSender<Command>,
        log: Log,
    ) -> Self {
        Self {
            identity: Arc::new(identity),
            readers_max,
            given,
            tally,
            driver: Arc::new(Driver::new(commands)),
            log,
            warnings: Warnings::default(),
            places: Vec::new(),
            tasks: JoinSet::new(),
            refusals: Arc::new(Semaphore::new(REFUSALS_MAX)),
        }
    }

    pub(super) async fn serve(mut self, mut listeners: Listeners) {
        let mut ending = self.given.clone();
        let mut has_ended: Pin<Box<dyn Future<Output = ()> + Send>> =
            Box::pin(async move { while ending.changed().await.is_ok() {} });
        loop {
            tokio::select! {
                () = &mut has_ended => break,
                Some(closed) = self.tasks.join_next() => {
                    // Who was aborted for another is counted where that was done.
                    if let Ok(closed) = closed { self.note(&closed) }
                }
                accepted = listeners.accept() => match accepted {
                    Ok(stream) => self.take(stream),
                    Err(error) => {
                        self.warn(&format!("map output: cannot accept a connection: {error}"));
                        sleep(ACCEPT_PAUSE).await;
                    }
                }
            }
        }
        // Nobody comes any more, and whoever is there gets the rest.
        drop(listeners);
        let rest = async { while self.tasks.join_next().await.is_some() {} };
        // Who is slower than that is not waited for.
        let _ = timeout(END_TIME, rest).await;
    }

    fn take(&mut self, stream: Box<dyn Connection>) {
        self.places.retain(|place| !place.task.is_finished());
        if self.places.len() >= self.readers_max {
            let silent = |place: &Place| !place.has_said_hello.load(Ordering::Relaxed);
            let Some(longest) = self.places.iter().position(silent) else { return self.refuse(stream) };
            // It connected and says nothing: whoever wants something goes first.
            self.places.remove(longest).task.abort();
            self.tally.note_refused();
            self.warn("a connection to the map that had said no hello yet gave way to another one");
        }
        let has_said_hello = Arc::<AtomicBool>::default();
        let reader = Reader {
            identity: Arc::clone(&self.identity),
            given: self.given.clone(),
            tally: Arc::clone(&self.tally),
            giver: Arc::<Driver>::clone(&self.driver),
        };
        let task = self.tasks.spawn(reader.serve(stream, Arc::clone(&has_said_hello)));
        self.places.push(Place { has_said_hello, task });
    }

    fn refuse(&mut self, mut stream: Box<dyn Connection>) {
        self.tally.note_refused();
        let max = self.readers_max;
        self.warn(&format!(
            "a reader of the map was refused: there are {max}, and [map_output] readers_max allows no more"
        ));
        let Ok(permit) = Arc::clone(&self.refusals).try_acquire_owned() else { return };
        let end =
            format!("no place: {max} readers are there, and readers_max allows no more; try again later");
        tokio::spawn(async move {
            let say = async {
                stream.write_all(&Message::End(end).emit()).await?;
                stream.shutdown().await?;
                // What it said must be taken from the socket, or the system throws the refusal away.
                let mut rest = [0; 256];
                while stream.read(&mut rest).await? > 0 {}
                io::Result::Ok(())
            };
            // Nobody may be there to hear it.
            let _ = timeout(REFUSAL_TIME, say).await;
            drop(permit);
        });
    }

    fn note(&mut self, closed: &Closed) {
        match closed {
            Closed::Gone => {}
            Closed::Silent => self.tally.note_refused(),
            Closed::Fault(text) => {
                self.tally.note_closed();
                self.warn(&format!("a reader of the map was closed: {text}"));
            }
        }
    }

    fn warn(&mut self, text: &str) {
        if let Some(text) = self.warnings.take(Instant::now(), text) {
            self.log.warn(text);
        }
    }
}
