//! How the points of scans are put into a relay's message.
//!
//! For each scan there are two lists, the returns and the rays without one; a point is three numbers. Exact:
//! the bits of the coordinates as `f32`, in the order of the scan. Of each the difference to the point before
//! (layout 0), or to the sixth before (layout 1: LiDARs of six lines), wrapping and in zigzag form; then for
//! each axis and each byte of the differences, from the lowest, the bytes of all points. Centimetres: whole
//! numbers in the frame of the sensor plus 2¹⁹, in Morton order. Layout 2: differences of the codes as
//! varints. Layout 3: octrees, level by level from the root: for each node a byte with a bit for each child
//! that holds points; after 20 levels, for each leaf the number of its points less 1, as varints. Empty lists
//! have no tree.

use flockmap_cli::team::is_masked;

use crate::baselines::bytes::{Reader, put_varint, varint_up_to};
use crate::baselines::morton::{interleave, separate};
use crate::baselines::traits::Observation;

/// Most points in a message, 2²²: 48 MiB as points.
pub(crate) const POINTS_MAX: usize = 1 << 22;

/// What is kept of the points.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Points {
    /// Every bit.
    Exact,
    /// Whole centimetres, cut at the range, team-mates masked.
    Centimetre,
}

/// The points of a scan, as numbers to be written: returns, and rays without one.
pub(crate) type ScanPoints = [Vec<[u32; 3]>; 2];

const CENTIMETRES: f64 = 100.0;
/// Bits of a coordinate in centimetres, levels of an octree: up to 5.2 km from the sensor.
const LEVELS: u32 = 20;
const HALF: i64 = 1 << (LEVELS - 1);

impl Points {
    pub(crate) const fn method(self) -> &'static str {
        match self {
            Self::Exact => "scan-relay",
            Self::Centimetre => "scan-relay-1cm",
        }
    }

    /// The layouts to choose from.
    pub(crate) const fn layouts(self) -> &'static [u8] {
        match self {
            Self::Exact => &[0, 1],
            Self::Centimetre => &[2, 3],
        }
    }

    /// What is sent of a scan. `range_m`: nearest and farthest that the mapper takes in.
    pub(crate) fn of_scan(self, seen: &Observation<'_>, range_m: [f64; 2]) -> ScanPoints {
        let scan = seen.scan;
        match self {
            Self::Exact => {
                let bits = |points: &[[f32; 3]]| points.iter().map(|p| p.map(f32::to_bits)).collect();
                [bits(&scan.points), bits(&scan.no_returns)]
            }
            Self::Centimetre => {
                let mut lists = [Vec::new(), Vec::new()];
                let all =
                    scan.points.iter().map(|p| (p, true)).chain(scan.no_returns.iter().map(|p| (p, false)));
                for (point, returned) in all {
                    let p = point.map(f64::from);
                    let length = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
                    let masked = returned && is_masked(seen.pose.transform(p), seen.masks);
                    if !(length >= range_m[0] && length < f64::INFINITY) || masked {
                        continue;
                    }
                    // A little beyond the range, so that rounding does not make a hit of it.
                    let cut = if length > range_m[1] { (range_m[1] + 0.02) / length } else { 1.0 };
                    let whole = p.map(|v| (v * cut * CENTIMETRES).round() as i64 + HALF);
                    if whole.iter().all(|v| (0..2 * HALF).contains(v)) {
                        lists[usize::from(!(returned && cut == 1.0))].push(whole.map(|v| v as u32));
                    }
                }
                lists.iter_mut().for_each(|list| list.sort_unstable_by_key(code));
                lists
            }
        }
    }
}

fn code(point: &[u32; 3]) -> u64 {
    interleave(point.map(u64::from))
}

/// Appends the points of all scans.
pub(crate) fn write(layout: u8, scans: &[ScanPoints], out: &mut Vec<u8>) {
    let lists = || scans.iter().flatten();
    match layout {
        0 | 1 => write_planes(&lists().flatten().copied().collect::<Vec<_>>(), step(layout), out),
        2 => {
            for list in lists() {
                let mut before = 0;
                for code in list.iter().map(code) {
                    put_varint(out, code - before);
                    before = code;
                }
            }
        }
        _ => write_octrees(lists().map(|list| list.iter().map(code).collect()).collect(), out),
    }
}

/// How far back the point is that a difference is taken to.
const fn step(layout: u8) -> usize {
    if layout == 0 { 1 } else { 6 }
}

fn write_planes(points: &[[u32; 3]], step: usize, out: &mut Vec<u8>) {
    for axis in 0..3 {
        for byte in 0..4 {
            out.extend(points.iter().enumerate().map(|(at, point)| {
                let before =
                    at.checked_sub(step).and_then(|at| points.get(at)).map_or(0, |before| before[axis]);
                let difference = point[axis].wrapping_sub(before) as i32;
                let zigzag = (difference << 1 ^ difference >> 31) as u32;
                (zigzag >> (8 * byte)) as u8
            }));
        }
    }
}

fn write_octrees(lists: Vec<Vec<u64>>, out: &mut Vec<u8>) {
    for level in 0..LEVELS {
        let shift = 3 * (LEVELS - 1 - level);
        for list in &lists {
            for node in list.chunk_by(|a, b| a >> (shift + 3) == b >> (shift + 3)) {
                out.push(node.iter().fold(0, |children, code| children | 1 << (code >> shift & 7)));
            }
        }
    }
    for leaf in lists.iter().flat_map(|list| list.chunk_by(|a, b| a == b)) {
        put_varint(out, leaf.len() as u64 - 1);
    }
}

/// The points of scans with these numbers of points, as coordinates in metres. Takes no memory for points
/// before it is sure that the message holds so many, at most [`POINTS_MAX`].
pub(crate) fn read(
    layout: u8,
    counts: &[[usize; 2]],
    reader: &mut Reader<'_>,
) -> Option<Vec<[Vec<[f32; 3]>; 2]>> {
    let total = counts.iter().flatten().try_fold(0usize, |sum, count| sum.checked_add(*count));
    let total = total.filter(|total| *total <= POINTS_MAX)?;
    let mut points = match layout {
        0 | 1 => read_planes(step(layout), total, reader)?,
        2 | 3 => {
            let codes = if layout == 2 { read_codes(counts, reader)? } else { read_octrees(counts, reader)? };
            let metres = |code| separate(code).map(|v| ((v as i64 - HALF) as f64 / CENTIMETRES) as f32);
            codes.into_iter().map(metres).collect()
        }
        _ => return None,
    }
    .into_iter();
    let mut list = |count: usize| points.by_ref().take(count).collect();
    Some(counts.iter().map(|[returns, no_returns]| [list(*returns), list(*no_returns)]).collect())
}

fn read_planes(step: usize, total: usize, reader: &mut Reader<'_>) -> Option<Vec<[f32; 3]>> {
    let bytes = reader.bytes(12 * total)?;
    let mut numbers = vec![[0u32; 3]; total];
    for (plane, bytes) in bytes.chunks(total.max(1)).enumerate() {
        let (axis, shift) = (plane / 4, 8 * (plane % 4));
        for (number, byte) in numbers.iter_mut().zip(bytes) {
            number[axis] |= u32::from(*byte) << shift;
        }
    }
    for at in 0..numbers.len() {
        let before = at.checked_sub(step).and_then(|at| numbers.get(at)).copied().unwrap_or_default();
        if let Some(number) = numbers.get_mut(at) {
            let difference = |zigzag: u32| zigzag >> 1 ^ (zigzag & 1).wrapping_neg();
            *number = core::array::from_fn(|axis| before[axis].wrapping_add(difference(number[axis])));
        }
    }
    Some(numbers.into_iter().map(|point| point.map(f32::from_bits)).collect())
}

/// Ascending codes of 60 bits.
fn read_codes(counts: &[[usize; 2]], reader: &mut Reader<'_>) -> Option<Vec<u64>> {
    let mut codes = Vec::new();
    for count in counts.iter().flatten() {
        let mut code = 0;
        for _ in 0..*count {
            code += varint_up_to(reader, (1 << (3 * LEVELS)) - 1 - code)?;
            codes.push(code);
        }
    }
    Some(codes)
}

/// Octrees with no more nodes in a level than points.
fn read_octrees(counts: &[[usize; 2]], reader: &mut Reader<'_>) -> Option<Vec<u64>> {
    let mut lists: Vec<Vec<u64>> =
        counts.iter().flatten().map(|count| vec![0; usize::from(*count > 0)]).collect();
    for _ in 0..LEVELS {
        for (nodes, count) in lists.iter_mut().zip(counts.iter().flatten()) {
            let mut next = Vec::with_capacity(nodes.len());
            for node in nodes.iter() {
                let children = reader.u8()?;
                next.extend((0..8).filter(|child| children >> child & 1 == 1).map(|child| node << 3 | child));
                if children == 0 || next.len() > *count {
                    return None;
                }
            }
            *nodes = next;
        }
    }
    let mut codes = Vec::new();
    for (leaves, count) in lists.iter().zip(counts.iter().flatten()) {
        let end = codes.len() + count;
        for leaf in leaves {
            let room = end.checked_sub(codes.len() + 1)?;
            let more = varint_up_to(reader, room as u64)? as usize;
            codes.extend(core::iter::repeat_n(*leaf, 1 + more));
        }
        if codes.len() != end {
            return None;
        }
    }
    Some(codes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn some_scans(bits: u32) -> impl Strategy<Value = Vec<ScanPoints>> {
        let list = || prop::collection::vec(prop::array::uniform3(0..=u32::MAX >> (32 - bits)), 0..60);
        let scan = (list(), list()).prop_map(|(mut returns, mut no_returns)| {
            returns.sort_unstable_by_key(code);
            no_returns.sort_unstable_by_key(code);
            [returns, no_returns]
        });
        prop::collection::vec(scan, 0..4)
    }

    fn there_and_back(layout: u8, scans: &[ScanPoints]) -> Vec<[Vec<[f32; 3]>; 2]> {
        let mut bytes = Vec::new();
        write(layout, scans, &mut bytes);
        let counts: Vec<_> = scans.iter().map(|lists| lists.each_ref().map(Vec::len)).collect();
        let mut reader = Reader::new(&bytes);
        let read = read(layout, &counts, &mut reader).unwrap();
        assert!(reader.is_empty());
        read
    }

    proptest! {
        #[test]
        fn exact_points_come_back(scans in prop_oneof![some_scans(31), some_scans(5)]) {
            for layout in [0, 1] {
                for (scan, read) in scans.iter().zip(there_and_back(layout, &scans)) {
                    let bits = |list: Vec<[f32; 3]>| list.iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>();
                    prop_assert_eq!(&read.map(bits), scan);
                }
            }
        }

        // Few values, so that points share nodes and leaves.
        #[test]
        fn centimetres_come_back(scans in prop_oneof![some_scans(20), some_scans(2)]) {
            for layout in [2, 3] {
                for (scan, read) in scans.iter().zip(there_and_back(layout, &scans)) {
                    let back = read.map(|list| -> Vec<[u32; 3]> {
                        list.iter().map(|p| p.map(|v| ((f64::from(v) * 100.0).round() as i64 + HALF) as u32)).collect()
                    });
                    prop_assert_eq!(&back, scan);
                }
            }
        }
    }
}
