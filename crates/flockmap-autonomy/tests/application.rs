//! Two robots in line, of which the leader looks backwards: it gets through with its follower's map and not
//! without.

use flockmap_autonomy::application::{
    ApplicationOptions, Course, Ending, MapSync, SeriesOptions, fly, series,
};
use flockmap_grid::Resolution;
use flockmap_worlds::World;
use std::sync::Arc;

/// A wall, 3 m wide, across the straight path to the goal.
fn wall_ahead() -> Course {
    let wall = (-15..15).flat_map(|y| (0..25).map(move |z| [8.05, f64::from(y) * 0.1, f64::from(z) * 0.1]));
    Course {
        world: Arc::new(World::from_points(wall, Resolution::from_metres(0.1).unwrap()).unwrap()),
        leader_start: [4.0, 0.0, 1.3],
        follower_start: [1.5, 0.0, 1.8],
        goal: [11.0, 0.0],
        fence: [[0.0, -4.0], [13.0, 4.0]],
    }
}

fn options(sync: MapSync) -> ApplicationOptions {
    ApplicationOptions { sync, seconds_max: 30.0, ..ApplicationOptions::default() }
}

const PERFECT: MapSync = MapSync::Radio { rate_bytes_per_s: None, loss: 0.0, delay_ms: 20 };

#[test]
fn with_its_followers_map_the_leader_flies_round_a_wall_that_it_cannot_see() {
    let outcome = fly(&wall_ahead(), &options(PERFECT)).unwrap();
    assert!(outcome.is_success(), "{outcome:?}");
    assert!((7.0..12.0).contains(&outcome.leader_path_m), "{outcome:?}");
    assert!(outcome.seconds > 2.0 + 6.5 / 1.5, "faster than it can fly: {outcome:?}");
    assert!(outcome.follower.sent_bytes > 0 && outcome.leader.received_bytes == outcome.follower.sent_bytes);
    assert!((0.02..0.5).contains(&outcome.obstacle_age_median_s), "{outcome:?}");
}

#[test]
fn without_sync_the_leader_flies_into_it() {
    let outcome = fly(&wall_ahead(), &options(MapSync::None)).unwrap();
    assert_eq!(outcome.ending, Ending::LeaderHit, "{outcome:?}");
    assert!((7.5..8.0).contains(&outcome.leader_at[0]), "{outcome:?}");
    assert_eq!(outcome.leader.sent_bytes + outcome.follower.sent_bytes, 0);
}

#[test]
fn a_radio_that_loses_everything_is_no_better_than_none() {
    let deaf = MapSync::Radio { rate_bytes_per_s: None, loss: 1.0, delay_ms: 20 };
    assert_eq!(fly(&wall_ahead(), &options(deaf)).unwrap().ending, Ending::LeaderHit);
}

#[test]
fn the_same_flight_twice_is_the_same_and_a_budget_is_kept() {
    let sync = MapSync::Radio { rate_bytes_per_s: Some(5 * 1024), loss: 0.2, delay_ms: 20 };
    let options = ApplicationOptions { seconds_max: 4.0, ..options(sync) };
    let course = wall_ahead();
    let outcome = fly(&course, &options).unwrap();
    assert_eq!(outcome, fly(&course, &options).unwrap());
    let most = outcome.follower.sent_bytes_per_s_max;
    assert!((2_000..=5 * 1024).contains(&most), "{most} bytes in a second");
    let another = fly(&course, &ApplicationOptions { seed: 2, ..options }).unwrap();
    assert_ne!(outcome, another, "the seed makes no difference");
}

#[test]
fn every_thicket_can_be_crossed_and_none_by_flying_straight() {
    for seed in 1..=20 {
        let course = Course::thicket(seed);
        assert!(course.is_passable(), "seed {seed}");
        let straight = (0..3).any(|dy| {
            let from = [4.0, f64::from(dy - 1) * 0.2, 1.3];
            course.world.cast_ray(from, [1.0, 0.0, 0.0], 30.0).is_some()
        });
        assert!(straight, "seed {seed}: nothing stands between start and goal");
    }
    // A course that a wall divides is not passable.
    let mut course = wall_ahead();
    course.fence = [[0.0, -1.4], [13.0, 1.4]];
    assert!(!course.is_passable());
}

#[test]
fn a_series_does_not_depend_on_threads_and_ends_when_it_is_stopped() {
    let application = ApplicationOptions { seconds_max: 0.3, ..ApplicationOptions::default() };
    let options = |threads| SeriesOptions {
        seeds: 2,
        rates_bytes_per_s: vec![5 * 1024],
        losses: vec![0.2],
        obstacles_first_rates_bytes_per_s: vec![5 * 1024],
        threads,
        application: application.clone(),
        ..SeriesOptions::default()
    };
    let one = series(&options(1), || true).unwrap();
    assert_eq!(one, series(&options(2), || true).unwrap());
    assert_eq!(one.iter().map(|s| s.obstacles_first).collect::<Vec<_>>(), [false, false, false, true]);
    assert!(one.iter().all(|series| series.outcomes.len() == 2));
    assert_eq!(one[0].sync, MapSync::None);
    let stopped = series(&options(1), || false).unwrap();
    assert_eq!(stopped.iter().map(|series| series.outcomes.len()).sum::<usize>(), 1);
}
