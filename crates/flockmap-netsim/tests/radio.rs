//! The emulated radio loses, delays, doubles and reorders as configured, and each time the same.

use flockmap_grid::{RobotId, Stamp};
use flockmap_netsim::{Delivery, IP_UDP_BYTES, Link, RadioConfig, RadioEmulator, To};

const A: RobotId = RobotId(1);
const B: RobotId = RobotId(2);
const C: RobotId = RobotId(3);

/// One datagram of 100 bytes each millisecond from A to B.
fn run(radio: &mut RadioEmulator, count: i64) -> Vec<Delivery> {
    let mut deliveries = Vec::new();
    for i in 0..count {
        let now = Stamp(i * 1_000);
        let mut bytes = [0; 100];
        bytes[..8].copy_from_slice(&i.to_le_bytes());
        radio.send(now, A, To::Node(B), &bytes);
        while let Some(delivery) = radio.deliver_due(now) {
            assert!(delivery.at <= now);
            deliveries.push(delivery);
        }
    }
    while let Some(due) = radio.next_due() {
        deliveries.push(radio.deliver_due(due).unwrap());
    }
    deliveries
}

fn number(delivery: &Delivery) -> i64 {
    i64::from_le_bytes(delivery.bytes[..8].try_into().unwrap())
}

fn radio(seed: u64, link: Link) -> RadioEmulator {
    RadioEmulator::new([A, B, C], RadioConfig { seed, link, ..RadioConfig::default() })
}

#[test]
fn a_perfect_link_delivers_everything_in_order_at_once() {
    let deliveries = run(&mut radio(1, Link::default()), 100);
    assert!(
        deliveries.iter().enumerate().all(|(i, d)| number(d) == i as i64 && d.at == Stamp(i as i64 * 1_000))
    );
    assert_eq!(deliveries.len(), 100);
}

#[test]
fn loss_and_duplication_come_at_their_rates() {
    let link = Link { loss: 0.2, duplication: 0.1, ..Link::default() };
    let mut radio = radio(7, link);
    let arrived = run(&mut radio, 20_000).len() as f64;
    assert!((arrived / 20_000.0 - 0.8 * 1.1).abs() < 0.01, "{arrived}");
    let lost = radio.traffic(B).lost as f64;
    assert!((lost / 20_000.0 - 0.2).abs() < 0.01, "{lost}");
}

#[test]
fn jitter_spreads_delays_and_reorders() {
    let link = Link { delay_micros: 50_000, jitter_micros: 20_000, ..Link::default() };
    let deliveries = run(&mut radio(3, link), 5_000);
    let delays: Vec<i64> = deliveries.iter().map(|d| d.at.0 - number(d) * 1_000).collect();
    assert_eq!(deliveries.len(), 5_000);
    assert!(delays.iter().all(|d| (50_000..=70_000).contains(d)));
    assert!(*delays.iter().min().unwrap() < 50_200 && *delays.iter().max().unwrap() > 69_800);
    assert!(deliveries.windows(2).any(|pair| number(&pair[0]) > number(&pair[1])));
    assert!(deliveries.windows(2).all(|pair| pair[0].at <= pair[1].at));
}

#[test]
fn the_same_seed_gives_the_same_deliveries_and_another_seed_others() {
    let link =
        Link { loss: 0.3, delay_micros: 1_000, jitter_micros: 9_000, duplication: 0.2, ..Link::PERFECT };
    let one = run(&mut radio(5, link), 1_000);
    assert_eq!(one, run(&mut radio(5, link), 1_000));
    assert_ne!(one, run(&mut radio(6, link), 1_000));
    // Golden: changes only when the emulator changes on purpose.
    let mut text = String::new();
    for d in &one {
        text += &format!("{} {};", d.at.0, number(d));
    }
    assert_eq!(crc32fast::hash(text.as_bytes()), GOLDEN);
}

const GOLDEN: u32 = 235_283_813;

#[test]
fn traffic_on_one_link_does_not_change_what_happens_on_another() {
    let link = Link { loss: 0.5, ..Link::default() };
    let quiet: Vec<i64> = run(&mut radio(5, link), 500).iter().map(number).collect();
    let mut busy = radio(5, link);
    for i in 0..300 {
        busy.send(Stamp(0), C, To::All, &[i as u8]);
        busy.send(Stamp(0), A, To::Node(C), &[i as u8]);
    }
    while busy.deliver_due(Stamp(0)).is_some() {}
    let loud: Vec<i64> = run(&mut busy, 500).iter().map(number).collect();
    assert_eq!(quiet, loud);
}

#[test]
fn a_broadcast_is_sent_once_and_heard_by_all_others() {
    let config = RadioConfig { overhead_bytes: IP_UDP_BYTES, ..RadioConfig::default() };
    let mut radio = RadioEmulator::new([A, B, C], config);
    radio.send(Stamp(5), B, To::All, &[0; 72]);
    let heard: Vec<RobotId> =
        core::iter::from_fn(|| radio.deliver_due(Stamp(5))).map(|delivery| delivery.to).collect();
    assert_eq!(heard, [A, C]);
    assert_eq!((radio.traffic(B).sent, radio.traffic(B).sent_bytes), (1, 100));
    assert_eq!((radio.traffic(C).received, radio.traffic(C).received_bytes), (1, 100));
    assert_eq!(radio.traffic(A).received_bytes, 100);
}

#[test]
fn a_rate_cap_spaces_datagrams_and_drops_what_the_queue_cannot_hold() {
    let config =
        RadioConfig { rate_bytes_per_s: Some(10_000), queue_bytes_max: 1_000, ..RadioConfig::default() };
    let mut radio = RadioEmulator::new([A, B], config);
    for _ in 0..15 {
        radio.send(Stamp(0), A, To::Node(B), &[0; 100]);
    }
    let arrivals: Vec<i64> =
        core::iter::from_fn(|| radio.deliver_due(Stamp(i64::MAX))).map(|delivery| delivery.at.0).collect();
    assert_eq!(arrivals, (1..=10).map(|i| i * 10_000).collect::<Vec<_>>());
    assert_eq!(radio.traffic(A).dropped, 5);
}

#[test]
fn closed_links_let_nothing_pass_until_they_are_open_again() {
    let mut radio = radio(1, Link::default());
    radio.set_open_both(A, B, false);
    radio.send(Stamp(0), A, To::All, b"x");
    radio.send(Stamp(0), B, To::Node(A), b"y");
    let got: Vec<RobotId> = core::iter::from_fn(|| radio.deliver_due(Stamp(0))).map(|d| d.to).collect();
    assert_eq!(got, [C]);
    radio.set_open_both(B, A, true);
    radio.send(Stamp(0), A, To::Node(B), b"x");
    assert_eq!(radio.deliver_due(Stamp(0)).unwrap().to, B);
}

#[test]
fn bytes_in_flight_are_bounded() {
    let link = Link { delay_micros: 1_000_000, ..Link::default() };
    let config = RadioConfig { link, in_flight_bytes_max: 1_000, ..RadioConfig::default() };
    let mut radio = RadioEmulator::new([A, B], config);
    for _ in 0..100 {
        radio.send(Stamp(0), A, To::Node(B), &[0; 100]);
    }
    assert_eq!(core::iter::from_fn(|| radio.deliver_due(Stamp(i64::MAX))).count(), 10);
    assert_eq!(radio.traffic(A).dropped, 90);
}

#[test]
fn nodes_that_do_not_exist_send_and_get_nothing() {
    let mut radio = radio(1, Link::default());
    radio.send(Stamp(0), RobotId(9), To::All, b"x");
    radio.send(Stamp(0), A, To::Node(RobotId(9)), b"x");
    radio.send(Stamp(0), A, To::Node(A), b"x");
    assert_eq!(radio.next_due(), None);
}
