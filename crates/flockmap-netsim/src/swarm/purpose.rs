//! Each part of the settings has random numbers of its own, so that an option given does not shift the others.

use flockmap_worlds::random::Random;

/// The random numbers of one robot, by its number, for one purpose.
pub(super) fn of_robot(seed: u64, purpose: u64, number: usize) -> Random {
    Random::new(seed, purpose + ((number as u64) << 32))
}

pub(super) const SWARM: u64 = 0x5357_0001;
pub(super) const RADIO: u64 = 0x5357_0002;
pub(super) const SESSION: u64 = 0x5357_0003;
pub(super) const ROBOT: u64 = 0x5357_0004;
pub(super) const PLAN: u64 = 0x5357_0005;
pub(super) const WORLD: u64 = 0x5357_0006;
pub(super) const SCANS: u64 = 0x5357_0007;
pub(super) const BROKEN: u64 = 0x5357_0008;
pub(super) const OUTSIDER: u64 = 0x5357_0009;
pub(super) const TROUBLE: u64 = 0x5357_000a;
pub(super) const FIELD: u64 = 0x5357_000b;
pub(super) const LIMITS: u64 = 0x5357_000c;
pub(super) const CLOCKS: u64 = 0x5357_000d;
pub(super) const DISK: u64 = 0x5357_000e;
pub(super) const RUNS: u64 = 0x5357_000f;
pub(super) const COSTLY: u64 = 0x5357_0010;
pub(super) const CAPS: u64 = 0x5357_0011;
pub(super) const PIECES: u64 = 0x5357_0012;
pub(super) const CROWD: u64 = 0x5357_0013;
pub(super) const SUBMAPS: u64 = 0x5357_0014;
