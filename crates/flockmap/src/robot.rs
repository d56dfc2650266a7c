//! One robot: mapper, packer, codec, session, layers and fusion joined. The way of the data, both directions.

use std::collections::{BTreeMap, VecDeque};

use flockmap_codec::{Content, Cycle, Decoder, Encoder, PACKAGE_BYTES_MAX, Package};
use flockmap_grid::{
    Changes, Fusion, FusionError, MapView, Mapper, Pose, RobotId, Scan, ScanReport, Sphere, Stamp, Stream,
};
use flockmap_sync::wire::DatagramError;
use flockmap_sync::{Session, Transmit};

use crate::{Packer, RobotConfig, RobotError};

/// Events that wait to be polled. The oldest is dropped, and counted, when one more comes.
const EVENTS_MAX: usize = 1_024;

/// Team-mates whose positions are kept.
const TEAMMATES_MAX: usize = 1_024;

/// Something worth knowing. Need not be polled: what is not read is dropped, oldest first, 1,024 are kept.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Event {
    /// An own cycle was closed and its packages are on their way.
    CycleClosed {
        /// Its time.
        cycle: Cycle,
        /// What changed.
        changes: Changes,
        /// The packages made of it.
        packages: Vec<Package>,
    },
    /// A package of another robot, or of a former run of this one, is in its layer and in the fused map.
    Merged {
        /// Whose observations these are.
        stream: Stream,
        /// Number of the package.
        index: u32,
        /// Oldest time of what it says, on the origin's clock.
        cycle_start: Stamp,
        /// Newest time of what it says, on the origin's clock.
        cycle_end: Stamp,
        /// What it says. Empty for a tile of a present state.
        changes: Changes,
        /// Voxels of the layer that were taken over; the others were known to be newer.
        taken: usize,
    },
    /// A package was not taken in. It is counted, and asked for again unless that is useless.
    Refused {
        /// Its stream.
        stream: Stream,
        /// Its index.
        index: u32,
        /// What was wrong.
        reason: Refusal,
    },
    /// All packages up to this one are held now, by way of a present state.
    CaughtUp {
        /// The stream.
        stream: Stream,
        /// The newest package contained.
        upto: u32,
    },
    /// A robot was heard for the first time, or again, or in a new run.
    PeerSeen(Stream),
    /// A robot has not been heard for a while.
    PeerLost(Stream),
    /// Another robot uses the own id. Give one of them another.
    SameIdentity,
    /// Own changes could not be coded, and are lost to the others. Please report it: this should not happen.
    EncodeFailed(flockmap_codec::EncodeError),
}

/// Why a package was not taken in.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// It is damaged, or of a version that is not known.
    #[error(transparent)]
    Package(#[from] flockmap_codec::PackageError),
    /// There is no room for it.
    #[error(transparent)]
    Fusion(#[from] FusionError),
    /// Its voxels have another size. It is held and passed on, but not merged.
    #[error("voxels of {got:?}, this robot has {own:?}: give all robots the same resolution")]
    Resolution {
        /// Of the package.
        got: flockmap_grid::Resolution,
        /// Of this robot.
        own: flockmap_grid::Resolution,
    },
}

/// What a robot counted, beside its session's counters.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[non_exhaustive]
pub struct RobotCounters {
    /// Scans taken in.
    pub scans: u64,
    /// Points that were ignored: not finite, too near or too far out.
    pub points_ignored: u64,
    /// Points that were taken for team-mates.
    pub points_masked: u64,
    /// Blocks of the own map that were forgotten under the byte cap.
    pub blocks_forgotten: u64,
    /// Cycles closed.
    pub cycles: u64,
    /// Own voxels that changed, added up over cycles.
    pub changes: u64,
    /// Own packages made.
    pub packages: u64,
    /// Bytes of these.
    pub package_bytes: u64,
    /// Packages of others merged, tiles of present states among them.
    pub merged: u64,
    /// Packages of others that were damaged: not taken in, and asked for again.
    pub damaged: u64,
    /// Packages of others for which there was no room.
    pub no_room: u64,
    /// Packages of others with voxels of another size.
    pub foreign_resolution: u64,
    /// Present states made for others.
    pub present_states: u64,
    /// Events dropped since nobody polled them.
    pub events_dropped: u64,
}

/// A robot of the swarm: keeps its own map from its scans, sends what changed, repairs what was lost, and fuses
/// what the others saw. Knows no sockets, threads or clocks; it can be driven by any runtime, or none.
///
/// After every input ([`insert_scan`](Self::insert_scan), [`handle_datagram`](Self::handle_datagram),
/// [`handle_timeout`](Self::handle_timeout)) send all that [`poll_transmit`](Self::poll_transmit) gives, then wait for
/// the next scan, the next datagram or [`poll_timeout`](Self::poll_timeout), whichever is first.
pub struct Robot {
    config: RobotConfig,
    own: Stream,
    mapper: Mapper,
    packer: Packer,
    encoder: Encoder,
    decoder: Decoder,
    session: Session,
    fusion: Fusion,
    teammates: BTreeMap<RobotId, Teammate>,
    next_index: u32,
    events: VecDeque<Event>,
    counters: RobotCounters,
}

struct Teammate {
    position: [f64; 3],
    seen: Stamp,
}

impl Robot {
    /// A robot with an empty map. `now` is the time on its clock; every later `now` must not be before it.
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
            mapper: Mapper::new(config.mapper.clone())?,
            packer: Packer::new(config.cycle, own, resolution, now),
            encoder: Encoder::new(),
            decoder: Decoder::new(),
            session: Session::new(own, config.session.clone(), config.seed)?,
            fusion: Fusion::new(own, resolution, config.fusion.clone()),
            teammates: BTreeMap::new(),
            next_index: 1,
            events: VecDeque::new(),
            counters: RobotCounters::default(),
            config,
        })
    }

    // Inputs.

    /// Takes in a scan made at `T_map_sensor`. Only maps: a cycle that is due is closed by the next
    /// [`handle_timeout`](Self::handle_timeout), and [`poll_timeout`](Self::poll_timeout) says so.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert_scan(&mut self, now: Stamp, scan: &Scan, T_map_sensor: &Pose) -> ScanReport {
        let timeout = 1_000 * i64::from(self.config.teammate_timeout_ms);
        let masks: Vec<Sphere> = self
            .teammates
            .values()
            .filter(|teammate| now.micros_since(teammate.seen) <= timeout)
            .map(|teammate| Sphere { centre: teammate.position, radius: self.config.teammate_radius_m })
            .collect();
        let report = self.mapper.insert(scan, T_map_sensor, &masks);
        self.packer.note_scan(scan.stamp);
        self.fusion.own_scan(&self.mapper, &report);
        self.counters.scans += 1;
        self.counters.points_ignored += report.ignored as u64;
        self.counters.points_masked += report.masked as u64;
        self.counters.blocks_forgotten += report.forgotten.len() as u64;
        report
    }

    /// Lets time pass: closes the cycle that is due, and does what the session has to do.
    pub fn handle_timeout(&mut self, now: Stamp) {
        while let Some((cycle, changes)) = self.packer.close_due(now, &mut self.mapper) {
            self.publish(now, cycle, changes);
        }
        self.session.handle_timeout(now);
        self.answer_session(now);
    }

    /// Takes in a datagram: what it brings is decoded, merged and fused before this returns.
    ///
    /// # Errors
    /// What was wrong with it. It is counted already and needs no action.
    pub fn handle_datagram(&mut self, now: Stamp, bytes: &[u8]) -> Result<(), DatagramError> {
        let result = self.session.handle_datagram(now, bytes);
        self.answer_session(now);
        result
    }

    /// Closes the cycle now, with whatever has changed.
    pub fn flush(&mut self, now: Stamp) {
        if let Some((cycle, changes)) = self.packer.close(now, &mut self.mapper) {
            self.publish(now, cycle, changes);
        }
        self.answer_session(now);
    }

    /// Says how a robot's frame lies in this one's. May change at any time; nothing is sent again. O(voxels known).
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn set_alignment(&mut self, origin: RobotId, T_own_origin: &Pose) {
        self.fusion.set_alignment(&self.mapper, origin, T_own_origin);
    }

    /// Says how far a robot's clock is ahead of this one's, in microseconds; used in place of what is measured.
    /// `None`: measure again. The fused map is made anew. O(voxels known).
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

    /// Says where a team-mate is, in metres in the frame of the own map, so that it is not taken for an obstacle.
    /// Positions of at most 1,024 robots are kept.
    pub fn set_teammate(&mut self, id: RobotId, position: [f64; 3], seen: Stamp) {
        if self.teammates.len() < TEAMMATES_MAX || self.teammates.contains_key(&id) {
            self.teammates.insert(id, Teammate { position, seen });
        }
    }

    // Outputs.

    /// The next datagram to send, until `None`.
    pub fn poll_transmit(&mut self, now: Stamp) -> Option<Transmit> {
        let transmit = self.session.poll_transmit(now);
        self.answer_session(now);
        transmit
    }

    /// When to call [`handle_timeout`](Self::handle_timeout) at the latest. May lie in the past: then at once.
    pub fn poll_timeout(&self) -> Option<Stamp> {
        let cycle = self.packer.deadline(&self.mapper);
        let session = self.session.poll_timeout();
        match (cycle, session) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
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

    /// What was counted.
    pub const fn counters(&self) -> &RobotCounters {
        &self.counters
    }

    /// The stream of this run.
    pub const fn own_stream(&self) -> Stream {
        self.own
    }

    /// What it was told.
    pub const fn config(&self) -> &RobotConfig {
        &self.config
    }

    /// Codes a cycle, takes it into the own layer and gives it to the session.
    fn publish(&mut self, now: Stamp, cycle: Cycle, changes: Changes) {
        let coded = self.encoder.encode_cycle(
            self.config.codec,
            &cycle,
            self.next_index,
            &changes,
            PACKAGE_BYTES_MAX,
        );
        let packages = match coded {
            Ok(packages) => packages,
            Err(error) => return self.push_event(Event::EncodeFailed(error)),
        };
        self.counters.cycles += 1;
        self.counters.changes += changes.len() as u64;
        for package in &packages {
            self.next_index += 1;
            self.counters.packages += 1;
            self.counters.package_bytes += package.bytes().len() as u64;
            // Numbered and sized by us, so the session takes it.
            let published = self.session.publish(now, package.clone());
            debug_assert_eq!(published, Ok(()));
        }
        if let Err(error) = self.fusion.apply(&self.mapper, self.own, &changes, cycle.end) {
            // The packages are out all the same; only a present state of this stream would lack them.
            self.counters.no_room += 1;
            let reason = error.into();
            self.push_event(Event::Refused { stream: self.own, index: self.next_index - 1, reason });
        }
        self.push_event(Event::CycleClosed { cycle, changes, packages });
        self.answer_session(now);
    }

    /// Gives every event of the session its answer.
    fn answer_session(&mut self, now: Stamp) {
        use flockmap_sync::Event as SessionEvent;
        while let Some(event) = self.session.poll_event() {
            match event {
                SessionEvent::Received(package) => self.receive(now, &package),
                SessionEvent::PresentStateWanted { stream, upto, .. } => {
                    self.provide_present_state(now, stream, upto);
                }
                SessionEvent::StreamForgotten(stream) => self.fusion.forget(&self.mapper, stream),
                SessionEvent::CaughtUp { stream, upto } => self.push_event(Event::CaughtUp { stream, upto }),
                SessionEvent::PeerSeen(stream) => self.push_event(Event::PeerSeen(stream)),
                SessionEvent::PeerLost(stream) => self.push_event(Event::PeerLost(stream)),
                SessionEvent::SameIdentity => self.push_event(Event::SameIdentity),
                _ => {}
            }
        }
    }

    /// Decodes and merges a package, and gives the session the verdict.
    fn receive(&mut self, now: Stamp, package: &Package) {
        match self.merge(package) {
            Ok(event) => {
                self.counters.merged += 1;
                self.session.accept(now, package);
                self.push_event(event);
            }
            Err(reason) => {
                match reason {
                    Refusal::Package(_) => self.counters.damaged += 1,
                    Refusal::Fusion(_) => self.counters.no_room += 1,
                    Refusal::Resolution { .. } => self.counters.foreign_resolution += 1,
                }
                if matches!(reason, Refusal::Resolution { .. }) {
                    // It will never fit here, but others may be able to use it.
                    self.session.accept(now, package);
                } else {
                    self.session.reject(now, package);
                }
                let (stream, index) = (package.header().stream, package.header().index);
                self.push_event(Event::Refused { stream, index, reason });
            }
        }
    }

    fn merge(&mut self, package: &Package) -> Result<Event, Refusal> {
        let header = *package.header();
        let stream = header.stream;
        let own = self.config.mapper.resolution;
        if header.resolution != own {
            return Err(Refusal::Resolution { got: header.resolution, own });
        }
        let content = self.decoder.decode(package)?;
        if let Some(offset) = self.session.clock_offset(stream) {
            self.fusion.set_clock_offset(stream.origin, offset.saturating_neg());
        }
        let (changes, taken) = match content {
            Content::Changes(changes) => {
                let taken = self.fusion.apply(&self.mapper, stream, &changes, header.cycle_end)?;
                (changes, taken)
            }
            Content::Present(state) => {
                let mut taken = 0;
                for (stamp, part) in &state.parts {
                    taken += self.fusion.apply(&self.mapper, stream, part, *stamp)?;
                }
                (Changes::default(), taken)
            }
        };
        let (cycle_start, cycle_end) = (header.cycle_start, header.cycle_end);
        Ok(Event::Merged { stream, index: header.index, cycle_start, cycle_end, changes, taken })
    }

    /// Codes the layer of a stream as it is, for a peer that misses too much of it.
    fn provide_present_state(&mut self, now: Stamp, stream: Stream, upto: u32) {
        let Some(state) = self.fusion.layer(stream).and_then(|layer| layer.present_state()) else {
            return;
        };
        let resolution = self.config.mapper.resolution;
        let coded = self.encoder.encode_present(
            self.config.codec,
            stream,
            upto,
            resolution,
            &state,
            PACKAGE_BYTES_MAX,
        );
        match coded {
            Ok(tiles) => {
                self.counters.present_states += 1;
                self.session.provide_present_state(now, stream, tiles);
            }
            Err(error) => self.push_event(Event::EncodeFailed(error)),
        }
    }

    fn push_event(&mut self, event: Event) {
        if self.events.len() >= EVENTS_MAX {
            self.events.pop_front();
            self.counters.events_dropped += 1;
        }
        self.events.push_back(event);
    }
}
