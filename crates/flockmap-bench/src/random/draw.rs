//! Draws changes, and counts what each method needs for them.

use anyhow::ensure;
use flockmap::codec::{Batch, Codec, Content, Decoder, Encoder, Package};
use flockmap::grid::{StateBlock, VoxelBox, voxel_bit};
use flockmap::{Changes, Resolution, RobotId, Stamp, State, Stream, Voxel};
use flockmap_cli::parallel::{cores, in_parallel};
use flockmap_cli::progress::Progress;
use flockmap_cli::stop;
use flockmap_worlds::Random;
use serde::Serialize;

/// Maps whose voxels need addresses of 2, 3, 3 and 4 bytes. The paper does not say its sizes. The last is a
/// forest of 60 × 25.6 × 12 m at 0.1 m.
const SIZES: [[u32; 3]; 4] = [[32, 32, 32], [64, 64, 64], [128, 128, 128], [600, 256, 120]];

/// Shares of voxels that changed: 10⁻⁴ to 1.
const RATIOS: [f64; 13] = [1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 1e-1, 2e-1, 5e-1, 1.0];

/// What is drawn.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Voxels along x, y, z of each map; multiples of 8.
    pub sizes: Vec<[u32; 3]>,
    /// Shares of voxels that changed.
    pub ratios: Vec<f64>,
    /// Draws for each size and ratio.
    pub draws: u32,
    pub seed: u64,
}

impl Plan {
    /// The whole figure, or a quick look at it.
    pub fn new(quick: bool, seed: u64) -> Self {
        let ratios = if quick { RATIOS.into_iter().step_by(3).collect() } else { RATIOS.to_vec() };
        Self { sizes: SIZES.to_vec(), ratios, draws: if quick { 2 } else { 10 }, seed }
    }
}

/// One map size.
#[derive(Serialize, Clone, Debug)]
pub struct Map3 {
    /// Voxels along x, y, z.
    pub size: [u32; 3],
    pub voxels: u64,
    /// Bytes of the shortest address that is another one for each voxel.
    pub address_bytes: u32,
    pub points: Vec<Point>,
}

/// One share of changed voxels.
#[derive(Serialize, Clone, Debug)]
pub struct Point {
    pub ratio: f64,
    pub changed: u64,
    /// No method can need less on average: (h(r) + r) · voxels / 8, h being the binary entropy.
    pub limit_bytes: f64,
    pub methods: Vec<Cost>,
}

/// What a method needs for one share of changed voxels.
#[derive(Serialize, Clone, Debug)]
pub struct Cost {
    pub name: &'static str,
    pub mean_bytes: f64,
    pub smallest_bytes: u64,
    pub largest_bytes: u64,
}

/// The figure.
pub struct Figure {
    pub maps: Vec<Map3>,
    /// Largest package header among all.
    pub header_bytes_max: usize,
    /// Whether what was decoded (first draw of every point) is what went in.
    pub lossless: bool,
}

/// RACER as the figure counts it: an address for each changed voxel, of as few bytes as the map allows.
pub const RACER_ADDRESSES: &str = "racer, addresses only";
/// The same with the state, which must be known too.
pub const RACER_SHORT: &str = "racer, short address + state";

/// Draws and encodes everything, on all cores. The result does not depend on their number.
pub fn measure(plan: &Plan) -> anyhow::Result<Figure> {
    // The largest maps first, so that no core is left with one at the end.
    let mut jobs: Vec<(usize, usize)> = (0..plan.sizes.len())
        .flat_map(|size| (0..plan.ratios.len()).map(move |ratio| (size, ratio)))
        .collect();
    jobs.sort_by_key(|&(size, _)| std::cmp::Reverse(volume(plan.sizes[size])));
    let weight = |size: usize| volume(plan.sizes[size]).div_ceil(1 << 15);
    let progress = Progress::new("Fig. 5: voxels drawn, in 32³", jobs.iter().map(|j| weight(j.0)).sum());
    let points = in_parallel(cores().min(jobs.len()), jobs, |(size, ratio)| {
        let point = point(plan, size, ratio);
        progress.add(weight(size));
        (size, point)
    });
    let mut figure = Figure { maps: Vec::new(), header_bytes_max: 0, lossless: true };
    for &size in &plan.sizes {
        let voxels = volume(size);
        figure.maps.push(Map3 { size, voxels, address_bytes: address_bytes(voxels), points: Vec::new() });
    }
    // Those of one size come in the order of the ratios.
    for (size, point) in points {
        let (point, header_bytes, lossless) = point?;
        figure.maps[size].points.push(point);
        figure.header_bytes_max = figure.header_bytes_max.max(header_bytes);
        figure.lossless &= lossless;
    }
    Ok(figure)
}

fn volume(size: [u32; 3]) -> u64 {
    size.into_iter().map(u64::from).product()
}

/// Bytes of the shortest address that is another one for each of so many voxels.
fn address_bytes(voxels: u64) -> u32 {
    (u64::BITS - voxels.saturating_sub(1).leading_zeros()).div_ceil(8).max(1)
}

/// Binary entropy in bits.
fn entropy(share: f64) -> f64 {
    [share, 1.0 - share].into_iter().filter(|p| *p > 0.0).map(|p| -p * p.log2()).sum()
}

/// Exactly `count` voxels of the map, each Free or Occupied with the same probability. Two opposite corners
/// of the map are always among them: the whole map is the box then, as in the paper's figure, and no method
/// gains from a smaller one.
fn draw(size: [u32; 3], count: u64, random: &mut Random) -> Changes {
    let voxels = volume(size);
    let [x, y, z] = size.map(|side| side as i32 - 1);
    let corners = [Voxel::new(0, 0, 0), Voxel::new(x, y, z)];
    let map = VoxelBox::spanning(corners[0], corners[1]);
    // Selection sampling (Knuth, vol. 2, algorithm S): every set of voxels has the same probability.
    let (mut left, mut wanted) = (voxels - 2, count.saturating_sub(2));
    let mut blocks = Vec::new();
    for index in map.iter().flat_map(VoxelBox::blocks) {
        let corner = corners.into_iter().find(|corner| corner.block() == index).map(voxel_bit);
        let mut block = StateBlock::default();
        for bit in 0..512 {
            let is_corner = corner == Some(bit);
            if !is_corner {
                let chosen = random.below(left) < wanted;
                left -= 1;
                if !chosen {
                    continue;
                }
                wanted -= 1;
            }
            let occupied = random.next_u64() >> 63 == 1;
            block.set(bit, if occupied { State::Occupied } else { State::Free });
        }
        blocks.push((index, block));
    }
    Changes::from_blocks(blocks)
}

/// A point, the largest header, and whether every codec is lossless.
type Measured = anyhow::Result<(Point, usize, bool)>;

/// Draws one point, encodes and decodes.
fn point(plan: &Plan, size_number: usize, ratio_number: usize) -> Measured {
    let (size, ratio) = (plan.sizes[size_number], plan.ratios[ratio_number]);
    let voxels = volume(size);
    ensure!(
        size.iter().all(|side| *side > 0 && side % 8 == 0),
        "a map of {size:?} voxels: sides must be multiples of 8"
    );
    let changed = ((voxels as f64 * ratio).round() as u64).clamp(2, voxels);
    let batch = Batch {
        stream: Stream { origin: RobotId(1), epoch: 1 },
        start: Stamp(0),
        end: Stamp(500_000),
        resolution: Resolution::from_micrometres(100_000)
            .ok_or_else(|| anyhow::anyhow!("0.1 m is a resolution"))?,
        sensor: [0; 3],
    };
    let (mut encoder, mut decoder) = (Encoder::new(), Decoder::new());
    let mut costs: Vec<(&'static str, Vec<u64>)> =
        Codec::ALL.into_iter().map(|codec| (codec.name(), Vec::new())).collect();
    let (mut header_bytes, mut lossless) = (0, true);
    for number in 0..plan.draws {
        let purpose = (size_number as u64) << 48 | (ratio_number as u64) << 32 | u64::from(number);
        let changes = draw(size, changed, &mut Random::new(plan.seed, purpose));
        for (codec, (_, bytes)) in Codec::ALL.into_iter().zip(&mut costs) {
            // What these two need does not depend on the draw.
            if let (Codec::Raw | Codec::Racer, Some(&first)) = (codec, bytes.first()) {
                bytes.push(first);
                continue;
            }
            let package = encoder.encode_whole(codec, &batch, 1, &changes)?;
            bytes.push(package.bytes().len() as u64);
            if codec == Codec::Raw {
                header_bytes = header_bytes.max(package.bytes().len() - voxels.div_ceil(4) as usize);
            }
            if number == 0 {
                let decoded = decoder.decode(&Package::parse(package.bytes())?)?;
                lossless &= matches!(&decoded, Content::Changes(decoded) if *decoded == changes);
            }
        }
        if stop::requested() {
            break;
        }
    }
    let address = u64::from(address_bytes(voxels));
    let fixed = [(RACER_SHORT, changed * (address + 1)), (RACER_ADDRESSES, changed * address)];
    costs.extend(fixed.map(|(name, bytes)| (name, vec![bytes])));
    let cost = |(name, bytes): (&'static str, Vec<u64>)| Cost {
        name,
        mean_bytes: bytes.iter().sum::<u64>() as f64 / bytes.len().max(1) as f64,
        smallest_bytes: bytes.iter().copied().min().unwrap_or(0),
        largest_bytes: bytes.iter().copied().max().unwrap_or(0),
    };
    let limit_bytes = (entropy(ratio) + ratio) * voxels as f64 / 8.0;
    Ok((
        Point { ratio, changed, limit_bytes, methods: costs.into_iter().map(cost).collect() },
        header_bytes,
        lossless,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small(sizes: &[[u32; 3]], ratios: &[f64], draws: u32) -> Figure {
        measure(&Plan { sizes: sizes.to_vec(), ratios: ratios.to_vec(), draws, seed: 3 }).unwrap()
    }

    #[test]
    fn the_four_maps_need_addresses_of_2_3_3_and_4_bytes() {
        assert_eq!(SIZES.map(|size| address_bytes(volume(size))), [2, 3, 3, 4]);
        assert_eq!(
            [1, 256, 257, 65_536, 65_537, 1 << 24, (1 << 24) + 1].map(address_bytes),
            [1, 1, 2, 2, 3, 3, 4]
        );
    }

    #[test]
    fn a_draw_has_just_so_many_voxels_in_the_whole_map() {
        let size = [16, 24, 8];
        for count in [2, 3, 100, 3_071, 3_072] {
            let changes = draw(size, count, &mut Random::new(1, count));
            assert_eq!(changes.len() as u64, count);
            assert_eq!(changes.bounding_box().unwrap().size(), size);
        }
        let halves = draw([64, 64, 64], 100_000, &mut Random::new(1, 1));
        let occupied = halves.voxels().filter(|(_, state)| *state == State::Occupied).count();
        assert!((48_500..51_500).contains(&occupied), "{occupied}");
    }

    #[test]
    fn costs_follow_the_formulas() {
        let figure = small(&[[32, 32, 32]], &[0.01, 0.1, 1.0], 2);
        assert!(figure.lossless);
        let voxels = 32_768.0;
        for point in &figure.maps[0].points {
            let cost = |name: &str| point.methods.iter().find(|cost| cost.name == name).unwrap().mean_bytes;
            let changed = point.changed as f64;
            assert_eq!(cost(RACER_ADDRESSES), changed * 2.0);
            assert_eq!(cost(RACER_SHORT), changed * 3.0);
            let header = figure.header_bytes_max as f64;
            assert!((1.0..=64.0).contains(&header));
            assert_eq!(cost("raw"), voxels / 4.0 + header);
            assert!(
                (cost("racer") - changed * 5.0 - header).abs() <= 8.0,
                "its own header may differ in length"
            );
            for name in ["paper", "nested-zlib"] {
                assert!(cost(name) > point.limit_bytes * 0.99, "{name} below what is possible");
                assert!(
                    cost(name) < point.limit_bytes * 3.0 + 100.0,
                    "{name} costs {} of {}",
                    cost(name),
                    point.limit_bytes
                );
            }
        }
        assert_eq!(entropy(0.5), 1.0);
        assert_eq!(entropy(0.0) + entropy(1.0), 0.0);
        assert!((entropy(0.11) - 0.4999).abs() < 1e-3);
    }

    #[test]
    fn the_same_seed_gives_the_same_figure() {
        let bytes = || format!("{:?}", small(&[[32, 32, 32], [64, 64, 64]], &[0.001, 0.2], 2).maps);
        assert_eq!(bytes(), bytes());
    }
}
