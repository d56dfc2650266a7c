//! A flight of a few batches, whatever it is: every package decodes to what was encoded, in any order that
//! its bases allow.
//!
//! Input: choices.

use flockmap_codec::{
    Base, Batch, ChunksRead, Codec, Content, Encoder, PACKAGE_BYTES_MAX, PACKAGE_BYTES_MIN, Package,
};
use flockmap_grid::{
    Changes, Layer, Resolution, RobotId, Stamp, State, Stream, VOXEL_LIMIT, Voxel, VoxelBox,
};

use super::{Choices, Fuzz, Random};

const BATCHES_MAX: usize = 5;

/// The robot that sends.
struct Sender {
    stream: Stream,
    resolution: Resolution,
    /// One for all batches: the packages of other codecs do not say that they change what one of `flock`
    /// looks at.
    codec: Codec,
    /// Where its world is.
    corner: Voxel,
    layer: Layer,
    batches: Vec<(Stamp, u32)>,
    readers: Vec<(u32, VoxelBox)>,
    next_index: u32,
    end: Stamp,
}

/// A package and its part of the changes.
struct Sent {
    package: Package,
    piece: Changes,
}

pub(crate) fn run(fuzz: &mut Fuzz, input: &[u8]) {
    let mut choices = Choices::new(input);
    let mut sender = Sender::new(&mut choices);
    let first_index = sender.next_index;
    let mut sent = Vec::new();
    for _ in 0..BATCHES_MAX {
        sender.encode_batch(fuzz, &mut choices, &mut sent);
        if choices.is_empty() {
            break;
        }
    }
    let received = receive_in_any_order(fuzz, &mut choices, &sent, first_index);
    assert_eq!(received.digest(), sender.layer.digest());
    encode_snapshot(fuzz, &mut choices, &sender);
}

impl Sender {
    fn new(choices: &mut Choices<'_>) -> Self {
        let mut corner = || match choices.byte() {
            0..240 => choices.byte() as i8 as i32,
            240..248 => VOXEL_LIMIT - i32::from(choices.byte()),
            _ => i32::from(choices.byte()) - VOXEL_LIMIT,
        };
        let corner = Voxel::new(corner(), corner(), corner());
        let has_long_header = choices.below(8) == 7;
        let epoch: u64 = if has_long_header { u64::MAX } else { u64::from(choices.below(3)) };
        Self {
            stream: Stream { origin: RobotId(if has_long_header { u16::MAX } else { 1 }), epoch },
            resolution: Resolution::from_micrometres(if has_long_header { 99_999_999 } else { 100_000 })
                .unwrap(),
            codec: Codec::from_id(choices.byte() % 16).unwrap_or(Codec::Flock),
            corner,
            layer: Layer::default(),
            batches: Vec::new(),
            readers: Vec::new(),
            next_index: if has_long_header { u32::MAX - 100_000 } else { 1 + choices.below(2) * 300 },
            end: Stamp(if has_long_header { i64::MIN } else { 0 }),
        }
    }

    fn encode_batch(&mut self, fuzz: &mut Fuzz, choices: &mut Choices<'_>, sent: &mut Vec<Sent>) {
        let start = self.end;
        self.end = start.plus_micros(1 + i64::from(choices.below(1_000_000)));
        let from = [(); 3].map(|()| choices.byte() as i32 * 4 - 256);
        let corner = [self.corner.x, self.corner.y, self.corner.z];
        let sensor: [i32; 3] = core::array::from_fn(|axis| {
            let at = i64::from(corner[axis]) * 16 + i64::from(from[axis]);
            at.clamp(i32::MIN.into(), i32::MAX.into()) as i32
        });
        let codec = self.codec;
        let is_independent = choices.below(4) == 3;
        let room = PACKAGE_BYTES_MAX - PACKAGE_BYTES_MIN;
        let bytes_max = PACKAGE_BYTES_MAX - choices.byte() as usize * room / 255;
        let changes = self.changes(choices, from);
        let batch = Batch { stream: self.stream, start, end: self.end, resolution: self.resolution, sensor };
        let layer = (!is_independent).then_some(&self.layer);
        let base = Base { layer, batches: &self.batches, readers: &self.readers };
        let first = self.next_index;
        let packages =
            fuzz.encoder.encode_batch_against(codec, &batch, first, &changes, Some(&base), bytes_max);
        let packages = packages.unwrap();
        if choices.below(8) == 7 {
            let again =
                Encoder::new().encode_batch_against(codec, &batch, first, &changes, Some(&base), bytes_max);
            assert_eq!(again.as_ref(), Ok(&packages), "memory of earlier packages changes a result");
        }

        // One after the other, as they come where nothing is lost.
        let mut layer = self.layer.clone();
        let mut blocks = Vec::new();
        let mut voxels = 0;
        for (number, package) in (first..).zip(&packages) {
            fuzz.note(package);
            let header = package.header();
            assert!(package.bytes().len() <= bytes_max);
            assert_eq!((header.index, header.batch_end, header.codec), (number, self.end, codec));
            assert!(header.base < first && header.is_independent | !is_independent);
            let read = Package::parse(package.bytes()).unwrap();
            assert_eq!(read.header(), header);
            let piece = changes_in(fuzz.decoder.decode_against(&read, Some(&layer)).unwrap());
            assert_eq!(piece.bounding_box().unwrap().union(&header.region), header.region);
            if header.is_independent {
                assert_eq!(changes_in(read.decode().unwrap()), piece);
            }
            layer.apply(&piece, self.end);
            blocks.extend_from_slice(piece.blocks());
            voxels += piece.len();
            if !header.is_independent {
                self.readers.push((header.index, header.region));
            }
            sent.push(Sent { package: read, piece });
        }
        assert_eq!(Changes::from_blocks(blocks), changes);
        assert_eq!(voxels, changes.len(), "no two packages share a voxel");
        self.layer.apply(&changes, self.end);
        assert_eq!(layer.digest(), self.layer.digest());
        self.next_index += packages.len() as u32;
        self.batches.extend((!packages.is_empty()).then(|| (self.end, self.next_index - 1)));
    }

    /// A few boxes, walls, rays and clouds.
    fn changes(&self, choices: &mut Choices<'_>, from: [i32; 3]) -> Changes {
        let mut voxels: Vec<(Voxel, State)> = Vec::new();
        for _ in 0..1 + choices.below(4) {
            let kind = choices.byte();
            let at = [(); 3].map(|()| choices.below(40) as i32);
            let size = [16, 16, 8].map(|most| 1 + choices.below(most) as i32);
            let state = if kind & 8 == 0 { State::Free } else { State::Occupied };
            let inside =
                VoxelBox::new(Voxel::new(at[0], at[1], at[2]), size.map(|side| side as u32)).unwrap();
            match kind % 8 {
                // A ray from the sensor: free space, and what ends it.
                0..3 => {
                    let from = from.map(|at| at.div_euclid(16));
                    let steps = 2 * (0..3).map(|axis| (at[axis] - from[axis]).abs()).max().unwrap_or(0);
                    voxels.extend((0..steps).map(|step| {
                        let along = |axis: usize| from[axis] + (at[axis] - from[axis]) * step / steps.max(1);
                        (Voxel::new(along(0), along(1), along(2)), State::Free)
                    }));
                    voxels.push((Voxel::new(at[0], at[1], at[2]), State::Occupied));
                }
                3 | 4 => voxels.extend(inside.voxels().map(|voxel| (voxel, state))),
                // What was there, reversed.
                5 => voxels.extend(inside.voxels().filter_map(|voxel| match self.state(voxel) {
                    State::Unknown => None,
                    State::Free => Some((voxel, State::Occupied)),
                    State::Occupied => Some((voxel, State::Free)),
                })),
                // A cloud.
                _ => {
                    let (mut random, share) = (Random(kind.into()), choices.byte());
                    voxels.extend(inside.voxels().filter_map(|voxel| {
                        let [happens, state, ..] = random.next().to_le_bytes();
                        let state = if state < share { State::Occupied } else { State::Free };
                        (happens <= share).then_some((voxel, state))
                    }));
                }
            }
        }
        let moved = voxels.into_iter().map(|(voxel, state)| (self.moved(voxel), state));
        Changes::from_voxels(moved.filter(|(voxel, _)| voxel.in_limits()))
    }

    /// From the world's own corner.
    fn moved(&self, voxel: Voxel) -> Voxel {
        Voxel::new(self.corner.x + voxel.x, self.corner.y + voxel.y, self.corner.z + voxel.z)
    }

    fn state(&self, voxel: Voxel) -> State {
        self.layer.state(self.moved(voxel))
    }
}

fn changes_in(content: Content) -> Changes {
    let Content::Changes(changes) = content else { panic!("{content:?}") };
    changes
}

/// Every package as soon as all up to its base are received, and else later. None may be wrong or superseded.
fn receive_in_any_order(
    fuzz: &mut Fuzz,
    choices: &mut Choices<'_>,
    sent: &[Sent],
    first_index: u32,
) -> Layer {
    let mut layer = Layer::default();
    let mut missing: Vec<&Sent> = sent.iter().collect();
    while !missing.is_empty() {
        // All before the first that is missing are held.
        let held = missing.iter().map(|sent| sent.package.header().index).min().unwrap_or(first_index) - 1;
        let ready = |sent: &&Sent| sent.package.header().base <= held;
        let count = missing.iter().copied().filter(ready).count() as u32;
        // From the last: without choices the newest goes first.
        let nth = (count - 1 - choices.below(count)) as usize;
        let nth = missing.iter().enumerate().filter(|(_, sent)| ready(sent)).nth(nth).unwrap().0;
        let Sent { package, piece } = missing.remove(nth);
        let found = changes_in(fuzz.decoder.decode_against(package, Some(&layer)).unwrap());
        assert_eq!(found, *piece);
        layer.apply(&found, package.header().batch_end);
    }
    layer
}

fn encode_snapshot(fuzz: &mut Fuzz, choices: &mut Choices<'_>, sender: &Sender) {
    let Some(state) = sender.layer.snapshot() else { return };
    let codec = Codec::from_id(choices.byte() % 16).unwrap_or(Codec::Flock);
    let bytes_max = PACKAGE_BYTES_MAX - choices.byte() as usize;
    let index = sender.next_index - 1;
    let chunks =
        fuzz.encoder.encode_snapshot(codec, sender.stream, index, sender.resolution, &state, bytes_max);
    let (mut layer, mut before) = (Layer::default(), ChunksRead::default());
    for chunk in chunks.unwrap() {
        fuzz.note(&chunk);
        assert!(chunk.bytes().len() <= bytes_max);
        let read = Package::parse(chunk.bytes()).unwrap();
        layer.apply_snapshot(&fuzz.read_chunk(&read, &mut before));
    }
    assert_eq!(layer.digest(), sender.layer.digest());
}
