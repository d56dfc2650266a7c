//! One robot: mapper, packer, codec, session, layers and fusion joined. The way of the data, both directions.

mod begin;
mod publish;
mod receive;
mod restore;

pub use restore::RestoreError;

use publish::{Held, believed_occupied};

use std::collections::{BTreeMap, BTreeSet};

use flockmap_codec::{Decoder, Encoder, Span};
use flockmap_grid::{
    Fusion, MapView, Mapper, Pose, PoseError, RobotId, Scan, ScanReport, Sphere, Stamp, Stream, Which,
};
use flockmap_sync::wire::DatagramError;
use flockmap_sync::{Path, Session, Transmit};

use crate::cost::Cost;
use crate::events::Events;
use crate::repair::RepairDelay;
use crate::sent::Sent;
use crate::tiles::Tiles;
use crate::waiting::Waiting;
use crate::{Event, Packer, RobotConfig, RobotCounters, RobotError};

/// Team-mates whose positions are kept.
const TEAMMATES_MAX: usize = 1_024;

/// A robot of the swarm: keeps its own map from its scans, sends what changed, repairs what was lost, and fuses
/// what the others saw. Knows no sockets, threads or clocks; it can be driven by any runtime, or none.
///
/// After every input ([`insert_scan`](Self::insert_scan), [`handle_datagram`](Self::handle_datagram),
/// [`handle_timeout`](Self::handle_timeout)) send all that [`poll_transmit`](Self::poll_transmit) gives, then wait for
/// the next scan, the next datagram or [`poll_timeout`](Self::poll_timeout), whichever is first.
pub struct Robot {
    config: RobotConfig,
    own: Stream,
    /// The newest time that came with an input.
    now: Stamp,
    mapper: Mapper,
    packer: Packer,
    encoder: Encoder,
    decoder: Decoder,
    session: Session,
    fusion: Fusion,
    teammates: BTreeMap<RobotId, Teammate>,
    next_index: u32,
    /// What cycles can refer to.
    sent: Sent,
    /// The own layer is what the others hold when all has arrived.
    own_layer_is_whole: bool,
    /// The own layer holds all that was published: a present state of it lacks nothing.
    own_layer_has_all: bool,
    /// Packages that were damaged once already.
    damaged: BTreeSet<(Stream, u32)>,
    repair: RepairDelay,
    cost: Cost,
    /// A cycle is due and waits for the budget.
    held: Option<Held>,
    waiting: Waiting,
    tiles: Tiles,
    /// Requests taken in when the repair delay was looked at last.
    requests_seen: u64,
    events: Events,
    counters: RobotCounters,
}

struct Teammate {
    position: [f64; 3],
    seen: Stamp,
}

impl Robot {
    /// A robot with an empty map. `now` is the time on its clock. Every later `now` must not be before it; where one is, time is taken to
    /// stand still.
    ///
    /// # Errors
    /// [`RobotError`] names the option that cannot work.
    pub fn new(config: RobotConfig, now: Stamp) -> Result<Self, RobotError> {
        for (option, is_zero) in [
            ("cycle.changes_max", config.cycle.changes_max == 0),
            ("cycle.t_l_ms", config.cycle.t_l_ms == 0),
            ("cycle.t_l_occupied_ms", config.cycle.t_l_occupied_ms == Some(0)),
        ] {
            if is_zero {
                return Err(RobotError::Cycle { option });
            }
        }
        let own = Stream { origin: config.id, epoch: config.epoch };
        let resolution = config.mapper.resolution;
        Ok(Self {
            own,
            now,
            mapper: Mapper::new(config.mapper.clone())?,
            packer: Packer::new(config.cycle, own, resolution, now),
            encoder: Encoder::new(),
            decoder: Decoder::new(),
            session: Session::new(own, config.session.clone(), config.seed)?,
            fusion: Fusion::new(own, resolution, config.fusion.clone()),
            teammates: BTreeMap::new(),
            next_index: 1,
            sent: Sent::default(),
            own_layer_is_whole: true,
            own_layer_has_all: true,
            damaged: BTreeSet::new(),
            repair: RepairDelay::new(config.repair_delay_max_ms),
            cost: Cost::default(),
            held: None,
            waiting: Waiting::default(),
            tiles: Tiles::new(config.session.transfers_max, config.fusion.layer_bytes_max),
            requests_seen: 0,
            events: Events::default(),
            counters: RobotCounters::default(),
            config,
        })
    }

    // Inputs.

    /// Takes in a scan made at `T_map_sensor`. Only maps: a cycle that is due is closed by the next
    /// [`handle_timeout`](Self::handle_timeout), and [`poll_timeout`](Self::poll_timeout) says so.
    ///
    /// No scan is made after `now`: one with a stamp ahead of it counts as made now, in the map and for the others, and is counted
    /// ([`RobotCounters::scans_ahead`]).
    ///
    /// # Errors
    /// [`PoseError`] if the pose is none or lies beyond the grid; nothing is changed then.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert_scan(
        &mut self,
        now: Stamp,
        scan: &Scan,
        T_map_sensor: &Pose,
    ) -> Result<ScanReport, PoseError> {
        T_map_sensor.check(self.config.mapper.resolution)?;
        let now = self.advance(now);
        let stamp = scan.stamp.min(now);
        let timeout = 1_000 * i64::from(self.config.teammate_timeout_ms);
        let radius = self.config.teammate_radius_m;
        let masks = self.teammates.values_mut().filter_map(|teammate| {
            // Else it would not be taken for an obstacle for as long as its clock is ahead.
            teammate.seen = teammate.seen.min(now);
            let is_fresh = now.micros_since(teammate.seen) <= timeout;
            is_fresh.then_some(Sphere { centre: teammate.position, radius })
        });
        let masks: Vec<Sphere> = masks.collect();
        let report = self.mapper.insert_at(stamp, scan, T_map_sensor, &masks);
        self.packer.note_scan(stamp, T_map_sensor);
        self.fusion.own_scan(&self.mapper, &report);
        self.counters.scans += 1;
        self.counters.scans_ahead += u64::from(scan.stamp > now);
        self.counters.points_ignored += report.ignored as u64;
        self.counters.points_masked += report.masked as u64;
        self.counters.blocks_forgotten += report.forgotten.len() as u64;
        Ok(report)
    }

    /// Lets time pass: closes the cycle that is due, and does what the session has to do.
    pub fn handle_timeout(&mut self, now: Stamp) {
        let now = self.advance(now);
        self.session.handle_timeout(now);
        while let Some((cycle, changes)) = self.close_due(now) {
            self.publish(now, cycle, changes);
        }
        self.answer_session(now);
    }

    /// Takes in a datagram: what it brings is decoded, merged and fused before this returns.
    ///
    /// # Errors
    /// What was wrong with it. It is counted already and needs no action.
    pub fn handle_datagram(&mut self, now: Stamp, bytes: &[u8]) -> Result<(), DatagramError> {
        let now = self.advance(now);
        let result = self.session.handle_datagram(now, bytes);
        self.after_datagram(now);
        result
    }

    /// The same for a driver that sends to addresses: `path` stands for the one that it was received from. By unicast nothing but a
    /// challenge goes out on a path before an answer came back through it; [`Transmit::path`] tells where datagrams go.
    ///
    /// # Errors
    /// What was wrong with it. It is counted already and needs no action.
    pub fn handle_datagram_from(
        &mut self,
        now: Stamp,
        path: Path,
        bytes: &[u8],
    ) -> Result<(), DatagramError> {
        let now = self.advance(now);
        let result = self.session.handle_datagram_from(now, path, bytes);
        self.after_datagram(now);
        result
    }

    fn after_datagram(&mut self, now: Stamp) {
        self.answer_session(now);
        let requests = self.session.counters().requests_in.datagrams;
        if requests != self.requests_seen {
            self.requests_seen = requests;
            self.repair.note_held(self.session.own_held_by_peers());
        }
    }

    /// Closes the cycle now, with whatever has changed.
    pub fn flush(&mut self, now: Stamp) {
        let now = self.advance(now);
        if let Some((cycle, changes)) = self.packer.close(now, &mut self.mapper) {
            self.publish(now, cycle, changes);
        }
        self.answer_session(now);
    }

    /// Says how a robot's frame lies in this one's. May change at any time; nothing is sent again. What comes to lie beyond the end of
    /// the grid is left out of the fused map. O(voxels known).
    ///
    /// # Errors
    /// [`PoseError`] if it is no pose, or brings the origin of the frame beyond the grid; the alignment stays as it was then.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn set_alignment(&mut self, origin: RobotId, T_own_origin: &Pose) -> Result<(), PoseError> {
        self.fusion.set_alignment(&self.mapper, origin, T_own_origin)
    }

    /// Says how far a robot's clock is ahead of this one's, in microseconds; used in place of what is measured.
    /// `None`: measure again. With its own id: how far its clock was ahead in former runs, 0 if it goes on through a restart; else that is
    /// measured by way of others that heard those runs. The fused map is made anew. O(voxels known).
    pub fn set_clock_offset(&mut self, origin: RobotId, micros: Option<i64>) {
        self.session.set_clock_offset(origin, micros);
        if let Some(micros) = micros {
            self.fusion.set_clock_offset(origin, micros.saturating_neg());
            self.fusion.rebuild(&self.mapper);
        }
    }

    /// Leaves a robot's layers out of the fused map, or takes them in again. O(voxels known).
    pub fn set_muted(&mut self, origin: RobotId, is_muted: bool) {
        self.fusion.set_muted(&self.mapper, origin, is_muted);
    }

    /// Says where a team-mate is, in metres in the frame of the own map, so that it is not taken for an obstacle. `seen` is on the own
    /// clock; one ahead of it counts as the time of the next scan. Positions of at most 1,024 robots are kept.
    ///
    /// # Errors
    /// [`PoseError`] if the position is not finite or lies beyond the grid; the one before is kept then, for as long as it counts.
    pub fn set_teammate(&mut self, id: RobotId, position: [f64; 3], seen: Stamp) -> Result<(), PoseError> {
        self.config.mapper.resolution.check_position(position)?;
        if self.teammates.len() < TEAMMATES_MAX || self.teammates.contains_key(&id) {
            self.teammates.insert(id, Teammate { position, seen });
        }
        Ok(())
    }

    // Outputs.

    /// The next datagram to send, until `None`.
    pub fn poll_transmit(&mut self, now: Stamp) -> Option<Transmit> {
        let now = self.advance(now);
        let transmit = self.session.poll_transmit(now);
        self.answer_session(now);
        transmit
    }

    /// When to call [`handle_timeout`](Self::handle_timeout) at the latest. May lie in the past: then at once.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        let cycle =
            self.packer.deadline(&self.mapper).map(|due| self.held.map_or(due, |held| due.max(held.until)));
        let session = self.session.poll_timeout();
        match (cycle, session) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop()
    }

    // Queries.

    /// The fused map at this moment, for a planner. Stays as it is while the robot goes on. O(1).
    pub fn view(&self) -> MapView {
        self.fusion.view()
    }

    /// The fused map.
    pub const fn map(&self) -> &MapView {
        self.fusion.map()
    }

    /// The own map.
    pub const fn mapper(&self) -> &Mapper {
        &self.mapper
    }

    /// The layers of all robots, and the fused map.
    pub const fn fusion(&self) -> &Fusion {
        &self.fusion
    }

    /// The session: peers, packages held, counters.
    pub const fn session(&self) -> &Session {
        &self.session
    }

    /// Packages that wait for those that they build on, and their bytes with 200 bytes of bookkeeping each: at most 1,024, and 1 MiB.
    pub fn waiting(&self) -> (usize, usize) {
        self.waiting.load()
    }

    /// Voxels that have changed and are still to be told. What a team-mate is believed to know better, where a budget made the own word late,
    /// is not among them: it is told when it is seen again, or by [`flush`](Self::flush). O(blocks with changes).
    pub fn untold(&self) -> usize {
        match self.packer.is_behind() {
            true => self.mapper.count_changes(Which::All, |block| believed_occupied(&self.fusion, block)),
            false => self.mapper.pending(),
        }
    }

    /// What was counted.
    pub const fn counters(&self) -> &RobotCounters {
        &self.counters
    }

    /// The stream of this run.
    pub const fn own_stream(&self) -> Stream {
        self.own
    }

    /// Whether all that was published is in the own layer, [`Fusion::layer`] of [`Self::own_stream`]. Not once it was full
    /// (`fusion.own_layer_bytes_max`): then it says less than the packages, and a present state made of it would pass for all of them.
    pub const fn own_layer_has_all(&self) -> bool {
        self.own_layer_has_all
    }

    /// What it was told.
    pub const fn config(&self) -> &RobotConfig {
        &self.config
    }

    /// Codes the layer of a stream as it is, or what of it is newer than a stamp, for a peer that misses too much of it.
    fn provide_present_state(&mut self, now: Stamp, span: Span, newer_than: Option<Stamp>, bytes_max: usize) {
        let stream = span.stream;
        let is_whole = stream != self.own || self.own_layer_has_all;
        let state = self.fusion.layer(stream).filter(|_| is_whole);
        let Some(state) = state.and_then(|layer| layer.present_voxels(newer_than)) else {
            return self.session.provide_present_state(now, stream, Vec::new());
        };
        let resolution = self.config.mapper.resolution;
        let coded = self.encoder.encode_span(self.config.codec, span, resolution, &state, bytes_max);
        match coded {
            Ok(tiles) => {
                self.counters.present_states += 1;
                self.session.provide_present_state(now, stream, tiles);
            }
            Err(error) => self.push_event(Event::EncodeFailed(error)),
        }
    }

    /// The time of an input. A clock that is set back stands still until it has come up again.
    fn advance(&mut self, now: Stamp) -> Stamp {
        self.now = self.now.max(now);
        self.now
    }

    fn push_event(&mut self, event: Event) {
        self.counters.events_dropped += self.events.push(event);
    }
}
