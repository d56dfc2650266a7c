//! One robot: mapper, publisher, session, layers and fusion joined. The path of the data in both directions.

mod begin;
mod poses;
mod receive;
mod restore;
mod room;
mod slices;
mod snapshots;
mod submaps;

pub use poses::KnownPose;
pub use restore::RestoreError;
pub use slices::REBUILD_BLOCKS;

use core::time::Duration;
use std::collections::BTreeMap;

use std::borrow::Cow;

use flockmap_codec::{Batch, Decoder};
use flockmap_grid::{
    Changes, Fusion, Layer, MapView, Mapper, Pose, PoseError, RobotId, Scan, ScanReport, Sphere, Stamp,
    StatesError, StatesUpdate, Stream,
};
use flockmap_mutation::{self as mutation, Mutation};
use flockmap_sync::wire::DatagramError;
use flockmap_sync::{Path, Session, Transmit};

use crate::effort::{MERGE_STEPS_MAX, Work};
use crate::events::Events;
use crate::publisher::Publisher;
use crate::readers::Readers;
use crate::republishing::Republishing;
use crate::snapshots::Snapshots;
use crate::submaps::Submaps;
use crate::{Event, RobotConfig, RobotCounters, RobotError};

/// Team-mates whose positions are kept.
const TEAMMATES_MAX: usize = 1_024;

/// A robot of the swarm: keeps its own map from its scans, sends what changed, repairs what was lost, and fuses
/// what the others saw. Knows no sockets, threads or clocks; it can be driven by any runtime, or none.
///
/// After every input ([`insert_scan`](Self::insert_scan), [`insert_states`](Self::insert_states),
/// [`handle_datagram`](Self::handle_datagram), [`handle_timeout`](Self::handle_timeout)) send all that [`poll_transmit`](Self::poll_transmit) gives, then
/// wait for the next scan, the next datagram or [`poll_timeout`](Self::poll_timeout), whichever is first.
pub struct Robot {
    config: RobotConfig,
    /// The newest time that came with an input.
    now: Stamp,
    mapper: Mapper,
    publisher: Publisher,
    session: Session,
    readers: Readers,
    snapshots: Snapshots,
    decoder: Decoder,
    fusion: Fusion,
    /// A run that was begun while flying publishes what the one before had published.
    republishing: Option<Republishing>,
    /// What is left for packages in this call.
    merge_steps_left: u64,
    /// Which long work goes on next.
    turn: Work,
    /// From when on submaps that are moved come into force.
    moves_from: Option<Stamp>,
    /// The last slice was left out for a batch.
    is_slice_due: bool,
    teammates: BTreeMap<RobotId, Teammate>,
    submaps: Submaps,
    /// Of the newest scan.
    pose: Option<(Stamp, Pose)>,
    events: Events,
    counters: RobotCounters,
    /// Bytes of the layers of others when something was dropped last, until there is room again.
    full_at: Option<usize>,
}

struct Teammate {
    position: [f64; 3],
    seen: Stamp,
}

impl Robot {
    /// A robot with an empty map. `now` is the time on its clock. Every later `now` must not be before it;
    /// where one is, time is taken to stand still.
    ///
    /// # Errors
    /// [`RobotError`] names the option that cannot work.
    pub fn new(config: RobotConfig, now: Stamp) -> Result<Self, RobotError> {
        for (option, is_zero) in [
            ("voxels_max", config.batch.voxels_max == 0),
            ("publish_period_ms", config.batch.publish_period_ms == 0),
            ("obstacle_period_ms", config.batch.obstacle_period_ms == Some(0)),
        ] {
            if is_zero {
                return Err(RobotError::Batch { option });
            }
        }
        if let Some(length_m) =
            config.submap_length_m.filter(|length_m| length_m.is_nan() || *length_m <= 0.0)
        {
            return Err(RobotError::SubmapLength(length_m));
        }
        // A block is 8 voxels wide.
        if config.fusion.submap_clears_voxels > 7 {
            return Err(RobotError::SubmapClears(config.fusion.submap_clears_voxels));
        }
        let own = Stream { origin: config.id, epoch: config.epoch };
        let resolution = config.mapper.resolution;
        let mut session = config.session.clone();
        session.fast_repair &= config.batch.obstacle_period_ms.is_some();
        Ok(Self {
            now,
            mapper: Mapper::new(config.mapper.clone())?,
            publisher: Publisher::new(&config, own, now),
            readers: Readers::new(config.fusion.layer_bytes_max),
            snapshots: Snapshots::default(),
            decoder: Decoder::new(),
            session: Session::new(own, session, config.seed)?,
            fusion: Fusion::new(own, resolution, config.fusion.clone()),
            republishing: None,
            merge_steps_left: 0,
            turn: Work::default(),
            moves_from: None,
            is_slice_due: false,
            teammates: BTreeMap::new(),
            submaps: Submaps::default(),
            pose: None,
            events: Events::default(),
            counters: RobotCounters::default(),
            full_at: None,
            config,
        })
    }

    // Inputs.

    /// Takes in a scan made at `T_map_sensor`. Only maps: a batch that is due is closed by the next
    /// [`handle_timeout`](Self::handle_timeout), and [`poll_timeout`](Self::poll_timeout) says so.
    ///
    /// No scan is made after `now`: one with a stamp ahead of it counts as made now, in the map and for the
    /// others, and is counted ([`RobotCounters::scans_ahead`]).
    ///
    /// The report is in the frame of the submap in which the scan is written ([`Self::submap_pose`]).
    ///
    /// # Errors
    /// [`PoseError`] if the pose is none or lies beyond the grid; nothing is mapped then.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert_scan(
        &mut self,
        now: Stamp,
        scan: &Scan,
        T_map_sensor: &Pose,
    ) -> Result<ScanReport, PoseError> {
        T_map_sensor.check(self.config.mapper.resolution)?;
        let now = self.advance(now);
        if let Some(length_m) = self.config.submap_length_m
            && self.submaps.note_place(T_map_sensor.translation(), length_m)
        {
            // When there are no more, the last one goes on.
            let _ = self.begin_submap(now);
        }
        let stamp = scan.stamp.min(now);
        let T_map_submap = self.submaps.pose(self.mapper.submap());
        let T_submap_map = (T_map_submap != Pose::IDENTITY).then(|| T_map_submap.inverse());
        let T_submap_sensor = T_submap_map.map_or(*T_map_sensor, |pose| pose.compose(T_map_sensor));
        T_submap_sensor.check(self.config.mapper.resolution)?;
        let timeout = Duration::from_millis(self.config.teammate_timeout_ms.into());
        let radius = self.config.teammate_radius_m;
        let masks = self.teammates.values_mut().filter_map(|teammate| {
            // Else it would not be taken for an obstacle for as long as its clock is ahead.
            teammate.seen = teammate.seen.min(now);
            let is_fresh = now.since(teammate.seen) <= timeout;
            let centre = T_submap_map.map_or(teammate.position, |pose| pose.transform(teammate.position));
            is_fresh.then_some(Sphere { centre, radius })
        });
        let masks: Vec<Sphere> = masks.collect();
        let report = self.mapper.insert_at(stamp, scan, &T_submap_sensor, &masks);
        self.pose = Some((stamp, *T_map_sensor));
        self.counters.scans += 1;
        self.counters.scans_ahead += u64::from(scan.stamp > now);
        self.counters.points_ignored += report.ignored as u64;
        self.counters.points_masked += report.masked as u64;
        self.note_own(now, &report);
        Ok(report)
    }

    /// Takes in the states of voxels from a mapper elsewhere, in place of scans or beside them. They enter where
    /// what the own mapper observes does: what differs from what was published is published, in batches, and the
    /// fused map takes them for what this robot saw. [`Mapper::insert_states`] says what becomes of a voxel on
    /// which scans and states meet.
    ///
    /// As for scans, no change to Unknown is sent: what this robot takes back, team-mates keep as it was
    /// published last, until somebody sees it again; and in its own map comes back what they know of it. Team-mates
    /// ([`set_teammate`](Self::set_teammate)) are not looked for in states.
    ///
    /// A stamp ahead of `now` counts as now, and is counted ([`RobotCounters::states_ahead`]).
    ///
    /// # Errors
    /// [`StatesError`] says what was wrong; nothing is changed then.
    ///
    /// ```
    /// use flockmap::{
    ///     Resolution, Robot, RobotConfig, RobotId, Stamp, State, States, StatesUpdate, Voxel, VoxelBox,
    /// };
    ///
    /// let resolution = Resolution::from_metres(0.1).unwrap();
    /// let mut robot = Robot::new(RobotConfig::new(RobotId(1), resolution, 7.0), Stamp(0))?;
    /// let stamp = Stamp(100_000);
    ///
    /// // What an octree calls its changed keys.
    /// let changed = [(Voxel::new(20, 0, 0), State::Occupied), (Voxel::new(19, 0, 0), State::Free)];
    /// let (sensor, states) = (Some([0.05; 3]), States::Voxels(&changed));
    /// let report = robot.insert_states(stamp, &StatesUpdate { stamp, resolution, sensor, states })?;
    /// assert_eq!(report.changed[0].1.known_count(), 2);
    ///
    /// // Or a local map: the row from x = 18 to 20. Only what differs counts.
    /// let region = VoxelBox::new(Voxel::new(18, 0, 0), [3, 1, 1]).unwrap();
    /// let row = [State::Free, State::Free, State::Occupied];
    /// let states = States::Box { region, states: &row, clear_unknown: false };
    /// let report = robot.insert_states(stamp, &StatesUpdate { stamp, resolution, sensor, states })?;
    /// assert_eq!(report.changed[0].1.known_count(), 1);
    /// assert_eq!(robot.map().state(Voxel::new(18, 0, 0)), State::Free);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn insert_states(
        &mut self,
        now: Stamp,
        update: &StatesUpdate<'_>,
    ) -> Result<ScanReport, StatesError> {
        update.check(self.config.mapper.resolution)?;
        let now = self.advance(now);
        let report = self.mapper.insert_states(&StatesUpdate { stamp: update.stamp.min(now), ..*update })?;
        self.counters.states += 1;
        self.counters.states_ahead += u64::from(update.stamp > now);
        self.note_own(now, &report);
        Ok(report)
    }

    /// Takes what came into the own map to where it goes from there.
    fn note_own(&mut self, now: Stamp, report: &ScanReport) {
        self.publisher.note_observed(now, report.stamp, report.sensor);
        self.fusion.own_scan(&self.mapper, report);
        self.counters.blocks_forgotten += report.forgotten.len() as u64;
    }

    /// Lets time pass: closes the batch that is due, does what the session has to do, and goes on with what takes long:
    /// the fused map by what was set, a snapshot for a peer, what a former run had published. Of one of these a slice,
    /// some milliseconds, and none if a batch was closed, unless that was so the last time too.
    pub fn handle_timeout(&mut self, now: Stamp) {
        let now = self.advance(now);
        self.session.handle_timeout(now);
        self.note_room();
        self.say_submaps(now);
        let batches = self.counters.batches;
        while let Some((batch, changes)) = self.poll_batch(now) {
            self.publish(now, batch, changes);
        }
        if self.counters.batches == batches || self.is_slice_due {
            self.is_slice_due = false;
            self.do_slice(now);
        } else {
            self.is_slice_due = true;
        }
        self.answer_session(now);
    }

    /// The batch that is due. What a former run had published goes out before.
    fn poll_batch(&mut self, now: Stamp) -> Option<(Batch, Changes)> {
        let Self { publisher, session, mapper, fusion, counters, republishing, .. } = self;
        if republishing.is_some() {
            return None;
        }
        publisher.poll(now, || session.pace(now), mapper, fusion, counters)
    }

    /// Takes in a datagram: what it brings is decoded, merged and fused before this returns, but for what goes beyond
    /// some milliseconds of that, where many packages waited for one: [`poll_timeout`](Self::poll_timeout) says "at
    /// once" then, and each further call goes on with it.
    ///
    /// # Errors
    /// What was wrong with it. It is counted already and needs no action.
    pub fn handle_datagram(&mut self, now: Stamp, bytes: &[u8]) -> Result<(), DatagramError> {
        let now = self.advance(now);
        let result = self.session.handle_datagram(now, bytes);
        self.after_datagram(now);
        result
    }

    /// The same for a driver that sends to addresses: `path` stands for the one that it was received from. By
    /// unicast nothing but a challenge goes out on a path before an answer came back through it;
    /// [`Transmit::path`] says where datagrams go.
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
        self.publisher.note_requests(now, &self.session);
    }

    /// Closes the batch now, with whatever has changed; where what a former run had published
    /// [is still to go out](Self::is_republishing), after that.
    pub fn flush(&mut self, now: Stamp) {
        let now = self.advance(now);
        if let Some(republishing) = &mut self.republishing {
            republishing.is_flush_wanted = true;
            return;
        }
        self.say_submaps(now);
        if let Some((batch, changes)) = self.publisher.flush(now, &mut self.mapper) {
            self.publish(now, batch, changes);
        }
        self.answer_session(now);
    }

    /// Says how a robot's frame lies in this one's. May change at any time; nothing is sent again. The fused map stays
    /// as it is until it has been made by the new alignment, which [`handle_timeout`](Self::handle_timeout) does a part
    /// at a time; [`is_rebuilding`](Self::is_rebuilding) says whether it is done. Another one that is set meanwhile
    /// comes into force after it. What comes to lie beyond the end of the grid is left out. O(streams).
    ///
    /// # Errors
    /// [`PoseError`] if it is no pose, or brings the origin of the frame beyond the grid; the alignment stays
    /// as it was then.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn set_alignment(&mut self, origin: RobotId, T_own_origin: &Pose) -> Result<(), PoseError> {
        self.fusion.set_alignment(origin, T_own_origin)
    }

    /// Says how far a robot's clock is ahead of this one's, in microseconds; used in place of what is
    /// measured. `None`: measure again. With its own id: how far its clock was ahead in former runs, 0 if it
    /// goes on through a restart; else that is measured through others that heard those runs. Comes into force as an
    /// alignment does. O(streams).
    pub fn set_clock_offset(&mut self, origin: RobotId, micros: Option<i64>) {
        self.session.set_clock_offset(origin, micros);
        if let Some(micros) = micros {
            self.fusion.apply_clock_offset(origin, micros.saturating_neg());
        }
    }

    /// Leaves a robot's layers out of the fused map, or takes them in again. Comes into force as an alignment does.
    /// O(streams).
    pub fn set_muted(&mut self, origin: RobotId, is_muted: bool) {
        self.fusion.set_muted(origin, is_muted);
    }

    /// Lets all that was set come into force at once. O(voxels of the layers concerned): seconds on a large map. For
    /// tools and tests; a robot that flies has [`handle_timeout`](Self::handle_timeout) do it.
    pub fn finish_rebuild(&mut self) {
        while self.fusion.work(&self.mapper, usize::MAX) {}
    }

    /// Says where a team-mate is, in metres in the frame of the own map, so that it is not taken for an
    /// obstacle. `seen` is on the own clock; one ahead of it counts as the time of the next scan. Positions
    /// of at most 1,024 robots are kept.
    ///
    /// # Errors
    /// [`PoseError`] if the position is not finite or lies beyond the grid; the one before is kept then, for
    /// as long as it counts.
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

    /// When to call [`handle_timeout`](Self::handle_timeout) at the latest. May lie in the past: then at once, as
    /// long as there is work that goes on in slices: the fused map [is being made anew](Self::is_rebuilding), a
    /// snapshot for a peer, what a former run had published, or packages that waited for one another.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        let at_once = self.is_busy().then_some(self.now);
        let batch = self.publisher.poll_timeout(&self.mapper).filter(|_| self.republishing.is_none());
        let due = [at_once, batch, self.submaps_due(), self.moves_due(), self.session.poll_timeout()];
        due.into_iter().flatten().min()
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

    /// Whether the fused map is being made anew: an alignment, a clock offset or a muting that was set, or a run that
    /// was forgotten, is not in force yet.
    pub fn is_rebuilding(&self) -> bool {
        self.fusion.is_rebuilding()
    }

    /// Whether what a former run had published still goes out in this one, which was begun while flying
    /// ([`Event::RunBegun`]). What changes meanwhile waits for that.
    pub const fn is_republishing(&self) -> bool {
        self.republishing.is_some()
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

    /// Voxels that have changed and are still to be published. What a team-mate is believed to know better,
    /// where a budget made the own observation late, is not among them: it is published when it is seen
    /// again, or by [`flush`](Self::flush). With what a former run had published and is still to go out, and one for each
    /// submap of which something is to be said. O(blocks with changes).
    pub fn unpublished(&self) -> usize {
        let former = self.republishing.as_ref().map_or(0, Republishing::voxels_left);
        former + self.submaps.unsaid.len() + self.publisher.unpublished(&self.mapper, &self.fusion)
    }

    /// Whether something of others was dropped for want of room, and there is no room for it yet: then nothing that
    /// is lacking is asked for.
    pub const fn is_full(&self) -> bool {
        self.full_at.is_some()
    }

    /// What was counted.
    pub const fn counters(&self) -> &RobotCounters {
        &self.counters
    }

    /// The stream of this run.
    pub const fn own_stream(&self) -> Stream {
        self.publisher.stream()
    }

    /// Whether all that was published is in the own layer, [`Fusion::layer`] of [`Self::own_stream`], but for what
    /// was dropped for want of room ([`Layer::lost_upto`](flockmap_grid::Layer::lost_upto)).
    pub fn own_layer_has_all(&self) -> bool {
        self.publisher.own_layer_has_all()
    }

    /// Its configuration.
    pub const fn config(&self) -> &RobotConfig {
        &self.config
    }

    /// Codes a batch, gives it to the session and takes it into the own layer.
    fn publish(&mut self, now: Stamp, batch: Batch, changes: Changes) {
        let mut coded = Cow::Borrowed(&changes);
        if mutation::is(Mutation::BlockLeftOut) && changes.blocks().len() > 1 {
            coded = Cow::Owned(Changes::from_blocks(changes.blocks()[1..].to_vec()));
        }
        let is_independent = self.session.is_independent_wanted();
        let Self { publisher, fusion, counters, .. } = self;
        let packages = match publisher.encode(now, &batch, &coded, is_independent, fusion, counters) {
            Ok(packages) => packages,
            Err(error) => return self.push_event(Event::EncodeFailed(error)),
        };
        self.counters.batches += 1;
        self.counters.changes += changes.len() as u64;
        for package in &packages {
            self.counters.packages += 1;
            self.counters.package_bytes += package.bytes().len() as u64;
            // Numbered and sized by us, so the session takes it.
            let published = self.session.publish(now, package.clone());
            debug_assert_eq!(published, Ok(()));
        }
        let own = self.own_stream();
        if let Err(error) = self.fusion.apply(&self.mapper, own, &changes, batch.end, now) {
            self.publisher.note_own_layer_full();
            self.counters.no_room += 1;
            let index = packages.last().map_or(0, |package| package.header().index);
            self.push_event(Event::Refused { stream: own, index, reason: error.into() });
        }
        self.note_dropped();
        self.fusion.note_sensor(own, batch.end, batch.sensor);
        self.push_event(Event::BatchClosed { batch, changes, packages });
        self.answer_session(now);
    }

    /// The time of an input. A clock that is set back stands still until it has come up again.
    fn advance(&mut self, now: Stamp) -> Stamp {
        self.snapshots.note_call();
        let fusion = &self.fusion;
        self.snapshots.trim_kept(|stream| fusion.layer(stream).map(Layer::bytes_left_in_copies));
        self.readers.free();
        self.merge_steps_left = MERGE_STEPS_MAX;
        self.now = self.now.max(now);
        self.hold_moves(self.now);
        self.now
    }

    fn push_event(&mut self, event: Event) {
        self.counters.events_dropped += self.events.push(event);
    }
}

/// For drivers of whatever holds a robot.
impl AsRef<Self> for Robot {
    fn as_ref(&self) -> &Self {
        self
    }
}

impl AsMut<Self> for Robot {
    fn as_mut(&mut self) -> &mut Self {
        self
    }
}
