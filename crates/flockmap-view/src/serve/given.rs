//! What is given to readers: a map that stands still, and what there is beside it.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use flockmap_feed::{
    Block, Link, Message, NodeCounts, Playback, ReaderHello, RobotPose, RunSubmaps, SeenScan,
};
use flockmap_grid::{BlockIndex, MapView, Resolution, RobotId, Stamp};

/// What the hello says.
#[derive(Clone, Debug)]
pub struct Identity {
    /// Whose map it is.
    pub robot: RobotId,
    /// The side of a voxel.
    pub resolution: Resolution,
    /// Id of the feed, never 0; another one for every run.
    pub feed: u64,
    /// Name of the robot, for people.
    pub name: String,
    /// Name of the frame of the map.
    pub frame: String,
}

/// What is given out at one moment.
#[derive(Debug)]
pub struct Given {
    /// The map.
    pub map: MapView,
    /// When the map came to this version.
    pub stamp: Stamp,
    /// Where robots are.
    pub poses: Numbered<Vec<RobotPose>>,
    /// What was counted.
    pub counts: Numbered<NodeCounts>,
    /// How robots are heard; while there are readers that want it.
    pub links: Numbered<Vec<Link>>,
    /// What the sensor saw; while there are readers that want it.
    pub scan: Numbered<Option<SeenScan>>,
    /// How submaps lie in this map; while there are readers that want it.
    pub submaps: Numbered<Vec<RunSubmaps>>,
    /// Of a recording: which time of it this is.
    pub playback: Numbered<Option<Playback>>,
}

impl Given {
    /// A frame of how submaps lie, if that is new. It goes before the blocks of this map: a reader that has all of them has
    /// a map that lies so.
    pub(crate) fn before_the_map(&self, hello: &ReaderHello, sent: &mut Sent) -> Vec<u8> {
        let is_new = sent.submaps != self.submaps.number && hello.submaps;
        sent.submaps = self.submaps.number;
        if is_new { Message::Submaps(self.submaps.value.to_vec()).emit() } else { Vec::new() }
    }

    /// Frames of what is new beside the map, for a reader that has been sent things with these numbers.
    pub(crate) fn beside_the_map(&self, hello: &ReaderHello, sent: &mut Sent) -> Vec<u8> {
        let Self { poses, counts, links, scan, playback, .. } = self;
        let numbers = [playback.number, poses.number, counts.number, links.number, scan.number];
        let is_new: [bool; 5] = core::array::from_fn(|of| numbers[of] != sent.beside[of]);
        sent.beside = numbers;
        let messages = [
            playback.value.filter(|_| is_new[0]).map(Message::Playback),
            is_new[1].then(|| Message::Poses(poses.value.to_vec())),
            is_new[2].then(|| Message::Counters((*counts.value).clone())),
            (is_new[3] && hello.links).then(|| Message::Links(links.value.to_vec())),
            (*scan.value).clone().filter(|_| is_new[4] && hello.scans).map(Message::Scan),
        ];
        messages.into_iter().flatten().flat_map(|message| message.emit()).collect()
    }
}

/// The numbers of what a reader was sent last.
#[derive(Default)]
pub(crate) struct Sent {
    submaps: u64,
    beside: [u64; 5],
}

/// Something that is sent again when its number is another. That of the default is 0: it is not sent.
#[derive(Clone, Debug, Default)]
pub struct Numbered<T> {
    number: u64,
    value: Arc<T>,
}

impl<T> Numbered<T> {
    /// Goes up each time.
    pub const fn number(&self) -> u64 {
        self.number
    }

    /// What is given out.
    pub fn value(&self) -> &T {
        &self.value
    }

    /// Something else is given out from now on.
    pub fn replace(&mut self, value: T) {
        self.number += 1;
        self.value = Arc::new(value);
    }

    /// The same with something that is there already. What is given out now is not given once more.
    pub fn share(&mut self, value: Arc<T>) {
        if !Arc::ptr_eq(&self.value, &value) {
            self.number += 1;
            self.value = value;
        }
    }
}

/// Who gives.
pub trait Giver: Send + Sync {
    /// A reader has come: it is time to give something.
    fn wake(&self);

    /// Some of these blocks as they are now, the first ones in their order, with who saw them. `None`: nothing will
    /// come any more.
    fn blocks_with_origins(&self, due: Vec<BlockIndex>) -> BlocksFuture;
}

/// See [`Giver::blocks_with_origins`].
pub type BlocksFuture = Pin<Box<dyn Future<Output = Option<BlocksNow>> + Send>>;

/// Blocks with who saw them.
#[derive(Clone, Debug)]
pub struct BlocksNow {
    /// The blocks.
    pub blocks: Vec<Block>,
    /// The version of the map that they are from.
    pub newest: u64,
    /// When that was.
    pub now: Stamp,
}
