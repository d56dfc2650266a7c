//! Counters over HTTP, for Prometheus.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc::WeakUnboundedSender;
use tokio::sync::{Semaphore, oneshot};

use crate::driver::Command;

/// Requests served at once; more wait.
const REQUESTS_MAX: usize = 4;

/// Bytes of a request; a longer one is refused.
const REQUEST_BYTES_MAX: usize = 8_192;

/// A client that takes longer is dropped.
const TIME_MAX: Duration = Duration::from_secs(5);

pub(crate) async fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    TcpListener::bind(address).await
}

/// Answers requests until the node has ended.
pub(crate) async fn serve(listener: TcpListener, commands: WeakUnboundedSender<Command>) {
    let room = Arc::new(Semaphore::new(REQUESTS_MAX));
    while let Ok(permit) = Arc::clone(&room).acquire_owned().await {
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(Duration::from_millis(200)).await;
            continue;
        };
        let commands = commands.clone();
        tokio::spawn(async move {
            // A client that is slow or gone gets no answer.
            let _ = tokio::time::timeout(TIME_MAX, answer(stream, commands)).await;
            drop(permit);
        });
    }
}

async fn answer(mut stream: TcpStream, commands: WeakUnboundedSender<Command>) -> io::Result<()> {
    let mut request = Vec::new();
    while !request.windows(4).any(|end| end == b"\r\n\r\n") && request.len() < REQUEST_BYTES_MAX {
        if stream.read_buf(&mut request).await? == 0 {
            break;
        }
    }
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
