//! The two halves of a method.

use anyhow::Result;
use flockmap::codec::Batch;
use flockmap::grid::{BlockIndex, Changes, Layer, Pose, Scan, Sphere, Stamp, StateBlock};

/// A scan that has been mapped.
#[derive(Clone, Copy)]
pub struct Observation<'a> {
    /// The scan, in the frame of the sensor.
    pub scan: &'a Scan,
    /// `T_map_sensor`: where the scan was taken.
    pub pose: &'a Pose,
    /// Where team-mates were; points in these spheres are no obstacles.
    pub masks: &'a [Sphere],
}

/// Messages, in the order in which they go out.
pub type Messages = Vec<Vec<u8>>;

/// The half that sends. Every method is given the same scans and the same batches, in this order: for each
/// scan [`Self::scan`], then [`Self::batch`] for each batch that it closes. What its rules keep back at the
/// end of the record stays unsent.
pub trait Sender: Send {
    /// A scan has been mapped. Appends messages to `out`; most methods wait for the batch.
    ///
    /// # Errors
    /// If the scan cannot be put into a message of this method.
    fn scan(&mut self, _seen: &Observation<'_>, _out: &mut Messages) -> Result<()> {
        Ok(())
    }

    /// A batch of mapping is closed with these net changes, of which there is at least one. Appends messages
    /// to `out`.
    ///
    /// # Errors
    /// If the changes cannot be put into messages of this method.
    fn batch(&mut self, now: Stamp, batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()>;

    /// The messages of a batch are out. Here a sender does what a robot does anyhow to know its own map, and
    /// what is not counted as time for the batch.
    fn published(&mut self, _batch: &Batch, _changes: &Changes) {}
}

/// The half that listens. It is given the messages of one sender in order, none lost, and makes a map of
/// nothing but their bytes.
pub trait Receiver: Send {
    /// Takes in a message. Memory: the map, kept within [`super::state_map::BLOCKS_MAX`] blocks, and what the
    /// message unpacks to, at most 256 MB.
    ///
    /// # Errors
    /// If the message is damaged, or the map is full.
    fn receive(&mut self, message: &[u8]) -> Result<()>;

    /// All blocks of which anything is known, in no order.
    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_>;

    /// The map with the stamp of every voxel, for methods that send stamps.
    fn layer(&self) -> Option<&Layer> {
        None
    }
}
