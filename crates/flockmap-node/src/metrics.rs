//! Counters over HTTP, for Prometheus.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc::WeakUnboundedSender;
use tokio::sync::oneshot;
use tokio::task::{AbortHandle, JoinSet};

use crate::advice::listen_error;
use crate::command::Command;

/// Clients that may be connected at once. Of more, the one that has been idle for longest is closed; if none
/// is, more wait. Worst case held: a request and an answer for each.
const CLIENTS_MAX: usize = 16;

/// Bytes of a request; a longer one is refused.
const REQUEST_BYTES_MAX: usize = 8_192;

/// A client that takes longer is dropped.
const TIME_MAX: Duration = Duration::from_secs(5);

pub(crate) async fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    TcpListener::bind(address).await.map_err(|error| listen_error("[metrics] prometheus", error))
}

/// Answers requests until the node has ended.
pub(crate) async fn serve(listener: TcpListener, commands: WeakUnboundedSender<Command>) {
    let mut clients = Clients::default();
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(Duration::from_millis(200)).await;
            continue;
        };
        clients.make_room().await;
        clients.give(stream, commands.clone());
    }
}

/// The clients that are connected, in the order in which they came.
#[derive(Default)]
struct Clients {
    connected: Vec<Client>,
    tasks: JoinSet<()>,
}

struct Client {
    /// The whole request is there.
    has_asked: Arc<AtomicBool>,
    task: AbortHandle,
}

impl Clients {
    async fn make_room(&mut self) {
        loop {
            while self.tasks.try_join_next().is_some() {}
            self.connected.retain(|client| !client.task.is_finished());
            if self.connected.len() < CLIENTS_MAX {
                return;
            }
            let is_idle = |client: &Client| !client.has_asked.load(Ordering::Relaxed);
            if let Some(longest) = self.connected.iter().position(is_idle) {
                self.connected.remove(longest).task.abort();
                return;
            }
            // Every one is being answered, which is soon over.
            self.tasks.join_next().await;
        }
    }

    fn give(&mut self, stream: TcpStream, commands: WeakUnboundedSender<Command>) {
        let has_asked = Arc::<AtomicBool>::default();
        let asked = Arc::clone(&has_asked);
        let task = self.tasks.spawn(async move {
            // A client that is slow or gone gets no answer.
            let _ = tokio::time::timeout(TIME_MAX, answer(stream, &asked, commands)).await;
        });
        self.connected.push(Client { has_asked, task });
    }
}

async fn answer(
    mut stream: TcpStream,
    asked: &AtomicBool,
    commands: WeakUnboundedSender<Command>,
) -> io::Result<()> {
    let mut request = Vec::new();
    while !request.windows(4).any(|end| end == b"\r\n\r\n") && request.len() < REQUEST_BYTES_MAX {
        if stream.read_buf(&mut request).await? == 0 {
            break;
        }
    }
    asked.store(true, Ordering::Relaxed);
    let (status, body) = respond(&request, commands).await;
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\nContent-Length: {}\r\n\
         Connection: close\r\n\r\n",
        body.len()
    );
    stream.write_all(head.as_bytes()).await?;
    if !request.starts_with(b"HEAD ") {
        stream.write_all(body.as_bytes()).await?;
    }
    stream.shutdown().await
}

async fn respond(request: &[u8], commands: WeakUnboundedSender<Command>) -> (&'static str, String) {
    let line = request.split(|&b| b == b'\r').next().unwrap_or_default();
    let line = String::from_utf8_lossy(line);
    let mut words = line.split(' ');
    let (method, path, version) = (words.next(), words.next().unwrap_or_default(), words.next());
    if !version.is_some_and(|version| version.starts_with("HTTP/1.")) || request.len() >= REQUEST_BYTES_MAX {
        return ("400 Bad Request", "not an HTTP/1 request, or one that is too long\n".into());
    }
    if !matches!(method, Some("GET" | "HEAD")) {
        return ("405 Method Not Allowed", "GET /metrics\n".into());
    }
    if path.split('?').next() != Some("/metrics") {
        return ("404 Not Found", "the counters are at /metrics\n".into());
    }
    let (send, receive) = oneshot::channel();
    if let Some(commands) = commands.upgrade() {
        // If the node has just ended, the answer never comes.
        let _ = commands.send(Command::Status(Box::new(|status| drop(send.send(status.prometheus())))));
    }
    match receive.await {
        Ok(text) => ("200 OK", text),
        Err(_) => ("503 Service Unavailable", "the node is ending\n".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::sync::mpsc::unbounded_channel;

    const REQUEST: &[u8] = b"GET /metrics HTTP/1.1\r\n\r\n";

    /// Far more than anything here takes.
    const PATIENCE: Duration = Duration::from_secs(40);

    async fn answer_of(client: &mut TcpStream) -> String {
        let mut text = String::new();
        tokio::time::timeout(PATIENCE, client.read_to_string(&mut text)).await.unwrap().unwrap();
        text
    }

    #[test]
    fn a_client_that_has_asked_does_not_give_way() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let listener = listen("127.0.0.1:0".parse().unwrap()).await.unwrap();
            let address = listener.local_addr().unwrap();
            let (commands, mut commands_in) = unbounded_channel();
            tokio::spawn(serve(listener, commands.downgrade()));
            let mut asked = Vec::new();
            let mut waiting = Vec::new();
            for _ in 0..CLIENTS_MAX {
                let mut client = TcpStream::connect(address).await.unwrap();
                client.write_all(REQUEST).await.unwrap();
                asked.push(client);
                // The node is busy: it has the question, and answers later.
                waiting.push(commands_in.recv().await.unwrap());
            }
            let mut late = TcpStream::connect(address).await.unwrap();
            late.write_all(REQUEST).await.unwrap();
            // The node answers nobody: each gets that as an answer, none was closed.
            waiting.clear();
            for client in &mut asked {
                assert!(answer_of(client).await.starts_with("HTTP/1.1 503"));
            }
            drop(commands_in.recv().await.unwrap());
            assert!(answer_of(&mut late).await.starts_with("HTTP/1.1 503"));
        });
    }
}
