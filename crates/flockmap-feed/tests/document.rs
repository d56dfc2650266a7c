//! The example in `docs/map-output.md` is what the code says.

use flockmap_feed::{
    Block, Blocks, Event, Link, Message, Mirror, NodeCounts, NodeHello, Playback, ReaderHello, RobotPose,
    RunSubmaps, SeenScan,
};
use flockmap_grid::{
    BlockIndex, Pose, Resolution, RobotId, Stamp, State, StateBlock, Stream, SubmapId, Voxel,
};

/// The frames of the document, each with what is said before it.
fn frames() -> Vec<(String, Vec<u8>)> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/map-output.md");
    let text = std::fs::read_to_string(path).unwrap();
    let example = text.split("```hex\n").nth(1).unwrap().split("```").next().unwrap();
    let mut frames: Vec<(String, Vec<u8>)> = Vec::new();
    for line in example.lines().filter(|line| !line.trim().is_empty()) {
        match line.strip_prefix("# ") {
            Some(what) => frames.push((what.to_owned(), Vec::new())),
            None => {
                let bytes = line.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap());
                frames.last_mut().unwrap().1.extend(bytes);
            }
        }
    }
    frames
}

#[test]
fn the_example_in_the_document_is_what_is_written_and_read() {
    let resolution = Resolution::from_metres(0.2).unwrap();
    let mut states = StateBlock::default();
    states.set(0, State::Occupied);
    states.set(1, State::Free);
    states.set(2, State::Free);
    states.set(511, State::Occupied);
    let block = Block { index: BlockIndex::new(1, 0, -1), states, origins: Vec::new() };
    let stamp = Stamp(1_700_000_000_000_000);
    let expected = [
        ReaderHello::default().emit(),
        Message::Hello(NodeHello {
            origins: false,
            goes_on: false,
            robot: RobotId(7),
            resolution,
            feed: 0x1122_3344_5566_7788,
            name: "alpha".into(),
            frame: "map".into(),
        })
        .emit(),
        Message::Anew { began: 5 }.emit(),
        Message::Blocks(Blocks { upto: 5, newest: 5, stamp, origins: false, blocks: vec![block] }).emit(),
        Message::Poses(vec![RobotPose {
            stream: Stream { origin: RobotId(7), epoch: 3 },
            position: [1.0, -2.0, 0.5],
            orientation: Some([0.0, 0.0, 0.0, 1.0]),
            age: std::time::Duration::from_millis(1_500),
        }])
        .emit(),
        Message::Counters(NodeCounts {
            now: stamp.plus_micros(1_500_000),
            counters: vec![("node_frames".into(), 300)],
        })
        .emit(),
        Message::Links(vec![Link {
            stream: Stream { origin: RobotId(2), epoch: 9 },
            hears_us: true,
            round_trip: Some(std::time::Duration::from_millis(40)),
            loss: 13_107,
            bytes_in: 1_000,
            bytes_out: 2_000,
            missing: 3,
            unconfirmed: 1,
            silence: std::time::Duration::from_millis(250),
        }])
        .emit(),
        Message::Scan(SeenScan {
            stamp: stamp.plus_micros(1_400_000),
            position: [1.0, -2.0, 0.5],
            orientation: [0.0, 0.0, 0.0, 1.0],
            points_all: 20_000,
            points: vec![[3.0, 0.0, 0.5]],
        })
        .emit(),
        Message::Playback(Playback {
            begin: Stamp(0),
            end: Stamp(60_000_000),
            at: Stamp(12_500_000),
            speed: 2.0,
            plays: true,
            grows: false,
        })
        .emit(),
        Message::Submaps(vec![RunSubmaps {
            stream: Stream { origin: RobotId(7), epoch: 3 },
            newest: SubmapId::new(4).unwrap(),
            poses: vec![
                (SubmapId::FIRST, Pose::IDENTITY),
                (SubmapId::new(2).unwrap(), Pose::from_translation([0.0, 0.5, -0.25])),
            ],
            left_out: 0,
        }])
        .emit(),
        Message::End("the node ends".into()).emit(),
    ];
    let frames = frames();
    assert_eq!(frames.len(), expected.len());
    for ((what, bytes), expected) in frames.iter().zip(&expected) {
        assert_eq!(bytes, expected, "{what}");
    }

    let mut mirror = Mirror::default();
    assert_eq!(mirror.connect(), frames[0].1);
    let wire: Vec<u8> = frames[1..].iter().flat_map(|(_, bytes)| bytes.clone()).collect();
    let (mut rest, mut events) = (&wire[..], Vec::new());
    while let Some(event) = mirror.push(&mut rest).unwrap() {
        events.push(event);
    }
    use Event::{Anew, Counters, End, Hello, Links, Poses, Scan, Submaps};
    let expected =
        [Hello, Anew, Event::Blocks(1), Poses, Counters, Links, Scan, Event::Playback, Submaps, End];
    assert_eq!(events, expected);
    assert_eq!(mirror.links()[0].missing, 3);
    assert_eq!(mirror.scan().unwrap().points, [[3.0, 0.0, 0.5]]);
    assert_eq!(mirror.playback().unwrap().at, Stamp(12_500_000));
    // A submap without a pose lies as the one before it does.
    let [of_7] = mirror.submaps() else { panic!("one run") };
    let at = |submap: u16| of_7.pose(SubmapId::new(submap).unwrap()).map(|pose| pose.translation());
    let moved = Some([0.0, 0.5, -0.25]);
    assert_eq!([0, 1, 2, 3, 4, 5].map(at), [Some([0.0; 3]), Some([0.0; 3]), moved, moved, moved, None]);
    assert!(mirror.is_complete());
    let map = mirror.map().unwrap();
    assert_eq!(map.count(), (2, 2));
    // As the document says.
    assert_eq!(map.state(Voxel::new(8, 0, -8)), State::Occupied);
    assert_eq!(map.state(Voxel::new(15, 7, -1)), State::Occupied);
    assert_eq!(map.state_at([1.9, 0.1, -1.5]), State::Free);
}
