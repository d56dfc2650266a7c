//! Gap coding as a whole: what comes back, what it costs, what it makes of any bytes.

use flockmap_grid::{BLOCK_VOXELS, Changes, State, StateBlock, Voxel, VoxelBox, bit_of};
use proptest::prelude::*;

use super::cut::{cut, estimate};
use super::judge::has_no_pattern;
use super::limits::{bytes_min, voxels_max};
use super::payload::{encode, number};
use crate::codec::Codec;
use crate::error::PackageError;
use crate::work::Work;
use flockmap_coder::BitWriter;

#[path = "../../../tests/common/random.rs"]
mod random;
pub(super) use random::Random;

/// Changes drawn at random, as `flockmap-bench random` draws them.
#[derive(Clone, Debug)]
pub(super) struct Draw {
    pub(super) region: VoxelBox,
    /// At least two where there are two voxels: the corners of the box are always among them.
    pub(super) count: u64,
    /// So many of four changes are to Occupied.
    pub(super) occupied_of_four: u64,
    pub(super) seed: u64,
}

impl Draw {
    /// A share of a box of this size, half of it Occupied.
    pub(super) fn of_ratio(size: [u32; 3], ratio: f64, seed: u64) -> Self {
        let region = VoxelBox::new(Voxel::new(0, 0, 0), size).unwrap();
        let count = (region.volume() as f64 * ratio).round() as u64;
        Self { region, count, occupied_of_four: 2, seed }
    }

    /// What no code can go below on average, in bytes: (h(r) + r) bits a voxel, if half of the changes are
    /// Occupied.
    fn limit(&self) -> f64 {
        let (voxels, count) = (self.region.volume() as f64, self.count as f64);
        let part = |n: f64| if n > 0.0 { n * (voxels / n).log2() } else { 0.0 };
        (part(count) + part(voxels - count) + count) / 8.0
    }
}

pub(super) fn draw(draw: &Draw) -> Changes {
    let Draw { region, count, occupied_of_four, seed } = draw;
    let mut random = Random(*seed);
    let corners = [region.min(), region.max()];
    let corner_count = if corners[0] == corners[1] { 1 } else { 2 };
    let voxels = region.volume() as u64;
    // Selection sampling (Knuth, vol. 2, algorithm S): every set of voxels has the same probability.
    let (mut left, mut wanted) = (voxels - corner_count, (*count).min(voxels).saturating_sub(corner_count));
    let mut blocks = Vec::new();
    for index in region.blocks() {
        let (corner, mut block) = (index.corner(), StateBlock::default());
        for bit in 0..BLOCK_VOXELS {
            let [x, y, z] = bit_of(bit);
            let voxel = Voxel::new(corner.x + x, corner.y + y, corner.z + z);
            if !region.contains(voxel) {
                continue;
            }
            if !corners.contains(&voxel) {
                let is_chosen = random.below(left) < wanted;
                left -= 1;
                if !is_chosen {
                    continue;
                }
                wanted -= 1;
            }
            let is_occupied = random.below(4) < *occupied_of_four;
            block.set(bit, if is_occupied { State::Occupied } else { State::Free });
        }
        blocks.push((index, block));
    }
    Changes::from_blocks(blocks)
}

/// A ball that became Free, with obstacles in a tenth of its shell.
pub(super) fn ball(radius: i32, seed: u64) -> Changes {
    let mut random = Random(seed);
    let cube = VoxelBox::spanning(Voxel::new(-radius, -radius, -radius), Voxel::new(radius, radius, radius))
        .unwrap();
    Changes::from_voxels(cube.voxels().filter_map(|v| {
        let square = v.x * v.x + v.y * v.y + v.z * v.z;
        let is_shell = square > (radius - 1) * (radius - 1);
        (square <= radius * radius)
            .then(|| (v, if is_shell && random.below(10) == 0 { State::Occupied } else { State::Free }))
    }))
}

/// Thin rays from one place in random directions, each voxel along them Free and the last Occupied.
pub(super) fn rays(count: u64, length: i32, seed: u64) -> Changes {
    let mut random = Random(seed);
    let mut voxels = Vec::new();
    for _ in 0..count {
        // Steps through the cells that a ray passes, one axis at a time.
        let goal: [i32; 3] = core::array::from_fn(|_| random.below(2 * length as u64 + 1) as i32 - length);
        let mut at = [0i32; 3];
        while at != goal {
            let axis = (0..3).max_by_key(|&a| {
                let done =
                    if goal[a] == 0 { 1 << 20 } else { (at[a].abs() * 2 + 1) * (1 << 16) / goal[a].abs() };
                -done
            });
            let axis = axis.unwrap();
            at[axis] += goal[axis].signum();
            let state = if at == goal { State::Occupied } else { State::Free };
            voxels.push((Voxel::new(at[0], at[1], at[2]), state));
        }
    }
    Changes::from_voxels(voxels)
}

fn any_draw() -> impl Strategy<Value = Draw> {
    let limit = flockmap_grid::VOXEL_LIMIT;
    let corner = prop_oneof![-40..40i32, Just(-limit), Just(limit - 70), -100_000..100_000i32];
    let side = prop_oneof![Just(1u32), 1..9u32, 1..70u32];
    let share =
        prop_oneof![Just(0.0), Just(1.0), 0.0..1.0f64, (-4.0..0.0f64).prop_map(|log| 10f64.powf(log))];
    (
        [corner.clone(), corner.clone(), corner],
        [side.clone(), side.clone(), side],
        share,
        0..=4u64,
        any::<u64>(),
    )
        .prop_map(|([x, y, z], size, share, occupied_of_four, seed)| {
            let region = VoxelBox::new(Voxel::new(x, y, z), size).unwrap();
            Draw { region, count: (region.volume() as f64 * share) as u64, occupied_of_four, seed }
        })
}

/// Both, the second set moved: long gaps where many changes are to come.
fn apart(a: &Changes, b: &Changes, by: i32) -> Changes {
    let moved = b.voxels().map(|(v, state)| (Voxel::new(v.x + by, v.y - by / 2, v.z), state));
    Changes::from_voxels(a.voxels().chain(moved))
}

/// Changes of many kinds, with a pattern and without one. Never empty.
pub(super) fn any_changes() -> impl Strategy<Value = Changes> {
    prop_oneof![
        any_draw().prop_map(|d| draw(&d)),
        (1..14i32, any::<u64>()).prop_map(|(radius, seed)| ball(radius, seed)),
        (1..60u64, 1..40i32, any::<u64>()).prop_map(|(count, length, seed)| apart(
            &ball(1, 0),
            &rays(count, length, seed),
            0
        )),
        (1..9i32, any_draw(), 0..100i32).prop_map(|(radius, mut d, by)| {
            d.region = VoxelBox::new(Voxel::new(0, 0, 0), d.region.size()).unwrap();
            apart(&ball(radius, 1), &draw(&d), by)
        }),
    ]
}

fn encoded(changes: &Changes, region: &VoxelBox) -> Vec<u8> {
    let mut payload = vec![0xff; 3];
    encode(changes, region, &mut payload);
    assert_eq!(payload[..3], [0xff; 3], "what stood before stays");
    payload.split_off(3)
}

fn decode(payload: &[u8], region: &VoxelBox) -> Result<Changes, PackageError> {
    super::decode(payload, region, &mut Work::new(Codec::Flock, payload.len()))
}

fn is_refused(payload: &[u8], region: &VoxelBox) -> bool {
    decode(payload, region).is_err()
}

/// The bytes of a payload that says there are so many changes, and ends there.
fn numbered(total: u32) -> Vec<u8> {
    let mut payload = Vec::new();
    let mut bits = BitWriter::new(&mut payload);
    number(&mut bits, total);
    bits.finish();
    payload
}

proptest! {
    #[test]
    fn what_was_encoded_comes_back(changes in any_changes()) {
        let region = changes.bounding_box().unwrap();
        let payload = encoded(&changes, &region);
        prop_assert_eq!(decode(&payload, &region), Ok(changes));
    }

    #[test]
    fn the_box_may_be_wider_than_the_changes(changes in any_changes(), wider in prop::array::uniform3(0..20u32)) {
        let region = changes.bounding_box().unwrap();
        let size = core::array::from_fn(|axis| region.size()[axis] + wider[axis]);
        let Some(region) = VoxelBox::new(region.min(), size) else { return Ok(()) };
        let payload = encoded(&changes, &region);
        prop_assert_eq!(decode(&payload, &region), Ok(changes));
    }

    #[test]
    fn any_bytes_are_refused_or_give_changes_within_every_limit(
        draw in any_draw(),
        total in prop_oneof![1..200u32, 1..1u32 << 28],
        bytes in prop::collection::vec(prop_oneof![any::<u8>(), Just(0), Just(0xff)], 0..80),
    ) {
        for payload in [bytes.clone(), [numbered(total), bytes].concat()] {
            let payload = &payload;
            if let Ok(changes) = decode(payload, &draw.region) {
                prop_assert!(changes.len() <= voxels_max(payload.len()));
                let inside = changes.bounding_box().is_none_or(|b| b.union(&draw.region) == draw.region);
                prop_assert!(inside);
            }
        }
    }

    #[test]
    fn damaged_payloads_are_refused_or_give_changes_inside_the_box(
        changes in any_changes(), at in any::<prop::sample::Index>(), flip in 1..=255u8, cut in any::<prop::sample::Index>(),
    ) {
        let region = changes.bounding_box().unwrap();
        let mut payload = encoded(&changes, &region);
        let at = at.index(payload.len().max(1));
        payload.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= flip);
        for payload in [&payload[..], &payload[..cut.index(payload.len() + 1)]] {
            if let Ok(decoded) = decode(payload, &region) {
                prop_assert!(!decoded.is_empty() && decoded.len() <= voxels_max(payload.len()));
                prop_assert_eq!(decoded.bounding_box().map(|b| b.union(&region)), Some(region));
            }
        }
    }
}

#[test]
fn random_draws_cost_at_most_three_per_cent_more_than_they_must() {
    for (number, size) in [[32u32, 32, 32], [64, 64, 64], [40, 24, 200]].into_iter().enumerate() {
        for (ratio_number, ratio) in RATIOS.into_iter().enumerate() {
            let seed = (number << 8 | ratio_number) as u64;
            let draws = (0..10).map(|n| Draw::of_ratio(size, ratio, seed << 8 | n));
            let (mut bytes, mut limit) = (0, 0.0);
            for d in draws {
                let changes = draw(&d);
                bytes += encoded(&changes, &d.region).len();
                limit += d.limit();
            }
            assert!(bytes as f64 <= limit * 1.03, "{size:?}, {ratio}: {bytes} bytes, {limit:.1} at best");
        }
    }
}

/// As in `flockmap-bench random`.
const RATIOS: [f64; 13] = [1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 1e-1, 2e-1, 5e-1, 1.0];

#[test]
fn one_state_costs_nothing_beside_the_places() {
    let mut d = Draw::of_ratio([64; 3], 0.02, 5);
    let mixed = encoded(&draw(&d), &d.region).len();
    for occupied_of_four in [0, 4] {
        d.occupied_of_four = occupied_of_four;
        let one = encoded(&draw(&d), &d.region).len();
        let saved = mixed - one;
        assert!(
            (d.count / 8 - 20..=d.count / 8 + 2).contains(&(saved as u64)),
            "{saved} of {mixed} bytes for {} changes",
            d.count
        );
    }
}

#[test]
fn a_full_box_of_one_state_is_filled_up_to_the_limit_of_the_decoder() {
    let region = VoxelBox::new(Voxel::new(-3, 5, 0), [50, 61, 33]).unwrap();
    for state in [State::Free, State::Occupied] {
        let changes = Changes::from_voxels(region.voxels().map(|v| (v, state)));
        let payload = encoded(&changes, &region);
        assert_eq!(payload.len(), bytes_min(changes.len(), changes.blocks().len()));
        assert!(voxels_max(payload.len()) >= changes.len());
        assert_eq!(decode(&payload, &region), Ok(changes.clone()));
        let short = &payload[..payload.len() - 1];
        assert!(is_refused(short, &region));
    }
}

#[test]
fn too_many_changes_are_refused_before_anything_is_read() {
    let mut payload = numbered(500);
    payload.resize(40, 0x5a);
    let region = |side| VoxelBox::new(Voxel::new(0, 0, 0), [side; 3]).unwrap();
    assert_eq!(decode(&payload, &region(8)).map(|c| c.len()), Ok(500));
    assert!(is_refused(&payload, &region(7)), "more than the box has voxels");
    assert!(is_refused(&payload[..36], &region(8)), "more than so few bytes may hold");
    assert!(is_refused(&payload, &region(513)), "a box that is too large");
    assert!(is_refused(&[], &region(8)), "nothing");
}

#[test]
fn no_changes_are_no_bytes() {
    let region = VoxelBox::new(Voxel::new(0, 0, 0), [9; 3]).unwrap();
    assert!(encoded(&Changes::default(), &region).is_empty());
}

#[test]
fn the_largest_boxes_come_back() {
    for size in [[512, 512, 512], [1 << 27, 1, 1], [1, 1, 1 << 27], [1, 1 << 20, 1 << 7]] {
        let region = VoxelBox::new(Voxel::new(-(1 << 27), -5, -(1 << 26)), size).unwrap();
        let (min, max) = (region.min(), region.max());
        let middle = Voxel::new((min.x + max.x) / 2, (min.y + max.y) / 2, (min.z + max.z) / 2);
        for voxels in [&[min, middle, max][..], &[middle], &[min], &[max]] {
            let changes = Changes::from_voxels(voxels.iter().map(|v| (*v, State::Occupied)));
            let payload = encoded(&changes, &region);
            assert!(payload.len() <= estimate(&changes, &region));
            assert_eq!(decode(&payload, &region), Ok(changes));
        }
    }
}

#[test]
fn bytes_are_the_same_on_every_machine() {
    let draws = [(4, 0.001, 2), (5, 0.2, 1), (6, 0.99, 2), (7, 1.0, 3), (8, 0.02, 0)].map(
        |(seed, share, occupied_of_four)| {
            let region = VoxelBox::new(Voxel::new(-7, 3, 100), [61, 40, 29]).unwrap();
            Draw { region, count: (region.volume() as f64 * share) as u64, occupied_of_four, seed }
        },
    );
    let mut bytes = Vec::new();
    for d in &draws {
        bytes.extend(encoded(&draw(d), &d.region));
    }
    let patterns = [ball(12, 3), rays(40, 30, 4)];
    for changes in &patterns {
        bytes.extend(encoded(changes, &changes.bounding_box().unwrap()));
    }
    assert_eq!(crc32fast::hash(&bytes), GOLDEN);
}
const GOLDEN: u32 = 3_963_041_922;

/// Prints what is in the diary: `cargo test --release -p flockmap-codec -- --ignored --nocapture
/// noise_figures`
#[test]
#[ignore = "prints figures"]
fn noise_figures() {
    use crate::{Codec, Encoder};
    use std::time::Instant;
    let batch = crate::Batch {
        stream: flockmap_grid::Stream { origin: flockmap_grid::RobotId(1), epoch: 1 },
        start: flockmap_grid::Stamp(0),
        end: flockmap_grid::Stamp(500_000),
        resolution: flockmap_grid::Resolution::from_micrometres(100_000).unwrap(),
        sensor: [0; 3],
    };
    println!(
        "size, ratio, changed, draws | noise payload / limit | noise + 35 B, paper package, racer package | over estimate"
    );
    println!(
        "  encode, decode, is_noise ns a change | taken for noise | cut: packages of up to 1,150 B with 35 B of header each, all bytes"
    );
    let sizes = [[32u32, 32, 32], [64, 64, 64], [128, 128, 128], [600, 256, 120]];
    for (size_number, size) in sizes.into_iter().enumerate() {
        for (ratio_number, ratio) in RATIOS.into_iter().enumerate() {
            let draws = [10, 10, 3, 1][size_number];
            let (mut bytes, mut paper, mut racer, mut limit, mut estimated, mut noise) = (0, 0, 0, 0.0, 0, 0);
            let mut ns = [f64::INFINITY; 3];
            let (mut changed, mut pieces, mut in_pieces) = (0, 0, 0);
            for n in 0..draws {
                let d = Draw::of_ratio(size, ratio, (size_number << 16 | ratio_number << 8 | n) as u64);
                let changes = draw(&d);
                changed = changes.len();
                let mut timed = |which: usize, work: &mut dyn FnMut()| {
                    for _ in 0..if changed < 1_000_000 { 5 } else { 2 } {
                        let start = Instant::now();
                        work();
                        ns[which] = ns[which].min(start.elapsed().as_nanos() as f64 / changed as f64);
                    }
                };
                let mut payload = Vec::new();
                timed(0, &mut || {
                    payload.clear();
                    encode(&changes, &d.region, &mut payload);
                });
                let mut decoded = None;
                timed(1, &mut || decoded = decode(&payload, &d.region).ok());
                assert_eq!(decoded.as_ref(), Some(&changes));
                let mut says = false;
                timed(2, &mut || says = has_no_pattern(&changes, &d.region));
                noise += usize::from(says);
                bytes += payload.len();
                limit += d.limit();
                estimated += estimate(&changes, &d.region);
                let cut = cut(&changes, 1_115);
                pieces += cut.len();
                for (region, piece) in &cut {
                    in_pieces += encoded(piece, region).len() + 35;
                }
                let package =
                    |codec| Encoder::new().encode_whole(codec, &batch, 1, &changes).unwrap().bytes().len();
                paper += package(Codec::Paper);
                racer += package(Codec::Racer);
            }
            let mean = |sum: usize| sum as f64 / draws as f64;
            println!(
                "{size:?} {ratio} {changed} {draws} | {:.1} / {:.1} = {:+.2} % | {:.1} {:.1} {:.1} {} | {:+.1} B | {:.1} {:.1} {:.1} | {noise} | {:.1} {:.1}",
                mean(bytes),
                limit / draws as f64,
                (bytes as f64 / limit - 1.0) * 100.0,
                mean(bytes) + 35.0,
                mean(paper),
                mean(racer),
                if bytes + 35 * draws <= paper.min(racer) { "below" } else { "ABOVE" },
                mean(estimated) - mean(bytes),
                ns[0],
                ns[1],
                ns[2],
                mean(pieces),
                mean(in_pieces),
            );
        }
    }
}
