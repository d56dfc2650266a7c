//! The disk of a robot, with the node's own store and epoch file on it: in memory, failing as drawn, with the
//! power cut where a run ends.

use super::purpose;
use flockmap::{Event, Robot, RobotConfig, Stamp};
use flockmap_store::memory::{Faults, MemoryDisk, PowerCut};
use flockmap_store::{Compaction, EpochFile, Identity, Store, StoreLog, StoreOptions};
use flockmap_worlds::random::Random;
use std::sync::Arc;
use std::time::Duration;

/// Small, so that logs are made shorter now and then.
const OPTIONS: StoreOptions = StoreOptions { bytes_max: 256 << 10, sync_period: Duration::from_millis(300) };

pub(super) struct SimDisk {
    disk: MemoryDisk,
    random: Random,
    is_faulty: bool,
    run: Option<Run>,
}

/// What a run has on its disk.
struct Run {
    log: StoreLog,
    compaction: Option<Compaction>,
    epochs: EpochFile,
}

/// What a run finds on its disk.
pub(super) struct Found {
    store: Store,
    epochs: EpochFile,
}

impl Found {
    /// The highest epoch that is known to have been used.
    pub(super) fn last_epoch(&self) -> Option<u64> {
        self.epochs.last().max(self.store.last_epoch())
    }
}

impl SimDisk {
    pub(super) fn new(seed: u64, number: usize, is_faulty: bool) -> Self {
        let random = purpose::of_robot(seed, purpose::DISK, number);
        Self { disk: MemoryDisk::default(), random, is_faulty, run: None }
    }

    /// The power comes back, and the robot looks at what is there.
    ///
    /// # Errors
    /// What the store cannot work with; a disk that fails is not among it.
    pub(super) fn open(&mut self, config: &RobotConfig) -> Result<Found, String> {
        self.disk.set_faults(Faults::default());
        let cut =
            PowerCut { bytes_kept: self.random.below(2_000) as usize, names_kept: self.random.happens(0.5) };
        if self.random.happens(0.7) {
            self.disk.cut_power(cut);
        }
        let faults = self.faults();
        self.disk.set_faults(faults);
        let swarm = config.session.swarm;
        let identity = Identity { swarm, robot: config.id, resolution: config.mapper.resolution };
        let store = Store::open(Arc::new(self.disk.clone()), identity, OPTIONS);
        let store = store.map_err(|error| error.to_string())?;
        let (epochs, _) = EpochFile::open(Arc::new(self.disk.clone()), swarm, config.id);
        Ok(Found { store, epochs })
    }

    /// The robot takes what there is, and a run begins.
    ///
    /// # Errors
    /// The epoch was used before, as far as the store knows.
    pub(super) fn begin(&mut self, found: Found, robot: &mut Robot, now: Stamp) -> Result<(), String> {
        let Found { mut store, mut epochs } = found;
        let epoch = robot.own_stream().epoch;
        // The next run relies on the clock then.
        let _ = epochs.keep(epoch);
        store.restore(robot, now);
        let log = store.start(epoch).map_err(|error| error.to_string())?;
        self.run = Some(Run { log, compaction: None, epochs });
        Ok(())
    }

    /// Stores what an event says is to be stored.
    pub(super) fn note(&mut self, now: Stamp, event: &Event) {
        let Some(Run { log, epochs, .. }) = &mut self.run else { return };
        if let Event::RunBegun(run) = event {
            log.note_epoch(run.epoch);
            let _ = epochs.keep(run.epoch);
        }
        log.handle_timeout(now);
        log.note(now, event);
    }

    /// Lets a compaction go on, with no event of the robot left unread.
    pub(super) fn go_on(&mut self, robot: &Robot) {
        // The run before is still needed.
        if robot.is_republishing() {
            return;
        }
        let Some(Run { log, compaction, .. }) = &mut self.run else { return };
        if compaction.is_none() {
            *compaction = log.begin_compaction();
        }
        if let Some(done) = compaction.take_if(|compaction| !compaction.step(robot)) {
            log.end_compaction(done.finish());
        }
    }

    /// The run ends, in the middle of whatever it was doing.
    pub(super) fn crash(&mut self) {
        self.run = None;
    }

    fn faults(&mut self) -> Faults {
        let random = &mut self.random;
        let (kind, first) = (random.below(12), self.disk.calls() + random.below(80));
        let (room, readable) = (random.below(20_000) as usize, random.below(4_000) as usize);
        if !self.is_faulty {
            return Faults::default();
        }
        match kind {
            // At the start already.
            0 => Faults { calls: self.disk.calls()..u64::MAX, ..Faults::default() },
            1 => Faults { calls: first..u64::MAX, ..Faults::default() },
            2 | 3 => Faults { calls: first..first + 1, ..Faults::default() },
            4 | 5 => Faults { room: Some(room), ..Faults::default() },
            6 => Faults { sync: true, ..Faults::default() },
            7 => Faults { create: true, ..Faults::default() },
            8 => Faults { remove: true, ..Faults::default() },
            9 => Faults { readable: Some(readable), ..Faults::default() },
            _ => Faults::default(),
        }
    }
}
