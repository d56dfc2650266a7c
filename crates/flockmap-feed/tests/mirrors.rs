//! Mirrors of random maps, by readers of random speeds, over streams that are cut anywhere.

use std::collections::{BTreeMap, HashMap, HashSet};

use flockmap_feed::{
    Block, Event, Feed, FeedError, Message, Mirror, MirrorOptions, Next, NodeHello, ReaderHello, Splitter,
};
use flockmap_grid::{
    BlockIndex, MapView, Plane, Resolution, RobotId, Stamp, State, StateBlock, Voxel, set_bits,
};
use proptest::prelude::*;

fn resolution() -> Resolution {
    Resolution::from_metres(0.2).unwrap()
}

fn hello(feed: u64, origins: bool, goes_on: bool) -> Message {
    let (name, frame) = ("alpha".to_owned(), "map".to_owned());
    Message::Hello(NodeHello {
        origins,
        goes_on,
        robot: RobotId(7),
        resolution: resolution(),
        feed,
        name,
        frame,
    })
}

/// Planes from a number: as many known voxels as it likes, sometimes none.
fn states(seed: u64) -> StateBlock {
    let word = |n: u64| seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left((n * 7) as u32 % 64) ^ n;
    let planes =
        |by: u64| core::array::from_fn(|z| if seed.is_multiple_of(5) { 0 } else { word(by + z as u64) });
    StateBlock::new(planes(1), planes(seed % 3 * 100))
}

/// Who saw a voxel, by a rule that the mirror does not know.
fn origin_of(voxel: Voxel, version: u64) -> RobotId {
    RobotId((i64::from(voxel.x + voxel.y / 3) + version as i64).rem_euclid(3) as u16)
}

fn origins(index: BlockIndex, states: &StateBlock, version: u64) -> Vec<(RobotId, Plane)> {
    let mut planes = BTreeMap::<RobotId, Plane>::new();
    for bit in set_bits(&states.known()) {
        planes.entry(origin_of(index.voxel(bit), version)).or_default()[bit / 64] |= 1 << (bit % 64);
    }
    planes.into_iter().collect()
}

#[derive(Clone, Debug)]
enum Step {
    /// Blocks of the map become something else.
    Change { first: u32, count: u32, seed: u64 },
    /// A reader takes a frame of so many blocks, in pieces of so many bytes.
    Serve { reader: usize, blocks: usize, piece: usize },
    /// A connection breaks within a frame, and is made again.
    Break { reader: usize, bytes: usize },
    /// The node starts again with an empty map.
    Restart,
}

fn step() -> impl Strategy<Value = Step> {
    let reader = 0..READERS;
    prop_oneof![
        6 => (0..60u32, 1..40u32, any::<u64>()).prop_map(|(first, count, seed)| Step::Change { first, count, seed }),
        12 => (reader.clone(), 1..30usize, 1..3_000usize)
            .prop_map(|(reader, blocks, piece)| Step::Serve { reader, blocks, piece }),
        2 => (reader, 0..3_000usize).prop_map(|(reader, bytes)| Step::Break { reader, bytes }),
        1 => Just(Step::Restart),
    ]
}

const READERS: usize = 3;

/// A node with its map, and every state that it ever had.
struct Node {
    id: u64,
    map: MapView,
    at_version: HashMap<u64, MapView>,
    ever: HashMap<BlockIndex, HashSet<[Plane; 2]>>,
}

struct Reader {
    mirror: Mirror,
    feed: Feed,
    /// Bytes that are on the way.
    wire: Vec<u8>,
    /// What a planner keeps by asking what changed.
    planner: (u64, BTreeMap<BlockIndex, StateBlock>),
    with_origins: bool,
    /// Of which node the map is that is shown.
    shows: u64,
}

impl Node {
    fn new(id: u64) -> Self {
        let map = MapView::new(resolution());
        Self { id, at_version: HashMap::from([(0, map.clone())]), map, ever: HashMap::new() }
    }

    fn change(&mut self, index: BlockIndex, states: &StateBlock) {
        self.map.set_block(index, states);
        self.at_version.insert(self.map.version(), self.map.clone());
        self.ever.entry(index).or_default().insert([*states.free(), *states.occupied()]);
    }

    /// The next frame for a reader.
    #[expect(clippy::needless_collect, reason = "the frame takes blocks off the list that is read")]
    fn frame(&self, feed: &mut Feed, most: usize) -> Option<Vec<u8>> {
        match feed.next(&self.map) {
            Next::Nothing => None,
            Next::Anew(frame) => Some(frame),
            Next::Blocks => {
                let due: Vec<BlockIndex> = feed.due().take(most).collect();
                let with_origins = feed.origins();
                let block = |index| {
                    let states = self.map.block(index).unwrap_or_default();
                    let origins =
                        if with_origins { origins(index, &states, self.map.version()) } else { Vec::new() };
                    Block { index, states, origins }
                };
                let version = self.map.version();
                Some(feed.blocks(due.into_iter().map(block), version, Stamp(version as i64)))
            }
        }
    }
}

impl Reader {
    fn connect(node: &Node, mut mirror: Mirror, planner: (u64, BTreeMap<BlockIndex, StateBlock>)) -> Self {
        let said = mirror.connect();
        let mut splitter = Splitter::new(256);
        let mut said = &said[..];
        let (kind, body) = splitter.next(&mut said).unwrap().unwrap();
        let said = ReaderHello::parse(kind, body).unwrap();
        let (feed, goes_on) = Feed::begin(&said, node.id, &node.map);
        let wire = hello(node.id, said.origins, goes_on).emit();
        Self { mirror, feed, wire, planner, with_origins: said.origins, shows: 0 }
    }

    /// Takes all that is on the way, in pieces.
    fn take(&mut self, node: &Node, piece: usize) {
        let wire = core::mem::take(&mut self.wire);
        for piece in wire.chunks(piece.max(1)) {
            let mut rest = piece;
            while let Some(event) = self.mirror.push(&mut rest).unwrap() {
                self.check(node, event);
            }
            assert!(rest.is_empty());
        }
    }

    fn check(&mut self, node: &Node, event: Event) {
        if event == Event::Hello {
            return;
        }
        let map = self.mirror.map().unwrap();
        let has_all_of_this_node = self.mirror.have().is_some_and(|have| have.feed == node.id);
        if self.mirror.is_complete() && has_all_of_this_node && matches!(event, Event::Blocks(_)) {
            let then = &node.at_version[&self.mirror.newest()];
            assert_eq!(voxels(map), voxels(then), "complete means equal");
            assert_eq!(self.mirror.stamp(), Stamp(self.mirror.newest() as i64));
        }
        let is_first = event == Event::Anew && map.block_count() == 0;
        if has_all_of_this_node && (is_first || self.mirror.is_complete()) {
            self.shows = node.id;
        }
        if self.shows == node.id {
            for (index, states) in map.blocks() {
                let had = &node.ever[&index];
                assert!(had.contains(&[*states.free(), *states.occupied()]), "{index:?} was never so");
            }
        }
        // A planner that asks what changed since it asked last has the same map.
        let (version, known) = &mut self.planner;
        match map.changed_since(*version) {
            None => *known = map.blocks().collect(),
            Some(changed) => {
                for index in changed {
                    match map.block(index) {
                        Some(states) => known.insert(index, states),
                        None => known.remove(&index),
                    };
                }
            }
        }
        *version = map.version();
        let all: BTreeMap<_, _> = map.blocks().collect();
        assert_eq!(*known, all);
    }
}

fn voxels(map: &MapView) -> BTreeMap<Voxel, State> {
    map.voxels().collect()
}

fn index(number: u32) -> BlockIndex {
    BlockIndex::new((number % 10) as i32 - 5, (number / 10 % 10) as i32, -((number / 100) as i32))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn every_reader_ends_with_the_map_whatever_happened_on_the_way(
        steps in prop::collection::vec(step(), 1..120),
    ) {
        let mut node = Node::new(1);
        let mut readers: Vec<Reader> = (0..READERS)
            .map(|number| {
                let options = MirrorOptions { origins: number == 0, ..MirrorOptions::default() };
                Reader::connect(&node, Mirror::new(options), (0, BTreeMap::new()))
            })
            .collect();
        for step in steps {
            match step {
                Step::Change { first, count, seed } => {
                    for number in first..first + count {
                        node.change(index(number), &states(seed.wrapping_add(u64::from(number) * 7)));
                    }
                }
                Step::Serve { reader, blocks, piece } => {
                    let reader = &mut readers[reader];
                    reader.take(&node, piece);
                    if let Some(frame) = node.frame(&mut reader.feed, blocks) {
                        reader.wire = frame;
                        reader.take(&node, piece);
                    }
                }
                Step::Break { reader, bytes } => {
                    let number = reader;
                    let mut reader = readers.remove(number);
                    if let Some(frame) = node.frame(&mut reader.feed, 20) {
                        reader.wire.extend_from_slice(&frame);
                    }
                    reader.wire.truncate(bytes);
                    reader.take(&node, 100);
                    readers.insert(number, Reader::connect(&node, reader.mirror, reader.planner));
                }
                Step::Restart => {
                    node = Node::new(node.id + 1);
                    readers = readers.into_iter().map(|r| Reader::connect(&node, r.mirror, r.planner)).collect();
                }
            }
        }
        for reader in &mut readers {
            reader.take(&node, 1_000);
            while let Some(frame) = node.frame(&mut reader.feed, 25) {
                reader.wire = frame;
                reader.take(&node, 1_000);
            }
            prop_assert!(reader.mirror.is_complete());
            let map = reader.mirror.map().unwrap();
            prop_assert_eq!(voxels(map), voxels(&node.map));
            prop_assert_eq!(map.block_count(), node.map.block_count());
            for (voxel, _) in map.voxels() {
                prop_assert_eq!(reader.mirror.origin(voxel).is_some(), reader.with_origins);
            }
        }
    }

    /// A mirror takes anything without panicking, and holds no more than it may.
    #[test]
    fn damaged_bytes_do_no_harm(
        seed in any::<u64>(), flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        piece in 1..500usize,
    ) {
        let mut node = Node::new(3);
        (0..30).for_each(|number| node.change(index(number), &states(seed.wrapping_add(u64::from(number)))));
        let options = MirrorOptions { origins: seed % 2 == 0, blocks_max: 40, ..MirrorOptions::default() };
        let mut reader = Reader::connect(&node, Mirror::new(options), (0, BTreeMap::new()));
        let mut wire = core::mem::take(&mut reader.wire);
        while let Some(frame) = node.frame(&mut reader.feed, 7) {
            wire.extend_from_slice(&frame);
        }
        for (at, flip) in flips {
            let at = at.index(wire.len());
            wire[at] ^= flip;
        }
        let mut mirror = reader.mirror;
        'pieces: for piece in wire.chunks(piece) {
            let mut rest = piece;
            loop {
                match mirror.push(&mut rest) {
                    Ok(Some(_)) => {}
                    Ok(None) => break,
                    Err(error) => {
                        prop_assert!(!error.to_string().is_empty());
                        break 'pieces;
                    }
                }
            }
            prop_assert!(mirror.map().is_none_or(|map| map.block_count() <= 40));
        }
        // It may be connected again.
        prop_assert!(!mirror.connect().is_empty());
    }

    #[test]
    fn any_bytes_do_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..400), kind in 0..12u8) {
        let mut mirror = Mirror::default();
        let _ = mirror.push(&mut &hello(1, false, false).emit()[..]);
        let mut wire = ((bytes.len() + 1) as u32).to_le_bytes().to_vec();
        wire.push(kind);
        wire.extend_from_slice(&bytes);
        let _ = mirror.push(&mut &wire[..]);
        let _ = ReaderHello::parse(kind, &bytes);
    }

    /// What was written is read back, and written again it is the same.
    #[test]
    fn messages_come_back(seed in any::<u64>(), count in 0..20u32, name in ".{0,40}", is_known in any::<bool>()) {
        let blocks = (0..count).map(|number| {
            let (index, states) = (index(number), states(seed.wrapping_add(number.into())));
            let origins = if is_known { origins(index, &states, 0) } else { Vec::new() };
            Block { index, states, origins }
        });
        let blocks = flockmap_feed::Blocks {
            upto: seed, newest: seed, stamp: Stamp(-5), origins: is_known, blocks: blocks.collect(),
        };
        let pose = flockmap_feed::RobotPose {
            stream: flockmap_grid::Stream { origin: RobotId(seed as u16), epoch: seed },
            position: [1.5, -2.5, seed as f64],
            orientation: is_known.then_some([0.0, 0.5, 0.5, 0.0]),
            age: std::time::Duration::from_micros(seed),
        };
        let counts = flockmap_feed::NodeCounts { now: Stamp(seed as i64), counters: vec![(name.clone(), seed)] };
        for message in [
            hello(seed.max(1), is_known, !is_known),
            Message::Blocks(blocks),
            Message::Anew { began: seed },
            Message::Poses(vec![pose; count as usize]),
            Message::Counters(counts),
            Message::End(name),
        ] {
            let bytes = message.emit();
            let (mut splitter, mut rest) = (Splitter::new(1 << 20), &bytes[..]);
            let (kind, body) = splitter.next(&mut rest).unwrap().unwrap();
            prop_assert_eq!(Message::parse(kind, body).unwrap(), message);
        }
    }
}

/// A node, a mirror that has its map, and the feed between them.
fn complete(blocks: u32) -> (Node, Reader) {
    let mut node = Node::new(9);
    (0..blocks).for_each(|number| node.change(index(number), &states(u64::from(number) * 5 + 1)));
    let mut reader = Reader::connect(&node, Mirror::default(), (0, BTreeMap::new()));
    serve(&node, &mut reader);
    (node, reader)
}

fn serve(node: &Node, reader: &mut Reader) -> usize {
    reader.take(node, 10_000);
    let mut bytes = 0;
    while let Some(frame) = node.frame(&mut reader.feed, usize::MAX) {
        bytes += frame.len();
        reader.wire = frame;
        reader.take(node, 10_000);
    }
    bytes
}

#[test]
fn a_reader_that_comes_back_is_sent_only_what_changed() {
    let (mut node, mut reader) = complete(300);
    node.change(index(17), &states(4));
    let mut again = Reader::connect(&node, reader.mirror, reader.planner);
    let bytes = serve(&node, &mut again);
    assert!(bytes < 300, "{bytes} bytes for one block");
    assert_eq!(voxels(again.mirror.map().unwrap()), voxels(&node.map));
    // The same again: nothing but how far it has come.
    reader = Reader::connect(&node, again.mirror, again.planner);
    assert!(serve(&node, &mut reader) < 60);
}

#[test]
fn a_slow_reader_is_sent_each_block_once_however_often_it_changed() {
    let (mut node, mut reader) = complete(50);
    for seed in 1..200u64 {
        (0..50).for_each(|number| node.change(index(number), &states(seed * 5 + 1 + u64::from(number) % 3)));
    }
    let bytes = serve(&node, &mut reader);
    assert!(bytes <= 50 * 140 + 60, "{bytes}");
    assert_eq!(voxels(reader.mirror.map().unwrap()), voxels(&node.map));
}

#[test]
fn the_old_map_is_shown_until_the_new_one_is_complete() {
    let (old, reader) = complete(200);
    let mut node = Node::new(old.id + 1);
    (100..400).for_each(|number| node.change(index(number), &states(u64::from(number) * 5 + 2)));
    let mut reader = Reader::connect(&node, reader.mirror, reader.planner);
    let before = voxels(&old.map);
    reader.take(&node, 100);
    while let Some(frame) = node.frame(&mut reader.feed, 10) {
        assert_eq!(voxels(reader.mirror.map().unwrap()), before);
        assert!(
            !matches!(reader.mirror.have(), Some(have) if have.feed == node.id)
                || !reader.mirror.is_complete()
        );
        reader.wire = frame;
        reader.take(&node, 100);
    }
    assert!(reader.mirror.is_complete());
    assert_eq!(voxels(reader.mirror.map().unwrap()), voxels(&node.map));
}

#[test]
fn a_reader_that_left_while_a_new_map_came_goes_on_with_that() {
    let (old, reader) = complete(100);
    let mut node = Node::new(old.id + 1);
    (0..400).for_each(|number| node.change(index(number), &states(u64::from(number) * 5 + 2)));
    // Blocks were let go before it came.
    (0..100).for_each(|number| node.change(index(number), &StateBlock::default()));
    assert_eq!(node.map.changed_since(0), None);
    let mut reader = Reader::connect(&node, reader.mirror, reader.planner);
    reader.take(&node, 100);
    for _ in 0..5 {
        reader.wire = node.frame(&mut reader.feed, 20).unwrap();
        reader.take(&node, 100);
    }
    let sent = reader.feed.upto();
    let mut again = Reader::connect(&node, reader.mirror, reader.planner);
    assert_eq!(again.feed.upto(), sent, "it goes on");
    let bytes = serve(&node, &mut again);
    assert!(bytes < 260 * 140, "{bytes}");
    assert_eq!(voxels(again.mirror.map().unwrap()), voxels(&node.map));
}

#[test]
fn a_large_map_is_picked_in_parts_and_is_whole_at_the_end() {
    let mut map = MapView::new(resolution());
    for number in 0..20_000 {
        map.set_block(BlockIndex::new(number % 200, number / 200, 0), &states(number as u64 * 5 + 1));
    }
    let mut mirror = Mirror::default();
    mirror.connect();
    mirror.push(&mut &hello(1, false, false).emit()[..]).unwrap();
    let (mut feed, _) = Feed::begin(&ReaderHello::default(), 1, &map);
    let (mut frames, mut before) = (0, 0);
    loop {
        let frame = match feed.next(&map) {
            Next::Nothing => break,
            Next::Anew(frame) => frame,
            Next::Blocks => feed.blocks_of(&map, Stamp(1)),
        };
        assert!(frame.len() <= (1 << 16) + 140, "{}", frame.len());
        mirror.push(&mut &frame[..]).unwrap();
        assert!(feed.upto() >= before);
        (frames, before) = (frames + 1, feed.upto());
    }
    assert!((43..60).contains(&frames), "{frames}");
    assert_eq!(voxels(mirror.map().unwrap()), voxels(&map));
}

#[test]
fn unknown_kinds_are_skipped_by_their_length() {
    let (node, mut reader) = complete(3);
    let mut wire = vec![6, 0, 0, 0, 200, 1, 2, 3, 4, 5];
    wire.extend(Message::End("over".into()).emit());
    reader.wire = wire;
    reader.take(&node, 4);
    assert_eq!(reader.mirror.end(), Some("over"));
    assert!(reader.mirror.is_complete());
}

#[test]
fn what_a_mirror_may_not_hold_is_refused() {
    let mut node = Node::new(1);
    (0..50).for_each(|number| node.change(index(number), &states(u64::from(number) * 5 + 1)));
    let options = MirrorOptions { blocks_max: 49, ..MirrorOptions::default() };
    let mut mirror = Mirror::new(options);
    let (mut feed, _) = Feed::begin(&ReaderHello::default(), 1, &node.map);
    mirror.push(&mut &hello(1, false, false).emit()[..]).unwrap();
    let anew = node.frame(&mut feed, 50).unwrap();
    mirror.push(&mut &anew[..]).unwrap();
    let frame = node.frame(&mut feed, 50).unwrap();
    assert_eq!(mirror.push(&mut &frame[..]), Err(FeedError::BlocksFull(49)));
    assert!(mirror.map().unwrap().block_count() <= 49);

    let length = |bytes: &[u8]| Mirror::default().push(&mut &bytes[..]);
    assert!(matches!(length(&[0; 4]), Err(FeedError::Length { got: 0, .. })));
    assert!(matches!(length(&[0xff; 4]), Err(FeedError::Length { .. })));
    assert_eq!(length(&[0, 0, 16, 0]), Ok(None), "a long frame is waited for");
}

#[test]
fn a_mirror_is_of_one_robot_and_takes_frames_in_their_order() {
    let mut mirror = Mirror::default();
    let anew = Message::Anew { began: 1 }.emit();
    assert_eq!(mirror.push(&mut &anew[..]), Err(FeedError::OutOfOrder("begin-anew")));
    mirror.connect();
    mirror.push(&mut &hello(1, false, false).emit()[..]).unwrap();
    let again = mirror.push(&mut &hello(1, false, false).emit()[..]);
    assert_eq!(again, Err(FeedError::OutOfOrder("hello")));
    mirror.connect();
    let Message::Hello(other) = hello(1, false, false) else { unreachable!() };
    let other = Message::Hello(NodeHello { robot: RobotId(8), ..other }).emit();
    assert!(matches!(mirror.push(&mut &other[..]), Err(FeedError::AnotherMap { .. })));
    let version = mirror.push(&mut &[11, 0, 0, 0, 1, b'F', b'L', b'K', b'M', 2, 0, 0, 0, 0, 0][..]);
    assert!(matches!(version, Err(FeedError::Version(2))), "{version:?}");
}
