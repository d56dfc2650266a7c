//! Scans in the open, and states from elsewhere, far larger than what may be held of the map: the mapper takes no more
//! than it states.

use flockmap_grid::{
    Mapper, MapperConfig, Pose, Preset, RaysWalked, Resolution, Scan, Stamp, State, States, StatesUpdate,
    Voxel, VoxelBox, Which,
};
use peak_alloc::PeakAlloc;

/// Counts the bytes that are held, and the most that ever were.
#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

/// Points all around, at the end of the range, on a spiral from pole to pole.
fn sphere(points: usize, radius: f64, stamp: i64) -> Scan {
    let point = |n: usize| {
        let (z, turn) = ((2 * n + 1) as f64 / points as f64 - 1.0, n as f64 * 2.399_963);
        let across = (1.0 - z * z).sqrt();
        [across * turn.cos(), across * turn.sin(), z].map(|at| (at * radius) as f32)
    };
    Scan { stamp: Stamp(stamp), points: (0..points).map(point).collect(), no_returns: Vec::new() }
}

fn config(memory_bytes_max: usize, range_m: f64) -> MapperConfig {
    of_preset(Preset::RogMap, 1, memory_bytes_max, range_m)
}

fn of_preset(preset: Preset, threads: usize, memory_bytes_max: usize, range_m: f64) -> MapperConfig {
    let resolution = Resolution::from_metres(0.1).unwrap();
    let rays = if threads == 2 { RaysWalked::OnePerEndVoxel } else { RaysWalked::All };
    MapperConfig { memory_bytes_max, threads, rays, ..MapperConfig::preset(preset, resolution, range_m) }
}

/// Inserts scans one after the other; returns what was held afterwards and the most meanwhile. Reports are
/// let go at once.
fn held(mapper: &mut Mapper, scans: &[Scan], step_m: f64) -> (usize, usize, usize) {
    let mut blocks = 0;
    ALLOCATOR.reset_peak_usage();
    for (number, scan) in scans.iter().enumerate() {
        let pose = Pose::from_translation([number as f64 * step_m, 0.05, 0.05]);
        let report = mapper.insert(scan, &pose, &[]);
        blocks = blocks.max(mapper.block_count() + report.forgotten.len());
        drop(report);
        drop(mapper.take_changes(Which::All));
    }
    (blocks, ALLOCATOR.current_usage(), ALLOCATOR.peak_usage())
}

/// One test, since the counter is one for the whole process.
#[test]
fn a_mapper_takes_what_it_states_also_while_a_scan_is_taken_in() {
    // Far more than may be held: a mebibyte, of a scan that touches nearly all within its range.
    let rules =
        [Preset::RogMap, Preset::OctoMap].into_iter().flat_map(|preset| [1, 2, 3].map(|n| (preset, n)));
    let rules: Vec<(Preset, usize)> = rules.collect();
    for (range, points) in [(8.0, 40_000), (20.0, 150_000)] {
        let scans: Vec<Scan> = (1..4).map(|stamp| sphere(points, range * 0.99, stamp)).collect();
        for &(preset, threads) in &rules {
            let config = of_preset(preset, threads, 1 << 20, range);
            let before = ALLOCATOR.current_usage();
            let mut mapper = Mapper::new(config.clone()).unwrap();
            let (blocks, after, peak) = held(&mut mapper, &scans[..1], 0.0);
            let (after, peak) = (after - before, peak - before);
            let stated = config.memory_max(points);
            println!(
                "{preset}, {threads} threads, {range} m: {blocks} blocks, {peak} at the peak, {stated} stated"
            );
            assert!(peak <= stated, "{peak} bytes, {stated} stated");
            assert!(mapper.memory_bytes() <= 1 << 20, "{}", mapper.memory_bytes());
            // What the documentation says of each block and point, by the blocks that were really touched.
            let window = (2.0 * range / 0.8).ceil() as usize + 2;
            let window = window.next_power_of_two().pow(3);
            let counts = match preset {
                Preset::RogMap => window * 8 + blocks * 2 * 640,
                _ => window * 68 + blocks * 80,
            };
            let ends = if threads == 2 { window * 4 + blocks * 80 } else { 0 };
            let (fixed, counts) = ((1 << 20) + (64 << 10), threads * (counts + ends));
            println!("  {after} after, of which {counts} may be counts");
            assert!(after <= fixed + points * 36 + counts, "{after} bytes");
            assert!(peak <= fixed + points * 72 + blocks * 900 + counts * 3 / 2, "{peak} bytes");
            // The next ones take nothing more.
            let (_, again, _) = held(&mut mapper, &scans[1..], 0.0);
            assert!(again - before <= after + (64 << 10), "{} bytes after {after}", again - before);
        }
    }

    // A flight whose map fits: what is said to be held is held.
    let config = config(64 << 20, 6.0);
    let scans: Vec<Scan> = (1..60).map(|stamp| sphere(3_000, 5.9, stamp)).collect();
    let before = ALLOCATOR.current_usage();
    let mut mapper = Mapper::new(config.clone()).unwrap();
    let (_, after, peak) = held(&mut mapper, &scans, 1.0);
    let (said, after, peak) = (mapper.memory_bytes(), after - before, peak - before);
    println!(
        "flight: {} blocks of {} bytes, {after} held, {peak} at the peak",
        mapper.block_count(),
        said / mapper.block_count()
    );
    assert!(mapper.block_count() > 10_000 && said <= 64 << 20 && said / mapper.block_count() <= 2_500);
    assert!(after > said && after < said + (8 << 20), "{after} bytes held, {said} said");
    assert!(peak <= config.memory_max(3_000));

    // One that goes on and on under a cap: the tables do not grow with what was forgotten.
    let config = self::config(8 << 20, 6.0);
    let scans: Vec<Scan> = (1..200).map(|stamp| sphere(3_000, 5.9, stamp)).collect();
    let before = ALLOCATOR.current_usage();
    let mut mapper = Mapper::new(config.clone()).unwrap();
    let (_, after, peak) = held(&mut mapper, &scans, 2.0);
    let (said, after, peak) = (mapper.memory_bytes(), after - before, peak - before);
    println!(
        "long flight: {} blocks, {said} bytes said, {after} held, {peak} at the peak",
        mapper.block_count()
    );
    assert!(said <= 8 << 20 && after > said && after < said + (8 << 20), "{after} bytes held, {said} said");
    assert!(peak <= config.memory_max(3_000));

    // States from elsewhere, each in a block of its own: far more blocks than may be held.
    let config = self::config(1 << 20, 6.0);
    let voxels: Vec<(Voxel, State)> = (0..100_000).map(|k| (Voxel::new(8 * k, 0, 0), State::Free)).collect();
    let states = vec![State::Free; 1 << 24];
    let region = VoxelBox::new(Voxel::new(0, 0, 0), [1 << 10, 1 << 7, 1 << 7]).unwrap();
    let a_box = States::Box { region, states: &states, clear_unknown: true };
    for (said, states) in [(voxels.len(), States::Voxels(&voxels)), (states.len() / 512, a_box)] {
        let before = ALLOCATOR.current_usage();
        let mut mapper = Mapper::new(config.clone()).unwrap();
        ALLOCATOR.reset_peak_usage();
        let update = StatesUpdate { stamp: Stamp(1), resolution: config.resolution, sensor: None, states };
        let report = mapper.insert_states(&update).unwrap();
        let peak = ALLOCATOR.peak_usage() - before;
        println!("{said} blocks of states: {peak} bytes at the peak, {} kept", report.touched.len());
        assert!(mapper.memory_bytes() <= 1 << 20 && report.touched.len() == mapper.block_count());
        assert!(peak <= (1 << 20) + said * 80 + mapper.block_count() * 250, "{peak} bytes for {said}");
    }
}
