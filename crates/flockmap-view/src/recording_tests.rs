use std::time::Duration;

use flockmap_feed::{Event, Mirror, MirrorOptions};
use flockmap_grid::{Pose, State, Stream, SubmapId};
use proptest::prelude::*;
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};
use tokio::sync::mpsc;

use super::*;
use crate::{Control, Source};

fn recording() -> Recording {
    Recording::new(RobotId(1), "one", Resolution::from_metres(0.1).unwrap(), "map").unwrap()
}

/// A block with one voxel, or none.
fn block(x: i32, bit: Option<usize>) -> Block {
    let (mut states, mut origins) = (StateBlock::default(), Vec::new());
    if let Some(bit) = bit {
        states.set(bit, State::Occupied);
        origins.push((RobotId(bit as u16 % 3), states.known()));
    }
    Block { index: BlockIndex::new(x, 0, 0), states, origins }
}

fn step(second: i64, blocks: Vec<Block>) -> Step {
    Step { stamp: Stamp(second * 1_000_000), blocks, ..Step::default() }
}

/// The blocks of a map that are not empty.
fn blocks_of(map: &MapView) -> Vec<(BlockIndex, StateBlock)> {
    let mut blocks: Vec<_> = map.blocks().filter(|(_, b)| !b.is_empty()).collect();
    blocks.sort_unstable_by_key(|(index, _)| *index);
    blocks
}

/// What the maps should be, moment by moment, kept as whole maps.
fn naive(steps: &[Vec<(i32, Option<usize>)>]) -> Vec<Vec<(BlockIndex, StateBlock)>> {
    let mut now = std::collections::BTreeMap::new();
    let after = |step: &Vec<(i32, Option<usize>)>| {
        for (x, bit) in step {
            let block = block(*x, *bit);
            now.insert(block.index, block.states);
        }
        now.iter().filter(|(_, states)| !states.is_empty()).map(|(index, states)| (*index, *states)).collect()
    };
    steps.iter().map(after).collect()
}

proptest! {
    #[test]
    fn every_moment_is_reached_from_every_other_one_also_after_thinning(
        steps in prop::collection::vec(prop::collection::vec((0..6, prop::option::of(0..512_usize)), 0..5), 1..24),
        jumps in prop::collection::vec(0..24_usize, 1..12),
        thinned in 0..3_usize,
    ) {
        let recording = recording();
        for (second, blocks) in steps.iter().enumerate() {
            recording.push(step(second as i64, blocks.iter().map(|(x, bit)| block(*x, *bit)).collect()));
        }
        for _ in 0..thinned {
            recording.kept.write().unwrap().thin();
        }
        let (all, every) = (naive(&steps), 1 << thinned);
        let moments = steps.len().div_ceil(every);
        prop_assert_eq!(recording.moments(), moments);
        let mut map = MapView::new(Resolution::from_metres(0.1).unwrap());
        let mut from = None;
        for to in jumps.into_iter().map(|jump| jump % moments) {
            recording.change(&mut map, from, to);
            from = Some(to);
            // The last of those that became one.
            let second = ((to + 1) * every - 1).min(steps.len() - 1);
            prop_assert_eq!(&blocks_of(&map), &all[second]);
            prop_assert_eq!(blocks_of(&recording.map_at(to)), blocks_of(&map));
            prop_assert_eq!(recording.stamp_of(to), Some(Stamp(second as i64 * 1_000_000)));
            for (index, states) in &all[second] {
                let bit = (0..512).find(|bit| states.get(*bit) == State::Occupied).unwrap();
                let block = recording.block_at(to, *index);
                prop_assert_eq!((block.states, block.origins), (*states, vec![(RobotId(bit as u16 % 3), states.known())]));
            }
        }
    }

    #[test]
    fn the_bytes_that_are_counted_are_those_of_a_recount(
        steps in prop::collection::vec(prop::collection::vec((0..6, prop::option::of(0..512_usize)), 0..5), 2..24),
    ) {
        let recording = recording();
        for (second, blocks) in steps.iter().enumerate() {
            recording.push(step(second as i64, blocks.iter().map(|(x, bit)| block(*x, *bit)).collect()));
        }
        let mut kept = recording.kept.write().unwrap();
        let moments: usize = kept.moments.iter().map(|_| 400).sum();
        let states: usize = kept.seen.iter().map(|seen| SEEN_BYTES + seen.states.len() * BLOCK_BYTES).sum();
        prop_assert_eq!(kept.bytes, moments + states);
        let before = kept.bytes;
        kept.thin();
        prop_assert!(kept.bytes < before);
    }
}

#[test]
fn a_recording_keeps_to_its_bytes_and_ends_as_it_should() {
    let recording = recording().with_bytes_max(100_000);
    for second in 0..5_000 {
        let x = (second % 50) as i32;
        recording.push(step(second, vec![block(x, Some(second as usize % 512)), block(100, Some(7))]));
        assert!(recording.kept.read().unwrap().bytes <= 100_000);
    }
    assert!(recording.moments() > 40, "{}", recording.moments());
    let last = recording.map_at(recording.moments() - 1);
    assert_eq!(last.block_count(), 51);
    assert_eq!(last.block(BlockIndex::new(49, 0, 0)), Some(block(49, Some(4_999 % 512)).states));
}

/// A browser's mirror on a recording, in a time that stands still but for what is waited for.
struct Viewer {
    pipe: DuplexStream,
    mirror: Mirror,
    controls: mpsc::Sender<Control>,
}

impl Viewer {
    async fn new(recording: &Arc<Recording>, origins: bool) -> Self {
        let (mut pipe, theirs) = tokio::io::duplex(1 << 16);
        let (controls, controls_in) = mpsc::channel(4);
        recording.connect(theirs, controls_in);
        let mut mirror = Mirror::new(MirrorOptions { origins, submaps: true, ..MirrorOptions::default() });
        pipe.write_all(&mirror.connect()).await.unwrap();
        Self { pipe, mirror, controls }
    }

    /// Reads until something is so.
    async fn until(&mut self, is: impl Fn(&Mirror) -> bool) {
        let mut buffer = [0; 4_096];
        while !is(&self.mirror) {
            let count = self.pipe.read(&mut buffer).await.unwrap();
            assert!(count > 0, "the player went");
            let mut bytes = &buffer[..count];
            while let Some(event) = self.mirror.push(&mut bytes).unwrap() {
                assert_ne!(event, Event::End);
            }
        }
    }

    fn at(mirror: &Mirror) -> i64 {
        mirror.playback().map_or(-1, |playback| playback.at.0)
    }
}

fn with_time<T: Future<Output = ()>>(test: T) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build();
    runtime.unwrap().block_on(test);
}

#[test]
fn a_browser_sees_the_map_of_the_time_that_it_asks_for_forwards_and_back() {
    for origins in [false, true] {
        with_time(async move {
            let recording = Arc::new(recording());
            for second in 0..10 {
                recording.push(step(
                    second,
                    vec![block(second as i32, Some(3)), block(50, Some(second as usize))],
                ));
            }
            recording.finish();
            let mut viewer = Viewer::new(&recording, origins).await;
            viewer.controls.send(Control::Play(false)).await.unwrap();
            for second in [7, 2, 9, 0, 5] {
                viewer.controls.send(Control::SeekUs(second * 1_000_000)).await.unwrap();
                viewer.until(|mirror| Viewer::at(mirror) == second * 1_000_000 && mirror.is_complete()).await;
                // What was on its way when it was asked for comes to an end.
                tokio::time::sleep(Duration::from_millis(10)).await;
                viewer.until(|mirror| mirror.is_complete()).await;
                let map = viewer.mirror.map().unwrap();
                assert_eq!(blocks_of(map), blocks_of(&recording.map_at(second as usize)), "second {second}");
                assert!(!viewer.mirror.playback().unwrap().plays);
            }
        });
    }
}

/// One run whose first submap was moved so far along x.
fn moved(x: f64) -> Vec<RunSubmaps> {
    let stream = Stream { origin: RobotId(1), epoch: 3 };
    let poses = vec![(SubmapId::FIRST, Pose::from_translation([x, 0.0, 0.0]))];
    vec![RunSubmaps { stream, newest: SubmapId::FIRST, poses, left_out: 0 }]
}

#[test]
fn a_browser_is_told_how_submaps_lay_at_the_time_that_it_asks_for() {
    with_time(async move {
        let recording = Arc::new(recording());
        // A loop was closed in the sixth second.
        let metres = |second: i64| if second < 6 { 0.0 } else { 0.5 };
        for second in 0..10 {
            let submaps = moved(metres(second));
            recording.push(Step { submaps, ..step(second, vec![block(second as i32, Some(3))]) });
        }
        recording.finish();
        let mut viewer = Viewer::new(&recording, false).await;
        viewer.controls.send(Control::Play(false)).await.unwrap();
        for second in [7, 2, 9, 0] {
            viewer.controls.send(Control::SeekUs(second * 1_000_000)).await.unwrap();
            viewer
                .until(|mirror| {
                    Viewer::at(mirror) == second * 1_000_000 && mirror.submaps() == moved(metres(second))
                })
                .await;
        }
    });
}

#[test]
fn submaps_that_lie_as_before_are_kept_once_and_count_once() {
    let (with, without) = (recording(), recording());
    for second in 0..100 {
        let submaps = moved(if second < 50 { 0.0 } else { 0.5 });
        with.push(Step { submaps, ..step(second, Vec::new()) });
        without.push(step(second, Vec::new()));
    }
    let bytes = |recording: &Recording| recording.kept.read().unwrap().bytes;
    let of_one = size_of::<RunSubmaps>() + size_of::<(SubmapId, Pose)>();
    assert_eq!(bytes(&with) - bytes(&without), 2 * of_one);
    with.kept.write().unwrap().thin();
    without.kept.write().unwrap().thin();
    assert_eq!(bytes(&with) - bytes(&without), 2 * of_one);
}

#[test]
fn what_a_browser_has_of_one_player_is_nothing_to_the_next() {
    with_time(async {
        let recording = Arc::new(recording());
        (0..10).for_each(|second| recording.push(step(second, vec![block(second as i32, Some(1))])));
        recording.finish();
        let mut viewer = Viewer::new(&recording, false).await;
        viewer.controls.send(Control::SeekUs(9_000_000)).await.unwrap();
        viewer.until(|mirror| Viewer::at(mirror) == 9_000_000 && mirror.is_complete()).await;
        let have = viewer.mirror.have().unwrap();
        // It comes back, to a player that is at the beginning.
        let mut back = Viewer::new(&recording, false).await;
        std::mem::swap(&mut back.mirror, &mut viewer.mirror);
        let (pipe, theirs) = tokio::io::duplex(1 << 16);
        let (controls, controls_in) = mpsc::channel(4);
        recording.connect(theirs, controls_in);
        (back.pipe, back.controls) = (pipe, controls);
        back.controls.send(Control::Play(false)).await.unwrap();
        back.pipe.write_all(&back.mirror.connect()).await.unwrap();
        back.until(|mirror| mirror.have().is_some_and(|now| now.feed != have.feed) && mirror.is_complete())
            .await;
        assert!(!back.mirror.node().unwrap().goes_on);
        assert_eq!(blocks_of(back.mirror.map().unwrap()), blocks_of(&recording.map_at(0)));
    });
}

#[test]
fn it_plays_as_fast_as_is_asked_and_stops_at_the_end() {
    with_time(async {
        let recording = Arc::new(recording());
        (0..11).for_each(|second| recording.push(step(second, vec![block(second as i32, Some(1))])));
        recording.finish();
        let mut viewer = Viewer::new(&recording, false).await;
        let began = tokio::time::Instant::now();
        viewer.controls.send(Control::Speed(2.0)).await.unwrap();
        viewer.until(|mirror| mirror.playback().is_some_and(|playback| !playback.plays)).await;
        let took = began.elapsed().as_secs_f64();
        assert!((4.9..5.2).contains(&took), "10 s at twice the speed took {took} s");
        assert_eq!(Viewer::at(&viewer.mirror), 10_000_000);
        // Once more from the beginning.
        viewer.controls.send(Control::Play(true)).await.unwrap();
        viewer.until(|mirror| Viewer::at(mirror) < 1_000_000).await;
        assert!(viewer.mirror.playback().unwrap().plays);
    });
}

#[test]
fn a_recording_that_grows_is_waited_for() {
    with_time(async {
        let recording = Arc::new(recording());
        let mut viewer = Viewer::new(&recording, false).await;
        tokio::time::sleep(Duration::from_secs(1)).await;
        recording.push(step(100, vec![block(1, Some(1))]));
        viewer.until(|mirror| mirror.is_complete() && mirror.map().unwrap().block_count() == 1).await;
        tokio::time::sleep(Duration::from_secs(5)).await;
        recording.push(step(101, vec![block(2, Some(1))]));
        recording.finish();
        viewer.until(|mirror| mirror.playback().is_some_and(|playback| !playback.plays)).await;
        assert_eq!(Viewer::at(&viewer.mirror), 101_000_000);
        assert_eq!(viewer.mirror.map().unwrap().block_count(), 2);
    });
}

#[test]
fn the_recording_may_go_before_its_browser_and_the_browser_before_the_recording() {
    with_time(async {
        let recording = Arc::new(recording());
        recording.push(step(0, vec![block(1, Some(1))]));
        drop(Viewer::new(&recording, false).await);
        tokio::time::sleep(Duration::from_secs(1)).await;
        assert_eq!(Arc::strong_count(&recording), 1, "no player is left of a browser that has gone");
    });
}
