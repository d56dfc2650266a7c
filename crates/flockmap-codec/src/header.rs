//! The header of a package.

use flockmap_grid::{Changes, Resolution, RobotId, Stamp, Stream, Voxel, VoxelBox, seconds_of_epoch};

use crate::varint::{self, Reader};
use crate::{Codec, PackageError};

/// The version of the package format, the first byte of every package.
pub const FORMAT_VERSION: u8 = 4;

/// What a package says about itself: 25 to 35 bytes on the wire as a rule, with the check.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Header {
    /// Whose observations these are.
    pub stream: Stream,
    /// Changes: the number of this package in its stream, from 1.
    /// Present state: the newest package of the stream that is contained, together with all before it; from 1.
    pub index: u32,
    /// Changes: when the cycle began. Present state: the oldest stamp in the package. On the origin's clock.
    pub cycle_start: Stamp,
    /// Changes: when the cycle was closed; the stamp of every voxel in the package, the same in all packages of
    /// one cycle. Present state: the newest stamp in the package. Never before `cycle_start`.
    pub cycle_end: Stamp,
    /// The newest package that this one builds on: who is to decode it must hold packages 1 to `reference` of the stream. 0: none is
    /// needed. Always below `index`; 0 in a present state.
    pub reference: u32,
    /// Whether the payload can be decoded without what earlier packages said. Its `reference` is then only what has to be merged
    /// first: an earlier package that is told against what this one changes. True for a present state, and where `reference` is 0.
    pub is_alone: bool,
    /// Side of a voxel.
    pub resolution: Resolution,
    /// The box that the payload speaks of, in the origin's grid.
    pub region: VoxelBox,
    /// How the payload is coded.
    pub codec: Codec,
    /// Changes or present state.
    pub content: ContentKind,
    /// What to send first where there is not room for all. Of a present state always `Obstacles`.
    pub priority: Priority,
}

/// How urgent the changes of a package are: a radio with little room sends the urgent ones first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Priority {
    /// At least one voxel became Occupied.
    Obstacles,
    /// Free space of which some may be within [`FAR_METRES`] of the sensor.
    NearFree,
    /// Free space in a box farther than [`FAR_METRES`] from the sensor.
    FarFree,
}

/// Free space farther than this from the sensor is the least urgent. In metres.
pub const FAR_METRES: u32 = 4;

impl Priority {
    /// All priorities, the most urgent first.
    pub const ALL: [Self; 3] = [Self::Obstacles, Self::NearFree, Self::FarFree];

    const fn id(self) -> u8 {
        match self {
            Self::Obstacles => 0,
            Self::NearFree => 1,
            Self::FarFree => 2,
        }
    }

    /// The priority of changes in a box, seen from `sensor`, in sixteenths of a voxel from the corner of voxel (0, 0, 0).
    pub(crate) fn of(changes: &Changes, region: &VoxelBox, sensor: [i32; 3], resolution: Resolution) -> Self {
        if changes.has_occupied() {
            Self::Obstacles
        } else if is_far(region, sensor, resolution) {
            Self::FarFree
        } else {
            Self::NearFree
        }
    }
}

/// Whether all of a box is farther than [`FAR_METRES`] from the sensor.
fn is_far(region: &VoxelBox, sensor: [i32; 3], resolution: Resolution) -> bool {
    let (min, max) = (region.min(), region.max());
    let sides = [(min.x, max.x), (min.y, max.y), (min.z, max.z)];
    // Gaps are below 2³³ sixteenths, a voxel below 2²⁷ micrometres: the sum of squares is below 2¹²².
    let gaps = sides.into_iter().zip(sensor).map(|((min, max), sensor)| {
        let (low, high) = (i64::from(min) * 16, (i64::from(max) + 1) * 16);
        let gap = (low - i64::from(sensor)).max(i64::from(sensor) - high).max(0);
        u128::from(gap.unsigned_abs()).pow(2)
    });
    let far = u128::from(FAR_METRES) * 1_000_000 * 16;
    gaps.sum::<u128>() * u128::from(resolution.micrometres()).pow(2) > far * far
}

/// What kind of content a package has.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum ContentKind {
    /// What changed in one cycle; voxels of the box that are not named stay as they are.
    Changes,
    /// One tile of the state of the stream after packages 1 to `index`, or of the part of it that packages after `since` made. Who has
    /// packages 1 to `since` and all tiles of the set knows all that packages 1 to `index` said.
    Present {
        /// 0: the whole state. Else the tiles hold every voxel whose newest change is in the packages from `since` + 1 to
        /// `index`, and may hold others. Below `index`.
        since: u32,
        /// Tells sets apart: a check of the whole state that was cut into tiles. Tiles of different sets must
        /// not be counted together.
        set: u32,
        /// Number of this tile, from 0.
        tile: u32,
        /// Number of tiles in the set, at least 1.
        tiles: u32,
    },
}

/// What follows the fields of [`Header`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tail {
    /// Bytes of header up to the check; all of them are checked.
    pub(crate) checked: usize,
    /// CRC-32 over header and decoded content.
    pub(crate) check: u32,
}

const KIND_CHANGES: u8 = 0;
const KIND_PRESENT: u8 = 1;
/// Changes that are told without what was before, and are to be merged after their reference.
const KIND_ALONE: u8 = 2;
/// In the byte of codec and kind: bits 0 to 2 are the codec, 3 and 4 the kind, 5 and 6 the priority; bit 7: the box is made of whole
/// blocks, and counted in these.
const BOX_IN_BLOCKS: u8 = 1 << 7;
const KIND_SHIFT: u32 = 3;
const PRIORITY_SHIFT: u32 = 5;
/// The stream stands behind version, codec and kind.
pub(crate) const STREAM_AT: usize = 2;
/// Voxels along the side of a block.
const BLOCK_SIDE: u32 = 8;

impl Header {
    /// Appends everything up to the check. The length goes with the values: `reference` takes less the nearer it is to `index`,
    /// and the box takes less if it is made of whole blocks.
    pub(crate) fn write(&self, out: &mut Vec<u8>) {
        let kind = match self.content {
            ContentKind::Changes if self.is_alone && self.reference != 0 => KIND_ALONE,
            ContentKind::Changes => KIND_CHANGES,
            ContentKind::Present { .. } => KIND_PRESENT,
        };
        out.push(FORMAT_VERSION);
        let (unit, flag) = if is_in_blocks(&self.region) { (BLOCK_SIDE, BOX_IN_BLOCKS) } else { (1, 0) };
        out.push(self.codec.id() | kind << KIND_SHIFT | self.priority.id() << PRIORITY_SHIFT | flag);
        varint::write(out, u64::from(self.stream.origin.0));
        varint::write(out, self.stream.epoch);
        varint::write(out, u64::from(self.index));
        varint::write_signed(out, self.cycle_end.0.wrapping_sub(epoch_micros(self.stream.epoch)));
        varint::write(out, self.cycle_end.0.wrapping_sub(self.cycle_start.0) as u64);
        varint::write(out, resolution_code(self.resolution));
        write_box(&self.region, unit, out);
        match self.content {
            ContentKind::Changes => write_back(self.index, self.reference, out),
            ContentKind::Present { since, set, tile, tiles } => {
                write_back(self.index, since, out);
                out.extend_from_slice(&set.to_le_bytes());
                varint::write(out, u64::from(tile));
                varint::write(out, u64::from(tiles));
            }
        }
    }

    /// Reads header and check from the front of `bytes`; returns the payload, which is all of the rest.
    pub(crate) fn read(bytes: &[u8]) -> Result<(Self, Tail, &[u8]), PackageError> {
        let mut reader = Reader::new(bytes);
        let version = reader.byte("version")?;
        if version != FORMAT_VERSION {
            return Err(PackageError::Version { found: version });
        }
        let all = reader.byte("codec and kind")?;
        let (codec, kind, priority) = (all & 7, all >> KIND_SHIFT & 3, all >> PRIORITY_SHIFT & 3);
        let codec = Codec::from_id(codec).ok_or(PackageError::Codec { found: codec })?;
        let unit = if all & BOX_IN_BLOCKS == 0 { 1 } else { BLOCK_SIDE };
        if ![KIND_CHANGES, KIND_PRESENT, KIND_ALONE].contains(&kind) {
            return Err(PackageError::ContentKind { found: kind });
        }
        let priority = Priority::ALL.into_iter().find(|known| known.id() == priority);
        let priority = priority.ok_or(PackageError::Header { rule: "priorities are 0 to 2" })?;
        if kind == KIND_PRESENT && priority != Priority::Obstacles {
            return Err(PackageError::Header { rule: "a present state has priority 0" });
        }
        let u32_max = u64::from(u32::MAX);
        let origin = RobotId(reader.number("origin", u64::from(u16::MAX))? as u16);
        let epoch = reader.number("epoch", u64::MAX)?;
        let index = reader.number("index", u32_max)? as u32;
        if index == 0 {
            return Err(PackageError::Header { rule: "indices begin at 1" });
        }
        let cycle_end = Stamp(reader.signed("cycle end")?.wrapping_add(epoch_micros(epoch)));
        let duration = reader.number("cycle duration", u64::MAX)?;
        let cycle_start = cycle_end.0.checked_sub_unsigned(duration).map(Stamp);
        let cycle_start = cycle_start
            .ok_or(PackageError::Header { rule: "the cycle starts within the range of 64-bit stamps" })?;
        let resolution = read_resolution(&mut reader)?;
        let region = read_box(&mut reader, unit)?;
        if unit == 1 && is_in_blocks(&region) {
            return Err(PackageError::Header { rule: "a box of whole blocks is counted in blocks" });
        }
        let (content, reference) = if kind == KIND_PRESENT {
            let since = read_back(&mut reader, index, "since", "a span begins after an earlier package")?;
            let set = reader.u32_le("set")?;
            let tile = reader.number("tile", u32_max)? as u32;
            let tiles = reader.number("tiles", u32_max)? as u32;
            if tile >= tiles {
                return Err(PackageError::Header { rule: "a tile number is below the number of tiles" });
            }
            (ContentKind::Present { since, set, tile, tiles }, 0)
        } else {
            let reference = read_back(&mut reader, index, "reference", "a reference is an earlier package")?;
            if reference == 0 && kind == KIND_ALONE {
                return Err(PackageError::Header { rule: "who is to be merged after another names it" });
            }
            (ContentKind::Changes, reference)
        };
        let checked = reader.offset();
        let check = reader.u32_le("check")?;
        let stream = Stream { origin, epoch };
        let is_alone = reference == 0 || kind == KIND_ALONE;
        let header = Self {
            stream,
            index,
            cycle_start,
            cycle_end,
            reference,
            is_alone,
            resolution,
            region,
            codec,
            content,
            priority,
        };
        Ok((header, Tail { checked, check }, reader.rest()))
    }
}

/// An earlier package as the number of steps back from `index`; 0 for none.
fn write_back(index: u32, earlier: u32, out: &mut Vec<u8>) {
    let back = if earlier == 0 { 0 } else { index.saturating_sub(earlier) };
    varint::write(out, u64::from(back));
}

fn read_back(
    reader: &mut Reader<'_>,
    index: u32,
    field: &'static str,
    rule: &'static str,
) -> Result<u32, PackageError> {
    match reader.number(field, u64::from(u32::MAX))? as u32 {
        0 => Ok(0),
        back if back < index => Ok(index - back),
        _ => Err(PackageError::Header { rule }),
    }
}

/// Real robots take the seconds since 1970 for their epoch, and their clocks tell the microseconds: what is left of a stamp is
/// the time since the run began, which is short. Any other epoch does no harm.
fn epoch_micros(epoch: u64) -> i64 {
    i64::from(seconds_of_epoch(epoch)) * 1_000_000
}

/// Twice the millimetres where they are whole, else twice the micrometres and one.
fn resolution_code(resolution: Resolution) -> u64 {
    let micrometres = u64::from(resolution.micrometres());
    if micrometres.is_multiple_of(1_000) { micrometres / 1_000 * 2 } else { micrometres * 2 + 1 }
}

fn read_resolution(reader: &mut Reader<'_>) -> Result<Resolution, PackageError> {
    let code = reader.number("resolution", u64::from(u32::MAX))?;
    let micrometres = if code & 1 == 0 { code / 2 * 1_000 } else { code / 2 };
    u32::try_from(micrometres)
        .ok()
        .and_then(Resolution::from_micrometres)
        // There is one way to write each.
        .filter(|resolution| resolution_code(*resolution) == code)
        .ok_or(PackageError::Header {
            rule: "the resolution is 1,000 to 100,000,000 micrometres in its shorter form",
        })
}

fn is_in_blocks(region: &VoxelBox) -> bool {
    let min = region.min();
    let corner = [min.x, min.y, min.z];
    corner.iter().all(|corner| corner.rem_euclid(BLOCK_SIDE as i32) == 0)
        && region.size().iter().all(|size| size.is_multiple_of(BLOCK_SIDE))
}

/// Corner and size in `unit`s of voxels along each axis, of which the box is made.
fn write_box(region: &VoxelBox, unit: u32, out: &mut Vec<u8>) {
    let min = region.min();
    for corner in [min.x, min.y, min.z] {
        varint::write_signed(out, i64::from(corner).div_euclid(i64::from(unit)));
    }
    for size in region.size() {
        varint::write(out, u64::from((size / unit).saturating_sub(1)));
    }
}

fn read_box(reader: &mut Reader<'_>, unit: u32) -> Result<VoxelBox, PackageError> {
    let mut corner = [0i32; 3];
    for corner in &mut corner {
        let low = reader.signed("box corner")?.checked_mul(i64::from(unit)).ok_or(BOX)?;
        *corner = i32::try_from(low).map_err(|_| BOX)?;
    }
    let mut size = [0u32; 3];
    for size in &mut size {
        let units = reader.number("box size", u64::from(u32::MAX) - 1)? + 1;
        *size = units.checked_mul(u64::from(unit)).and_then(|size| u32::try_from(size).ok()).ok_or(BOX)?;
    }
    VoxelBox::new(Voxel::new(corner[0], corner[1], corner[2]), size).ok_or(BOX)
}

const BOX: PackageError = PackageError::Header { rule: "the box lies within the limits of the grid" };

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn header() -> impl Strategy<Value = Header> {
        let stamp = prop_oneof![any::<i64>(), 0..1_800_000_000_000_000i64];
        let numbers = (any::<u16>(), any::<u64>(), 1..=u32::MAX, any::<u32>(), 1_000..=100_000_000u32);
        let side = prop_oneof![1..200u32, Just(1 << 28)];
        let corner = -(1 << 28)..=1i32;
        let corners = [corner.clone(), corner.clone(), corner];
        let region = (corners, [side.clone(), side.clone(), side], any::<bool>());
        let region = region.prop_map(|(corner, size, is_in_blocks)| match is_in_blocks {
            true => (corner.map(|c| c & !7), size.map(|s| (s + 7) & !7)),
            false => (corner, size),
        });
        let content = prop_oneof![
            Just(ContentKind::Changes),
            (any::<u32>(), any::<u32>(), 0..9u32, 9..2_000u32)
                .prop_map(|(since, set, tile, tiles)| ContentKind::Present { since, set, tile, tiles }),
        ];
        let content = (content, 0..Priority::ALL.len());
        let codec = (0..Codec::ALL.len()).prop_map(|at| Codec::ALL[at]);
        (numbers, [stamp.clone(), stamp], region, codec, content).prop_map(
            |(
                (origin, epoch, index, reference, resolution),
                stamps,
                (corner, size),
                codec,
                (mut content, priority),
            )| {
                if let ContentKind::Present { since, .. } = &mut content {
                    *since %= index;
                }
                let priority = if content == ContentKind::Changes { priority } else { 0 };
                Header {
                    priority: Priority::ALL[priority],
                    stream: Stream { origin: RobotId(origin), epoch },
                    index,
                    cycle_start: Stamp(stamps[0].min(stamps[1])),
                    cycle_end: Stamp(stamps[0].max(stamps[1])),
                    reference: if content == ContentKind::Changes { reference % index } else { 0 },
                    is_alone: content != ContentKind::Changes || reference % index == 0 || epoch % 2 == 0,
                    // One of three in whole millimetres.
                    resolution: Resolution::from_micrometres(match resolution % 3 {
                        0 => resolution / 1_000 * 1_000,
                        _ => resolution,
                    })
                    .unwrap(),
                    region: VoxelBox::new(Voxel::new(corner[0], corner[1], corner[2]), size).unwrap(),
                    codec,
                    content,
                }
            },
        )
    }

    fn written(header: &Header) -> Vec<u8> {
        let mut bytes = Vec::new();
        header.write(&mut bytes);
        bytes.extend_from_slice(&[1, 2, 3, 4]);
        bytes
    }

    proptest! {
        #[test]
        fn every_header_comes_back_and_has_one_form(header in header()) {
            let bytes = written(&header);
            let payload = [&bytes[..], &[9; 5]].concat();
            let (read, tail, rest) = Header::read(&payload).unwrap();
            prop_assert_eq!(read, header);
            prop_assert_eq!((tail.checked, tail.check, rest), (bytes.len() - 4, 0x0403_0201, &[9u8; 5][..]));
            for length in 0..bytes.len() {
                prop_assert!(Header::read(&bytes[..length]).is_err());
            }
        }

        #[test]
        fn whatever_is_read_is_written_the_same(mut bytes in prop::collection::vec(any::<u8>(), 20..80), codec in 0..5u8, kind in 0..32u8) {
            bytes[0] = FORMAT_VERSION;
            bytes[1] = kind << KIND_SHIFT | codec;
            // Low bytes end numbers: more of the fields are in range.
            bytes[2..].iter_mut().filter(|byte| **byte % 3 > 0).for_each(|byte| *byte &= 0x7f);
            if let Ok((header, tail, _)) = Header::read(&bytes) {
                prop_assert_eq!(&written(&header)[..tail.checked], &bytes[..tail.checked]);
            }
        }

        #[test]
        fn boxes_in_blocks_come_back(corner in prop::array::uniform3(-(1 << 25)..0i32), size in prop::array::uniform3(1..300u32)) {
            let min = Voxel::new(corner[0] * 8, corner[1] * 8, corner[2] * 8);
            let region = VoxelBox::new(min, size.map(|side| side * 8)).unwrap();
            let mut bytes = Vec::new();
            write_box(&region, 8, &mut bytes);
            prop_assert_eq!(read_box(&mut Reader::new(&bytes), 8), Ok(region));
        }
    }

    #[test]
    fn a_usual_header_takes_few_bytes() {
        let epoch = flockmap_grid::epoch(1_700_000_000, 0x8765_4321);
        let end = Stamp(epoch_micros(epoch) + 10 * 60 * 1_000_000);
        let header = Header {
            stream: Stream { origin: RobotId(3), epoch },
            index: 12_000,
            cycle_start: end.plus_micros(-500_000),
            cycle_end: end,
            reference: 11_970,
            is_alone: false,
            resolution: Resolution::from_metres(0.1).unwrap(),
            region: VoxelBox::new(Voxel::new(-200, 310, -8), [60, 40, 24]).unwrap(),
            codec: Codec::Paper,
            content: ContentKind::Changes,
            priority: Priority::NearFree,
        };
        assert_eq!(written(&header).len(), 37);
    }

    #[test]
    fn numbers_out_of_range_are_refused() {
        let refused = |edit: &dyn Fn(&mut Vec<u8>)| {
            // Version, kind and codec, origin, epoch, index 5, cycle end, duration, resolution 0.1 m, box, reference.
            let mut bytes = vec![FORMAT_VERSION, 2, 1, 0, 5, 0, 0, 0xc8, 1, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4];
            assert!(Header::read(&bytes).is_ok());
            edit(&mut bytes);
            Header::read(&bytes).unwrap_err().to_string()
        };
        assert_eq!(refused(&|b| b[4] = 0), "package header: indices begin at 1");
        // One block, told as 8 × 8 × 8 voxels.
        let blocks = refused(&|b| b[12..15].copy_from_slice(&[7; 3]));
        assert_eq!(blocks, "package header: a box of whole blocks is counted in blocks");
        assert_eq!(refused(&|b| b[15] = 5), "package header: a reference is an earlier package");
        assert_eq!(refused(&|b| b[1] |= 3 << 5), "package header: priorities are 0 to 2");
        let urgent_state = refused(&|b| b[1] |= KIND_PRESENT << KIND_SHIFT | 1 << 5);
        assert_eq!(urgent_state, "package header: a present state has priority 0");
        assert_eq!(
            refused(&|b| b[1] |= 3 << 3),
            "package content kind 0x3 is not known; the sender may be newer"
        );
        assert_eq!(refused(&|b| b[1] = 7), "package codec 7 is not known; the sender may be newer");
        let late = refused(&|b| {
            b[1] |= KIND_PRESENT << KIND_SHIFT;
            b[15] = 5;
        });
        assert_eq!(late, "package header: a span begins after an earlier package");
        let resolution =
            "package header: the resolution is 1,000 to 100,000,000 micrometres in its shorter form";
        // 100 mm as micrometres; 0 mm; 100,001 mm.
        for code in [&[0xc1, 0x9a, 0x0c][..], &[0], &[0xc2, 0x9a, 0x0c]] {
            let refused = refused(&|bytes| drop(bytes.splice(7..9, code.iter().copied())));
            assert_eq!(refused, resolution);
        }
        let mut far = Vec::new();
        varint::write_signed(&mut far, i64::MAX);
        assert!(read_box(&mut Reader::new(&[&far[..], &[0; 5]].concat()), 8).is_err());
        let mut wide = vec![0; 3];
        varint::write(&mut wide, u64::from(u32::MAX) - 1);
        assert!(read_box(&mut Reader::new(&[&wide[..], &[0; 2]].concat()), 8).is_err());
    }

    #[test]
    fn free_space_is_far_where_all_of_its_box_is_farther_than_four_metres() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let region = VoxelBox::new(Voxel::new(40, -5, -5), [8, 10, 10]).unwrap();
        // The near side lies at 4 m.
        assert!(!is_far(&region, [0; 3], resolution));
        assert!(is_far(&region, [-1, 0, 0], resolution));
        assert!(!is_far(&region, [44 * 16, 0, 0], resolution));
        // Beyond the far side, and across a corner.
        assert!(is_far(&region, [(48 + 41) * 16, 0, 0], resolution));
        assert!(!is_far(&region, [(40 - 28) * 16, (5 + 28) * 16, 0], resolution));
        assert!(is_far(&region, [(40 - 29) * 16, (5 + 29) * 16, 0], resolution));
        let changes = |state| Changes::from_voxels([(Voxel::new(41, 0, 0), state)]);
        let of = |state, sensor| Priority::of(&changes(state), &region, sensor, resolution);
        use flockmap_grid::State::{Free, Occupied};
        assert_eq!(of(Free, [0; 3]), Priority::NearFree);
        assert_eq!(of(Free, [-1, 0, 0]), Priority::FarFree);
        assert_eq!(of(Occupied, [-1, 0, 0]), Priority::Obstacles);
        // The ends of the grid and the largest voxels do not overflow.
        let whole = VoxelBox::new(Voxel::new((1 << 28) - 1, 0, 0), [1; 3]).unwrap();
        assert!(is_far(&whole, [i32::MIN; 3], Resolution::from_micrometres(100_000_000).unwrap()));
    }
}
