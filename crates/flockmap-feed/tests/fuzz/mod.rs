//! What the fuzzer runs, shared with the test `fuzz_corpus`: `fuzz/README.md` says how to run it.

use flockmap_feed::{
    Event, FRAME_BYTES_MAX, HELLO_BYTES_MAX, Message, Mirror, MirrorOptions, NodeHello, ReaderHello, Splitter,
};
use flockmap_grid::{Resolution, RobotId};

/// Blocks that the mirror may hold.
const BLOCKS_MAX: usize = 64;

/// Bytes that a map of so many blocks may take: 350 for each, those emptied, twice as much where a new map
/// comes, and a region for each of them.
const MAP_BYTES_MAX: usize = BLOCKS_MAX * 2_048 + 65_536;

/// Any bytes as a feed. The first byte says how: raw, or as frames whose lengths are put right, behind an honest
/// hello; and whether the mirror wants origins.
pub(crate) fn mirror(input: &[u8]) {
    let Some((how, input)) = input.split_first() else { return };
    let options = MirrorOptions { origins: how & 1 == 1, blocks_max: BLOCKS_MAX, ..MirrorOptions::default() };
    let mut mirror = Mirror::new(options);
    mirror.connect();
    let wire = if how & 2 == 0 { input.to_vec() } else { framed(input) };
    let piece = usize::from(how >> 2) + 1;
    'all: for piece in wire.chunks(piece) {
        let mut rest = piece;
        loop {
            match mirror.push(&mut rest) {
                Ok(None) => break,
                Ok(Some(event)) => check(&mirror, event),
                Err(error) => {
                    assert!(!error.to_string().is_empty());
                    break 'all;
                }
            }
        }
        assert!(rest.is_empty());
    }
    if let Some(map) = mirror.map() {
        assert!(map.block_count() <= BLOCKS_MAX);
        assert!(map.memory_bytes() <= MAP_BYTES_MAX, "{}", map.memory_bytes());
        for (voxel, _) in map.voxels() {
            let _ = mirror.origin(voxel);
        }
    }
    // Whatever came, it can be connected again, and says something that a node understands.
    hello(&mirror.connect());
    // What can be read can be written, and is the same again.
    let (mut splitter, mut rest) = (Splitter::new(FRAME_BYTES_MAX), &wire[..]);
    while let Ok(Some((kind, body))) = splitter.next(&mut rest) {
        let Ok(message) = Message::parse(kind, body) else { continue };
        if let Message::Unknown(_) = message {
            continue;
        }
        let bytes = message.emit();
        let (mut again, mut bytes) = (Splitter::new(FRAME_BYTES_MAX), &bytes[..]);
        let (kind, body) = again.next(&mut bytes).unwrap().unwrap();
        let read = Message::parse(kind, body).unwrap();
        // Texts and lists beyond what is ever sent are cut.
        assert!(core::mem::discriminant(&read) == core::mem::discriminant(&message));
        assert_eq!(read.emit(), message.emit());
    }
}

fn check(mirror: &Mirror, event: Event) {
    let have = mirror.have();
    assert!(have.is_none_or(|have| have.upto <= mirror.newest() || event == Event::Hello));
    if let Event::Blocks(count) = event {
        assert!(count <= FRAME_BYTES_MAX / 140);
    }
}

/// Pieces of the input as bodies: a kind, two bytes of length, the body.
fn framed(mut input: &[u8]) -> Vec<u8> {
    let hello = NodeHello {
        origins: true,
        goes_on: false,
        robot: RobotId(1),
        resolution: Resolution::from_micrometres(100_000).unwrap(),
        feed: 7,
        name: "a".into(),
        frame: "map".into(),
    };
    let mut wire = Message::Hello(hello).emit();
    wire.extend(Message::Anew { began: 0 }.emit());
    while let Some(([kind, low, high], rest)) = input.split_first_chunk::<3>() {
        let length = usize::from(u16::from_le_bytes([*low, *high])).min(rest.len());
        let (body, rest) = rest.split_at(length);
        wire.extend_from_slice(&(length as u32 + 1).to_le_bytes());
        wire.push(kind % 12);
        wire.extend_from_slice(body);
        input = rest;
    }
    wire
}

/// Any bytes as what a reader says, as the node reads it.
pub(crate) fn hello(input: &[u8]) {
    let (mut splitter, mut rest) = (Splitter::new(HELLO_BYTES_MAX), input);
    while let Ok(Some((kind, body))) = splitter.next(&mut rest) {
        if let Ok(hello) = ReaderHello::parse(kind, body) {
            let bytes = hello.emit();
            let (mut again, mut bytes) = (Splitter::new(HELLO_BYTES_MAX), &bytes[..]);
            let (kind, body) = again.next(&mut bytes).unwrap().unwrap();
            assert_eq!(ReaderHello::parse(kind, body), Ok(hello));
        }
    }
}
