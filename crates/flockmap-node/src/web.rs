//! What a node serves over HTTP: counters, and the view of its map.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use flockmap::RobotId;
use flockmap_view::{Access, Content, Control, Kind, Metrics, Series, Source, StartError, ViewServer};
use tokio::io::DuplexStream;
use tokio::sync::mpsc::{self, WeakUnboundedSender};
use tokio::sync::oneshot;

use crate::MapReaders;
use crate::advice::listen_error;
use crate::command::Command;

/// Where a node's map is seen in a browser, with its counters.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ViewOptions {
    /// The address to listen at.
    pub address: SocketAddr,
    /// Who may look.
    pub access: Access,
}

/// The map of a node, for browsers.
#[derive(Clone)]
pub(crate) struct NodeSource {
    pub(crate) robot: RobotId,
    pub(crate) name: String,
    pub(crate) readers: MapReaders,
    pub(crate) series: Arc<Series>,
}

impl Source for NodeSource {
    fn id(&self) -> u16 {
        self.robot.0
    }

    fn name(&self) -> String {
        self.name.clone()
    }

    fn connect(&self, stream: DuplexStream, _: mpsc::Receiver<Control>) {
        self.readers.take(stream);
    }

    fn series(&self) -> Option<Arc<Series>> {
        Some(Arc::clone(&self.series))
    }
}

/// Serves counters alone, to whoever asks.
pub(crate) fn serve_counters(
    address: SocketAddr,
    commands: WeakUnboundedSender<Command>,
) -> Result<ViewServer, (String, io::Error)> {
    let server = ViewServer::start(address, Access::Everybody, Content::counters(counters(commands)));
    server.map_err(|error| (format!("serve metrics at {address}"), advised("[metrics] prometheus", error)))
}

/// Serves the view of a node, and its counters.
pub(crate) fn serve_view(
    options: ViewOptions,
    source: NodeSource,
    commands: WeakUnboundedSender<Command>,
) -> Result<ViewServer, (String, io::Error)> {
    let content = Content {
        title: source.name.clone(),
        kind: Kind::Live,
        sources: vec![Arc::new(source)],
        metrics: Some(counters(commands)),
    };
    let address = options.address;
    let server = ViewServer::start(address, options.access, content);
    server.map_err(|error| (format!("serve the view at {address}"), advised("[view] listen", error)))
}

fn advised(option: &str, error: StartError) -> io::Error {
    match error {
        StartError::System { error, .. } => listen_error(option, error),
        other => io::Error::other(other),
    }
}

fn counters(commands: WeakUnboundedSender<Command>) -> Metrics {
    Box::new(move || {
        let commands = commands.clone();
        Box::pin(async move {
            let (send, receive) = oneshot::channel();
            // If the node has just ended, the answer never comes.
            let answer = Box::new(|status: crate::NodeStatus| drop(send.send(status.prometheus())));
            commands.upgrade()?.send(Command::Status(answer)).ok()?;
            receive.await.ok()
        })
    })
}
