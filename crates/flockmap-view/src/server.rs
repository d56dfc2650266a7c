//! The server: a thread of its own, and the connections that it takes.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc as std_mpsc;
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use axum::extract::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use socket2::SockRef;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, oneshot};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{sleep, timeout};

use crate::access::{Access, Token};
use crate::routes::{SOCKETS_MAX, router};
use crate::{Content, Kind};

/// Connections that have asked nothing yet or are being answered. Of more, the one that has been idle for longest
/// is closed; if none is, more wait. Browsers that follow a map do not count here.
const CONNECTIONS_MAX: usize = 64;

/// For the head of a request to come.
const HEAD_TIME: Duration = Duration::from_secs(5);

/// For a request and its whole answer.
const ANSWER_TIME: Duration = Duration::from_secs(60);

/// Most bytes of the head of a request; hyper takes no less.
const HEAD_BYTES_MAX: usize = 8_192;

/// For browsers to be told the end.
const END_TIME: Duration = Duration::from_secs(1);

/// After a connection could not be taken.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// What the system keeps for a browser before it has gone out: what waits there grows old.
const SEND_BUFFER_BYTES: usize = 1 << 16;

/// Data that nobody takes for so long ends a connection, also where the other machine is gone.
#[cfg(target_os = "linux")]
const UNTAKEN_MAX: Duration = Duration::from_secs(60);

/// Why a server could not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// The system refused something.
    #[error("cannot serve at {address}: {error}")]
    System {
        /// Where.
        address: SocketAddr,
        /// Its answer.
        error: io::Error,
    },
    /// Maps beyond the loopback need a token.
    #[error("{0} is not the loopback: maps are given out there for a token only")]
    TokenNeeded(SocketAddr),
}

/// A server at work. Dropping it ends it.
///
/// It holds at most 64 connections that ask something, 8 KiB each, and 64 browsers that follow a map, 0.3 MB each
/// with what the system keeps.
#[derive(Debug)]
pub struct ViewServer {
    address: SocketAddr,
    token: Option<Token>,
    /// Dropping it ends the thread.
    end: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl ViewServer {
    /// Opens the address and serves it on a thread of its own. Returns when it is open.
    ///
    /// # Errors
    /// If the address cannot be listened at, or is beyond the loopback and gives maps out without a token.
    pub fn start(address: SocketAddr, access: Access, content: Content) -> Result<Self, StartError> {
        if !address.ip().is_loopback() && !content.sources.is_empty() && !matches!(access, Access::Token(_)) {
            return Err(StartError::TokenNeeded(address));
        }
        let token = match &access {
            Access::Token(token) => Some(token.clone()),
            Access::Loopback | Access::Everybody => None,
        };
        let system = |error| StartError::System { address, error };
        let (started, start) = std_mpsc::channel();
        let (end, ended) = oneshot::channel();
        let work = move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let runtime = match runtime {
                Ok(runtime) => runtime,
                Err(error) => return drop(started.send(Err(error))),
            };
            runtime.block_on(async move {
                let listener = TcpListener::bind(address).await;
                match listener.and_then(|listener| Ok((listener.local_addr()?, listener))) {
                    Err(error) => drop(started.send(Err(error))),
                    Ok((address, listener)) => {
                        // The caller waits for this.
                        let _ = started.send(Ok(address));
                        let sockets = Arc::new(Semaphore::new(SOCKETS_MAX));
                        let router = router(content, access, Arc::clone(&sockets));
                        tokio::select! {
                            () = serve(listener, router) => {}
                            _ = ended => {}
                        }
                        // Sources that have ended said so, and that is on its way.
                        let _ = timeout(END_TIME, sockets.acquire_many(SOCKETS_MAX as u32)).await;
                    }
                }
            });
        };
        let thread = std::thread::Builder::new().name("view".into()).spawn(work).map_err(system)?;
        let died = || system(io::Error::other("its thread panicked"));
        let address = start.recv().map_err(|_| died())?.map_err(system)?;
        Ok(Self { address, token, end: Some(end), thread: Some(thread) })
    }

    /// Where it listens.
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// What to open in a browser, with the token if one is needed. It stands behind a `#`: browsers keep that part
    /// for themselves.
    pub fn url(&self) -> String {
        // What listens everywhere is not everywhere.
        let host = match self.address.ip() {
            ip if ip.is_unspecified() => "HOST".to_owned(),
            std::net::IpAddr::V6(ip) => format!("[{ip}]"),
            std::net::IpAddr::V4(ip) => ip.to_string(),
        };
        let token = self.token.as_ref().map_or(String::new(), |token| format!("#token={}", token.as_str()));
        format!("http://{host}:{}/{token}", self.address.port())
    }
}

impl Drop for ViewServer {
    fn drop(&mut self) {
        self.end = None;
        if let Some(thread) = self.thread.take() {
            // It ends by itself, and if it panicked there is nothing to mend.
            let _ = thread.join();
        }
    }
}

/// Takes connections and answers them.
async fn serve(listener: TcpListener, router: Router) {
    let mut connections = Connections::default();
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            sleep(ACCEPT_PAUSE).await;
            continue;
        };
        bound_buffers(&stream);
        connections.make_room().await;
        connections.take(stream, router.clone());
    }
}

/// What the system does not do costs nothing but freshness.
fn bound_buffers(stream: &TcpStream) {
    let socket = SockRef::from(stream);
    let _ = socket.set_send_buffer_size(SEND_BUFFER_BYTES);
    let _ = socket.set_tcp_nodelay(true);
    #[cfg(target_os = "linux")]
    let _ = socket.set_tcp_user_timeout(Some(UNTAKEN_MAX));
}

/// Connections, in the order in which they came.
#[derive(Default)]
struct Connections {
    connected: Vec<Connection>,
    tasks: JoinSet<()>,
}

struct Connection {
    /// The head of its request is there.
    has_asked: Arc<AtomicBool>,
    task: AbortHandle,
}

impl Connections {
    async fn make_room(&mut self) {
        loop {
            while self.tasks.try_join_next().is_some() {}
            self.connected.retain(|connection| !connection.task.is_finished());
            if self.connected.len() < CONNECTIONS_MAX {
                return;
            }
            let is_idle = |connection: &Connection| !connection.has_asked.load(Ordering::Relaxed);
            if let Some(longest) = self.connected.iter().position(is_idle) {
                self.connected.remove(longest).task.abort();
                return;
            }
            // Every one is being answered, which is over in a while.
            self.tasks.join_next().await;
        }
    }

    fn take(&mut self, stream: TcpStream, router: Router) {
        let has_asked = Arc::<AtomicBool>::default();
        let asked = Arc::clone(&has_asked);
        let service = TowerToHyperService::new(router);
        let service = hyper::service::service_fn(move |request: Request<Incoming>| {
            asked.store(true, Ordering::Relaxed);
            hyper::service::Service::call(&service, request)
        });
        let task = self.tasks.spawn(async move {
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(HEAD_TIME).max_buf_size(HEAD_BYTES_MAX);
            let connection = http.serve_connection(TokioIo::new(stream), service).with_upgrades();
            // Who is slow or gone gets no answer. What was upgraded goes on in a task of its own.
            let _ = timeout(ANSWER_TIME, connection).await;
        });
        self.connected.push(Connection { has_asked, task });
    }
}

/// What a server of counters alone serves.
impl Content {
    /// Counters and no maps.
    pub fn counters(metrics: crate::Metrics) -> Self {
        Self { title: String::new(), kind: Kind::Live, sources: Vec::new(), metrics: Some(metrics) }
    }
}
