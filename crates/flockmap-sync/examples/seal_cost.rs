//! What a swarm key costs: time and bytes of each datagram, beside the same datagram without a key.
//!
//! `cargo run --release -p flockmap-sync --example seal_cost`

use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_sync::SwarmKey;
use flockmap_sync::wire::{
    Datagram, DatagramHeader, Kind, PackagesWriter, SEAL_BYTES, SealedDatagram, seal_datagram,
};
use std::hint::black_box;
use std::time::Instant;

const ROUNDS: u64 = 200;
const REPEATS: u64 = 1_000;

/// The shortest of many repeats, in microseconds for each round: other work on the machine only adds.
fn time(mut work: impl FnMut(u64)) -> f64 {
    (0..REPEATS)
        .map(|repeat| {
            let began = Instant::now();
            for round in 0..ROUNDS {
                work(repeat * ROUNDS + round + 1);
            }
            began.elapsed().as_secs_f64() * 1e6 / ROUNDS as f64
        })
        .fold(f64::INFINITY, f64::min)
}

fn main() {
    let (salt, robot) = ([7; 16], Some(RobotId(2)));
    let key = SwarmKey::from_bytes(core::array::from_fn(|at| at as u8));
    let sender = Stream { origin: RobotId(1), epoch: 1_800_000_000 };
    let header = DatagramHeader { kind: Kind::Packages, swarm: 0, sender, stamp: Stamp(1) };
    let empty = PackagesWriter::new(header, 1_200).finish();
    println!("bytes   sealed   check unsealed µs   seal µs   open µs");
    for content in [0, 203, 476, 1_154] {
        // A record of a type that nobody knows is skipped: the time is that of the datagram, not of what is
        // in it.
        let mut plain = empty.clone();
        if content > 3 {
            let length = content - 3;
            plain.extend([99, length as u8 | 0x80, (length >> 7) as u8]);
            plain.extend((0..length).map(|at| at as u8));
        }
        let plain = with_check(plain);
        let sealed = seal_datagram(&key, &salt, &plain, robot, 1).expect("a datagram can be sealed");
        assert_eq!(sealed.len(), plain.len() + SEAL_BYTES);
        let check = time(|_| {
            black_box(Datagram::new_checked(black_box(&plain)).expect("it is sound"));
        });
        let seal = time(|counter| {
            black_box(seal_datagram(&key, &salt, black_box(&plain), robot, counter));
        });
        let open = time(|_| {
            let sealed = SealedDatagram::new_checked(black_box(&sealed)).expect("it is sealed");
            let opened = sealed.open(&key, &salt, RobotId(2));
            black_box(opened.expect("it is genuine").datagram().expect("it is sound"));
        });
        println!("{:5}   {:6}   {check:17.3}   {seal:7.3}   {open:7.3}", plain.len(), sealed.len());
    }
}

fn with_check(mut bytes: Vec<u8>) -> Vec<u8> {
    let check = crc32fast::hash(&[&bytes[..24], &bytes[28..]].concat());
    bytes[24..28].copy_from_slice(&check.to_le_bytes());
    bytes
}
