//! The node's side: what to send to one reader next.

use std::collections::VecDeque;

use flockmap_grid::{BlockIndex, MapView, Stamp};

use crate::message::{Block, BlocksFrame, Message, ReaderHello};

/// A frame is full when it has so many bytes.
const FRAME_BYTES: usize = 1 << 16;

/// Blocks that are picked at once: some ten frames' worth, so that a large map is not gone through for each.
const DUE_MAX: usize = 4_096;

/// What one reader has of the map, and what it gets next. The reader is never waited for and nothing is kept for
/// it but two version numbers and the names of the next blocks: 200 kB at most, while they are picked.
///
/// Blocks go out in ascending order of the version at which they changed last, as they are when they go. So a
/// slow reader gets newer states in fewer steps, and whatever it has come to is one number.
///
/// ```
/// use flockmap_feed::{Feed, Mirror, Next, ReaderHello};
/// # use flockmap_feed::{Message, NodeHello};
/// # use flockmap_grid::{BlockIndex, MapView, Resolution, RobotId, Stamp, State, StateBlock};
///
/// # let mut map = MapView::new(Resolution::from_metres(0.1).unwrap());
/// # let mut block = StateBlock::default();
/// # block.set(0, State::Occupied);
/// # map.set_block(BlockIndex::new(1, 0, 0), &block);
/// # let hello = NodeHello { origins: false, goes_on: false, robot: RobotId(1), resolution: map.resolution(),
/// #     feed: 7, name: String::new(), frame: "map".into() };
/// # let mut mirror = Mirror::default();
/// # mirror.connect();
/// # mirror.push(&mut &Message::Hello(hello).emit()[..])?;
/// let (mut feed, goes_on) = Feed::begin(&ReaderHello::default(), 7, &map);
/// assert!(!goes_on);
/// loop {
///     let frame = match feed.next(&map) {
///         Next::Nothing => break, // until the map changes
///         Next::Anew(frame) => frame,
///         Next::Blocks => feed.blocks_of(&map, Stamp(0)),
///     };
///     mirror.push(&mut &frame[..])?;
/// }
/// assert!(mirror.is_complete());
/// assert_eq!(mirror.map().unwrap().count(), map.count());
/// # Ok::<(), flockmap_feed::FeedError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Feed {
    origins: bool,
    /// The version of the map when the reader began with nothing.
    began: u64,
    /// The reader has all that changed up to this version.
    upto: u64,
    /// The next blocks, with the version at which each changed last, ascending.
    due: VecDeque<(u64, BlockIndex)>,
    /// What the reader has come to with the last of them.
    due_upto: u64,
    /// The reader knows how far it has come.
    is_told: bool,
}

/// What a reader gets next.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Next {
    /// It has the whole map.
    Nothing,
    /// This frame: what it has is not known to be a part of this map.
    Anew(Vec<u8>),
    /// Blocks: [`Feed::due`] says which, [`Feed::blocks`] makes the frame.
    Blocks,
}

impl Feed {
    /// Begins with what a reader said. With whether it goes on from what the reader has, for
    /// [`NodeHello::goes_on`](crate::NodeHello::goes_on). `feed` is the id of this run of the node.
    pub fn begin(hello: &ReaderHello, feed: u64, map: &MapView) -> (Self, bool) {
        let have = hello.have.filter(|have| {
            let is_known = || map.versions_since_beginning(have.began, have.upto).is_some();
            have.feed == feed && have.began.max(have.upto) <= map.version() && is_known()
        });
        let began = have.map_or(u64::MAX, |have| have.began);
        let feed = Self {
            origins: hello.origins,
            began,
            upto: have.map_or(0, |have| have.upto),
            due: VecDeque::new(),
            due_upto: 0,
            is_told: false,
        };
        (feed, have.is_some())
    }

    /// Whether the reader wants origins.
    pub const fn origins(&self) -> bool {
        self.origins
    }

    /// The reader has all that changed up to this version.
    pub const fn upto(&self) -> u64 {
        self.upto
    }

    /// What to send next. `map` is the newest one. O(1) while there are blocks due, else O(regions of 64³
    /// voxels, and blocks of those that changed).
    pub fn next(&mut self, map: &MapView) -> Next {
        if !self.due.is_empty() {
            return Next::Blocks;
        }
        // u64::MAX: nothing was begun.
        if self.began != u64::MAX && self.upto == map.version() && self.is_told {
            return Next::Nothing;
        }
        let known = (self.began != u64::MAX).then(|| map.versions_since_beginning(self.began, self.upto));
        let Some(changed) = known.flatten() else {
            self.began = map.version();
            self.upto = 0;
            self.is_told = false;
            return Next::Anew(Message::Anew { began: self.began }.emit());
        };
        let mut due: Vec<(u64, BlockIndex)> = Vec::new();
        let (mut limit, mut is_cut) = (u64::MAX, false);
        for (index, version) in changed {
            if version >= limit {
                continue;
            }
            due.push((version, index));
            if due.len() == 2 * DUE_MAX {
                let (_, last, _) = due.select_nth_unstable(DUE_MAX);
                (limit, is_cut) = (last.0, true);
                due.truncate(DUE_MAX);
            }
        }
        due.sort_unstable();
        self.due_upto = match due.last() {
            Some((last, _)) if is_cut => *last,
            _ => map.version(),
        };
        self.due = due.into();
        Next::Blocks
    }

    /// Which blocks are next.
    pub fn due(&self) -> impl Iterator<Item = BlockIndex> + '_ {
        self.due.iter().map(|(_, index)| *index)
    }

    /// A frame with the next blocks, as many as it has room for. `blocks` must be those of [`Self::due`] in that
    /// order, at least one if any is due; they may be newer than when they were named. `newest` and `stamp`
    /// are of the map from which they are.
    pub fn blocks(&mut self, blocks: impl IntoIterator<Item = Block>, newest: u64, stamp: Stamp) -> Vec<u8> {
        let mut frame = BlocksFrame::new(self.origins);
        for block in blocks {
            let Some((version, index)) = self.due.pop_front() else { break };
            debug_assert_eq!(index, block.index);
            frame.push(&block);
            self.upto = version;
            if frame.len() >= FRAME_BYTES {
                break;
            }
        }
        if self.due.is_empty() {
            self.upto = self.due_upto;
        }
        self.is_told = true;
        frame.finish(self.upto, newest, stamp)
    }

    /// The same without origins, from a view. `stamp`: when it came to be, on the node's clock.
    pub fn blocks_of(&mut self, map: &MapView, stamp: Stamp) -> Vec<u8> {
        // No more than fits; each takes 140 bytes.
        let due: Vec<BlockIndex> = self.due().take(FRAME_BYTES / 140 + 1).collect();
        let states = map.states_of(&due);
        let block = |(index, states)| Block { index, states, origins: Vec::new() };
        self.blocks(due.into_iter().zip(states).map(block), map.version(), stamp)
    }
}
