//! A peer that joins late wants all of a large map: the snapshot is made in slices, and the robot goes on meanwhile.

use flockmap::codec::{ContentKind, Encoder, Span};
use flockmap::{
    Codec, Event, Package, Pose, Resolution, Robot, RobotConfig, RobotId, Scan, Stamp, State, States,
    StatesUpdate, Stream, Voxel, VoxelBox, epoch,
};

/// What a call may take: its steps, and a cube of blocks or what cannot be stopped in more.
const STEPS_MOST: u64 = 1_500_000 + 1_000_000;

/// What goes into a datagram that is not sealed.
const CHUNK_BYTES_MAX: usize = 1_169;

fn resolution() -> Resolution {
    Resolution::from_metres(0.2).unwrap()
}

fn robot(id: u16, number: u32, now: Stamp) -> Robot {
    let mut config = RobotConfig::new(RobotId(id), resolution(), 6.0);
    config.epoch = epoch(number, 1);
    config.seed = u64::from(id);
    config.session.snapshot_bytes_min = Some(1_000);
    // This is about what comes in at once.
    config.session.congestion_control = false;
    Robot::new(config, now).unwrap()
}

/// Takes in a slab of a large room and publishes it.
fn insert_slab(robot: &mut Robot, now: Stamp, slab: i32, pattern: i32) {
    let region = VoxelBox::new(Voxel::new(0, 0, 8 * slab), [120, 120, 8]).unwrap();
    let mut noise = u64::from((1 + slab + 100 * pattern).unsigned_abs());
    let mut state = || {
        noise = noise.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        if noise >> 60 == 0 { State::Occupied } else { State::Free }
    };
    let states: Vec<State> = (0..120 * 120 * 8).map(|_| state()).collect();
    let states = States::Box { region, states: &states, clear_unknown: false };
    let update = StatesUpdate { stamp: now, resolution: resolution(), sensor: None, states };
    robot.insert_states(now, &update).unwrap();
    robot.flush(now);
}

/// A robot with a map of a million voxels, of which nobody heard.
fn full(id: u16, number: u32) -> (Robot, Stamp) {
    let mut now = Stamp(1_000_000);
    let mut robot = robot(id, number, now);
    // What changes again costs packages, and no more in a snapshot.
    for number in 0..27 {
        now = now.plus_micros(500_000);
        insert_slab(&mut robot, now, number % 9, number / 9);
        while robot.poll_transmit(now).is_some() {}
        while robot.poll_event().is_some() {}
    }
    (robot, now)
}

/// All that `from` sends now arrives. Returns the events of who got it.
fn send(from: &mut Robot, to: &mut Robot, now: Stamp) -> Vec<Event> {
    let mut events = Vec::new();
    while let Some(datagram) = from.poll_transmit(now) {
        let _ = to.handle_datagram(now, &datagram.bytes);
        events.extend(std::iter::from_fn(|| to.poll_event()));
    }
    events
}

fn is_busy(robot: &Robot, now: Stamp) -> bool {
    robot.poll_timeout().is_some_and(|due| due <= now)
}

/// Both go on until `b` has all that `a` published; the packages that it merged.
fn catch_up(a: &mut Robot, b: &mut Robot, now: &mut Stamp) -> Vec<Package> {
    let mut merged = Vec::new();
    for _ in 0..4_000 {
        *now = now.plus_micros(10_000);
        a.handle_timeout(*now);
        b.handle_timeout(*now);
        merged.extend(send(a, b, *now).into_iter().filter_map(|event| match event {
            Event::Merged { package, .. } => Some(package),
            _ => None,
        }));
        send(b, a, *now);
        let newest = a.session().store().newest_known(a.own_stream());
        let received = b.session().received(a.own_stream());
        if newest > 0 && received.is_some_and(|received| received.contains_range(1, newest)) {
            let layers = [&*a, &*b].map(|robot| robot.fusion().layer(a.own_stream()).map(|l| l.digest()));
            assert_eq!(layers[0], layers[1]);
            return merged;
        }
    }
    panic!("it never caught up");
}

fn snapshot_of(packages: &[Package]) -> Vec<Package> {
    let is_chunk = |package: &&Package| matches!(package.header().content, ContentKind::Snapshot { .. });
    packages.iter().filter(is_chunk).cloned().collect()
}

fn newest(robot: &Robot) -> u32 {
    robot.session().store().newest_known(robot.own_stream())
}

#[test]
fn while_a_snapshot_is_made_the_robot_goes_on_and_the_snapshot_is_of_when_it_was_begun() {
    let (mut a, mut now) = full(1, 5);
    let upto = newest(&a);
    let layer = a.fusion().layer(a.own_stream()).unwrap().clone();
    let mut b = robot(2, 5, now);
    send(&mut b, &mut a, now);
    assert!(is_busy(&a, now) && a.counters().snapshots == 0, "it is not made in the call that asks for it");

    let mut calls = 0;
    while a.counters().snapshots == 0 {
        now = now.plus_micros(10_000);
        calls += 1;
        // Scans, states, requests and packages are taken in as always.
        let scan = Scan { stamp: now, points: vec![[2.0, 0.1 * calls as f32, 0.0]], no_returns: Vec::new() };
        a.insert_scan(now, &scan, &Pose::from_translation([40.0, 0.0, 0.0])).unwrap();
        if calls == 2 {
            insert_slab(&mut a, now.plus_micros(1_000), 0, 5);
            insert_slab(&mut a, now.plus_micros(2_000), 20, 0);
        }
        a.handle_timeout(now);
        send(&mut b, &mut a, now);
        assert!(calls < 1_000, "it comes to an end");
    }
    assert!(calls > 3, "{calls} calls");
    assert!(a.counters().snapshot_steps_most < STEPS_MOST, "{} steps", a.counters().snapshot_steps_most);
    assert!(newest(&a) > upto);

    assert_eq!(a.session().counters().snapshots_wanted, 1);
    let merged = catch_up(&mut a, &mut b, &mut now);
    let chunks = snapshot_of(&merged);
    println!(
        "{calls} calls, {} steps, {} chunks, {} packages",
        a.counters().snapshot_steps_most,
        chunks.len(),
        a.counters().packages
    );
    let others = merged.iter().filter(|package| !chunks.contains(package));
    let beside: Vec<u32> =
        others.map(|package| package.header().index).filter(|index| *index <= upto).collect();
    assert!(beside.is_empty(), "{beside:?} of {upto} came beside {} chunks", chunks.len());
    let state = layer.snapshot_voxels(None).unwrap();
    let span = Span::new(a.own_stream(), 0, upto);
    let at_once = Encoder::new().encode_span(Codec::Flock, span, resolution(), &state, CHUNK_BYTES_MAX);
    assert_eq!(chunks, at_once.unwrap());
    assert_eq!(a.counters().snapshots, 1);
}

#[test]
fn who_asks_again_while_a_snapshot_is_made_does_not_make_it_begin_again() {
    let (mut a, mut now) = full(1, 5);
    let mut others: Vec<Robot> = (2..6).map(|id| robot(id, 5, now)).collect();
    let mut calls = 0;
    send(&mut others[0], &mut a, now);
    while a.counters().snapshots == 0 {
        // So slow that each call comes when the session would ask again.
        now = now.plus_micros(2_500_000);
        for other in &mut others {
            other.handle_timeout(now);
            send(other, &mut a, now);
        }
        a.handle_timeout(now);
        calls += 1;
        assert!(calls < 100, "it comes to an end");
    }
    assert!(calls > 3);
    assert_eq!(a.counters().snapshots, 1);
    for other in &mut others {
        catch_up(&mut a, other, &mut now);
    }
}

/// Tells a robot that there was a later run of it, until it begins anew.
fn begin_anew(a: &mut Robot, now: &mut Stamp) {
    let begun = a.counters().runs_begun;
    let seconds = flockmap::grid::seconds_of_epoch(a.own_stream().epoch) + 9;
    let mut later = robot(a.own_stream().origin.0, seconds, *now);
    insert_slab(&mut later, *now, 30, 0);
    let mut witness = robot(3, 5, *now);
    send(&mut later, &mut witness, *now);
    assert!(witness.session().received(later.own_stream()).is_some());
    while a.counters().runs_begun == begun {
        *now = now.plus_micros(200_000);
        witness.handle_timeout(*now);
        send(&mut witness, a, *now);
    }
}

#[test]
fn a_run_that_begins_anew_while_a_snapshot_is_made_lets_go_of_it() {
    let (mut a, mut now) = full(1, 5);
    let mut b = robot(2, 5, now);
    send(&mut b, &mut a, now);
    assert!(is_busy(&a, now));
    let former: Stream = a.own_stream();
    begin_anew(&mut a, &mut now);
    assert_eq!((a.counters().runs_begun, a.counters().snapshots), (1, 0));
    assert_ne!(a.own_stream(), former);
    let merged = catch_up(&mut a, &mut b, &mut now);
    assert!(merged.iter().all(|package| package.header().stream != former));
}

/// The blocks that were published in each call until all is out, and the ends of the batches.
fn republish(a: &mut Robot, now: &mut Stamp) -> (Vec<usize>, Vec<Stamp>) {
    let (mut calls, mut ends) = (Vec::new(), Vec::new());
    while a.is_republishing() {
        assert!(is_busy(a, *now), "there is something to do at once");
        *now = now.plus_micros(1_000);
        a.handle_timeout(*now);
        let mut blocks = 0;
        while let Some(event) = a.poll_event() {
            if let Event::BatchClosed { batch, changes, .. } = event {
                blocks += changes.blocks().len();
                ends.push(batch.end);
            }
        }
        calls.push(blocks);
    }
    (calls, ends)
}

#[test]
fn a_run_begun_anew_publishes_what_the_former_one_had_a_part_at_a_time_and_then_what_is_new() {
    let (mut a, mut now) = full(1, 5);
    let before = a.fusion().layer(a.own_stream()).unwrap().clone();
    let batch_most =
        before.snapshot().unwrap().parts.iter().map(|(_, part)| part.blocks().len()).max().unwrap();
    begin_anew(&mut a, &mut now);
    assert!(
        a.is_republishing() && a.fusion().layer(a.own_stream()).is_none(),
        "not in the call that says so"
    );
    assert_eq!(a.unpublished(), before.len());
    // What is seen meanwhile, and even what somebody wants to go out at once, waits.
    let seen = now;
    insert_slab(&mut a, seen, 40, 0);
    let (calls, ends) = republish(&mut a, &mut now);
    let reading = calls.iter().take_while(|blocks| **blocks == 0).count();
    assert!(reading >= before.block_count() / 512, "{reading} calls to read {} blocks", before.block_count());
    assert!(calls.iter().all(|blocks| *blocks < 64 + batch_most), "{calls:?}, batches of {batch_most}");
    assert!(ends.is_sorted() && ends.last() == Some(&seen), "in the order of the stamps: {ends:?}");
    assert_eq!(a.unpublished(), 0);
    let after = a.fusion().layer(a.own_stream()).unwrap();
    assert_eq!(after.len(), before.len() + 120 * 120 * 8);
    let mut all = before;
    let slab = after.snapshot_since(seen.plus_micros(-1)).unwrap();
    all.apply_snapshot(&slab);
    assert_eq!(all.digest(), after.digest(), "nothing old looks new, and nothing is lost");
    catch_up(&mut a, &mut robot(2, 5, now), &mut now);
}

#[test]
fn a_run_begun_anew_in_the_middle_of_that_publishes_all_of_it_again() {
    for calls in [1, 5, 12] {
        let (mut a, mut now) = full(1, 5);
        let before = a.fusion().layer(a.own_stream()).unwrap().digest();
        begin_anew(&mut a, &mut now);
        for _ in 0..calls {
            a.handle_timeout(now);
        }
        assert!(a.is_republishing());
        // The session takes no second one so soon.
        now = now.plus_micros(15_000_000);
        begin_anew(&mut a, &mut now);
        let _ = republish(&mut a, &mut now);
        assert_eq!(a.counters().runs_begun, 2);
        assert_eq!(a.fusion().layer(a.own_stream()).unwrap().digest(), before, "after {calls} calls");
    }
}

/// A map goes to a robot that joins late, but for one datagram. Returns the robots, the time, what was withheld, and
/// which datagram was the first of which something could be merged.
fn join_without(withheld: Option<usize>) -> (Robot, Robot, Stamp, Option<Vec<u8>>, usize) {
    let (mut a, mut now) = full(1, 5);
    let mut b = robot(2, 5, now);
    let (mut number, mut first, mut kept) = (0, None, None);
    for _ in 0..1_000 {
        now = now.plus_micros(10_000);
        a.handle_timeout(now);
        b.handle_timeout(now);
        while let Some(datagram) = a.poll_transmit(now) {
            number += 1;
            if withheld == Some(number) {
                kept = Some(datagram.bytes);
                continue;
            }
            let _ = b.handle_datagram(now, &datagram.bytes);
            while let Some(event) = b.poll_event() {
                if let Event::Merged { .. } = event {
                    first.get_or_insert(number);
                }
            }
            if b.session().counters().waited >= 100 || withheld.is_none() && first.is_some() {
                return (a, b, now, kept, first.unwrap_or(0));
            }
        }
        send(&mut b, &mut a, now);
    }
    panic!("nothing came");
}

#[test]
fn what_waited_for_a_chunk_is_merged_some_in_each_call() {
    let (.., first) = join_without(None);
    let (mut a, mut b, mut now, withheld, _) = join_without(Some(first));
    let _ = b.handle_datagram(now, &withheld.expect("the first chunk"));
    let mut calls = Vec::new();
    loop {
        let merged = std::iter::from_fn(|| b.poll_event());
        calls.push(merged.filter(|event| matches!(event, Event::Merged { .. })).count());
        if !b.session().has_events() {
            break;
        }
        assert!(is_busy(&b, now), "there is more to do at once");
        b.handle_timeout(now);
    }
    assert!(calls.iter().sum::<usize>() > 100, "{calls:?}");
    // The last may find that there is nothing more.
    calls.pop_if(|merged| *merged == 0);
    assert!(calls.iter().all(|merged| (1..=16).contains(merged)), "{calls:?}");
    catch_up(&mut a, &mut b, &mut now);
}
