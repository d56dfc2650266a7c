//! What a payload, or a section of a chunk, begins with: the set of tables, from where it was seen, and where
//! in its box it begins.

use super::block_box::{BOX_BLOCKS_MAX, BlockBox};
use super::tables::TableSet;
use crate::bytes::{put_varint, put_zigzag};
use crate::codec::Codec;
use crate::error::PackageError;
use crate::fields::Fields;

/// What a payload begins with.
pub(crate) struct Head {
    pub(crate) set: TableSet,
    /// In sixteenths of a voxel, [`as_sent`].
    pub(crate) sensor: [i32; 3],
    /// Blocks of the box before the first that is coded.
    pub(crate) before: u64,
}

/// The first byte of a payload that is gap coded: the number after those of the sets of tables.
pub(crate) const GAP_CODED: u8 = TableSet::ALL.len() as u8;
/// Numbers that say which set of tables there is, or that there is none.
const SETS: u64 = GAP_CODED as u64 + 1;

/// Sixteenths of a voxel to which the place of a sensor is rounded.
const SENSOR_UNIT: i32 = 16;

/// A sensor as it is sent: in the middle of its unit.
pub(crate) fn as_sent(sensor: [i32; 3]) -> [i32; 3] {
    sensor.map(|at| (at & -SENSOR_UNIT) | (SENSOR_UNIT / 2))
}

impl Head {
    pub(crate) fn write(&self, region: &BlockBox, out: &mut Vec<u8>) {
        put_varint(out, self.before * SETS + u64::from(self.set.id()));
        for (at, middle) in self.sensor.into_iter().zip(region.middle()) {
            put_zigzag(out, (i64::from(at) - middle).div_euclid(i64::from(SENSOR_UNIT)));
        }
    }

    /// `region` is the box of the payload.
    pub(crate) fn read(region: &BlockBox, reader: &mut Fields<'_>) -> Result<Self, PackageError> {
        let wrong = |rule| PackageError::Payload { codec: Codec::Flock, rule };
        let volume = region.volume().min(BOX_BLOCKS_MAX) as u64;
        let number = reader.number("tables and blocks before", (volume + 1) * SETS - 1)?;
        let set = TableSet::from_id((number % SETS) as u8).ok_or_else(|| wrong("the tables are known"))?;
        let mut sensor = [0; 3];
        for (at, middle) in sensor.iter_mut().zip(region.middle()) {
            let place = reader.signed("sensor")?.checked_mul(SENSOR_UNIT.into());
            let place = place.and_then(|place| place.checked_add(middle + i64::from(SENSOR_UNIT / 2)));
            let place = place.and_then(|at| i32::try_from(at).ok());
            *at = place.ok_or_else(|| wrong("the sensor is within 2³¹ sixteenths of a voxel"))?;
        }
        Ok(Self { set, sensor, before: number / SETS })
    }
}
