//! The map does not depend on how many threads make it.

use flockmap_grid::{
    Mapper, MapperConfig, Pose, Preset, RaysWalked, Resolution, Scan, ScanReport, Sphere, Stamp, Voxel,
};
use proptest::prelude::*;

/// Points all around, at 0.5 to 5 m, some of them with nothing there.
fn scan(random: &mut impl FnMut() -> f64, stamp: i64, points: usize) -> Scan {
    let mut list = || (0..points).map(|_| core::array::from_fn(|_| (random() * 10.0 - 5.0) as f32)).collect();
    let (points, no_returns) = (list(), list());
    Scan { stamp: Stamp(stamp), points, no_returns }
}

/// All that a map says, and what became of the scans.
type Said = (Vec<(Voxel, Option<f64>, Option<Stamp>)>, Vec<ScanReport>);

fn map(config: MapperConfig, scans: &[Scan]) -> Said {
    let mut mapper = Mapper::new(config).unwrap();
    // So large that some forty points lie in it, whatever the seed.
    let teammate = Sphere { centre: [1.0, 1.0, 0.0], radius: 0.8 };
    let reports = scans.iter().enumerate().map(|(number, scan)| {
        if number == 2 {
            mapper.begin_submap();
            mapper.begin_submap();
        }
        let pose = Pose::from_yaw([number as f64 * 0.7, 0.3, -0.1], number as f64);
        mapper.insert(scan, &pose, &[teammate])
    });
    let reports = reports.collect();
    let mut blocks: Vec<_> = mapper.blocks().map(|(index, _)| index).collect();
    blocks.sort_unstable();
    let voxels = blocks.into_iter().flat_map(|index| (0..512).map(move |bit| index.voxel(bit)));
    (voxels.map(|voxel| (voxel, mapper.log_odds(voxel), mapper.last_seen(voxel))).collect(), reports)
}

/// Of `rog-map` with misses that count little, so that more than 255 of them differ from 255.
fn patient(resolution: Resolution) -> MapperConfig {
    MapperConfig { p_miss: 0.4995, ..MapperConfig::preset(Preset::RogMap, resolution, 4.0) }
}

#[test]
fn any_number_of_threads_makes_the_same_map_and_says_the_same_of_it() {
    compare(7);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2, max_shrink_iters: 0, ..ProptestConfig::default() })]
    #[test]
    fn any_number_of_threads_makes_the_same_map_with_fresh_seeds(seed: u64) {
        compare(seed);
    }
}

fn compare(seed: u64) {
    let mut state = seed;
    let mut random = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f64 / (1u64 << 24) as f64
    };
    // The last ones are worth one thread, and two.
    let scans = [20_000, 17_000, 16_500, 1_000, 5_000];
    let scans: Vec<Scan> = (1..).zip(scans).map(|(stamp, points)| scan(&mut random, stamp, points)).collect();
    let resolution = Resolution::from_metres(0.25).unwrap();
    let presets = [Preset::RogMap, Preset::Racer, Preset::OctoMap];
    let presets = presets.map(|preset| MapperConfig::preset(preset, resolution, 4.0));
    let single = MapperConfig { rays: RaysWalked::OnePerEndVoxel, ..presets[0].clone() };
    for config in presets.into_iter().chain([patient(resolution), single]) {
        let alone = map(config.clone(), &scans);
        assert!(alone.0.len() > 10_000 && alone.1[0].masked > 0);
        assert!(alone.1.iter().all(|report| report.hits > 100));
        // Also where blocks are forgotten, for which it matters which ones were touched.
        let small = MapperConfig { memory_bytes_max: 200 << 10, ..config.clone() };
        let small_alone = map(small.clone(), &scans);
        assert!(small_alone.1.iter().any(|report| !report.forgotten.is_empty()));
        for threads in [2, 3, 8] {
            assert!(map(MapperConfig { threads, ..config.clone() }, &scans) == alone, "{threads} threads");
            assert!(
                map(MapperConfig { threads, ..small.clone() }, &scans) == small_alone,
                "{threads} threads"
            );
        }
    }
}
