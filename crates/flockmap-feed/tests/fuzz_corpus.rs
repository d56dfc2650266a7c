//! What the fuzzer runs, on inputs made here and on what it found: `tests/corpus/TARGET`, see `fuzz/README.md`.
//!
//! `FLOCKMAP_BLESS=1 cargo test -p flockmap-feed --test fuzz_corpus` writes the inputs made here to
//! `tests/corpus`, for the fuzzer to begin with.

mod fuzz;

use std::path::Path;

use flockmap_feed::{
    Block, Blocks, Have, Link, Message, NodeCounts, NodeHello, Playback, ReaderHello, RobotPose, RunSubmaps,
    SeenScan,
};
use flockmap_grid::{BlockIndex, Pose, Resolution, RobotId, Stamp, State, StateBlock, Stream, SubmapId};

fn replay(target: &str, made: Vec<Vec<u8>>, run: impl Fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(target);
    if std::env::var_os("FLOCKMAP_BLESS").is_some() {
        std::fs::create_dir_all(&folder).unwrap();
        for (number, input) in made.iter().enumerate() {
            std::fs::write(folder.join(format!("honest-{number:02}.bin")), input).unwrap();
        }
    }
    if let Ok(entries) = std::fs::read_dir(folder) {
        let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
        files.sort();
        for file in files {
            println!("{}", file.display());
            run(&std::fs::read(file).unwrap());
        }
    }
    for (number, input) in made.iter().enumerate() {
        println!("input {number} of {target}");
        run(input);
        // Each byte once another one.
        for at in 0..input.len().min(400) {
            let mut damaged = input.clone();
            damaged[at] ^= 1 << (at % 8);
            run(&damaged);
            run(&input[..at]);
        }
    }
}

fn block(at: i32, origins: usize) -> Block {
    let mut states = StateBlock::default();
    (0..4).for_each(|bit| states.set(bit * 100, if bit % 2 == 0 { State::Free } else { State::Occupied }));
    let known = states.known();
    let origins = match origins {
        0 => Vec::new(),
        1 => vec![(RobotId(4), known)],
        _ => {
            let first = [known[0], 0, 0, 0, 0, 0, 0, 0];
            vec![(RobotId(1), first), (RobotId(2), core::array::from_fn(|z| known[z] & !first[z]))]
        }
    };
    Block { index: BlockIndex::new(at, -at, 3), states, origins }
}

fn messages() -> Vec<Message> {
    let hello = NodeHello {
        origins: true,
        goes_on: false,
        robot: RobotId(1),
        resolution: Resolution::from_micrometres(100_000).unwrap(),
        feed: 7,
        name: "a".into(),
        frame: "map".into(),
    };
    let blocks = |upto, newest, origins: usize, count| {
        let blocks = (0..count).map(|at| block(at, origins)).collect();
        Message::Blocks(Blocks { upto, newest, stamp: Stamp(5), origins: origins > 0, blocks })
    };
    let emptied =
        Block { index: BlockIndex::new(1, -1, 3), states: StateBlock::default(), origins: Vec::new() };
    let emptied = Blocks { upto: 9, newest: 9, stamp: Stamp(6), origins: true, blocks: vec![emptied] };
    let pose = RobotPose {
        stream: Stream { origin: RobotId(2), epoch: 5 },
        position: [1.0, 2.0, 3.0],
        orientation: Some([0.0, 0.0, 0.0, 1.0]),
        age: std::time::Duration::from_millis(3),
    };
    let link = Link {
        stream: pose.stream,
        hears_us: true,
        round_trip: None,
        loss: 1 << 16,
        bytes_in: 1,
        bytes_out: 2,
        missing: 3,
        unconfirmed: 4,
        silence: std::time::Duration::from_millis(5),
    };
    let scan = SeenScan {
        stamp: Stamp(1),
        position: [1.0; 3],
        orientation: [0.5; 4],
        points_all: 9,
        points: vec![[1.0, 2.0, 3.0]; 4],
    };
    let (begin, end, at) = (Stamp(-5), Stamp(5), Stamp(0));
    let playback = Playback { begin, end, at, speed: 1.0, plays: true, grows: true };
    let submap = |number| SubmapId::new(number).unwrap();
    let moved = Pose::from_yaw([1.0, 2.0, 3.0], 0.1);
    let poses = vec![(submap(0), Pose::IDENTITY), (submap(3), moved)];
    let submaps = RunSubmaps { stream: pose.stream, newest: submap(9), poses, left_out: 0 };
    let later = RunSubmaps { stream: Stream { epoch: 6, ..pose.stream }, left_out: 2, ..submaps.clone() };
    vec![
        Message::Hello(hello),
        Message::Anew { began: 4 },
        blocks(3, 8, 1, 3),
        blocks(4, 8, 2, 2),
        blocks(8, 8, 0, 2),
        Message::Blocks(emptied),
        Message::Anew { began: 9 },
        blocks(9, 9, 2, 1),
        blocks(90, 90, 0, 66),
        Message::Poses(vec![pose; 2]),
        Message::Counters(NodeCounts { now: Stamp(7), counters: vec![("one".into(), 1)] }),
        Message::Links(vec![link; 3]),
        Message::Scan(scan),
        Message::Playback(playback),
        Message::Submaps(vec![submaps, later]),
        Message::Unknown(77),
        Message::End("over".into()),
    ]
}

#[test]
fn feeds_do_no_harm() {
    let all: Vec<u8> = messages().iter().flat_map(Message::emit).collect();
    let mut inputs: Vec<Vec<u8>> = [0, 1, 40, 252].map(|how| [&[how][..], &all].concat()).to_vec();
    // As frames whose lengths are put right.
    for message in messages() {
        let frame = message.emit();
        let length = ((frame.len() - 5) as u16).to_le_bytes();
        inputs.push([&[3, frame[4]][..], &length, &frame[5..]].concat());
    }
    replay("mirror", inputs, fuzz::mirror);
}

#[test]
fn what_readers_say_does_no_harm() {
    let have = Have { feed: 5, began: 6, upto: 7 };
    let hellos = [
        ReaderHello::default(),
        ReaderHello { origins: true, links: true, have: Some(have), ..ReaderHello::default() },
        ReaderHello {
            no_map: true,
            scans: true,
            submaps: true,
            have: Some(Have { feed: u64::MAX, began: u64::MAX, upto: u64::MAX }),
            ..ReaderHello::default()
        },
    ];
    replay("reader_hello", hellos.map(|hello| hello.emit()).to_vec(), fuzz::hello);
}
