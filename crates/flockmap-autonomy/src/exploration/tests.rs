use super::*;
use flockmap_grid::Resolution;
use flockmap_io::Frame;
use flockmap_worlds::World;
use flockmap_worlds::curve::distance;
use std::sync::Arc;

/// Two rooms of 4 × 4 m, 2.4 m high, with a door 1.2 m wide between them, walls all around, floor and ceiling.
fn two_rooms() -> World {
    let mut points = Vec::new();
    for x in 0..=80 {
        for y in 0..=40 {
            for z in 0..=24 {
                let wall = [0, 80].contains(&x) || [0, 40].contains(&y) || [0, 24].contains(&z);
                let divides = x == 40 && !(14..26).contains(&y);
                if wall || divides {
                    points.push([x, y, z].map(|v| f64::from(v) * 0.1 + 0.05));
                }
            }
        }
    }
    World::from_points(points, Resolution::from_metres(0.1).unwrap()).unwrap()
}

fn options(robots: usize) -> ExploreOptions {
    ExploreOptions {
        robots,
        resolution: Resolution::from_metres(0.2).unwrap(),
        range_m: 3.0,
        seconds_max: 200.0,
        ..ExploreOptions::default()
    }
}

fn explore(world: &Arc<World>, options: ExploreOptions) -> (Outcome, Vec<Vec<Frame>>) {
    let mut explorer = Explorer::new(Arc::clone(world), options).unwrap();
    let mut steps = Vec::new();
    while let Some(frames) = explorer.step() {
        steps.push(frames);
    }
    (explorer.outcome(), steps)
}

#[test]
fn two_robots_see_two_rooms_and_stop_by_themselves_without_touching_anything() {
    let world = Arc::new(two_rooms());
    let (outcome, steps) = explore(&world, options(2));
    assert_eq!(outcome.ended, Ended::Done, "{outcome:?}");
    assert!(outcome.seen_share >= 0.95, "{outcome:?}");
    let mut flown = [0.0; 2];
    let mut before: Option<Vec<[f64; 3]>> = None;
    for frames in &steps {
        let places: Vec<[f64; 3]> = frames.iter().map(|frame| frame.t_map_sensor.translation()).collect();
        assert!(distance(places[0], places[1]) >= 1.0, "{places:?}");
        for (robot, place) in places.iter().enumerate() {
            // Nothing solid within 20 cm, seen along six axes.
            for axis in 0..3 {
                for sign in [-1.0, 1.0] {
                    let mut direction = [0.0; 3];
                    direction[axis] = sign;
                    assert_eq!(world.cast_ray(*place, direction, 0.2), None, "{place:?}");
                }
            }
            if let Some(before) = &before {
                let moved = distance(before[robot], *place);
                assert!(moved <= 0.2 + 1e-6, "{moved} m in 0.1 s at 2 m/s");
                flown[robot] += moved;
            }
        }
        before = Some(places);
    }
    for robot in 0..2 {
        assert!((flown[robot] - outcome.path_m[robot]).abs() < 0.5, "{flown:?} {outcome:?}");
    }
    for (number, frames) in steps.iter().enumerate() {
        assert!(frames.iter().all(|frame| frame.scan.stamp.0 == number as i64 * 100_000));
    }
}

#[test]
fn the_same_seed_gives_the_same_frames_with_one_and_two_threads() {
    let world = Arc::new(two_rooms());
    let run = |threads| explore(&world, ExploreOptions { threads, seconds_max: 3.0, ..options(3) });
    let (one, two) = (run(1), run(2));
    assert_eq!(one.0, two.0);
    assert!(one.1 == two.1, "the frames differ");
    assert_eq!(one.1.len(), 30);
    assert_eq!(one.0.ended, Ended::TimeOut);
}

#[test]
fn without_a_radio_robots_look_at_what_others_have_seen() {
    let world = Arc::new(two_rooms());
    let joined = explore(&world, options(2)).0;
    let mut cut = options(2);
    cut.radio.link.loss = 1.0;
    let cut = explore(&world, cut).0;
    assert!(cut.seen_share >= 0.95, "{cut:?}");
    assert!(cut.overlap > joined.overlap + 0.1, "{joined:?} {cut:?}");
}

#[test]
fn options_that_cannot_work_are_refused_with_a_reason() {
    let world = Arc::new(two_rooms());
    let refused = |options| Explorer::new(Arc::clone(&world), options).err().unwrap();
    for (name, options) in [
        ("robots", ExploreOptions { robots: 0, ..options(1) }),
        ("threads", ExploreOptions { threads: 0, ..options(1) }),
        ("range_m", ExploreOptions { range_m: f64::NAN, ..options(1) }),
        ("clearance_m", ExploreOptions { clearance_m: 5.0, ..options(1) }),
    ] {
        assert!(refused(options).to_string().starts_with(name));
    }
    let nowhere = ExploreOptions { region_m: Some([[0.0; 3]; 2]), ..options(1) };
    assert!(matches!(refused(nowhere), ExploreError::Region(_)));
    let crowd = refused(options(60));
    assert!(matches!(crowd, ExploreError::NoStart { robots: 60, .. }), "{crowd}");
}

#[test]
fn working_out_what_can_be_seen_is_reported_and_can_be_stopped() {
    let world = Arc::new(two_rooms());
    let most = std::sync::Mutex::new((0, 0));
    let progress = |done: usize, of: usize| {
        let mut most = most.lock().unwrap();
        *most = (most.0.max(done), of);
        done < 5
    };
    let stopped = Explorer::new_watched(Arc::clone(&world), options(1), &progress);
    assert_eq!(stopped.err(), Some(ExploreError::Stopped));
    let (done, of) = *most.lock().unwrap();
    assert_eq!(done, 5);
    assert!(of > 20, "{of} blocks");
}
