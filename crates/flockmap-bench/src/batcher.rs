//! A robot that maps, closes batches, and does nothing else.

use flockmap::{
    Batch, BatchConfig, Changes, Mapper, MapperConfig, Packer, Pose, RobotId, Scan, ScanReport, Sphere,
    Stamp, StatesUpdate, Stream,
};

/// What comes of a scan, with the time of each: the batches that it closes, and in between that it is mapped.
pub enum Step {
    Mapped,
    Closed(Batch, Changes),
}

/// Its stamps must begin near 0.
pub struct Batcher {
    mapper: Mapper,
    packer: Packer,
    /// Time of the last scan.
    pub last: Stamp,
}

impl Batcher {
    /// Robot `number`, counted from 0, of those that are measured.
    pub fn new(number: usize, mapper: &MapperConfig, batch: BatchConfig) -> anyhow::Result<Self> {
        let stream = Stream { origin: RobotId(number as u16 + 1), epoch: 1 };
        let packer = Packer::new(batch, stream, mapper.resolution, Stamp(0));
        Ok(Self { mapper: Mapper::new(mapper.clone())?, packer, last: Stamp(0) })
    }

    pub fn scan(
        &mut self,
        scan: &Scan,
        pose: &Pose,
        masks: &[Sphere],
        step: impl FnMut(Stamp, Step) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        self.observe(scan.stamp, |mapper| Ok(mapper.insert(scan, pose, masks)), step)
    }

    pub fn states(
        &mut self,
        update: &StatesUpdate<'_>,
        step: impl FnMut(Stamp, Step) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        self.observe(update.stamp, |mapper| Ok(mapper.insert_states(update)?), step)
    }

    fn observe(
        &mut self,
        stamp: Stamp,
        insert: impl FnOnce(&mut Mapper) -> anyhow::Result<ScanReport>,
        mut step: impl FnMut(Stamp, Step) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let Self { mapper, packer, last } = self;
        // The deadline of a batch may pass between two scans.
        while let Some(deadline) = packer.deadline(mapper).filter(|at| *at < stamp) {
            let now = deadline.max(*last);
            let Some((batch, changes)) = packer.close_due(now, mapper) else { break };
            step(now, Step::Closed(batch, changes))?;
        }
        *last = stamp;
        let report = insert(mapper)?;
        packer.note_observed(stamp, stamp, report.sensor);
        step(stamp, Step::Mapped)?;
        while let Some((batch, changes)) = packer.close_due(stamp, mapper) {
            step(stamp, Step::Closed(batch, changes))?;
        }
        Ok(())
    }

    /// The batch that is still open.
    pub fn end(&mut self) -> Option<(Batch, Changes)> {
        self.packer.close(self.last, &mut self.mapper)
    }
}
