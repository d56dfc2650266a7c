//! States of voxels from a mapper elsewhere: kinds 4 and 5.

use flockmap::{Resolution, Stamp, State, States, StatesUpdate, Voxel, VoxelBox};

use super::fields::{HEADER_BYTES, MessageError, Reader};

/// Header, stamp, resolution, place of the sensor, flags.
const COMMON_BYTES: usize = HEADER_BYTES + 8 + 8 + 24 + 4;
const VOXELS_HEADER_BYTES: usize = COMMON_BYTES + 4;
const VOXEL_BYTES: usize = 13;
const BOX_HEADER_BYTES: usize = COMMON_BYTES + 24;

/// Flag: the place of the sensor is given.
const SENSOR_GIVEN: u32 = 1;
/// Flag of a box: Unknown takes back what was known.
const UNKNOWN_CLEARS: u32 = 2;

/// The longest message.
pub(super) fn bytes_max(states_max: u32, box_states_max: u32) -> usize {
    let voxels = VOXELS_HEADER_BYTES + VOXEL_BYTES * states_max as usize;
    voxels.max(BOX_HEADER_BYTES + box_states_max as usize)
}

/// States of voxels, as a sensor program says them: [`StatesUpdate`] with voxels of its own.
#[derive(Clone, PartialEq, Debug)]
pub struct StatesMessage {
    /// When it was observed. 0 means now.
    pub stamp: Stamp,
    /// Side of the voxels.
    pub resolution: Resolution,
    /// Where the sensor was, in metres in the map, if that is known.
    pub sensor: Option<[f64; 3]>,
    /// The voxels.
    pub states: OwnedStates,
}

/// As [`States`], owned.
#[derive(Clone, PartialEq, Debug)]
pub enum OwnedStates {
    /// Kind 4: single voxels.
    Voxels(Vec<(Voxel, State)>),
    /// Kind 5: a box.
    Box {
        /// Which voxels.
        region: VoxelBox,
        /// One for each: x runs fastest, then y, then z.
        states: Vec<State>,
        /// Whether Unknown takes back what was known.
        clear_unknown: bool,
    },
}

impl StatesMessage {
    /// What a robot takes.
    pub fn update(&self) -> StatesUpdate<'_> {
        let Self { stamp, resolution, sensor, .. } = *self;
        let states = match &self.states {
            OwnedStates::Voxels(voxels) => States::Voxels(voxels),
            OwnedStates::Box { region, states, clear_unknown } => {
                States::Box { region: *region, states, clear_unknown: *clear_unknown }
            }
        };
        StatesUpdate { stamp, resolution, sensor, states }
    }

    pub(super) const fn kind(&self) -> u8 {
        match self.states {
            OwnedStates::Voxels(_) => 4,
            OwnedStates::Box { .. } => 5,
        }
    }

    /// What follows the header of kind 4.
    pub(super) fn parse_voxels(reader: &mut Reader<'_>, max: u32) -> Result<Self, MessageError> {
        reader.expected = VOXELS_HEADER_BYTES as u64;
        let (message, _) = Self::parse_common(reader, SENSOR_GIVEN)?;
        let count = u32::from_le_bytes(reader.take()?);
        if count > max {
            return Err(MessageError::TooMany { got: count.into(), max, option: "states_max" });
        }
        reader.expected += u64::from(count) * VOXEL_BYTES as u64;
        reader.check_length()?;
        let mut voxels = Vec::with_capacity(count as usize);
        for (number, bytes) in reader.records::<VOXEL_BYTES>(count)?.iter().enumerate() {
            let [a, b, c, d, e, f, g, h, i, j, k, l, state] = *bytes;
            let [x, y, z] = [[a, b, c, d], [e, f, g, h], [i, j, k, l]].map(i32::from_le_bytes);
            voxels.push((Voxel::new(x, y, z), state_of(number, state)?));
        }
        Ok(Self { states: OwnedStates::Voxels(voxels), ..message })
    }

    /// What follows the header of kind 5.
    pub(super) fn parse_box(reader: &mut Reader<'_>, max: u32) -> Result<Self, MessageError> {
        reader.expected = BOX_HEADER_BYTES as u64;
        let (message, flags) = Self::parse_common(reader, SENSOR_GIVEN | UNKNOWN_CLEARS)?;
        let mut min = [0; 3];
        for at in &mut min {
            *at = i32::from_le_bytes(reader.take()?);
        }
        let mut size = [0; 3];
        for side in &mut size {
            *side = u32::from_le_bytes(reader.take()?);
        }
        let region = VoxelBox::new(Voxel::new(min[0], min[1], min[2]), size);
        let region = region.ok_or(MessageError::Box { min, size })?;
        let count = u32::try_from(region.volume()).ok().filter(|count| *count <= max);
        let too_many = MessageError::TooMany { got: region.volume(), max, option: "box_states_max" };
        let count = count.ok_or(too_many)?;
        reader.expected += u64::from(count);
        reader.check_length()?;
        let mut states = Vec::with_capacity(count as usize);
        for (number, [state]) in reader.records(count)?.iter().enumerate() {
            states.push(state_of(number, *state)?);
        }
        let clear_unknown = flags & UNKNOWN_CLEARS != 0;
        Ok(Self { states: OwnedStates::Box { region, states, clear_unknown }, ..message })
    }

    /// What both kinds begin with, and the flags; without a voxel.
    fn parse_common(reader: &mut Reader<'_>, flags_known: u32) -> Result<(Self, u32), MessageError> {
        let stamp = Stamp(i64::from_le_bytes(reader.take()?));
        let [metres, sensor @ ..] = reader.numbers::<4>()?;
        let flags = u32::from_le_bytes(reader.take()?);
        if flags & !flags_known != 0 {
            return Err(MessageError::Flags(flags));
        }
        let resolution = Resolution::from_metres(metres).ok_or(MessageError::Resolution(metres))?;
        let sensor = (flags & SENSOR_GIVEN != 0).then_some(sensor);
        Ok((Self { stamp, resolution, sensor, states: OwnedStates::Voxels(Vec::new()) }, flags))
    }

    /// What follows the header.
    pub(super) fn emit(&self, out: &mut Vec<u8>) {
        let mut flags = if self.sensor.is_some() { SENSOR_GIVEN } else { 0 };
        if let OwnedStates::Box { clear_unknown: true, .. } = self.states {
            flags |= UNKNOWN_CLEARS;
        }
        out.extend(self.stamp.0.to_le_bytes());
        out.extend(self.resolution.metres().to_le_bytes());
        out.extend(self.sensor.unwrap_or_default().iter().flat_map(|metres| metres.to_le_bytes()));
        out.extend(flags.to_le_bytes());
        match &self.states {
            OwnedStates::Voxels(voxels) => {
                out.extend((voxels.len() as u32).to_le_bytes());
                for (voxel, state) in voxels {
                    out.extend([voxel.x, voxel.y, voxel.z].iter().flat_map(|at| at.to_le_bytes()));
                    out.push(byte_of(*state));
                }
            }
            OwnedStates::Box { region, states, .. } => {
                let min = region.min();
                out.extend([min.x, min.y, min.z].iter().flat_map(|at| at.to_le_bytes()));
                out.extend(region.size().iter().flat_map(|side| side.to_le_bytes()));
                out.extend(states.iter().map(|state| byte_of(*state)));
            }
        }
    }
}

const fn byte_of(state: State) -> u8 {
    match state {
        State::Unknown => 0,
        State::Free => 1,
        State::Occupied => 2,
    }
}

const fn state_of(number: usize, byte: u8) -> Result<State, MessageError> {
    match byte {
        0 => Ok(State::Unknown),
        1 => Ok(State::Free),
        2 => Ok(State::Occupied),
        got => Err(MessageError::State { got, number }),
    }
}
