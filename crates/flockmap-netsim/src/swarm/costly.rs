//! A faulty robot sends packages that ask for far more work than their length allows, in the name of one
//! whose package is missing.

use flockmap::codec::{ContentKind, Header, Priority};
use flockmap::grid::VoxelBox;
use flockmap::sync::wire::{DatagramHeader, Kind, PackagesWriter};
use flockmap::{Codec, Package, Resolution, Stamp, Stream, Voxel};
use flockmap_worlds::random::Random;

/// Pauses between two such datagrams, in microseconds.
const PAUSE: i64 = 50_000;
const PAUSE_JITTER: u64 = 400_000;
/// A box of 64 × 64 × 64 blocks: nothing but to look at them is more than a payload of any length allows.
const SIDE: u32 = 512;

pub(super) struct Costly {
    random: Random,
    /// When it sends next.
    pub(super) next: i64,
}

impl Costly {
    pub(super) fn new(mut random: Random) -> Self {
        let next = random.below(PAUSE_JITTER) as i64;
        Self { random, next }
    }

    /// The next time; and which of so many robots gets a datagram now, from which.
    pub(super) fn pair(&mut self, now: i64, robots: usize) -> (usize, usize) {
        self.next = now + PAUSE + self.random.below(PAUSE_JITTER) as i64;
        let to = self.random.below(robots as u64) as usize;
        (to, (to + 1 + self.random.below(robots as u64 - 1) as usize) % robots)
    }

    /// A datagram with package `index` of the sender's stream, which says nothing at great cost.
    pub(super) fn datagram(
        &mut self,
        sender: Stream,
        index: u32,
        stamp: Stamp,
        resolution: Resolution,
    ) -> Option<Vec<u8>> {
        let corner = -(SIDE as i32) / 2;
        let header = Header {
            stream: sender,
            index,
            batch_start: stamp,
            batch_end: stamp,
            base: 0,
            is_independent: true,
            resolution,
            region: VoxelBox::new(Voxel::new(corner, corner, corner), [SIDE; 3])?,
            codec: Codec::Flock,
            content: ContentKind::Changes,
            lost_upto: None,
            changed_upto: None,
            says_upto: None,
            is_cut: false,
            is_of_all: false,
            priority: Priority::NearFree,
        };
        let payload: Vec<u8> = (0..8 + self.random.below(64)).map(|_| self.random.next_u64() as u8).collect();
        let package = Package::from_parts(&header, &payload, self.random.next_u64() as u32);
        let mut writer =
            PackagesWriter::new(DatagramHeader { kind: Kind::Packages, swarm: 0, sender, stamp }, 1_200);
        writer.push(&package).then(|| writer.finish())
    }
}
