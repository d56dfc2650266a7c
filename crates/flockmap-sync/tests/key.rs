//! What a swarm key promises: only holders are heard, each datagram once, and nothing else changes anything.

mod swarm;

use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_sync::wire::{DatagramError, DatagramHeader, Kind, Request, SealedDatagram, seal_datagram};
use flockmap_sync::{Cast, Counters, Destination, Event, Session, SessionConfig, SwarmKey};
use proptest::prelude::*;
use std::collections::BTreeSet;
use swarm::{MS, Radio, SECOND, Swarm};

fn key(byte: u8) -> SwarmKey {
    SwarmKey::from_bytes(core::array::from_fn(|at| byte.wrapping_mul(31) ^ at as u8))
}

fn with_key(byte: u8) -> SessionConfig {
    SessionConfig { swarm_key: Some(key(byte)), ..SessionConfig::default() }
}

fn session(id: u16, epoch: u64, config: SessionConfig) -> Session {
    let config = SessionConfig { salt: [id as u8 ^ epoch as u8 | 0x80; 16], ..config };
    Session::new(Stream { origin: RobotId(id), epoch }, config, id.into()).unwrap()
}

/// The next datagram of a session, waiting for it if need be.
fn next(session: &mut Session, now: &mut Stamp) -> Vec<u8> {
    loop {
        while session.poll_event().is_some() {}
        if let Some(transmit) = session.poll_transmit(*now) {
            return transmit.bytes;
        }
        *now = session.poll_timeout().unwrap();
    }
}

/// All that a datagram may change, as text; what the clock and the counters show is left out.
fn state(session: &Session) -> String {
    let peers: Vec<_> = session.peers().collect();
    let streams: Vec<_> = session.streams().map(|s| (s, session.received(s).cloned())).collect();
    format!("{peers:?} {streams:?} {:?}", session.poll_timeout())
}

fn counters(swarm: &Swarm, id: u16) -> Counters {
    *swarm.robots[&id].session.counters()
}

#[test]
fn robots_with_the_same_key_get_in_sync() {
    for (cast, seed) in [(Cast::Unicast, 1), (Cast::Broadcast, 2)] {
        let config = SessionConfig { cast, ..with_key(1) };
        let mut swarm = Swarm::of(3, seed, Radio::lossy(0.2), &config);
        // From here on each knows the others, so that a datagram to everyone by unicast is one for each of them.
        swarm.run(2 * SECOND);
        let counted_before: Vec<_> = (1..=3).map(|id| counters(&swarm, id).out().bytes).collect();
        for _ in 0..20 {
            for id in 1..=3 {
                swarm.publish(id, 600);
            }
            swarm.run(SECOND / 2);
        }
        swarm.run(10 * SECOND);
        swarm.assert_in_sync(&[swarm.stream(1), swarm.stream(2), swarm.stream(3)]);
        let doubled: u64 = (1..=3).map(|id| counters(&swarm, id).replayed).sum();
        assert!(doubled > 0, "the radio doubles some");
        for id in 1..=3 {
            let c = counters(&swarm, id);
            assert_eq!(c.forged + c.unsealed + c.sealed_without_key + c.stale_epoch, 0, "{c:#?}");
            let (_, bytes, _) = swarm.robots[&id].sent.iter().max_by_key(|sent| sent.1).unwrap();
            assert!(*bytes <= 1_228, "{bytes} bytes on the wire");
            let counted = c.out().bytes - counted_before[usize::from(id) - 1];
            let sent = swarm.robots[&id].bytes_between(2 * SECOND, i64::MAX);
            assert_eq!(counted, sent as u64, "what goes out is what is counted");
        }
    }
}

#[test]
fn without_the_right_key_nothing_is_heard() {
    let configs = [with_key(1), with_key(2), SessionConfig::default()];
    let mut swarm = Swarm::new(5, Radio::PERFECT);
    for (id, config) in (1..).zip(configs) {
        swarm.start(id, 1, config);
    }
    for _ in 0..10 {
        for id in 1..=3 {
            swarm.publish(id, 300);
        }
        swarm.run(SECOND);
    }
    for id in 1..=3 {
        let session = &swarm.robots[&id].session;
        assert_eq!((session.peers().count(), session.streams().count()), (0, 1), "robot {id}");
    }
    let (one, two, three) = (counters(&swarm, 1), counters(&swarm, 2), counters(&swarm, 3));
    assert!(one.forged > 0 && one.unsealed > 0 && two.forged > 0 && two.unsealed > 0);
    assert!(three.sealed_without_key >= 6 && three.forged + three.unsealed == 0);
}

#[test]
fn another_swarm_is_told_apart_even_with_the_same_key() {
    let mut now = Stamp(0);
    let bytes = next(&mut session(2, 1, SessionConfig { swarm: 7, ..with_key(1) }), &mut now);
    let mut receiver = session(1, 1, with_key(1));
    let error = receiver.handle_datagram(now, &bytes).unwrap_err();
    assert_eq!(error, DatagramError::Swarm { got: 7, expected: 0 });
    assert_eq!((receiver.counters().foreign_swarm, receiver.peers().count()), (1, 0));
}

#[test]
fn replayed_datagrams_change_nothing_and_are_counted() {
    let mut swarm = Swarm::of(2, 8, Radio::PERFECT, &with_key(1));
    let mut recorded = Vec::new();
    for _ in 0..10 {
        swarm.publish(1, 600);
        swarm.run(SECOND / 2);
        recorded.append(&mut swarm.take_heard(2));
    }
    assert!(recorded.len() > 20);
    let robot = swarm.robots.get_mut(&2).unwrap();
    let now = Stamp(swarm.now + robot.clock);
    let before = state(&robot.session);
    let replayed = robot.session.counters().replayed;
    for bytes in &recorded {
        let error = robot.session.handle_datagram(now, bytes).unwrap_err();
        assert!(matches!(error, DatagramError::Replayed { sender: RobotId(1), .. }), "{error}");
        assert_eq!(state(&robot.session), before);
        assert!(robot.session.poll_event().is_none());
    }
    assert_eq!(robot.session.counters().replayed, replayed + recorded.len() as u64);
}

#[test]
fn a_departed_peers_datagrams_cannot_be_replayed() {
    let mut now = Stamp(0);
    let (mut sender, mut receiver) = (session(2, 9, with_key(1)), session(1, 1, with_key(1)));
    let recorded: Vec<_> = (0..100).map(|_| next(&mut sender, &mut now)).collect();
    for bytes in recorded.iter().step_by(2) {
        receiver.handle_datagram(now, bytes).unwrap();
    }
    receiver.handle_timeout(now.plus_micros(3_600 * SECOND));
    assert_eq!(receiver.peers().count(), 0);
    let newest_heard = 18;
    for bytes in &recorded[..=newest_heard] {
        let error = receiver.handle_datagram(now, bytes).unwrap_err();
        assert!(matches!(error, DatagramError::Replayed { .. }), "{error}");
    }
    // Nor those of a run before it.
    let former = next(&mut session(2, 8, with_key(1)), &mut now);
    let error = receiver.handle_datagram(now, &former).unwrap_err();
    assert_eq!(error, DatagramError::StaleEpoch { sender: RobotId(2), got: 8, current: 9 });
    assert_eq!((receiver.peers().count(), receiver.counters().stale_epoch), (0, 1));
    // The robot itself is welcome.
    receiver.handle_datagram(now, &next(&mut sender, &mut now)).unwrap();
    assert_eq!(receiver.peers().count(), 1);
}

#[test]
fn own_datagrams_that_come_back_raise_no_alarm() {
    let mut now = Stamp(0);
    let former = next(&mut session(1, 1, with_key(1)), &mut now);
    let mut own = session(1, 2, with_key(1));
    let snapshot = next(&mut own, &mut now);
    own.handle_datagram(now, &snapshot).unwrap();
    assert!(matches!(own.handle_datagram(now, &former), Err(DatagramError::StaleEpoch { .. })));
    assert_eq!((own.counters().own_heard, own.counters().stale_epoch), (1, 1));
    assert_eq!(own.counters().same_identity, 0);
    assert!(own.poll_event().is_none());
}

#[test]
fn of_two_robots_with_one_id_one_finds_out() {
    for (epoch, other_epoch) in [(5, 5), (5, 6)] {
        let mut now = Stamp(0);
        let mut one = session(1, epoch, with_key(1));
        let other = Stream { origin: RobotId(1), epoch: other_epoch };
        let mut two = Session::new(other, SessionConfig { salt: [77; 16], ..with_key(1) }, 2).unwrap();
        next(&mut two, &mut now);
        let bytes = next(&mut two, &mut now);
        let error = one.handle_datagram(now, &bytes).unwrap_err();
        assert_eq!(error, DatagramError::SameIdentity { id: RobotId(1) });
        assert_eq!(one.counters().same_identity, 1);
    }
}

#[test]
fn a_reboot_never_repeats_a_nonce() {
    let mut nonces = BTreeSet::new();
    let mut swarm = Swarm::new(12, Radio::lossy(0.1));
    let mut datagrams = 0;
    for epoch in 1..=6u64 {
        for id in 1..=3 {
            // They do not all start again each time.
            if epoch == 1 || (epoch + u64::from(id)) % 2 == 0 {
                swarm.start(id, epoch, with_key(1));
            }
        }
        for _ in 0..6 {
            for id in 1..=3 {
                swarm.publish(id, 400);
            }
            swarm.run(SECOND / 2);
        }
        for (to, bytes) in swarm.take_sent() {
            let sealed = SealedDatagram::new_checked(&bytes).unwrap();
            let recipient = match to {
                Destination::Peer(peer) => Some(peer),
                Destination::Everyone => None,
            };
            assert_eq!(recipient.is_some(), sealed.is_for_one());
            let nonce = (sealed.sender(), recipient, sealed.counter());
            assert!(nonces.insert(nonce), "nonce of {:?} {} repeats", sealed.sender(), sealed.counter());
            assert!(sealed.counter() > 0);
            datagrams += 1;
        }
    }
    assert!(datagrams > 500, "{datagrams} datagrams");
}

#[test]
fn datagrams_overtaken_on_the_way_count_once_each() {
    // Delays of up to 400 ms turn bursts over; every third datagram comes twice.
    let radio = Radio { loss: 0.0, duplicate: 0.3, delay: 10 * MS, jitter: 400 * MS };
    let mut swarm = Swarm::of(2, 14, radio, &with_key(1));
    swarm.run(2 * SECOND);
    for _ in 0..20 {
        swarm.publish(1, 3_000);
        swarm.run(SECOND / 2);
    }
    swarm.run(8 * SECOND);
    swarm.assert_in_sync(&[swarm.stream(1)]);
    let (sent, got) = (counters(&swarm, 1), counters(&swarm, 2));
    assert_eq!(got.packages_in.datagrams, sent.packages_out.datagrams, "each once: {got:#?}");
    assert!(got.replayed > sent.packages_out.datagrams / 5);
}

#[test]
fn a_request_that_somebody_held_back_says_nothing_any_more() {
    for (config, stale) in [(with_key(1), 1), (SessionConfig::default(), 0)] {
        let config = SessionConfig { peer_timeout_ms: 60_000, ..config };
        let (mut a, mut b) = (session(1, 1, config.clone()), session(2, 1, config));
        let mut now = Stamp(0);
        b.handle_datagram(now, &next(&mut a, &mut now)).unwrap();
        let delayed = next(&mut a, &mut now);
        b.handle_datagram(now, &next(&mut a, &mut now)).unwrap();
        let later = now.plus_micros(6 * SECOND);
        b.handle_datagram(later, &delayed).unwrap();
        // Without a key the newer one might have been of anybody: it does not count for ever.
        assert_eq!(b.counters().stale_requests, stale);
    }
}

#[test]
fn robots_that_each_take_the_other_for_a_former_run_begin_anew_and_find_together() {
    let mut now = Stamp(0);
    let [one, two] = [1, 2].map(|id| next(&mut session(id, 5, with_key(1)), &mut now));
    // After a start both have a clock that was set back, and hear a datagram of the other's last run, late.
    let mut robots = [1, 2].map(|id| session(id, 3, with_key(1)));
    robots[0].handle_datagram(now, &two).unwrap();
    robots[1].handle_datagram(now, &one).unwrap();
    for _ in 0..300 {
        now = now.plus_micros(SECOND / 10);
        for to in 0..2 {
            robots[1 - to].handle_timeout(now);
            while let Some(transmit) = robots[1 - to].poll_transmit(now) {
                let _ = robots[to].handle_datagram(now, &transmit.bytes);
            }
            while let Some(event) = robots[to].poll_event() {
                if let Event::EpochTooLow { used } = event {
                    assert!(robots[to].begin_run(now, used + 1));
                }
            }
        }
    }
    let [one, two] = robots;
    assert!(one.own().epoch > 5 || two.own().epoch > 5);
    assert_eq!(one.peers().map(|peer| peer.stream).collect::<Vec<_>>(), [two.own()]);
    assert_eq!(two.peers().map(|peer| peer.stream).collect::<Vec<_>>(), [one.own()]);
}

#[test]
fn errors_say_what_to_do() {
    let mut now = Stamp(0);
    let sealed = next(&mut session(2, 1, with_key(1)), &mut now);
    let plain = next(&mut session(3, 1, SessionConfig::default()), &mut now);
    let advice =
        |config, bytes: &[u8]| session(1, 1, config).handle_datagram(now, bytes).unwrap_err().to_string();
    for (text, words) in [
        (advice(with_key(2), &sealed), "give all robots of the swarm the same swarm_key"),
        (advice(with_key(2), &plain), "this robot has a swarm_key; give it to that robot too"),
        (advice(SessionConfig::default(), &sealed), "that robot has a swarm_key; give it to this robot too"),
    ] {
        assert!(text.contains(words), "{text}");
    }
    let config = SessionConfig { datagram_bytes_max: 1_190, salt: [7; 16], ..with_key(1) };
    let error = Session::new(Stream { origin: RobotId(1), epoch: 1 }, config, 1).unwrap_err().to_string();
    assert_eq!(error, "datagram_bytes_max is 1190, expected 1,199 or 1,200 with a key");
    let error =
        Session::new(Stream { origin: RobotId(1), epoch: 1 }, with_key(1), 1).unwrap_err().to_string();
    assert!(error.contains("16 random bytes, drawn anew for each run"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// Nothing that the radio or an attacker does to the bytes gets through, or leaves a trace.
    #[test]
    fn changed_bits_are_refused_and_leave_no_trace(
        flips in prop::collection::vec((0..1_000usize, 0..8u8), 1..6), from_peer: bool, epoch in 1..4u64,
    ) {
        let mut now = Stamp(0);
        let (mut sender, mut receiver) = (session(2, epoch, with_key(1)), session(1, 1, with_key(1)));
        if from_peer {
            receiver.handle_datagram(now, &next(&mut sender, &mut now)).unwrap();
        }
        while receiver.poll_event().is_some() {}
        let bytes = next(&mut sender, &mut now);
        receiver.handle_timeout(now);
        let mut changed = bytes.clone();
        for (at, bit) in flips {
            changed[at % bytes.len()] ^= 1 << bit;
        }
        prop_assume!(changed != bytes);
        let before = state(&receiver);
        let error = receiver.handle_datagram(now, &changed).unwrap_err();
        prop_assert_eq!(state(&receiver), before);
        prop_assert!(receiver.poll_event().is_none());
        // By the first six bytes it may already be known to be none of ours.
        let counters = receiver.counters();
        if changed[..6] == bytes[..6] {
            let sender = RobotId(u16::from_le_bytes([changed[6], changed[7]]));
            let is_named = error == DatagramError::Forged { sender } || error == DatagramError::Malformed { sender, what: "counter" };
            prop_assert!(is_named, "{}", error);
            prop_assert_eq!(counters.forged + counters.malformed, 1);
        } else {
            let by_kind = counters.unknown_run + counters.malformed + counters.unsealed;
            prop_assert_eq!(by_kind + counters.damaged + counters.foreign_version + counters.foreign_swarm + counters.forged, 1);
        }
        // The true one still counts.
        prop_assert_eq!(receiver.handle_datagram(now, &bytes), Ok(()));
    }

    /// Whoever has no key makes no peer, whatever he claims.
    #[test]
    fn a_forged_datagram_makes_no_peer(id in 2..100u16, epoch: u64, counter in 0..1u64 << 47, tag: [u8; 16], byte in 2..255u8) {
        let sender = Stream { origin: RobotId(id), epoch };
        let header = DatagramHeader { kind: Kind::Request, swarm: 0, sender, stamp: Stamp(5) };
        let plain = Request::default().emit(header, 1_200);
        let mut receiver = session(1, 1, with_key(1));
        let by_another_key = seal_datagram(&key(byte), &[5; 16], &plain, None, counter).unwrap();
        let mut made_up = by_another_key.clone();
        let at = made_up.len() - 16;
        made_up[at..].copy_from_slice(&tag);
        for bytes in [&by_another_key, &made_up, &plain] {
            prop_assert!(receiver.handle_datagram(Stamp(9), bytes).is_err());
        }
        prop_assert_eq!((receiver.peers().count(), receiver.counters().forged, receiver.counters().unsealed), (0, 2, 1));
        // The robot of that name is as welcome as before.
        let genuine = seal_datagram(&key(1), &[5; 16], &plain, None, 1).unwrap();
        prop_assert_eq!(receiver.handle_datagram(Stamp(9), &genuine), Ok(()));
    }
}
