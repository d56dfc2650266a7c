//! The two halves of a method.

use flockmap_codec::Cycle;
use flockmap_grid::{
    BlockIndex, Changes, Layer, Mapper, Pose, Scan, ScanReport, Sphere, Stamp, State, StateBlock, Voxel,
};

use crate::{ReceiveError, SendError};

/// What a sender knows when a scan has been mapped.
#[derive(Clone, Copy)]
pub struct Observation<'a> {
    /// The time, on the robot's clock.
    pub now: Stamp,
    /// The scan, in the frame of the sensor.
    pub scan: &'a Scan,
    /// `T_map_sensor`: where the scan was taken.
    pub pose: &'a Pose,
    /// Where team-mates were; points in these spheres are no obstacles.
    pub masks: &'a [Sphere],
    /// The robot's own map, with the scan in it.
    pub mapper: &'a Mapper,
    /// What became of the scan.
    pub report: &'a ScanReport,
}

/// The half that tells. Every method is given the same scans, the same mapper and the same cycles, in this order: for each scan
/// [`Self::scan`], then [`Self::cycle`] for each cycle that it closes.
pub trait Sender: Send {
    /// A scan has been mapped. Appends messages to `out`; most methods wait for the cycle.
    ///
    /// # Errors
    /// [`SendError`] if the scan cannot be put into a message of this method.
    fn scan(&mut self, _seen: &Observation<'_>, _out: &mut Vec<Vec<u8>>) -> Result<(), SendError> {
        Ok(())
    }

    /// A cycle of mapping is closed with these net changes, of which there is at least one. Appends messages to `out`.
    ///
    /// # Errors
    /// [`SendError`] if the changes cannot be put into messages of this method.
    fn cycle(
        &mut self,
        now: Stamp,
        cycle: &Cycle,
        changes: &Changes,
        mapper: &Mapper,
        out: &mut Vec<Vec<u8>>,
    ) -> Result<(), SendError>;

    /// The messages of a cycle are out. Here a sender does what a robot does anyhow to know its own map, and what is not
    /// counted as time for the cycle.
    fn told(&mut self, _cycle: &Cycle, _changes: &Changes) {}

    /// The record is over. Appends only what the method itself would still send: what its rules keep back stays unsent.
    ///
    /// # Errors
    /// As for [`Self::cycle`].
    fn end(&mut self, _now: Stamp, _mapper: &Mapper, _out: &mut Vec<Vec<u8>>) -> Result<(), SendError> {
        Ok(())
    }
}

/// The half that listens. It is given the messages of one sender in order, none lost, and makes a map of nothing but their bytes.
pub trait Receiver: Send {
    /// Takes in a message. Memory: the map, kept within [`crate::BLOCKS_MAX`] blocks, and what the message unpacks to, at
    /// most 256 MB.
    ///
    /// # Errors
    /// [`ReceiveError`] if the message is damaged. What it said before the damage may be in the map or not.
    fn receive(&mut self, message: &[u8]) -> Result<(), ReceiveError>;

    /// What the messages so far say of a voxel.
    fn state(&self, voxel: Voxel) -> State;

    /// All blocks of which anything is known, in no order.
    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_>;

    /// The map with the stamp of every voxel, for methods that send stamps.
    fn layer(&self) -> Option<&Layer> {
        None
    }
}
