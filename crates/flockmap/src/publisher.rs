//! What goes out: when a batch is published and how much of it, coded against what the others will hold.

mod cost;
mod packer;
mod repair;
mod sent;

use core::time::Duration;
use flockmap_codec::{Base, Batch, Codec, EncodeError, Encoder, PACKAGE_BYTES_MAX, Package};
use std::borrow::Cow;

use flockmap_grid::{BlockIndex, Changes, Fusion, Mapper, Sheet, Stamp, Stream, Which};
use flockmap_sync::{Pace, Session};

use crate::{RobotConfig, RobotCounters};
use cost::{Cost, Room};
pub use packer::Packer;
use repair::RepairDelay;
use sent::SentHistory;

/// A batch that is deferred for the budget is looked at again after so long.
const DEFER_PAUSE: Duration = Duration::from_millis(10);
/// And where there was nothing to publish, after so many.
const NOTHING_PAUSE: Duration = Duration::from_millis(50);
/// Pause between two looks at what the peers hold.
const REQUESTS_SEEN_PAUSE: Duration = Duration::from_millis(50);

/// Takes what has changed from the mapper, when and as far as the radio takes it, and makes packages of it.
pub(crate) struct Publisher {
    stream: Stream,
    codec: Codec,
    repair_delay_max_ms: u32,
    packer: Packer,
    encoder: Encoder,
    next_index: u32,
    /// What batches can refer to.
    sent: SentHistory,
    own_layer: OwnLayer,
    repair: RepairDelay,
    /// Requests taken in when the repair delay was looked at last.
    requests_seen: u64,
    requests_seen_at: Stamp,
    cost: Cost,
    /// A batch is due and waits for the budget.
    deferred: Option<Deferred>,
}

/// What the own layer is good for.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum OwnLayer {
    /// It lacks something that was published: a snapshot made of it would pass for all that was.
    Lacks,
    /// It holds all that was published, but not all that the map counts as published: the others do not hold
    /// what is published next against it.
    HasAll,
    /// It is what the others hold when all has arrived.
    IsWhole,
}

/// A batch that is due and is deferred.
#[derive(Clone, Copy)]
struct Deferred {
    since: Stamp,
    /// When to look again.
    until: Stamp,
}

impl Publisher {
    pub(crate) fn new(config: &RobotConfig, stream: Stream, now: Stamp) -> Self {
        Self {
            stream,
            codec: config.codec,
            repair_delay_max_ms: config.repair_delay_max_ms,
            packer: Packer::new(config.batch, stream, config.mapper.resolution, now),
            encoder: Encoder::new(),
            next_index: 1,
            sent: SentHistory::default(),
            own_layer: OwnLayer::IsWhole,
            repair: RepairDelay::new(config.repair_delay_max_ms),
            requests_seen: 0,
            requests_seen_at: Stamp(i64::MIN),
            cost: Cost::default(),
            deferred: None,
        }
    }

    /// What is published from now on is of another run, of which nothing is published yet.
    pub(crate) fn begin_run(&mut self, stream: Stream) {
        self.stream = stream;
        self.packer.begin_run(stream);
        self.next_index = 1;
        self.sent = SentHistory::default();
        self.repair = RepairDelay::new(self.repair_delay_max_ms);
        self.own_layer = OwnLayer::IsWhole;
    }

    /// The stream of this run.
    pub(crate) const fn stream(&self) -> Stream {
        self.stream
    }

    /// Notes what the mapper has taken in, and from where it was seen, if that is known: metres in the map.
    pub(crate) fn note_observed(&mut self, now: Stamp, stamp: Stamp, sensor: Option<[f64; 3]>) {
        self.packer.note_observed(now, stamp, sensor);
    }

    /// When to [`poll`](Self::poll) again, if nothing more changes.
    pub(crate) fn poll_timeout(&self, mapper: &Mapper) -> Option<Stamp> {
        let due = self.packer.deadline(mapper)?;
        Some(self.deferred.map_or(due, |deferred| due.max(deferred.until)))
    }

    /// The batch that is due, unless own packages still wait for the radio's budget: then what changes is
    /// merged in the map, which costs less than packages that wait, and nothing builds on them. Of what is
    /// due, as much as the radio takes.
    pub(crate) fn poll(
        &mut self,
        now: Stamp,
        pace: impl FnOnce() -> Pace,
        mapper: &mut Mapper,
        fusion: &Fusion,
        counters: &mut RobotCounters,
    ) -> Option<(Batch, Changes)> {
        if self.packer.deadline(mapper).is_none_or(|due| due > now) {
            return None;
        }
        let (room, waits) = match pace() {
            // What waited and is known better by a team-mate stays, also while nobody seems to listen.
            Pace::Free if self.packer.is_behind() => (Room::UNLIMITED, false),
            Pace::Free => {
                self.deferred = None;
                return self.packer.close_due(now, mapper);
            }
            Pace::AllSent { bytes_per_s } => (self.cost.room(bytes_per_s), false),
            Pace::Waiting { bytes_per_s } => (self.cost.room(bytes_per_s), true),
        };
        let since = self.deferred.map_or(now, |deferred| deferred.since);
        if waits && now.since(since) < room.defer_max {
            counters.batches_deferred += u64::from(self.deferred.is_none());
            self.deferred = Some(Deferred { since, until: now.plus(DEFER_PAUSE) });
            if now.since(since) >= self.packer.period() {
                self.packer.note_late();
            }
            return None;
        }
        self.deferred = None;
        let submap = mapper.submap();
        let believed = |block| fusion.occupied_in_view(submap, block);
        let closed = self.packer.close_part(now, mapper, room, believed);
        if closed.is_none() {
            // There may be nothing but what a team-mate knows better.
            self.deferred = Some(Deferred { since: now, until: now.plus(NOTHING_PAUSE) });
        } else {
            counters.batches_in_parts +=
                u64::from(self.packer.deadline(mapper).is_some_and(|due| due <= now));
        }
        closed
    }

    /// The batch with whatever has changed, due or not.
    pub(crate) fn flush(&mut self, now: Stamp, mapper: &mut Mapper) -> Option<(Batch, Changes)> {
        self.packer.close(now, mapper)
    }

    /// A batch for what is to be said of submaps.
    pub(crate) fn batch_of_records(&mut self) -> Batch {
        self.packer.batch_of_records()
    }

    /// The longest that a batch with changes waits if nothing defers it.
    pub(crate) const fn period(&self) -> Duration {
        self.packer.period()
    }

    /// The packages of a batch, coded against what the others will hold; without (`is_independent`), if some of them
    /// do not hold it any more, or repair is slow.
    pub(crate) fn encode(
        &mut self,
        now: Stamp,
        batch: &Batch,
        changes: &Changes,
        is_independent: bool,
        fusion: &Fusion,
        counters: &mut RobotCounters,
    ) -> Result<Vec<Package>, EncodeError> {
        let is_independent = is_independent || self.own_layer != OwnLayer::IsWhole || self.repair.is_slow();
        counters.batches_independent += u64::from(is_independent && self.codec == Codec::Flock);
        let layer = fusion.layer(self.stream).filter(|_| !is_independent);
        let base = Base { layer, batches: self.sent.batches(), readers: self.sent.readers() };
        let sheets = by_sheet(batch, changes);
        let mut encode = |base: &Base<'_>| {
            let (mut all, mut first) = (Vec::new(), self.next_index);
            for (batch, changes) in &sheets {
                let (codec, base) = (self.codec, Some(base));
                let packages = self.encoder.encode_batch_against(
                    codec,
                    batch,
                    first,
                    changes,
                    base,
                    PACKAGE_BYTES_MAX,
                )?;
                first = first.saturating_add(packages.len() as u32);
                all.extend(packages);
            }
            Ok(all)
        };
        let coded = match encode(&base) {
            // Something was dropped there, which others hold; or the own layer holds something as new, which no batch
            // should meet. It can be published all the same.
            Err(EncodeError::BaseSuperseded(_)) => {
                counters.batches_independent += 1;
                encode(&Base { layer: None, ..base })
            }
            coded => coded,
        };
        // Else the map goes on without these changes, and what is published next counts on them.
        let packages = coded.inspect_err(|_| self.own_layer = self.own_layer.min(OwnLayer::HasAll))?;
        self.next_index += packages.len() as u32;
        self.sent.note_batch(&packages);
        self.cost.note_batch(changes, &packages);
        self.repair.note_batch(now, self.next_index - 1);
        Ok(packages)
    }

    /// Notes that the own layer had no room for a batch that was published. Only a snapshot of this stream
    /// would lack it; but the others hold more from now on than the own layer, so that nothing can be coded
    /// against it any more.
    pub(crate) const fn note_own_layer_full(&mut self) {
        self.own_layer = OwnLayer::Lacks;
    }

    /// Whether all that was published is in the own layer.
    pub(crate) fn own_layer_has_all(&self) -> bool {
        self.own_layer >= OwnLayer::HasAll
    }

    /// Takes in what the peers hold, after a datagram. O(peers), at most twenty times a second.
    pub(crate) fn note_requests(&mut self, now: Stamp, session: &Session) {
        let requests = session.counters().requests_in.datagrams;
        if requests != self.requests_seen && now.since(self.requests_seen_at) >= REQUESTS_SEEN_PAUSE {
            (self.requests_seen, self.requests_seen_at) = (requests, now);
            self.repair.note_received(session.own_received_by_peers());
        }
    }

    /// Voxels that have changed and are still to be published.
    pub(crate) fn unpublished(&self, mapper: &Mapper, fusion: &Fusion) -> usize {
        match self.packer.is_behind() {
            true => mapper.count_changes(Which::All, |block| fusion.occupied_in_view(mapper.submap(), block)),
            false => mapper.pending(),
        }
    }
}

/// The changes of a batch on each sheet, with where the sensor was as seen from there: on others than the first, and of
/// submaps, there are few.
fn by_sheet<'a>(batch: &Batch, changes: &'a Changes) -> Vec<(Batch, Cow<'a, Changes>)> {
    let sheet_of = |(index, _): &(BlockIndex, _)| Sheet::of(*index);
    if changes.blocks().iter().all(|block| sheet_of(block) == Some(Sheet::FIRST)) {
        return vec![(*batch, Cow::Borrowed(changes))];
    }
    let mut blocks = changes.blocks().to_vec();
    blocks.sort_by_key(sheet_of);
    let sheets = blocks.chunk_by(|a, b| sheet_of(a) == sheet_of(b)).map(|blocks| {
        let middle = sheet_of(&blocks[0]).map_or([0; 3], Sheet::middle);
        let sensor =
            core::array::from_fn(|axis| batch.sensor[axis].saturating_add(middle[axis] * BLOCK_SIXTEENTHS));
        (Batch { sensor, ..*batch }, Cow::Owned(Changes::from_blocks(blocks.to_vec())))
    });
    sheets.collect()
}

/// Sixteenths of a voxel along a side of a block.
const BLOCK_SIXTEENTHS: i32 = 16 * 8;
