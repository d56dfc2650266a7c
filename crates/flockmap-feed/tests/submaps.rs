//! Submaps as readers are told of them.

use flockmap_feed::{
    Event, FRAME_BYTES_MAX, FeedError, Message, Mirror, MirrorOptions, NodeHello, ReaderHello, RunSubmaps,
    Splitter,
};
use flockmap_grid::{Pose, Resolution, RobotId, Stream, SubmapId};
use proptest::prelude::*;

fn submap(number: u16) -> SubmapId {
    SubmapId::new(number).unwrap()
}

fn stream(origin: u16, epoch: u64) -> Stream {
    Stream { origin: RobotId(origin), epoch }
}

/// A run of which each submap up to the newest has a pose of its own.
fn run(origin: u16, newest: u16) -> RunSubmaps {
    let pose = |number: u16| (submap(number), Pose::from_yaw([f64::from(number), 0.5, -1.0], 0.1));
    let poses = (0..=newest).map(pose).collect();
    RunSubmaps { stream: stream(origin, 5), newest: submap(newest), poses, left_out: 0 }
}

fn read(frame: &[u8]) -> Result<Message, FeedError> {
    let (mut splitter, mut rest) = (Splitter::new(FRAME_BYTES_MAX), frame);
    let (kind, body) = splitter.next(&mut rest)?.expect("a whole frame");
    assert_eq!(kind, 10);
    Message::parse(kind, body)
}

/// What comes of runs that are written and read.
fn sent(runs: Vec<RunSubmaps>) -> Result<Vec<RunSubmaps>, FeedError> {
    match read(&Message::Submaps(runs).emit())? {
        Message::Submaps(runs) => Ok(runs),
        other => panic!("{other:?}"),
    }
}

/// A frame with one run of one pose, of which some bytes are others. The body begins at 5, the pose at 23.
fn refused(at: usize, bytes: &[u8]) -> String {
    let mut frame = Message::Submaps(vec![run(1, 0)]).emit();
    frame[at..at + bytes.len()].copy_from_slice(bytes);
    read(&frame).unwrap_err().to_string()
}

fn a_pose() -> impl Strategy<Value = Pose> {
    let numbers = (prop::array::uniform3(-1e6..1e6), prop::array::uniform4(-1.0..1.0));
    numbers.prop_filter_map("a rotation", |(at, turned)| Pose::new(at, turned))
}

/// Runs as a node may tell of them, with how each submap lies, told one by one.
fn some_runs() -> impl Strategy<Value = Vec<RunSubmaps>> {
    let poses = prop::collection::btree_map(0..SubmapId::COUNT as u16, a_pose(), 0..12);
    let run = (poses, 0..SubmapId::COUNT as u16, any::<u16>());
    prop::collection::btree_map((any::<u16>(), any::<u64>()), run, 0..6).prop_map(|runs| {
        let run = |((origin, epoch), (poses, more, left_out)): ((u16, u64), (_, u16, u16))| {
            let poses: std::collections::BTreeMap<u16, Pose> = poses;
            let newest = poses.keys().next_back().map_or(more, |last| more.max(*last));
            let poses = poses.into_iter().map(|(number, pose)| (submap(number), pose)).collect();
            RunSubmaps { stream: stream(origin, epoch), newest: submap(newest), poses, left_out }
        };
        runs.into_iter().map(run).collect()
    })
}

proptest! {
    #[test]
    fn submaps_come_back_bit_for_bit(runs in some_runs()) {
        prop_assert_eq!(sent(runs.clone()), Ok(runs));
    }

    #[test]
    fn each_submap_lies_as_the_newest_one_with_a_pose_that_is_not_after_it(runs in some_runs()) {
        for run in &runs {
            let mut pose = None;
            for number in 0..SubmapId::COUNT as u16 {
                pose = run.poses.iter().find(|(of, _)| of.number() == number).map(|(_, pose)| *pose).or(pose);
                let expected = if number <= run.newest.number() { pose } else { None };
                prop_assert_eq!(run.pose(submap(number)), expected);
            }
        }
    }

    #[test]
    fn damaged_submaps_do_no_harm(
        runs in some_runs(), flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in any::<prop::sample::Index>(),
    ) {
        let body = &Message::Submaps(runs).emit()[5..];
        let mut body = body[..cut.index(body.len() + 1)].to_vec();
        for (at, flip) in flips {
            if let Some(count) = std::num::NonZeroUsize::new(body.len()) {
                body[at.index(count.get())] ^= flip;
            }
        }
        // What is taken is what can be told.
        if let Ok(Message::Submaps(runs)) = Message::parse(10, &body) {
            prop_assert_eq!(sent(runs.clone()), Ok(runs));
        }
    }

    #[test]
    fn of_too_many_poses_the_newest_are_told_and_who_has_few_has_all_of_them(
        counts in prop::collection::vec(prop_oneof![1..40u16, 1_000..SubmapId::COUNT as u16], 1..40),
    ) {
        let runs: Vec<_> = counts.iter().enumerate().map(|(k, count)| run(k as u16, count - 1)).collect();
        let frame = Message::Submaps(runs.clone()).emit();
        prop_assert!(frame.len() <= FRAME_BYTES_MAX, "{}", frame.len());
        let told = sent(runs.clone()).unwrap();
        prop_assert_eq!(&told, &RunSubmaps::within_limits(runs.clone()));
        let all: usize = told.iter().map(|run| run.poses.len()).sum();
        let wanted: usize = counts.iter().map(|count| usize::from(*count)).sum();
        prop_assert!(all <= RunSubmaps::POSES_MAX);
        // Nothing is left out where there is room; of the rest no more than what cannot be shared evenly is.
        prop_assert!(all >= wanted.min(RunSubmaps::POSES_MAX - counts.len()), "{} of {}", all, wanted);
        let least = told.iter().filter(|run| run.left_out > 0).map(|run| run.poses.len()).min();
        for (told, run) in told.iter().zip(&runs) {
            let gone = usize::from(told.left_out);
            prop_assert_eq!(&told.poses[..], &run.poses[gone..]);
            prop_assert!(gone > 0 || told.poses.len() <= least.unwrap_or(usize::MAX));
            prop_assert_eq!(told.pose(told.newest), run.pose(run.newest));
            prop_assert_eq!(told.pose(SubmapId::FIRST).is_none(), gone > 0);
        }
    }
}

#[test]
fn no_more_runs_are_told_than_a_mirror_takes() {
    let runs: Vec<_> = (0..2_000).map(|origin| run(origin, 0)).collect();
    let told = sent(runs.clone()).unwrap();
    assert_eq!(told, runs[..RunSubmaps::RUNS_MAX]);
}

#[test]
fn what_is_no_pose_is_refused() {
    let nan = f64::NAN.to_le_bytes();
    assert!(refused(25, &nan).contains("translation"));
    assert!(refused(49, &nan).contains("rotation"));
    // Without a rotation, and with one that would scale.
    assert!(refused(49, &[0; 32]).contains("length 1"));
    let twice = [0.0, 0.0, 0.0, 2.0_f64].map(f64::to_le_bytes);
    assert!(refused(49, twice.as_flattened()).contains("length 1"));
    let far_too_long = [f64::MAX; 4].map(f64::to_le_bytes);
    assert!(refused(49, far_too_long.as_flattened()).contains("length 1"));
}

#[test]
fn submaps_that_cannot_be_are_refused() {
    // The newest of a run, the number left out, that of poses, and the submap of the first pose.
    let (newest, poses, first) = (17, 21, 23);
    assert!(refused(newest, &4_096_u16.to_le_bytes()).contains("newest submap"));
    assert!(refused(first, &1_u16.to_le_bytes()).contains("no newer one than the newest"));
    assert!(refused(poses, &2_u16.to_le_bytes()).contains("poses"), "one that is not there");
    assert!(refused(poses, &8_193_u16.to_le_bytes()).contains("8,192 in all at most"));
    assert!(refused(5, &1_025_u16.to_le_bytes()).contains("1,024 runs"));
    let twice = Message::Submaps(vec![run(1, 0), run(1, 0)]).emit();
    assert!(read(&twice).unwrap_err().to_string().contains("runs that ascend"));
    let mut back = run(1, 1);
    back.poses.reverse();
    assert!(sent(vec![back]).unwrap_err().to_string().contains("numbers that ascend"));
}

fn hello() -> Vec<u8> {
    let resolution = Resolution::from_metres(0.2).unwrap();
    let (name, frame) = (String::new(), String::new());
    let hello =
        NodeHello { origins: false, goes_on: false, robot: RobotId(7), resolution, feed: 1, name, frame };
    Message::Hello(hello).emit()
}

#[test]
fn a_mirror_asks_for_submaps_only_if_it_is_told_to_and_shows_what_was_said_last() {
    const FLAGS: usize = 10;
    let (mut plain, mut mirror) =
        (Mirror::default(), Mirror::new(MirrorOptions { submaps: true, ..MirrorOptions::default() }));
    assert_eq!(plain.connect()[FLAGS], 0);
    let said = mirror.connect();
    assert_eq!(said[FLAGS], 16);
    assert!(ReaderHello::parse(said[4], &said[5..]).unwrap().submaps);

    let frame = Message::Submaps(vec![run(1, 2)]).emit();
    assert_eq!(mirror.push(&mut &frame[..]), Err(FeedError::OutOfOrder("submaps")));
    mirror.connect();
    mirror.push(&mut &hello()[..]).unwrap();
    assert_eq!(mirror.push(&mut &frame[..]), Ok(Some(Event::Submaps)));
    assert_eq!(mirror.submaps(), [run(1, 2)]);
    // What is refused leaves what there was.
    let twice = Message::Submaps(vec![run(2, 1), run(2, 1)]).emit();
    mirror.push(&mut &twice[..]).unwrap_err();
    assert_eq!(mirror.submaps(), [run(1, 2)]);
}
