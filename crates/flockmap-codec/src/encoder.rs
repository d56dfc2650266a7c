//! From changes, or from the state of a layer, to packages.

mod present;

pub use present::Span;

use flockmap_grid::{Changes, Layer, Plane, Resolution, Stamp, Stream, VoxelBox};

use crate::check::check_changes;
use crate::deflate::Deflater;
use crate::flock;
use crate::piece::{Measure, Piece};
use crate::reference::Known;
use crate::states::{self, Others, Scratch};
use crate::{
    BOX_VOXELS_MAX, Codec, ContentKind, EncodeError, Header, PACKAGE_BYTES_MIN, Package, Priority, Reference,
    stamps, varint, work,
};

/// One cycle of mapping: all changes from `start` to `end`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Cycle {
    /// Whose observations these are.
    pub stream: Stream,
    /// When the cycle began, on the origin's clock.
    pub start: Stamp,
    /// When it was closed: the stamp of every change in it. Cycles of a stream have strictly increasing ends.
    pub end: Stamp,
    /// Side of a voxel.
    pub resolution: Resolution,
    /// Where the sensor was in the middle of the cycle, in sixteenths of a voxel from the corner of voxel (0, 0, 0). Only
    /// [`Codec::Flock`] makes use of it: whatever it is, the changes come out right, in fewer bytes the nearer it is.
    pub sensor: [i32; 3],
}

/// Makes packages. Keeps its memory from one to the next: up to 2.25 bytes for each voxel of the largest box so
/// far, and 300 KB. For [`Codec::Flock`] in place of that: 550 bytes for each block of the largest package and each known one in its box
/// or beside it, 45 bytes at most for each block of the box, and 40 KB. One for each thread. The same input gives the same packages,
/// whatever was encoded before.
pub struct Encoder {
    scratch: Scratch,
    deflater: Deflater,
    payload: Vec<u8>,
    /// Made with the first package in that codec.
    flock: Option<Box<flock::Workspace>>,
}

impl Default for Encoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Encoder {
    /// An encoder.
    pub fn new() -> Self {
        Self { scratch: Scratch::default(), deflater: Deflater::new(), payload: Vec::new(), flock: None }
    }

    /// One package for all changes, whatever its size, as the paper sends it (Sec. III). For benchmarks: what goes
    /// over a radio is better cut to its datagrams by [`Self::encode_cycle`].
    pub fn encode_whole(
        &mut self,
        codec: Codec,
        cycle: &Cycle,
        index: u32,
        changes: &Changes,
    ) -> Result<Package, EncodeError> {
        check_cycle(cycle, index, changes)?;
        if codec == Codec::Flock {
            let mut packages = self.flock_cycle(cycle, index, changes, None, WHOLE_BYTES_MAX)?;
            return match packages.len() {
                1 => packages.pop().ok_or(EncodeError::Empty),
                _ => Err(EncodeError::BoxTooLarge {
                    voxels: changes.bounding_box().map_or(0, |region| region.volume()),
                }),
            };
        }
        let region = changes.bounding_box().ok_or(EncodeError::OutsideGrid)?;
        let voxels = region.volume();
        if voxels > u128::from(BOX_VOXELS_MAX) {
            return Err(EncodeError::BoxTooLarge { voxels });
        }
        self.payload.clear();
        let steps = self.encode_states(codec, changes, &region, Others::Unchanged);
        if steps > work::limit(self.payload.len()) {
            return Err(EncodeError::TooMuchWork);
        }
        let header = changes_header(codec, cycle, index, region).with_priority(cycle, changes);
        Ok(Package::seal(&header, &self.payload, |header| check_changes(header, changes)))
    }

    /// The changes of a cycle as packages of at most `bytes_max` bytes each, numbered from `first_index`. Each has a
    /// tight box of its own and is useful alone; no two share a voxel. No changes: no packages.
    ///
    /// The changes are cut in two across the longest side of their box until each piece fits. What a piece will
    /// take is foretold from the pieces before it, so that few are encoded in vain.
    pub fn encode_cycle(
        &mut self,
        codec: Codec,
        cycle: &Cycle,
        first_index: u32,
        changes: &Changes,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        self.encode_cycle_against(codec, cycle, first_index, changes, None, bytes_max)
    }

    /// As [`Self::encode_cycle`], told against what the receivers hold already. Their headers say in `reference` which packages a
    /// receiver must have before it can decode them, with [`Decoder::decode_against`](crate::Decoder::decode_against).
    pub fn encode_cycle_against(
        &mut self,
        codec: Codec,
        cycle: &Cycle,
        first_index: u32,
        changes: &Changes,
        reference: Option<&Reference<'_>>,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        if changes.is_empty() {
            return Ok(Vec::new());
        }
        check_cycle(cycle, first_index, changes)?;
        if codec == Codec::Flock {
            return self.flock_cycle(cycle, first_index, changes, reference, bytes_max);
        }
        let piece = Piece::new(changes.clone(), Vec::new()).ok_or(EncodeError::OutsideGrid)?;
        // There are no more packages than voxels, which bounds the index and with it the header.
        let last_index = first_index.saturating_add(u32::try_from(changes.len()).unwrap_or(u32::MAX));
        let last_index = changes_header(codec, cycle, last_index, piece.region);
        let pieces = self.fit(codec, piece, &last_index, bytes_max)?;
        let count = pieces.len();
        check_indices(first_index, count)?;
        let packages = (first_index..=u32::MAX).zip(&pieces).map(|(index, (piece, payload))| {
            let header =
                changes_header(codec, cycle, index, piece.region).with_priority(cycle, &piece.states);
            Package::seal(&header, payload, |header| check_changes(header, &piece.states))
        });
        Ok(packages.collect())
    }

    /// A cycle in the codec `flock`: cut along its own order.
    fn flock_cycle(
        &mut self,
        cycle: &Cycle,
        first_index: u32,
        changes: &Changes,
        reference: Option<&Reference<'_>>,
        bytes_max: usize,
    ) -> Result<Vec<Package>, EncodeError> {
        check_limit(bytes_max)?;
        // Before the first package there is nothing to refer to.
        let reference = reference.filter(|_| first_index > 1);
        changes.bounding_box().ok_or(EncodeError::OutsideGrid)?;
        let layer = reference.and_then(|reference| reference.layer);
        // The codec has no words for a voxel that is told again what it is: such a cycle is told alone.
        let layer = layer.filter(|layer| !repeats(changes, layer, cycle.end));
        let known = Known::new(layer, cycle.end);
        let header = |index, region| changes_header(Codec::Flock, cycle, index, region);
        let room = |number: usize, region: &VoxelBox| {
            let index = u32::try_from(number).map_or(u32::MAX, |number| first_index.saturating_add(number));
            // The reference is not known yet: one to the first package takes most.
            let longest = Header { reference: u32::from(first_index > 1), ..header(index, *region) };
            bytes_max.saturating_sub(header_length(&longest))
        };
        let all = flock::encode(self.flock.get_or_insert_default(), &known, cycle.sensor, changes, room)?;
        check_indices(first_index, all.len())?;
        let mut packages = Vec::with_capacity(all.len());
        for (index, flock::Told { piece, reference: newest }) in (first_index..=u32::MAX).zip(all) {
            let written = newest.zip(reference);
            let written = written.map_or(0, |(stamp, to)| to.newest_package(stamp, first_index));
            let read = reference.map_or(0, |reference| reference.newest_reader(&piece.region));
            let reference = written.max(read).min(first_index - 1);
            let header = header(index, piece.region).with_priority(cycle, &piece.changes);
            let header = Header { reference, is_alone: written == 0, ..header };
            let package =
                Package::seal(&header, &piece.payload, |header| check_changes(header, &piece.changes));
            if package.bytes().len() > bytes_max {
                return Err(EncodeError::BytesMaxTooSmall { bytes_max });
            }
            packages.push(package);
        }
        Ok(packages)
    }

    /// Cuts `whole` until each piece fits into `bytes_max` with a header like `longest`, whose box and stamps are
    /// replaced by those of the piece.
    fn fit(
        &mut self,
        codec: Codec,
        whole: Piece,
        longest: &Header,
        bytes_max: usize,
    ) -> Result<Vec<(Piece, Vec<u8>)>, EncodeError> {
        check_limit(bytes_max)?;
        let others = match longest.content {
            ContentKind::Changes => Others::Unchanged,
            ContentKind::Present { .. } => Others::Unknown,
        };
        let mut forecast = Forecast::new(codec, others);
        let mut done = Vec::new();
        let mut waiting = vec![whole];
        while let Some(piece) = waiting.pop() {
            let room = bytes_max.saturating_sub(header_bytes(longest, &piece));
            let needed = if piece.region.volume() > u128::from(BOX_VOXELS_MAX) {
                usize::MAX
            } else {
                let expected = forecast.payload_bytes(&piece);
                // What cannot be cut is tried in any case.
                if expected > room + room / 10 && piece.states.len() > 1 {
                    expected
                } else {
                    let steps = self.encode_piece(codec, &piece, others);
                    forecast.learn(&piece, self.payload.len());
                    if self.is_decodable(codec, &piece, others, steps) {
                        self.payload.len()
                    } else {
                        usize::MAX
                    }
                }
            };
            if needed <= room {
                done.push((piece, self.payload.clone()));
                continue;
            }
            // Aimed a little below full, since a piece that is just too large costs two half-full ones.
            let pieces = match needed {
                usize::MAX => 2,
                _ => needed.div_ceil((room * 19 / 20).max(1)).max(2),
            };
            let [head, tail] = piece
                .cut(pieces / 2, pieces, forecast.measure())
                .ok_or(EncodeError::BytesMaxTooSmall { bytes_max })?;
            waiting.push(tail);
            waiting.push(head);
        }
        Ok(done)
    }

    /// The payload of a piece into `self.payload`. Returns the steps that it takes to decode it.
    fn encode_piece(&mut self, codec: Codec, piece: &Piece, others: Others) -> u64 {
        self.payload.clear();
        let steps = self.encode_states(codec, &piece.states, &piece.region, others);
        if others == Others::Unknown {
            let mut length = Vec::new();
            varint::write(&mut length, self.payload.len() as u64);
            self.payload.splice(..0, length);
            stamps::encode(&piece.parts, &piece.region, &mut self.deflater, &mut self.payload);
        }
        steps + stamps::steps(&piece.parts, &piece.region)
    }

    fn encode_states(&mut self, codec: Codec, states: &Changes, region: &VoxelBox, others: Others) -> u64 {
        let Self { scratch, deflater, payload, .. } = self;
        states::encode(codec, states, region, others, scratch, deflater, payload)
    }

    /// Whether the payload just made respects the limits that a decoder holds it to beyond its length.
    fn is_decodable(&self, codec: Codec, piece: &Piece, others: Others, steps: u64) -> bool {
        let length = self.payload.len();
        let box_limit = match others {
            Others::Unchanged => BOX_VOXELS_MAX,
            // The states are a part of the payload; what the rest takes is left out to be safe.
            Others::Unknown => states::voxels_max(codec, length / 2, others),
        };
        let fills = codec == Codec::Raw || piece.region.volume() <= u128::from(box_limit);
        fills && piece.parts.len() <= stamps::STAMPS_MAX && steps <= work::limit(length)
    }
}

/// No package comes near this: those of the largest box have some 50 MB.
const WHOLE_BYTES_MAX: usize = 1 << 30;

/// What the payload of a piece will take, judged by the pieces before it.
struct Forecast {
    codec: Codec,
    others: Others,
    /// For the codecs whose size depends on the pattern: bytes for 1,024 edges.
    bytes_per_1024: usize,
}

impl Forecast {
    /// What a zlib stream takes however short it is.
    const OVERHEAD: usize = 10;

    fn new(codec: Codec, others: Others) -> Self {
        Self { codec, others, bytes_per_1024: 210 }
    }

    /// What the size goes with, so that pieces come out of even size.
    fn measure(&self) -> Measure {
        if self.codec == Codec::Racer { Measure::Voxels } else { Measure::Edges }
    }

    fn payload_bytes(&self, piece: &Piece) -> usize {
        match (self.codec, self.others) {
            // At least; stamps come on top.
            (Codec::Raw, _) => piece.region.volume().div_ceil(4) as usize,
            (Codec::Racer, Others::Unchanged) => piece.states.len() * 5,
            _ => Self::OVERHEAD + piece.edges * self.bytes_per_1024 / 1024,
        }
    }

    fn learn(&mut self, piece: &Piece, payload_bytes: usize) {
        let bytes_per_1024 = payload_bytes.saturating_sub(Self::OVERHEAD) * 1024 / piece.edges.max(1);
        self.bytes_per_1024 = (3 * self.bytes_per_1024 + bytes_per_1024).div_ceil(4);
    }
}

fn changes_header(codec: Codec, cycle: &Cycle, index: u32, region: VoxelBox) -> Header {
    Header {
        stream: cycle.stream,
        index,
        cycle_start: cycle.start,
        cycle_end: cycle.end,
        reference: 0,
        is_alone: true,
        resolution: cycle.resolution,
        region,
        codec,
        content: ContentKind::Changes,
        priority: Priority::Obstacles,
    }
}

impl Header {
    fn with_priority(self, cycle: &Cycle, changes: &Changes) -> Self {
        Self { priority: Priority::of(changes, &self.region, cycle.sensor, cycle.resolution), ..self }
    }
}

/// Bytes of the header of `piece`, with the check, if it is otherwise like `longest`.
fn header_bytes(longest: &Header, piece: &Piece) -> usize {
    let mut header = Header { region: piece.region, ..*longest };
    if let (Some((first, _)), Some((last, _))) = (piece.parts.first(), piece.parts.last()) {
        (header.cycle_start, header.cycle_end) = (*first, *last);
    }
    header_length(&header)
}

/// Bytes of a header with the check.
fn header_length(header: &Header) -> usize {
    let mut bytes = Vec::with_capacity(96);
    header.write(&mut bytes);
    bytes.len() + 4
}

fn check_cycle(cycle: &Cycle, index: u32, changes: &Changes) -> Result<(), EncodeError> {
    if changes.is_empty() {
        return Err(EncodeError::Empty);
    }
    if cycle.end < cycle.start {
        return Err(EncodeError::CycleEndsBeforeStart);
    }
    if index == 0 {
        return Err(EncodeError::IndexOutOfRange { first: 0, count: 1 });
    }
    Ok(())
}

/// Whether a voxel changes to what it was before the cycle that ended at `end`. Not so in net changes, if `layer` holds all before.
fn repeats(changes: &Changes, layer: &Layer, end: Stamp) -> bool {
    let share = |a: &Plane, b: &Plane| a.iter().zip(b).any(|(a, b)| a & b != 0);
    changes.blocks().iter().any(|(index, block)| match layer.block_before(*index, end) {
        Ok(Some(before)) => share(block.free(), before.free()) || share(block.occupied(), before.occupied()),
        // Nothing was known; or it is gone, as the encoder will find.
        _ => false,
    })
}

/// Whether there are so many indices left.
fn check_indices(first: u32, count: usize) -> Result<(), EncodeError> {
    let last = u64::from(first) + count as u64 - 1;
    if last > u64::from(u32::MAX) { Err(EncodeError::IndexOutOfRange { first, count }) } else { Ok(()) }
}

fn check_limit(bytes_max: usize) -> Result<(), EncodeError> {
    if bytes_max < PACKAGE_BYTES_MIN { Err(EncodeError::BytesMaxTooSmall { bytes_max }) } else { Ok(()) }
}
