//! Robots on a radio that carries everything at once, in virtual time.

use std::time::Duration;

use anyhow::bail;
use flockmap::grid::Layer;
use flockmap::{Destination, Event, Robot, Stamp, Stream};
use flockmap_cli::measure::Times;
use flockmap_cli::stop;

use crate::calls::meter::{Call, Meter};

/// Virtual time between two looks at the robots while there is something to be done.
const STEP_MICROS: i64 = 20_000;
/// Slices of work that a driver finds time for meanwhile.
const SLICES: usize = 8;
/// Virtual time between two looks at what has come of it.
const LOOK_MICROS: i64 = 100_000;
/// Virtual time without anything new after which nothing more will come.
const GIVE_UP: Duration = Duration::from_secs(3 * 3_600);

/// A robot, what its calls take, and what it received.
pub struct Member {
    pub robot: Robot,
    pub meter: Meter,
    /// Processor time of each `handle_timeout` that closed a batch.
    pub packing: Times,
    /// Processor time of each `handle_datagram` that merged something.
    pub inserting: Times,
    pub bytes: u64,
    pub datagrams: u64,
}

impl Member {
    pub fn new(robot: Robot) -> Self {
        let (meter, packing, inserting) = (Meter::default(), Times::default(), Times::default());
        Self { robot, meter, packing, inserting, bytes: 0, datagrams: 0 }
    }

    pub const fn id(&self) -> u16 {
        self.robot.own_stream().origin.0
    }

    /// Goes on with what there is to do.
    fn pass(&mut self, now: Stamp) -> anyhow::Result<()> {
        for _ in 0..SLICES {
            let Self { robot, meter, packing, .. } = self;
            if robot.poll_timeout().is_none_or(|due| due > now) {
                break;
            }
            let batches = robot.counters().batches;
            let ((), took) = meter.timed(Call::HandleTimeout, || robot.handle_timeout(now));
            if robot.counters().batches > batches {
                packing.add(took);
            }
            self.take_events()?;
        }
        Ok(())
    }

    fn hear(&mut self, now: Stamp, bytes: &[u8]) -> anyhow::Result<()> {
        let Self { robot, meter, inserting, .. } = self;
        let merged = robot.counters().merged;
        // What is wrong with it is counted, and asked for again.
        let (_, took) = meter.timed(Call::HandleDatagram, || robot.handle_datagram(now, bytes));
        if robot.counters().merged > merged {
            inserting.add(took);
        }
        self.bytes += bytes.len() as u64;
        self.datagrams += 1;
        self.take_events()
    }

    /// Events hold what was published and merged: left there, they would count as memory.
    fn take_events(&mut self) -> anyhow::Result<()> {
        while let Some(event) = self.robot.poll_event() {
            if let Event::EncodeFailed(error) = event {
                bail!("robot {} could not code a batch: {error}", self.id());
            }
        }
        Ok(())
    }

    /// Packages held of a stream, without a gap from the first one on.
    pub fn held_upto(&self, stream: Stream) -> u32 {
        self.robot.session().received(stream).map_or(0, |held| held.prefix())
    }

    /// Packages that it has published.
    pub fn published(&self) -> u32 {
        self.robot.session().store().newest_known(self.robot.own_stream())
    }

    /// Whether it holds all packages that another one has published.
    fn holds_all_of(&self, other: &Self) -> bool {
        self.held_upto(other.robot.own_stream()) == other.published()
    }

    /// Its layer of another one, if that lacks nothing.
    pub fn whole(&self, other: &Self) -> Option<&Layer> {
        let (fusion, stream) = (self.robot.fusion(), other.robot.own_stream());
        fusion.layer(stream).filter(|_| self.holds_all_of(other) && !fusion.is_in_part(stream))
    }

    /// Voxels in the layers of all others.
    pub fn voxels_of_others(&self) -> usize {
        let own = self.robot.own_stream();
        let others = self.robot.fusion().layers().filter(|(stream, _)| *stream != own);
        others.map(|(_, layer)| layer.len()).sum()
    }

    pub fn own_layer(&self) -> Option<&Layer> {
        self.robot.fusion().layer(self.robot.own_stream())
    }
}

/// What came of waiting.
#[derive(Clone, Copy)]
pub struct Waited {
    pub is_done: bool,
    /// When it was done, or something new came last.
    pub newest: Stamp,
}

/// All robots, and the time that it is.
pub struct Swarm {
    pub members: Vec<Member>,
    pub now: Stamp,
    /// In the last step something was sent: who heard it may have an answer, and no timer says so.
    is_talking: bool,
}

impl Swarm {
    pub fn new(members: Vec<Member>) -> Self {
        Self { members, now: Stamp(0), is_talking: false }
    }

    /// Lets so much time pass. Where nobody has anything to do it is left out.
    pub fn pass(&mut self, micros: i64) -> anyhow::Result<()> {
        let until = self.now.plus_micros(micros);
        while self.now < until {
            let next = self.now.plus_micros(STEP_MICROS);
            let due = self.members.iter().filter_map(|member| member.robot.poll_timeout()).min();
            let due = if self.is_talking { next } else { due.unwrap_or(until).max(next) };
            self.now = due.min(until);
            self.step()?;
        }
        Ok(())
    }

    fn step(&mut self) -> anyhow::Result<()> {
        self.is_talking = false;
        for number in 0..self.members.len() {
            self.members[number].pass(self.now)?;
            loop {
                let Member { robot, meter, .. } = &mut self.members[number];
                let transmit = meter.time(Call::PollTransmit, || robot.poll_transmit(self.now));
                let Some(transmit) = transmit else { break };
                self.is_talking = true;
                for (other, member) in self.members.iter_mut().enumerate() {
                    let id = member.robot.own_stream().origin;
                    let is_addressed = match transmit.to {
                        Destination::Everyone => true,
                        Destination::Peer(to) => to == id,
                    };
                    if other != number && is_addressed {
                        member.hear(self.now, &transmit.bytes)?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Lets time pass until it is so, or for three hours nothing new has come, or after Ctrl-C.
    pub fn until(&mut self, is_done: impl Fn(&Self) -> bool, look: impl Fn(&Self)) -> anyhow::Result<Waited> {
        let (mut most, mut since) = (self.held(), self.now);
        while !is_done(self) {
            if stop::requested() || self.now.since(since) >= GIVE_UP {
                return Ok(Waited { is_done: false, newest: since });
            }
            self.pass(LOOK_MICROS)?;
            look(self);
            // More than ever before: what is dropped and fetched in turn would go on for ever.
            let held = self.held();
            if held.0 > most.0 || held.1 > most.1 {
                (most, since) = ((most.0.max(held.0), most.1.max(held.1)), self.now);
            }
        }
        Ok(Waited { is_done: true, newest: self.now })
    }

    /// Packages and voxels that all hold together.
    fn held(&self) -> (u64, usize) {
        let of = |member: &Member| {
            let session = member.robot.session();
            let packages = session.streams().filter_map(|stream| session.received(stream));
            let voxels = member.robot.fusion().layers().map(|(_, layer)| layer.len());
            (packages.map(|held| held.count()).sum::<u64>(), voxels.sum::<usize>())
        };
        self.members.iter().map(of).fold((0, 0), |all, one| (all.0 + one.0, all.1 + one.1))
    }

    /// Snapshots that all have made for others.
    pub fn snapshots(&self) -> u64 {
        self.members.iter().map(|member| member.robot.counters().snapshots).sum()
    }

    /// Whether each has published what it saw and holds what all others have published.
    pub fn is_agreed(&self) -> bool {
        self.members.iter().all(|member| member.robot.unpublished() == 0 && self.is_served(member))
    }

    /// Whether one holds what all others have published, and what was dropped of that only if nobody has it.
    pub fn is_served(&self, member: &Member) -> bool {
        self.members.iter().filter(|other| other.id() != member.id()).all(|other| {
            let is_lost = || whole_layer(&self.members, other).is_none();
            member.holds_all_of(other)
                && (other.published() == 0 || member.whole(other).is_some() || is_lost())
        })
    }
}

/// The layer of one that flew, of who has all of it.
pub fn whole_layer<'a>(members: &'a [Member], origin: &Member) -> Option<&'a Layer> {
    members.iter().find_map(|member| member.whole(origin))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Resolution, RobotConfig, RobotId};

    #[test]
    fn nobody_waits_for_ever() {
        let resolution = Resolution::from_micrometres(100_000).unwrap();
        let robots = [1, 2].map(|id| Robot::new(RobotConfig::new(RobotId(id), resolution, 7.0), Stamp(0)));
        let mut swarm = Swarm::new(robots.map(|robot| Member::new(robot.unwrap())).into());
        let waited = swarm.until(|_| false, |_| ()).unwrap();
        assert!(!waited.is_done && waited.newest == Stamp(0));
        assert_eq!(swarm.now.since(waited.newest), GIVE_UP);
        assert!(swarm.is_agreed(), "nobody has published anything");
    }
}
