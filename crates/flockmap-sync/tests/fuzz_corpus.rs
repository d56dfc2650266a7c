//! What the fuzzer runs, on inputs made here and on what it found: `tests/corpus/TARGET`, see `fuzz/README.md`.

#[path = "../../flockmap-codec/tests/common/random.rs"]
mod random;

mod fuzz;

use std::path::Path;

use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_sync::Counters;
use fuzz::made::{self, Maker};
use fuzz::{Choices, datagram, package, request, session};
use random::Random;

/// Runs the finds in the folder of a target, if there are any, and inputs made here.
fn replay(target: &str, made: impl IntoIterator<Item = Vec<u8>>, run: impl Fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(target);
    if let Ok(entries) = std::fs::read_dir(folder) {
        let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
        files.sort();
        for file in files {
            println!("{}", file.display());
            run(&std::fs::read(file).unwrap());
        }
    }
    for (number, input) in made.into_iter().enumerate() {
        println!("input {number} of {target}");
        run(&input);
    }
}

/// Bytes from a seed, often small, as the choices want them.
fn bytes(seed: u64, length: usize) -> Vec<u8> {
    let mut random = Random(seed);
    (0..length)
        .map(|_| match random.next() % 3 {
            0 => (random.next() % 16) as u8,
            _ => random.next() as u8,
        })
        .collect()
}

/// Datagrams of both kinds that say something, whole and with bytes changed.
fn datagrams() -> Vec<Vec<u8>> {
    let mut maker = Maker::new();
    let mut all = Vec::new();
    for seed in 0..150 {
        let input = bytes(seed, 300);
        let mut choices = Choices::new(&input);
        for mut bytes in
            [made::request(&mut choices, Stamp(9)), made::packages(&mut choices, &mut maker, Stamp(9))]
        {
            all.push(bytes.clone());
            for _ in 0..3 {
                let at = choices.below(1_200) as usize % bytes.len();
                bytes[at] ^= 1 << (seed % 8);
            }
            all.push(bytes);
        }
    }
    all
}

#[test]
fn datagrams_do_no_harm() {
    replay("datagram", datagrams(), datagram::run);
}

#[test]
fn requests_have_one_form() {
    let inputs = datagrams().into_iter().enumerate().map(|(n, bytes)| [&[n as u8][..], &bytes].concat());
    replay("request", inputs, request::run);
}

#[test]
fn packages_travel_as_they_are() {
    let mut maker = Maker::new();
    let mut inputs = Vec::new();
    for index in [1, 7, u32::MAX] {
        let stream = Stream { origin: RobotId(3), epoch: index.into() };
        inputs.push(maker.package(stream, index, index == 7).bytes().to_vec());
        inputs.extend(
            maker.chunks(stream, (index / 2, index), 4, 1).iter().map(|chunk| chunk.bytes().to_vec()),
        );
    }
    let changed: Vec<Vec<u8>> = inputs
        .iter()
        .flat_map(|honest| {
            (0..honest.len().min(60)).map(move |at| {
                let mut bytes = honest.clone();
                bytes[at] ^= 1 << (at % 8);
                bytes
            })
        })
        .collect();
    replay("package", inputs.into_iter().chain(changed), package::run);
}

#[test]
fn sessions_hold_their_limits() {
    let inputs = (0..150).map(|seed| bytes(seed, 200 + 20 * seed as usize));
    let reached = std::cell::RefCell::new(Vec::new());
    replay("session", inputs, |input| reached.borrow_mut().push(session::run(input)));
    // The inputs come to all that matters, or the limits would hold for nothing.
    for (what, count) in [
        ("accepted", (|c| c.accepted) as fn(&Counters) -> u64),
        ("rejected", |c| c.rejected),
        ("undecodable", |c| c.undecodable),
        ("sent", |c| c.sent),
        ("confirmed", |c| c.confirmed),
        ("lost", |c| c.lost),
        ("delayed by the window", |c| c.delayed_by_window),
        ("delayed by the budget", |c| c.delayed_by_budget),
        ("chunks accepted", |c| c.chunks_accepted),
        ("chunks sent", |c| c.chunks_sent),
        ("caught up", |c| c.caught_up),
        ("too many transfers", |c| c.too_many_transfers),
        ("too many peers", |c| c.too_many_peers),
        ("too many streams", |c| c.too_many_streams),
        ("malformed", |c| c.malformed),
        ("snapshots asked for", |c| c.snapshots_wanted),
        ("snapshots refused", |c| c.snapshots_unusable),
    ] {
        let sum: u64 = reached.borrow().iter().map(count).sum();
        println!("{what}: {sum}");
        assert!(sum > 0, "no input comes to: {what}");
    }
}
