//! One robot that shares its map as RACER's code does.

use std::collections::{BTreeMap, VecDeque};

use anyhow::{Context, Result, ensure};
use flockmap::grid::{
    Changes, Mapper, Plane, Pose, RobotId, Scan, ScanReport, Sphere, Stamp, State, Voxel, set_bits,
};
use flockmap::sync::IntervalSet;
use flockmap_netsim::{Addressees, Datagram, Delivery, Node};

use super::config::{ANSWER_PAUSE_S, BEAT_MICROS, CHUNK_VOXELS, QUEUE_CHUNKS_MAX, RacerCast, RacerConfig};
use super::message::{CHUNK, ChunkData, ChunkStamps, STAMPS};
use crate::baselines::bytes::{nested_place, nested_voxel};
use crate::baselines::state_map::StateMap;

/// Chunks of all owners together: 52 million voxels, about 300 MB. More are not taken in.
const CHUNKS_MAX: usize = 1 << 18;

/// What a robot counted.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct RacerCounters {
    /// Voxels that were known for the first time by an own ray.
    pub listed: u64,
    /// Of these, outside of the grid: never sent.
    pub outside: u64,
    /// Own chunks cut.
    pub chunks: u64,
    /// Announcements made.
    pub stamps_sent: u64,
    /// Chunks sent, again and for others included.
    pub chunks_sent: u64,
    /// Of these, sent before to the same robot.
    pub chunks_resent: u64,
    /// Of these, chunks of other owners.
    pub chunks_relayed: u64,
    /// Announcements that got no answer as the last answer was less than 0.3 s ago.
    pub throttled: u64,
    /// Chunks received that were held already, or that are the own ones.
    pub duplicates: u64,
    /// Datagrams that were damaged.
    pub damaged: u64,
}

/// A robot with its own map, the chunks of all robots, and the one map into which all of them are written.
///
/// Sans-IO as `flockmap::Robot` is: a [`Node`] that is given scans.
///
/// The one map takes over the state of a voxel when the own map's state of it changes, and when a chunk says
/// so; the last one holds.
pub struct RacerRobot {
    config: RacerConfig,
    mapper: Mapper,
    map: StateMap,
    pending: VecDeque<u32>,
    /// Of each owner, 1 first.
    owners: Vec<Owner>,
    chunks_held: usize,
    buffer: VecDeque<ChunkData>,
    outgoing: VecDeque<Datagram>,
    /// Time of the announcement that was last answered, by robot.
    answered_s: BTreeMap<RobotId, f64>,
    next_beat: Stamp,
    counters: RacerCounters,
}

struct Owner {
    chunks: BTreeMap<u32, Chunk>,
    held: IntervalSet,
}

struct Chunk {
    addresses: Vec<u32>,
    /// Taken at the first transmission.
    states: Option<Vec<u8>>,
    /// To whom it was sent; only for counting.
    sent_to: Vec<RobotId>,
}

impl RacerRobot {
    /// A robot with an empty map, at this time on its clock.
    ///
    /// # Errors
    /// Names what cannot work.
    pub fn new(config: RacerConfig, now: Stamp) -> Result<Self> {
        let (id, robots) = (config.id.0, config.robots);
        ensure!(
            (1..=robots).contains(&id) && robots <= 1_000,
            "robot {id} of {robots}, expected 1 to the number of robots, and at most 1,000 of them"
        );
        let voxels = config.region.volume();
        ensure!(
            voxels <= 1 << 32,
            "a grid of {voxels} voxels, expected at most 2^32: a smaller region or larger voxels"
        );
        let owner = || Owner { chunks: BTreeMap::new(), held: IntervalSet::new(CHUNKS_MAX) };
        Ok(Self {
            mapper: Mapper::new(config.mapper.clone())?,
            map: StateMap::default(),
            pending: VecDeque::new(),
            owners: (0..robots).map(|_| owner()).collect(),
            chunks_held: 0,
            buffer: VecDeque::new(),
            outgoing: VecDeque::new(),
            answered_s: BTreeMap::new(),
            // Robots are started one after the other: their beats do not fall together.
            next_beat: now.plus_micros(i64::from(id) * 17_000 % BEAT_MICROS),
            counters: RacerCounters::default(),
            config,
        })
    }

    // Inputs.

    /// Takes in a scan made at `T_map_sensor`; points in `masks` are team-mates. What its rays touch for the
    /// first time is listed.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn insert_scan(&mut self, scan: &Scan, T_map_sensor: &Pose, masks: &[Sphere]) -> ScanReport {
        let report = self.mapper.insert(scan, T_map_sensor, masks);
        for (index, changed) in &report.changed {
            let (known, before) = (changed.known(), self.map.block(*index).known());
            let first: Plane = core::array::from_fn(|z| known[z] & !before[z]);
            for bit in set_bits(&first) {
                self.counters.listed += 1;
                match self.address(index.voxel(bit)) {
                    Some(address) => self.pending.push_back(address),
                    None => self.counters.outside += 1,
                }
            }
            // A block that there is no room for is left out.
            let _ = self.map.overlay(*index, changed);
        }
        while self.pending.len() > CHUNK_VOXELS && self.chunks_held < CHUNKS_MAX {
            let addresses = self.pending.drain(..CHUNK_VOXELS).collect();
            let own = self.config.id;
            let index = self.held(own).map_or(0, IntervalSet::prefix) + 1;
            self.keep(own, index, Chunk { addresses, states: None, sent_to: Vec::new() });
            self.counters.chunks += 1;
        }
        report
    }

    /// Takes in a datagram: an announcement is answered at once, a chunk waits for the next beat.
    ///
    /// # Errors
    /// If it is damaged. That is counted and needs no action.
    pub fn receive(&mut self, datagram: &[u8]) -> Result<()> {
        let result = match datagram {
            [STAMPS, message @ ..] => ChunkStamps::parse(message).and_then(|stamps| self.answer(&stamps)),
            [_, message @ ..] => ChunkData::parse(message).and_then(|chunk| self.buffer(chunk)),
            [] => None,
        };
        self.counters.damaged += u64::from(result.is_none());
        result.context("damaged message of racer-code")
    }

    // Queries.

    /// What the one map says of a voxel.
    #[cfg(test)]
    pub fn state(&self, voxel: Voxel) -> State {
        self.map.state(voxel)
    }

    /// The one map.
    pub const fn map(&self) -> &StateMap {
        &self.map
    }

    /// The own map, of own scans only.
    #[cfg(test)]
    pub const fn mapper(&self) -> &Mapper {
        &self.mapper
    }

    /// All that this robot has received of an owner, from whomever. Made anew at each call. O(voxels received).
    pub fn observed_by(&self, owner: RobotId) -> Changes {
        let chunks = self.owner(owner).map(|owner| owner.chunks.values()).into_iter().flatten();
        Changes::from_voxels(
            chunks.filter_map(|chunk| Some(self.voxels(&chunk.addresses, chunk.states.as_ref()?))).flatten(),
        )
    }

    /// The chunks held of an owner; `None` for a robot that is not of the swarm.
    pub fn held(&self, owner: RobotId) -> Option<&IntervalSet> {
        self.owner(owner).map(|owner| &owner.held)
    }

    /// Own voxels that are listed and in no chunk: nobody will hear of them unless more than 200 come together.
    #[cfg(test)]
    pub fn left_behind(&self) -> usize {
        self.pending.len()
    }

    /// What was counted.
    #[cfg(test)]
    pub const fn counters(&self) -> &RacerCounters {
        &self.counters
    }

    /// How it was set up.
    pub const fn config(&self) -> &RacerConfig {
        &self.config
    }

    // Helpers.

    /// Sends all that the sender of an announcement lacks, unless it was answered a moment ago.
    fn answer(&mut self, stamps: &ChunkStamps) -> Option<()> {
        let requester = self.robot(stamps.from)?;
        if requester == self.config.id {
            return Some(());
        }
        let answered = self.answered_s.get(&requester);
        if answered.is_some_and(|answered| stamps.time_s - answered < ANSWER_PAUSE_S) {
            self.counters.throttled += 1;
            return Some(());
        }
        self.answered_s.insert(requester, stamps.time_s);
        let to = match self.config.cast {
            RacerCast::Broadcast => Addressees::All,
            RacerCast::Unicast => Addressees::One(requester),
        };
        let nothing = IntervalSet::new(0);
        for number in (1..=self.config.robots).filter(|number| *number != requester.0) {
            let theirs = stamps.held.get(usize::from(number) - 1).unwrap_or(&nothing);
            let Some(owner) = self.owners.get_mut(usize::from(number) - 1) else { continue };
            let missing = owner.held.difference(theirs);
            for index in missing.intervals().iter().flat_map(|(low, high)| *low..=*high) {
                let Some(chunk) = owner.chunks.get_mut(&index) else { continue };
                let states = chunk.states.get_or_insert_with(|| {
                    let voxel = |address: &u32| nested_voxel(&self.config.region, u64::from(*address));
                    let voxels = chunk.addresses.iter().filter_map(voxel);
                    voxels.map(|voxel| u8::from(self.map.state(voxel) == State::Occupied)).collect()
                });
                let data = ChunkData {
                    from: self.config.id.0.into(),
                    to: requester.0.into(),
                    owner: number.into(),
                    index,
                    addresses: chunk.addresses.clone(),
                    states: states.clone(),
                };
                self.counters.chunks_sent += 1;
                self.counters.chunks_relayed += u64::from(number != self.config.id.0);
                if chunk.sent_to.contains(&requester) {
                    self.counters.chunks_resent += 1;
                } else {
                    chunk.sent_to.push(requester);
                }
                put(&mut self.outgoing, Datagram { to, bytes: [&[CHUNK], data.emit().as_slice()].concat() });
            }
        }
        Some(())
    }

    /// Whom a chunk is meant for is not looked at: what is heard is taken in.
    fn buffer(&mut self, chunk: ChunkData) -> Option<()> {
        self.robot(chunk.owner)?;
        let volume = self.config.region.volume();
        chunk.addresses.iter().all(|address| u128::from(*address) < volume).then_some(())?;
        put(&mut self.buffer, chunk);
        Some(())
    }

    /// Overwrites the map with a chunk whose number was not seen before.
    fn insert_chunk(&mut self, chunk: ChunkData) {
        // Checked when it came in.
        let Some(owner) = self.robot(chunk.owner) else { return };
        if owner == self.config.id || self.held(owner).is_none_or(|held| held.contains(chunk.index)) {
            self.counters.duplicates += 1;
            return;
        }
        let changes = Changes::from_voxels(self.voxels(&chunk.addresses, &chunk.states));
        if self.chunks_held >= CHUNKS_MAX || self.map.apply(&changes).is_err() {
            return;
        }
        let ChunkData { addresses, states, index, .. } = chunk;
        self.keep(owner, index, Chunk { addresses, states: Some(states), sent_to: Vec::new() });
    }

    fn keep(&mut self, owner: RobotId, index: u32, chunk: Chunk) {
        if let Some(owner) = self.owners.get_mut(usize::from(owner.0) - 1)
            && owner.held.insert(index) == Ok(true)
        {
            owner.chunks.insert(index, chunk);
            self.chunks_held += 1;
        }
    }

    /// A robot of the swarm by the number in a message.
    fn robot(&self, number: i32) -> Option<RobotId> {
        u16::try_from(number).ok().filter(|id| (1..=self.config.robots).contains(id)).map(RobotId)
    }

    fn owner(&self, id: RobotId) -> Option<&Owner> {
        self.owners.get(usize::from(id.0).checked_sub(1)?)
    }

    /// Number of a voxel in the grid, which has at most 2³²; `None` outside.
    fn address(&self, voxel: Voxel) -> Option<u32> {
        let region = &self.config.region;
        region.contains(voxel).then(|| nested_place(region, voxel) as u32)
    }

    fn voxels<'a>(&self, addresses: &'a [u32], states: &'a [u8]) -> impl Iterator<Item = (Voxel, State)> {
        addresses.iter().zip(states).filter_map(|(address, state)| {
            let state = if *state == 1 { State::Occupied } else { State::Free };
            Some((nested_voxel(&self.config.region, u64::from(*address))?, state))
        })
    }
}

impl Node for RacerRobot {
    fn id(&self) -> RobotId {
        self.config.id
    }

    fn handle_datagram(&mut self, _now: Stamp, delivery: &Delivery) {
        // Errors are counted.
        let _ = self.receive(&delivery.bytes);
    }

    /// At each beat, what was received is taken in, and what is held is announced.
    fn handle_timeout(&mut self, now: Stamp) {
        if now < self.next_beat {
            return;
        }
        // A timer that comes late fires once.
        let late = now.micros_since(self.next_beat) / BEAT_MICROS;
        self.next_beat = self.next_beat.plus_micros((late + 1) * BEAT_MICROS);
        while let Some(chunk) = self.buffer.pop_front() {
            self.insert_chunk(chunk);
        }
        let mut held: Vec<IntervalSet> = self.owners.iter().map(|owner| owner.held.clone()).collect();
        // The last of RACER's robots is a ground station, which maps nothing and never answers: N robots
        // count as N + 1.
        held.push(IntervalSet::new(0));
        let stamps = ChunkStamps { from: self.config.id.0.into(), held, time_s: now.seconds() };
        self.counters.stamps_sent += 1;
        let to = match self.config.cast {
            RacerCast::Broadcast => Addressees::All,
            RacerCast::Unicast => Addressees::Each,
        };
        let bytes = [&[STAMPS], stamps.emit().as_slice()].concat();
        self.outgoing.push_back(Datagram { to, bytes });
    }

    fn poll_timeout(&self) -> Option<Stamp> {
        Some(self.next_beat)
    }

    fn poll_transmit(&mut self, _now: Stamp) -> Option<Datagram> {
        self.outgoing.pop_front()
    }
}

/// Puts a chunk into a queue; if there is no room, the oldest gives way.
fn put<T>(queue: &mut VecDeque<T>, chunk: T) {
    if queue.len() >= QUEUE_CHUNKS_MAX {
        queue.pop_front();
    }
    queue.push_back(chunk);
}
