//! The server of the apps, and its end.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use foxglove::{Context, FoxgloveError, WebSocketServer};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::oneshot;

use crate::Options;
use crate::apps::Apps;
use crate::channels::Channels;
use crate::follow::follow;

/// Messages that may wait for an app; of more, the oldest are left out. The largest picture has 4.2 MB, so that is 134 MB
/// for an app that reads nothing.
pub(crate) const WAITING_MAX: usize = 32;
/// For the apps to take the last messages and the end of the connection.
const END_MAX: Duration = Duration::from_secs(2);

/// Serves until Ctrl-C, SIGTERM, or something that does not mend.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let ended = runtime.block_on(serve(options));
    // A thread that resolves a name or connects may take long.
    runtime.shutdown_background();
    ended
}

async fn serve(options: &Options) -> anyhow::Result<()> {
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot listen to signals")?;
    let mut terminate = signal(SignalKind::terminate()).context("cannot listen to signals")?;
    let (context, apps) = (Context::new(), Apps::default());
    let server = WebSocketServer::new()
        .context(&context)
        .name("flockmap")
        .message_backlog_size(WAITING_MAX)
        .listener(Arc::new(apps.clone()))
        .bind(host(options.listen), options.listen.port())
        .start()
        .await
        .map_err(|error| cannot_listen(options.listen, &error))?;
    let listens = SocketAddr::new(options.listen.ip(), server.port());
    if !listens.ip().is_loopback() {
        eprintln!(
            "warning: whoever reaches {listens} can read the map: it has no password and is not encrypted"
        );
    }
    eprintln!("listens on ws://{listens}: in the Foxglove app, Open connection, Foxglove WebSocket");
    let (says_end, ended) = oneshot::channel();
    let channels = Channels::new(context, apps.clone());
    let options = options.clone();
    std::thread::Builder::new().name("feed".into()).spawn(move || {
        let _ = says_end.send(follow(&options, channels, apps));
    })?;
    let ended = tokio::select! {
        _ = interrupt.recv() => Ok(()),
        _ = terminate.recv() => Ok(()),
        ended = ended => ended.unwrap_or_else(|_| Err(anyhow!("the thread that follows the node has panicked"))),
    };
    // An app that reads nothing is not waited for.
    let _ = tokio::time::timeout(END_MAX, server.stop().wait()).await;
    ended
}

/// As the server puts it before the port.
fn host(listen: SocketAddr) -> String {
    match listen {
        SocketAddr::V4(address) => address.ip().to_string(),
        SocketAddr::V6(address) => format!("[{}]", address.ip()),
    }
}

fn cannot_listen(listen: SocketAddr, error: &FoxgloveError) -> anyhow::Error {
    anyhow!(
        "--listen {listen}: {error}; is another program there? --listen takes another port, and 0 a free one"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_of_both_families_are_put_as_the_server_wants_them() {
        for (listen, expected) in [("127.0.0.1:0", "127.0.0.1"), ("[::1]:0", "[::1]")] {
            let listen: SocketAddr = listen.parse().unwrap();
            assert_eq!(host(listen), expected);
        }
    }
}
