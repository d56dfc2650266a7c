//! Scans show what is solid and what moves, in the pattern of their LiDAR, and are the same on every machine.

use flockmap_grid::{Pose, Scan, Stamp};
use flockmap_worlds::{Body, Lidar, Rendering, ScanOptions, Scanner, World};
use std::sync::{Arc, LazyLock};

static FOREST: LazyLock<Arc<World>> = LazyLock::new(|| Arc::new(World::forest(1)));
static INDOOR: LazyLock<Arc<World>> = LazyLock::new(|| Arc::new(World::indoor(1)));

/// Places inside of the two worlds.
const IN_FOREST: [f64; 3] = [0.375, 0.025, 2.325];
const INDOORS: [f64; 3] = [-1.0, 1.2, 1.7];

fn scan(world: &Arc<World>, lidar: Lidar, options: ScanOptions, pose: &Pose, stamp: i64) -> Scan {
    Scanner::new(Arc::clone(world), lidar, options).scan(Stamp(stamp), pose, None, &[])
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Golden: a change of a scan pattern or a rendering must be on purpose, since recordings and benchmarks
/// depend on it.
#[test]
fn scans_are_the_same_on_every_machine() {
    let pose = Pose::new(INDOORS, [0.01, -0.02, 0.1, 0.8]).unwrap();
    let end = Pose::new([-0.9, 1.25, 1.68], [0.01, -0.02, 0.15, 0.8]).unwrap();
    let bodies = [Body::robot([1.0, 1.5, 1.8])];
    let digest = |lidar: Lidar, rendering| {
        let options = ScanOptions {
            range_noise_m: 0.02,
            drop_out: 0.1,
            no_returns: true,
            motion: true,
            rendering,
            seed: 3,
            ..ScanOptions::default()
        };
        let mut scanner = Scanner::new(Arc::clone(&INDOOR), lidar, options);
        let scan = scanner.scan(Stamp(1_234_500_000), &pose, Some(&end), &bodies);
        let values = scan.points.iter().chain(&scan.no_returns).flatten();
        crc32fast::hash(&values.flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
    };
    let lidars = [Lidar::Avia, Lidar::Mid360, Lidar::Vlp32];
    let digests = lidars.map(|lidar| [digest(lidar, Rendering::Cast), digest(lidar, Rendering::Polar)]);
    assert_eq!(digests, SCAN_DIGESTS);
}

const SCAN_DIGESTS: [[u32; 2]; 3] =
    [[3_258_362_677, 3_378_558_712], [3_810_490_315, 2_726_129_556], [3_105_575_926, 337_727_492]];

#[test]
fn a_scanner_remembers_nothing() {
    for lidar in [Lidar::Mid360, Lidar::Vlp32] {
        for rendering in [Rendering::Cast, Rendering::Polar] {
            let options = ScanOptions { rendering, range_m: 10.0, motion: true, ..ScanOptions::default() };
            let mut used = Scanner::new(Arc::clone(&INDOOR), lidar, options);
            for number in 0..2 {
                let pose = Pose::from_yaw(INDOORS, f64::from(number));
                let end = Pose::from_yaw(INDOORS, f64::from(number) + 0.1);
                let bodies = [Body::robot([0.0, 1.2 + f64::from(number), 1.7])];
                let stamp = Stamp(i64::from(number) * 100_000);
                let fresh =
                    Scanner::new(Arc::clone(&INDOOR), lidar, options).scan(stamp, &pose, Some(&end), &bodies);
                assert_eq!(used.scan(stamp, &pose, Some(&end), &bodies), fresh, "{lidar} {rendering}");
            }
        }
    }
}

/// Every point lies in a solid cell, in range, in the field of view; beams are points, no-returns, or too
/// near.
fn check_scan(world: &World, lidar: Lidar, pose: &Pose, scan: &Scan, options: &ScanOptions) {
    let ([left, right], [low, high]) = lidar.field_of_view_deg();
    assert!(scan.points.len() + scan.no_returns.len() <= lidar.beams());
    for point in &scan.points {
        let point = point.map(f64::from);
        let cell = world.resolution().voxel_at(pose.transform(point)).unwrap();
        assert!(world.is_solid(cell), "{point:?} lies in {cell:?}, which is empty");
        let flat = (point[0] * point[0] + point[1] * point[1]).sqrt();
        let range = (flat * flat + point[2] * point[2]).sqrt();
        assert!(options.min_range_m - 1e-3 <= range && range <= options.range_m + 1e-3, "{range}");
        // Points near the sensor may be moved into their cell by a visible angle.
        if range > 2.0 {
            let (azimuth, elevation) =
                (point[1].atan2(point[0]).to_degrees(), point[2].atan2(flat).to_degrees());
            assert!((left - 0.05..=right + 0.05).contains(&azimuth), "{azimuth}");
            assert!((low - 0.05..=high + 0.05).contains(&elevation), "{elevation}");
        }
    }
    for point in &scan.no_returns {
        let range = point.iter().map(|v| f64::from(v * v)).sum::<f64>().sqrt();
        assert!((range - options.range_m).abs() < 1e-3);
    }
}

#[test]
fn every_cast_point_lies_in_a_solid_cell_within_range_and_field_of_view() {
    let options = ScanOptions { range_m: 12.0, min_range_m: 0.1, no_returns: true, ..ScanOptions::default() };
    for (world, place) in [(&*FOREST, IN_FOREST), (&*INDOOR, INDOORS)] {
        for lidar in Lidar::ALL {
            for (i, stamp) in [0, 100_000, 86_400_000_000].into_iter().enumerate() {
                let turn = 0.3 * i as f64;
                let pose = Pose::new(place, [0.02, turn * 0.1, turn, 1.0]).unwrap();
                let scan = scan(world, lidar, options, &pose, stamp);
                assert_eq!(scan.stamp, Stamp(stamp));
                assert!(scan.points.len() > 5_000, "{}", scan.points.len());
                check_scan(world, lidar, &pose, &scan, &options);
            }
        }
    }
}

#[test]
fn beams_are_unit_vectors_that_fill_the_field_of_view() {
    for lidar in Lidar::ALL {
        let beams = lidar.directions(Stamp(0));
        assert_eq!(beams.len(), lidar.beams());
        let ([left, right], [low, high]) = lidar.field_of_view_deg();
        let mut reached = [f64::MAX, f64::MIN, f64::MAX, f64::MIN];
        for beam in &beams {
            assert!((length(*beam) - 1.0).abs() < 1e-12);
            let azimuth = beam[1].atan2(beam[0]).to_degrees();
            let elevation = beam[2].asin().to_degrees();
            assert!((left..=right).contains(&azimuth), "{azimuth}");
            assert!((low - 1e-9..=high + 1e-9).contains(&elevation), "{elevation}");
            reached = [
                reached[0].min(azimuth),
                reached[1].max(azimuth),
                reached[2].min(elevation),
                reached[3].max(elevation),
            ];
        }
        assert!(reached[1] - reached[0] > 0.9 * (right - left), "{reached:?}");
        assert!(reached[3] - reached[2] > 0.9 * (high - low), "{reached:?}");
        assert_eq!(lidar.to_string().parse(), Ok(lidar));
    }
}

#[test]
fn rosettes_do_not_repeat_and_spinning_patterns_do() {
    for lidar in Lidar::ALL {
        let (before, after) = (lidar.directions(Stamp(0)), lidar.directions(Stamp(1_000_000)));
        assert_eq!(lidar.repeats(), before == after);
        if !lidar.repeats() {
            // One second later hardly any beam points where one pointed before.
            let key = |beam: &[f64; 3]| beam.map(|v| (v * 1e4).round() as i64);
            let seen: std::collections::BTreeSet<_> = before.iter().map(key).collect();
            let again = after.iter().filter(|beam| seen.contains(&key(beam))).count();
            assert!(again < lidar.beams() / 20, "{again} of {}", lidar.beams());
        }
    }
}

#[test]
fn beams_are_fired_in_order_within_a_tenth_of_a_second() {
    for lidar in Lidar::ALL {
        let times: Vec<i64> = (0..lidar.beams()).map(|beam| lidar.fired_after_micros(beam)).collect();
        assert!(times.is_sorted());
        assert_eq!(times[0], 0);
        assert!((99_900..100_000).contains(&times[times.len() - 1]), "{lidar}: {:?}", times.last());
    }
}

#[test]
fn range_noise_has_the_stated_deviation_and_moves_points_along_their_beams() {
    let pose = Pose::from_translation(INDOORS);
    for rendering in [Rendering::Cast, Rendering::Polar] {
        let options = ScanOptions { rendering, ..ScanOptions::default() };
        let exact = scan(&INDOOR, Lidar::Avia, options, &pose, 0);
        let noisy = scan(&INDOOR, Lidar::Avia, ScanOptions { range_noise_m: 0.02, ..options }, &pose, 0);
        assert_eq!(exact.points.len(), noisy.points.len());
        let count = exact.points.len() as f64;
        let (mut sum, mut squares, mut beyond) = (0.0, 0.0, 0);
        for (a, b) in exact.points.iter().zip(&noisy.points) {
            let (a, b) = (a.map(f64::from), b.map(f64::from));
            let error = length(b) - length(a);
            sum += error;
            squares += error * error;
            beyond += u32::from(error.abs() > 0.04);
            // Along the beam, which a point moved into its cell may leave by a few millimetres.
            let across = length(core::array::from_fn(|i| b[i] - a[i] * length(b) / length(a)));
            assert!(across < 1e-3, "{across}");
        }
        assert!((sum / count).abs() < 0.0005, "{}", sum / count);
        assert!(((squares / count).sqrt() - 0.02).abs() < 0.0005, "{}", (squares / count).sqrt());
        // 4.6 % of a normal distribution lie beyond two deviations.
        assert!((0.035..0.055).contains(&(f64::from(beyond) / count)), "{beyond} of {count}");
    }
}

#[test]
fn drop_out_loses_the_stated_share_and_other_beams_with_every_scan() {
    let pose = Pose::from_translation(INDOORS);
    let full = scan(&INDOOR, Lidar::Vlp32, ScanOptions::default(), &pose, 0);
    let options = ScanOptions { drop_out: 0.25, no_returns: true, ..ScanOptions::default() };
    let lossy: Vec<Scan> =
        [0, 100_000].map(|stamp| scan(&INDOOR, Lidar::Vlp32, options, &pose, stamp)).into();
    for lossy in &lossy {
        let share = lossy.points.len() as f64 / full.points.len() as f64;
        assert!((share - 0.75).abs() < 0.01, "{share}");
        // A lost return does not say that nothing was there.
        assert!(lossy.no_returns.len() <= Lidar::Vlp32.beams() - full.points.len());
    }
    assert_ne!(lossy[0].points, lossy[1].points);
    let other_seed = scan(&INDOOR, Lidar::Vlp32, ScanOptions { seed: 1, ..options }, &pose, 0);
    assert_ne!(lossy[0].points, other_seed.points);
    assert!(
        scan(&INDOOR, Lidar::Vlp32, ScanOptions { drop_out: 1.0, ..options }, &pose, 0).points.is_empty()
    );
}

#[test]
fn options_out_of_range_are_named() {
    assert_eq!(ScanOptions::default().check(), Ok(()));
    let error = ScanOptions { drop_out: 1.5, ..ScanOptions::default() }.check().unwrap_err();
    assert_eq!(error.to_string(), "drop_out is 1.5, expected 0 to 1");
    assert!(ScanOptions { range_m: f64::NAN, ..ScanOptions::default() }.check().is_err());
    assert!(ScanOptions { min_range_m: 31.0, ..ScanOptions::default() }.check().is_err());
    for range_m in [f64::NAN, -1.0, 0.0] {
        for rendering in [Rendering::Cast, Rendering::Polar] {
            let options = ScanOptions { range_m, rendering, ..ScanOptions::default() };
            let nothing = scan(&INDOOR, Lidar::Mid360, options, &Pose::from_translation(INDOORS), 0);
            assert!(nothing.points.is_empty(), "{rendering} at {range_m} m");
        }
    }
}
