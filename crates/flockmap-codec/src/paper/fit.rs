//! Cutting until each piece fits.

use super::stamps;
use super::states::{self, Others, Scratch};
use crate::bytes::put_varint;
use crate::codec::Codec;
use crate::deflate::Deflater;
use crate::limits::BOX_VOXELS_MAX;
use crate::piece::{Measure, Piece};
use crate::work;

/// Makes payloads, and keeps its memory from one to the next.
#[derive(Default)]
pub(crate) struct Writer {
    scratch: Scratch,
    deflater: Deflater,
    /// The last one.
    pub(super) payload: Vec<u8>,
}

impl Writer {
    /// Makes the payload of a piece. Returns the steps that it takes to decode it.
    pub(super) fn encode(&mut self, codec: Codec, piece: &Piece, others: Others) -> u64 {
        let Self { scratch, deflater, payload } = self;
        payload.clear();
        let Piece { states, parts, region, .. } = piece;
        let steps = states::encode(codec, states, region, others, scratch, deflater, payload);
        if others == Others::Unknown {
            let mut length = Vec::new();
            put_varint(&mut length, payload.len() as u64);
            payload.splice(..0, length);
            stamps::encode(parts, region, deflater, payload);
        }
        steps + stamps::steps(parts, region)
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

/// Cuts `whole` until the payload of each piece fits into its `room`; that of a single voxel may not.
pub(super) fn fit(
    writer: &mut Writer,
    codec: Codec,
    others: Others,
    whole: Piece,
    room: impl Fn(&Piece) -> usize,
) -> Vec<(Piece, Vec<u8>)> {
    let mut fit = Fit::new(codec, others, whole);
    core::iter::from_fn(|| fit.next(writer, &room)).collect()
}

/// The same, piece by piece.
pub(super) struct Fit {
    codec: Codec,
    others: Others,
    forecast: Forecast,
    waiting: Vec<Piece>,
    steps: u64,
}

impl Fit {
    pub(super) fn new(codec: Codec, others: Others, whole: Piece) -> Self {
        Self { codec, others, forecast: Forecast::new(codec, others), waiting: vec![whole], steps: 0 }
    }

    /// The next piece that fits, with its payload. `None` if all are done.
    pub(super) fn next(
        &mut self,
        writer: &mut Writer,
        room: impl Fn(&Piece) -> usize,
    ) -> Option<(Piece, Vec<u8>)> {
        let Self { codec, others, forecast, .. } = self;
        let (codec, others) = (*codec, *others);
        while let Some(piece) = self.waiting.pop() {
            let room = room(&piece);
            // The largest box that a package can fill; for `raw` the forecast knows it.
            let fills_max = if codec == Codec::Raw { usize::MAX } else { room };
            let box_max = states::voxels_max(codec, fills_max, others);
            // What it takes; `None` if no package can hold it.
            let needed = if piece.region.volume() > u128::from(box_max) && piece.states.len() > 1 {
                // Not even to be tried: that takes as long as its box is large, and voxels may lie far apart.
                None
            } else {
                let expected = forecast.payload_bytes(&piece);
                // What cannot be cut is tried in any case.
                if expected > room + room / 10 && piece.states.len() > 1 {
                    Some(expected)
                } else {
                    let steps = writer.encode(codec, &piece, others);
                    self.steps += steps;
                    forecast.learn(&piece, writer.payload.len());
                    Some(writer.payload.len()).filter(|_| writer.is_decodable(codec, &piece, others, steps))
                }
            };
            // Aimed a little below full, since a piece that is just too large costs two half-full ones.
            let count = match needed {
                Some(needed) if needed <= room => 1,
                Some(needed) => needed.div_ceil((room * 19 / 20).max(1)).max(2),
                None => 2,
            };
            let halves = if count == 1 { None } else { piece.cut(count / 2, count, forecast.measure()) };
            let blocks = piece.parts.iter().map(|(_, part)| part.blocks().len()).sum::<usize>();
            self.steps += work::BLOCK_STEPS * (piece.states.blocks().len() + blocks) as u64;
            match halves {
                Some([head, tail]) => self.waiting.extend([tail, head]),
                None => return Some((piece, writer.payload.clone())),
            }
        }
        None
    }

    /// The steps of work taken since this was called last.
    pub(super) const fn take_steps(&mut self) -> u64 {
        core::mem::replace(&mut self.steps, 0)
    }
}

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
