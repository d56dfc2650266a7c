//! The history of a map: what it was at each moment, in memory.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};

use flockmap_feed::{Block, Link, NodeCounts, RobotPose, RunSubmaps};
use flockmap_grid::{BlockIndex, MapView, Plane, Resolution, RobotId, Stamp, StateBlock};
use tokio::sync::watch;

use crate::Series;
use crate::serve::Identity;

/// Bytes that a recording may take if nothing else is said.
const BYTES_MAX: usize = 1 << 30;

/// A block at one moment, with what finds it. Origins of several robots come on top.
const BLOCK_BYTES: usize = 176;
/// A block that was seen: its place, and the list of its moments.
const SEEN_BYTES: usize = 96;

/// What changed from one moment to the next.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Step {
    /// When, on the clock of the recording. Stamps rise.
    pub stamp: Stamp,
    /// Blocks that changed, as they are now; with who saw them last, if it is known.
    pub blocks: Vec<Block>,
    /// Where robots are.
    pub poses: Vec<RobotPose>,
    /// How robots are heard.
    pub links: Vec<Link>,
    /// How submaps lie in the map.
    pub submaps: Vec<RunSubmaps>,
    /// What was counted.
    pub counters: Vec<(String, u64)>,
}

/// The history of a robot's map, that grows or is complete. As a [`Source`](crate::Source) it is played by each browser by itself.
///
/// Each block has the moments at which it changed, so that any time is as near as any other: to go from one to
/// another costs as much as there are blocks that changed in between. Where the recording takes more than it may,
/// every second moment is left out: the map at those that remain stays as it was.
pub struct Recording {
    identity: Identity,
    /// That there have been.
    players: AtomicU64,
    bytes_max: usize,
    series: Option<Arc<Series>>,
    kept: RwLock<Kept>,
    /// Moments, and whether more will come.
    grown: watch::Sender<(usize, bool)>,
}

#[derive(Default)]
struct Kept {
    moments: Vec<Moment>,
    /// In the order in which they were seen first.
    seen: Vec<Seen>,
    numbers: HashMap<BlockIndex, u32>,
    bytes: usize,
}

/// A moment, without its map.
#[derive(Clone)]
struct Moment {
    stamp: Stamp,
    /// Numbers of the blocks that changed.
    changed: Vec<u32>,
    beside: Beside,
}

/// What there is beside the map.
#[derive(Clone, Default)]
pub(crate) struct Beside {
    pub(crate) poses: Arc<Vec<RobotPose>>,
    pub(crate) links: Arc<Vec<Link>>,
    /// The same as of the moment before if nothing has changed.
    pub(crate) submaps: Arc<Vec<RunSubmaps>>,
    pub(crate) counts: Arc<NodeCounts>,
}

struct Seen {
    index: BlockIndex,
    /// From which moment on it was so; ascending.
    states: Vec<(u32, StateBlock, Origins)>,
}

/// Who saw a block: nobody knows, one robot all of it, or several.
#[derive(Clone, PartialEq)]
enum Origins {
    Unknown,
    One(RobotId),
    Several(Box<[(RobotId, Plane)]>),
}

impl Recording {
    /// Nothing yet. `frame` is the name of the frame of the map.
    ///
    /// # Errors
    /// If the system gives no random bytes.
    pub fn new(robot: RobotId, name: &str, resolution: Resolution, frame: &str) -> std::io::Result<Self> {
        let mut feed = [0; 8];
        getrandom::fill(&mut feed).map_err(std::io::Error::other)?;
        let identity = Identity {
            robot,
            resolution,
            // 0 means nothing.
            feed: u64::from_le_bytes(feed).max(1),
            name: name.to_owned(),
            frame: frame.to_owned(),
        };
        Ok(Self {
            identity,
            players: AtomicU64::new(0),
            bytes_max: BYTES_MAX,
            series: None,
            kept: RwLock::default(),
            grown: watch::channel((0, true)).0,
        })
    }

    /// The same with another limit of the bytes that it takes. Default 2³⁰.
    #[must_use]
    pub fn with_bytes_max(self, bytes_max: usize) -> Self {
        Self { bytes_max, ..self }
    }

    /// The same with bytes of each second.
    #[must_use]
    pub fn with_series(self, series: Arc<Series>) -> Self {
        Self { series: Some(series), ..self }
    }

    /// Adds a moment. One that is not after the last one counts as part of it.
    pub fn push(&self, step: Step) {
        let moments = {
            let mut kept = self.kept.write().unwrap_or_else(PoisonError::into_inner);
            kept.push(step);
            while kept.bytes > self.bytes_max && kept.moments.len() > 1 {
                kept.thin();
            }
            kept.moments.len()
        };
        self.grown.send_replace((moments, true));
    }

    /// Nothing more will come.
    pub fn finish(&self) {
        self.grown.send_modify(|(_, grows)| *grows = false);
    }

    /// How many moments there are; of a long recording fewer than were added.
    pub fn moments(&self) -> usize {
        self.read(|kept| kept.moments.len())
    }

    /// The map as it was at a moment. O(blocks).
    pub fn map_at(&self, moment: usize) -> MapView {
        let mut map = MapView::new(self.identity.resolution);
        self.change(&mut map, None, moment);
        map
    }

    fn read<T>(&self, get: impl FnOnce(&Kept) -> T) -> T {
        get(&self.kept.read().unwrap_or_else(PoisonError::into_inner))
    }

    // For players.

    pub(crate) fn identity(&self) -> &Identity {
        &self.identity
    }

    /// What a further player says of itself. Each has a feed of its own, since versions count in the player's map:
    /// what a reader has of one is nothing to another.
    pub(crate) fn player_identity(&self) -> Arc<Identity> {
        let number = self.players.fetch_add(1, Ordering::Relaxed);
        Arc::new(Identity { feed: self.identity.feed.wrapping_add(number).max(1), ..self.identity.clone() })
    }

    pub(crate) fn series(&self) -> Option<Arc<Series>> {
        self.series.clone()
    }

    pub(crate) fn grown(&self) -> watch::Receiver<(usize, bool)> {
        self.grown.subscribe()
    }

    /// The times of the first and of the last moment.
    pub(crate) fn span(&self) -> Option<(Stamp, Stamp)> {
        self.read(|kept| Some((kept.moments.first()?.stamp, kept.moments.last()?.stamp)))
    }

    /// The last moment that is not after a time; the first one if all are.
    pub(crate) fn moment_at(&self, time: Stamp) -> usize {
        self.read(|kept| kept.moments.partition_point(|moment| moment.stamp <= time).saturating_sub(1))
    }

    pub(crate) fn stamp_of(&self, moment: usize) -> Option<Stamp> {
        self.read(|kept| kept.moments.get(moment).map(|moment| moment.stamp))
    }

    pub(crate) fn beside_at(&self, moment: usize) -> Beside {
        self.read(|kept| kept.moments.get(moment).map(|moment| moment.beside.clone()).unwrap_or_default())
    }

    /// Makes the map of one moment that of another one. `from` is `None` for a map of nothing.
    pub(crate) fn change(&self, map: &mut MapView, from: Option<usize>, to: usize) {
        self.read(|kept| {
            let [low, high] = from.map_or([0, to + 1], |from| [from.min(to) + 1, from.max(to) + 1]);
            let moments = kept.moments.get(low..high.min(kept.moments.len())).unwrap_or_default();
            let mut changed: Vec<u32> = moments.iter().flat_map(|moment| &moment.changed).copied().collect();
            changed.sort_unstable();
            changed.dedup();
            for seen in changed.iter().filter_map(|number| kept.seen.get(*number as usize)) {
                map.set_block(seen.index, &seen.at(to).map(|(states, _)| *states).unwrap_or_default());
            }
        });
    }

    /// A block as it was, with who saw it.
    pub(crate) fn block_at(&self, moment: usize, index: BlockIndex) -> Block {
        let nothing = Block { index, states: StateBlock::default(), origins: Vec::new() };
        self.read(|kept| {
            let seen = kept.numbers.get(&index).and_then(|number| kept.seen.get(*number as usize));
            let Some((states, origins)) = seen.and_then(|seen| seen.at(moment)) else { return nothing };
            let origins = match origins {
                // The feed has somebody for each known voxel: the robot whose map it is told it.
                Origins::Unknown if states.is_empty() => Vec::new(),
                Origins::Unknown => vec![(self.identity.robot, states.known())],
                Origins::One(robot) => vec![(*robot, states.known())],
                Origins::Several(several) => several.to_vec(),
            };
            Block { index, states: *states, origins }
        })
    }
}

impl Kept {
    fn push(&mut self, step: Step) {
        let Step { stamp, blocks, poses, links, submaps, counters } = step;
        let (poses, links) = (Arc::new(poses), Arc::new(links));
        let before = self.moments.last().map(|last| &last.beside.submaps);
        let submaps = match before {
            Some(before) if **before == submaps => Arc::clone(before),
            _ => Arc::new(RunSubmaps::within_limits(submaps)),
        };
        let counts = Arc::new(NodeCounts { now: stamp, counters });
        let beside = Beside { poses, links, submaps, counts };
        match self.moments.last_mut() {
            Some(last) if last.stamp >= stamp => last.beside = beside,
            _ => self.moments.push(Moment { stamp, changed: Vec::new(), beside }),
        }
        let moment = self.moments.len() - 1;
        for block in blocks {
            self.push_block(moment as u32, block);
        }
        self.bytes += beside_bytes(&self.moments[moment.saturating_sub(1)..]);
    }

    fn push_block(&mut self, moment: u32, block: Block) {
        let Block { index, states, origins } = block;
        let number = match self.numbers.entry(index) {
            Entry::Occupied(entry) => *entry.get(),
            Entry::Vacant(entry) => {
                self.bytes += SEEN_BYTES;
                self.seen.push(Seen { index, states: Vec::new() });
                *entry.insert(self.seen.len() as u32 - 1)
            }
        };
        let origins = match &origins[..] {
            [] => Origins::Unknown,
            [(robot, _)] => Origins::One(*robot),
            several => Origins::Several(several.into()),
        };
        let seen = &mut self.seen[number as usize];
        match seen.states.last_mut() {
            Some(last) if last.0 == moment => (last.1, last.2) = (states, origins),
            _ => {
                self.bytes += BLOCK_BYTES + origins.bytes();
                seen.states.push((moment, states, origins));
                self.moments[moment as usize].changed.push(number);
            }
        }
    }

    /// Leaves every second moment out: what changed in it changed in the one after it.
    fn thin(&mut self) {
        let mut moments = std::mem::take(&mut self.moments).into_iter();
        while let Some(mut first) = moments.next() {
            if let Some(second) = moments.next() {
                first.changed.extend(second.changed);
                first.changed.sort_unstable();
                first.changed.dedup();
                (first.stamp, first.beside) = (second.stamp, second.beside);
            }
            first.changed.shrink_to_fit();
            self.moments.push(first);
        }
        let upto = |moment: usize| &self.moments[moment.saturating_sub(1)..=moment];
        self.bytes = (0..self.moments.len()).map(|moment| beside_bytes(upto(moment))).sum();
        for seen in &mut self.seen {
            seen.states.iter_mut().for_each(|(moment, ..)| *moment /= 2);
            // Of two of the same moment the later one counts.
            seen.states.reverse();
            seen.states.dedup_by_key(|(moment, ..)| *moment);
            seen.states.reverse();
            seen.states.shrink_to_fit();
            let bytes = |origins: &Origins| BLOCK_BYTES + origins.bytes();
            self.bytes += SEEN_BYTES + seen.states.iter().map(|(.., origins)| bytes(origins)).sum::<usize>();
        }
    }
}

/// Bytes of what is beside the map at the last one of one or two moments, without what it shares with the one before.
fn beside_bytes(moments: &[Moment]) -> usize {
    let Some((last, before)) = moments.split_last() else { return 0 };
    let Beside { poses, submaps, .. } = &last.beside;
    let is_shared = before.last().is_some_and(|before| Arc::ptr_eq(&before.beside.submaps, submaps));
    let of_runs = submaps.iter().map(|run| size_of_val(run) + size_of_val(&*run.poses));
    400 + 75 * poses.len() + if is_shared { 0 } else { of_runs.sum() }
}

impl Seen {
    fn at(&self, moment: usize) -> Option<(&StateBlock, &Origins)> {
        let after = self.states.partition_point(|(from, ..)| *from as usize <= moment);
        let (_, states, origins) = self.states.get(after.checked_sub(1)?)?;
        Some((states, origins))
    }
}

impl Origins {
    fn bytes(&self) -> usize {
        match self {
            Self::Unknown | Self::One(_) => 0,
            Self::Several(several) => size_of_val(&**several),
        }
    }
}

#[cfg(test)]
#[path = "recording_tests.rs"]
mod tests;
