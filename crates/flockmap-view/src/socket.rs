//! A WebSocket as a pipe: what the feed says goes out in messages of up to 64 KiB.

use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{Message, WebSocket};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::Control;

/// What waits in the pipe, each way.
pub(crate) const PIPE_BYTES: usize = 1 << 16;

/// Wishes that wait to be heard.
pub(crate) const CONTROLS_WAITING_MAX: usize = 16;

/// Most bytes of a message of a browser.
pub(crate) const MESSAGE_BYTES_MAX: usize = 4_096;

/// A browser that takes nothing for so long is left.
const UNTAKEN_MAX: Duration = Duration::from_secs(60);

/// Carries bytes between a browser and a source until either ends, or the browser says what it should not.
pub(crate) async fn pump(mut socket: WebSocket, mut pipe: DuplexStream, controls: mpsc::Sender<Control>) {
    let mut buffer = vec![0; PIPE_BYTES];
    loop {
        tokio::select! {
            read = pipe.read(&mut buffer) => {
                let Ok(count @ 1..) = read else { break };
                let message = Message::Binary(Bytes::copy_from_slice(&buffer[..count]));
                let Ok(Ok(())) = timeout(UNTAKEN_MAX, socket.send(message)).await else { return };
            }
            message = socket.recv() => {
                let is_heard = match message {
                    Some(Ok(Message::Binary(bytes))) => {
                        // The reader's hello; whoever says more than the source reads has to wait, or is closed.
                        matches!(timeout(UNTAKEN_MAX, pipe.write_all(&bytes)).await, Ok(Ok(())))
                    }
                    Some(Ok(Message::Text(text))) => {
                        match serde_json::from_str(&text) {
                            // No wish is lost: the last one counts. Who serves hears them at once.
                            Ok(control) => controls.send(control).await.is_ok(),
                            Err(_) => false,
                        }
                    }
                    Some(Ok(Message::Ping(_) | Message::Pong(_))) => true,
                    Some(Ok(Message::Close(_)) | Err(_)) | None => false,
                };
                if !is_heard {
                    break;
                }
            }
        }
    }
    // It may be gone already.
    let _ = timeout(Duration::from_secs(1), socket.send(Message::Close(None))).await;
}
