//! What is served: whose maps, and their counters.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tokio::io::DuplexStream;
use tokio::sync::mpsc;

use crate::Series;

/// A map that browsers read.
pub trait Source: Send + Sync {
    /// Id of the robot.
    fn id(&self) -> u16;

    /// Its name, for people.
    fn name(&self) -> String;

    /// Serves a reader: speaks the feed over `stream` until either side closes it. Must not block; it is called
    /// within a tokio runtime. `controls` are what a viewer of a recording wishes; dropping it says that this
    /// source takes none, and a viewer who wishes something is disconnected.
    fn connect(&self, stream: DuplexStream, controls: mpsc::Receiver<Control>);

    /// Bytes of each second, if they are known.
    fn series(&self) -> Option<Arc<Series>>;
}

/// What a viewer of a recording wishes.
#[derive(Clone, Copy, PartialEq, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Control {
    /// Show this time, in microseconds on the clock of the recording.
    SeekUs(i64),
    /// Play, or pause.
    Play(bool),
    /// So many times as fast as it was recorded; it is brought into 0.1 to 100.
    Speed(f32),
}

/// Counters as Prometheus text. `None`: there is nobody any more who counts.
pub type Metrics = Box<dyn Fn() -> Pin<Box<dyn Future<Output = Option<String>> + Send>> + Send + Sync>;

/// What kind of maps these are.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Of robots that are at work.
    Live,
    /// Of recordings and files.
    Playback,
}

/// All that a server serves.
pub struct Content {
    /// For people.
    pub title: String,
    /// What kind of maps.
    pub kind: Kind,
    /// Whose maps; none: no page.
    pub sources: Vec<Arc<dyn Source>>,
    /// Counters.
    pub metrics: Option<Metrics>,
}
