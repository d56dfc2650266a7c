//! Frames as they come, beside a naive model of them.

use std::collections::BTreeMap;

use flockmap_grid::{Pose, Stamp};
use flockmap_io::ros::{FRAMES_MAX, FrameForest, NoPose, NoPoseThen, Reach, Track};
use proptest::prelude::*;

fn at(x: f64) -> Pose {
    Pose::from_translation([x, 0.0, 0.0])
}

/// Poses by stamp, and what they answer.
#[derive(Default)]
struct Model(BTreeMap<i64, f64>);

impl Model {
    fn at(&self, stamp: i64, reach: Reach) -> Result<f64, NoPoseThen> {
        let before = self.0.range(..=stamp).next_back();
        let after = self.0.range(stamp..).next();
        let near = |found: Option<(&i64, &f64)>| {
            found.filter(|(s, _)| (stamp - **s).abs() <= reach.near).map(|(_, x)| *x)
        };
        match (before, after) {
            (Some((a, x)), Some((b, _))) if a == b => Ok(*x),
            (Some((a, from)), Some((b, to))) if b - a <= reach.gap_max => {
                Ok(from + (to - from) * (stamp - a) as f64 / (b - a) as f64)
            }
            (Some((a, _)), Some((b, _))) => {
                let nearest = if stamp - a <= b - stamp { before } else { after };
                near(nearest).ok_or(NoPoseThen::Gap { before: Stamp(*a), after: Stamp(*b) })
            }
            (Some((a, _)), None) => near(before).ok_or(NoPoseThen::NotYet { newest: Some(Stamp(*a)) }),
            (None, Some((b, _))) => near(after).ok_or(NoPoseThen::TooOld { oldest: Stamp(*b) }),
            (None, None) => Err(NoPoseThen::NotYet { newest: None }),
        }
    }
}

#[derive(Clone, Debug)]
enum Step {
    Push(i64, f64),
    Forget(i64),
    Ask(i64),
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (0..60i64, -100i32..100).prop_map(|(stamp, x)| Step::Push(stamp, f64::from(x))),
        1 => (0..60i64).prop_map(Step::Forget),
        4 => (-5..65i64).prop_map(Step::Ask),
    ]
}

proptest! {
    #[test]
    fn live_frames_answer_as_a_naive_model(
        steps in prop::collection::vec(any_step(), 1..80), most in 1..12usize, gap_max in 0..20i64, near in 0..6i64,
    ) {
        let reach = Reach { gap_max, near };
        let (mut model, mut forest, mut track) = (Model::default(), FrameForest::new(FRAMES_MAX, most), Track::default());
        for step in steps {
            match step {
                Step::Push(stamp, x) => {
                    model.0.insert(stamp, x);
                    while model.0.len() > most {
                        model.0.pop_first();
                    }
                    prop_assert!(forest.push("", "map".into(), "base".into(), Stamp(stamp), at(x)));
                    track.push(Stamp(stamp), at(x));
                    track.keep_newest(most);
                }
                Step::Forget(stamp) => {
                    let answers: Vec<_> = (stamp..65).map(|s| model.at(s, reach)).collect();
                    if let Some(last) = model.0.range(..=stamp).next_back().map(|(s, _)| *s) {
                        model.0.retain(|s, _| *s >= last);
                    }
                    // What is asked later does not change.
                    prop_assert_eq!(answers, (stamp..65).map(|s| model.at(s, reach)).collect::<Vec<_>>());
                    forest.forget_before(Stamp(stamp));
                    track.forget_before(Stamp(stamp));
                }
                Step::Ask(stamp) => {
                    let expected = model.at(stamp, reach);
                    let x = track.at(Stamp(stamp), reach).map(|pose| pose.translation()[0]);
                    match (&x, &expected) {
                        (Ok(x), Ok(expected)) => prop_assert!((x - expected).abs() < 1e-9),
                        _ => prop_assert_eq!(&x, &expected),
                    }
                    let found = forest.seen_from("/points").pose("map", "base", Stamp(stamp), reach);
                    match (found, x) {
                        (Ok(pose), Ok(x)) => prop_assert_eq!(pose.translation()[0], x),
                        (Err(NoPose::Link { reason, .. }), Err(expected)) => prop_assert_eq!(reason, expected),
                        (Err(NoPose::UnknownFrame(_)), Err(_)) => prop_assert!(model.0.is_empty()),
                        (found, x) => prop_assert!(false, "{found:?} {x:?}"),
                    }
                }
            }
            prop_assert_eq!(track.len(), model.0.len());
            prop_assert_eq!(track.newest().map(|s| s.0), model.0.keys().next_back().copied());
        }
    }
}

const REACH: Reach = Reach { gap_max: 100, near: 0 };

#[test]
fn who_asks_too_early_too_late_or_for_nobody_is_told() {
    let mut forest = FrameForest::new(FRAMES_MAX, 10);
    let ask = |forest: &FrameForest, root: &str, frame: &str, stamp: i64| {
        forest.seen_from("/points").pose(root, frame, Stamp(stamp), REACH).unwrap_err()
    };
    assert_eq!(ask(&forest, "map", "lidar", 5), NoPose::UnknownFrame("lidar".into()));
    forest.push_fixed("", "base".into(), "lidar".into(), at(1.0));
    assert_eq!(ask(&forest, "map", "lidar", 5), NoPose::UnknownFrame("map".into()));
    forest.push("", "map".into(), "odom".into(), Stamp(0), at(1.0));
    let unconnected = ask(&forest, "map", "lidar", 5);
    assert_eq!(unconnected, NoPose::NotConnected { ancestor: "map".into(), frame: "lidar".into() });
    assert!(unconnected.may_come());
    forest.push("", "odom".into(), "base".into(), Stamp(50), at(1.0));
    let early = ask(&forest, "map", "lidar", 2_000_000);
    let text = "no pose of \"base\" in \"odom\" at 2.000000 s: the newest pose is of 0.000050 s";
    assert_eq!((early.to_string().as_str(), early.may_come()), (text, true));
    // base has no pose yet at 10 that waiting would bring, whatever odom waits for.
    let late = ask(&forest, "map", "lidar", 10);
    assert!(!late.may_come() && late.to_string().contains("the oldest pose is of 0.000050 s"), "{late}");
    forest.push("", "odom".into(), "base".into(), Stamp(500), at(1.0));
    forest.push("", "map".into(), "odom".into(), Stamp(1_000), at(1.0));
    let gap = ask(&forest, "map", "lidar", 300);
    assert!(!gap.may_come() && gap.to_string().contains("no pose between"), "{gap}");
    let pose = forest.seen_from("/points").pose("odom", "lidar", Stamp(500), REACH).unwrap();
    assert_eq!(pose.translation(), [2.0, 0.0, 0.0]);
    // Upwards only.
    assert!(matches!(ask(&forest, "lidar", "map", 500), NoPose::NotConnected { .. }));
}

#[test]
fn frames_without_end_are_left_out() {
    let mut forest = FrameForest::new(usize::MAX, 0);
    for frame in 0..FRAMES_MAX {
        assert!(forest.push("", "map".into(), frame.to_string(), Stamp(0), at(0.0)));
    }
    assert!(!forest.push("", "map".into(), "one more".into(), Stamp(0), at(0.0)));
    assert!(!forest.push_fixed("", "map".into(), "one more".into(), at(0.0)));
    assert!(forest.push("", "map".into(), "7".into(), Stamp(1), at(0.0)), "known frames go on");
    let mut few = FrameForest::new(2, 5);
    let taken = ["a", "b", "c"].map(|frame| few.push_fixed("", "map".into(), frame.into(), at(0.0)));
    assert_eq!(taken, [true, true, false]);
}
