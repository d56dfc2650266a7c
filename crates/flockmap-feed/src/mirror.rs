//! The reader's side: bytes in, a map out.

use flockmap_grid::{BlockIndex, MapView, Resolution, RobotId, Stamp, StateBlock, Voxel};

use crate::message::{
    Block, Blocks, FRAME_BYTES_MAX, Have, Link, Message, NodeCounts, NodeHello, Playback, ReaderHello,
    RobotPose, RunSubmaps, SeenScan,
};
use crate::origins::Origins;
use crate::{FeedError, Splitter};

/// Blocks that a mirror holds at most if nothing else is said: 537 million voxels.
const BLOCKS_MAX: usize = 1 << 20;

/// What a mirror is to hold.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct MirrorOptions {
    /// Whether to ask who saw each voxel last.
    pub origins: bool,
    /// Whether to ask how robots are heard.
    pub links: bool,
    /// Whether to ask for what the sensor sees.
    pub scans: bool,
    /// Whether to ask how submaps lie: 1 MB at most.
    pub submaps: bool,
    /// Most blocks of 8³ voxels. A block takes 350 bytes, and up to 1.1 kB more with origins; while a new map
    /// comes in place of an old one, both are there. Default 2²⁰, 365 MB.
    pub blocks_max: usize,
}

impl Default for MirrorOptions {
    fn default() -> Self {
        Self { origins: false, links: false, scans: false, submaps: false, blocks_max: BLOCKS_MAX }
    }
}

/// What a frame has done.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[non_exhaustive]
pub enum Event {
    /// The node said who it is.
    Hello,
    /// The map begins anew. [`Mirror::map`] stays as it is until the new one is complete.
    Anew,
    /// So many blocks came.
    Blocks(usize),
    /// Where robots are: [`Mirror::robots`].
    Poses,
    /// What was counted: [`Mirror::counts`].
    Counters,
    /// How robots are heard: [`Mirror::links`].
    Links,
    /// What the sensor sees: [`Mirror::scan`].
    Scan,
    /// Which time of a recording this is: [`Mirror::playback`].
    Playback,
    /// How submaps lie: [`Mirror::submaps`].
    Submaps,
    /// The node ends the feed: [`Mirror::end`] says why.
    End,
    /// A frame of a kind that is not known here.
    Unknown(u8),
}

/// The map of a running node, kept up to date by the bytes of its feed. Knows no sockets and no clock; made
/// once, and connected as often as need be: it says what it has, and goes on from there.
///
/// At each moment every block is as it was in the node's map at some moment not long ago. Once
/// [`Self::is_complete`], the whole is the node's map as it was at [`Self::stamp`].
#[derive(Debug)]
pub struct Mirror {
    options: MirrorOptions,
    splitter: Splitter,
    /// Of the last connection.
    node: Option<NodeHello>,
    /// Has come on this connection.
    is_greeted: bool,
    shown: Option<Kept>,
    /// A new map, which is not complete. It will be shown.
    coming: Option<Kept>,
    /// What there is of the coming map, else of the one that is shown.
    have: Option<Have>,
    newest: u64,
    stamp: Stamp,
    robots: Vec<RobotPose>,
    counts: NodeCounts,
    links: Vec<Link>,
    scan: Option<SeenScan>,
    playback: Option<Playback>,
    submaps: Vec<RunSubmaps>,
    end: Option<String>,
}

#[derive(Debug)]
struct Kept {
    map: MapView,
    origins: Origins,
}

impl Default for Mirror {
    fn default() -> Self {
        Self::new(MirrorOptions::default())
    }
}

impl Mirror {
    /// One that has nothing.
    pub const fn new(options: MirrorOptions) -> Self {
        Self {
            options,
            splitter: Splitter::new(FRAME_BYTES_MAX),
            node: None,
            is_greeted: false,
            shown: None,
            coming: None,
            have: None,
            newest: 0,
            stamp: Stamp(0),
            robots: Vec::new(),
            counts: NodeCounts { now: Stamp(0), counters: Vec::new() },
            links: Vec::new(),
            scan: None,
            playback: None,
            submaps: Vec::new(),
            end: None,
        }
    }

    /// A connection begins: what to send first, and all there is to send. Half a frame of the one before is
    /// forgotten.
    pub fn connect(&mut self) -> Vec<u8> {
        self.splitter = Splitter::new(FRAME_BYTES_MAX);
        self.is_greeted = false;
        self.end = None;
        let MirrorOptions { origins, links, scans, submaps, .. } = self.options;
        ReaderHello { origins, no_map: false, links, scans, submaps, have: self.have }.emit()
    }

    /// Takes bytes from the front of `bytes` up to the end of a frame, and says what that has done; `None`
    /// where all was taken and more is needed. Call it again until then.
    ///
    /// # Errors
    /// [`FeedError`]: this connection is of no more use, and what came before the frame stays.
    pub fn push(&mut self, bytes: &mut &[u8]) -> Result<Option<Event>, FeedError> {
        let Some((kind, body)) = self.splitter.next(bytes)? else { return Ok(None) };
        let message = Message::parse(kind, body)?;
        self.take(message).map(Some)
    }

    fn take(&mut self, message: Message) -> Result<Event, FeedError> {
        let greeted = |kind| if self.is_greeted { Ok(()) } else { Err(FeedError::OutOfOrder(kind)) };
        Ok(match message {
            Message::Hello(hello) => {
                self.take_hello(hello)?;
                Event::Hello
            }
            Message::Anew { began } => {
                greeted("begin-anew")?;
                self.begin_anew(began);
                Event::Anew
            }
            Message::Blocks(blocks) => {
                greeted("blocks")?;
                let count = blocks.blocks.len();
                self.take_blocks(blocks)?;
                Event::Blocks(count)
            }
            Message::Poses(robots) => {
                greeted("poses")?;
                self.robots = robots;
                Event::Poses
            }
            Message::Counters(counts) => {
                greeted("counters")?;
                self.counts = counts;
                Event::Counters
            }
            // Also in place of a hello: no place for this reader.
            Message::End(reason) => {
                self.end = Some(reason);
                Event::End
            }
            Message::Links(links) => {
                greeted("links")?;
                self.links = links;
                Event::Links
            }
            Message::Scan(scan) => {
                greeted("scan")?;
                self.scan = Some(scan);
                Event::Scan
            }
            Message::Playback(playback) => {
                greeted("playback")?;
                self.playback = Some(playback);
                Event::Playback
            }
            Message::Submaps(submaps) => {
                greeted("submaps")?;
                self.submaps = submaps;
                Event::Submaps
            }
            Message::Unknown(kind) => Event::Unknown(kind),
        })
    }

    fn take_hello(&mut self, hello: NodeHello) -> Result<(), FeedError> {
        if self.is_greeted {
            return Err(FeedError::OutOfOrder("hello"));
        }
        if let Some(own) = &self.node
            && (own.robot, own.resolution) != (hello.robot, hello.resolution)
        {
            return Err(FeedError::AnotherMap {
                robot: hello.robot,
                resolution: hello.resolution,
                own_robot: own.robot,
                own_resolution: own.resolution,
            });
        }
        if !hello.goes_on {
            self.have = None;
        }
        if self.shown.is_none() {
            self.shown = Some(Kept::new(hello.resolution));
        }
        self.is_greeted = true;
        self.node = Some(hello);
        Ok(())
    }

    fn begin_anew(&mut self, began: u64) {
        let (Some(node), Some(shown)) = (&self.node, &self.shown) else { return };
        // Where nothing is shown, there is nothing to keep.
        self.coming = (shown.map.block_count() > 0).then(|| Kept::new(node.resolution));
        self.have = Some(Have { feed: node.feed, began, upto: 0 });
        self.newest = began;
    }

    fn take_blocks(&mut self, blocks: Blocks) -> Result<(), FeedError> {
        let Blocks { upto, newest, stamp, blocks, .. } = blocks;
        let (Some(have), Some(kept)) = (&mut self.have, self.coming.as_mut().or(self.shown.as_mut())) else {
            return Err(FeedError::OutOfOrder("blocks"));
        };
        if upto < have.upto || newest < upto {
            return Err(FeedError::Versions { upto, newest, before: have.upto });
        }
        let is_more = |block: &&Block| !block.states.is_empty() && kept.map.block(block.index).is_none();
        let more = blocks.iter().filter(is_more).count();
        if kept.map.block_count() + more > self.options.blocks_max {
            return Err(FeedError::BlocksFull(self.options.blocks_max));
        }
        for block in &blocks {
            kept.map.set_block(block.index, &block.states);
            kept.origins.set(block.index, &block.origins);
        }
        have.upto = upto;
        (self.newest, self.stamp) = (newest, stamp);
        if upto == newest
            && let (Some(shown), Some(coming)) = (&mut self.shown, self.coming.take())
        {
            shown.become_as(coming);
        }
        Ok(())
    }

    // Queries.

    /// The map, with the same queries as in the node's process; `None` before the first hello. Its versions are
    /// the mirror's own: they go on rising when the node restarts, and
    /// [`changed_since`](MapView::changed_since) then names what differs. Clone it for a picture that stands
    /// still, in O(1).
    pub fn map(&self) -> Option<&MapView> {
        self.shown.as_ref().map(|kept| &kept.map)
    }

    /// Who saw a voxel last, as far as was asked for: [`MirrorOptions::origins`]. `None` if it is Unknown. The
    /// states of Unknown blocks have nobody.
    pub fn origin(&self, voxel: Voxel) -> Option<RobotId> {
        self.shown.as_ref()?.origins.get(voxel)
    }

    /// Whether the map is the node's as it was at [`Self::stamp`], and not one in which parts are older.
    pub fn is_complete(&self) -> bool {
        self.coming.is_none() && self.have.is_some() && self.behind() == 0
    }

    /// By how many changes of a block the map is behind the newest that is known of; of a map that begins
    /// anew, at most.
    pub fn behind(&self) -> u64 {
        self.newest - self.have.map_or(0, |have| have.upto)
    }

    /// When the node's map came to its newest version that is known of, on the node's clock.
    pub const fn stamp(&self) -> Stamp {
        self.stamp
    }

    /// The newest version of the node's map that is known of. Counts within one run of the node.
    pub const fn newest(&self) -> u64 {
        self.newest
    }

    /// What there is of the node's map: what the next hello says.
    pub const fn have(&self) -> Option<Have> {
        self.have
    }

    /// What the node said of itself last.
    pub const fn node(&self) -> Option<&NodeHello> {
        self.node.as_ref()
    }

    /// Where robots are, as said last.
    pub fn robots(&self) -> &[RobotPose] {
        &self.robots
    }

    /// What the node has counted, as said last; about once a second.
    pub const fn counts(&self) -> &NodeCounts {
        &self.counts
    }

    /// How the other robots are heard, as said last, if it was asked for: [`MirrorOptions::links`].
    pub fn links(&self) -> &[Link] {
        &self.links
    }

    /// What the sensor saw newest, thinned, if it was asked for: [`MirrorOptions::scans`].
    pub const fn scan(&self) -> Option<&SeenScan> {
        self.scan.as_ref()
    }

    /// Which submaps each run has, and how they lie in the map, as said last, if it was asked for:
    /// [`MirrorOptions::submaps`]. Ascending by robot and run. Of a node that knows of no submaps: nothing.
    pub fn submaps(&self) -> &[RunSubmaps] {
        &self.submaps
    }

    /// Which time of a recording the map is of, where one is played.
    pub const fn playback(&self) -> Option<&Playback> {
        self.playback.as_ref()
    }

    /// Why the node ended this connection, if it did.
    pub fn end(&self) -> Option<&str> {
        self.end.as_deref()
    }
}

impl Kept {
    fn new(resolution: Resolution) -> Self {
        Self { map: MapView::new(resolution), origins: Origins::default() }
    }

    /// Takes another map over, such that what differs counts as changed. O(blocks of both).
    fn become_as(&mut self, other: Self) {
        let gone: Vec<BlockIndex> = self.map.blocks().map(|(index, _)| index).collect();
        for index in gone.into_iter().filter(|index| other.map.block(*index).is_none()) {
            self.map.set_block(index, &StateBlock::default());
        }
        other.map.blocks().for_each(|(index, states)| self.map.set_block(index, &states));
        self.origins = other.origins;
    }
}
