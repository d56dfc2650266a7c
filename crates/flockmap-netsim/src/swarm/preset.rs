//! Radios as they are met, as numbers. All of them are data: change a number here and the tables of the
//! swarms change.

use crate::{Burst, IP_UDP_BYTES, Link, RadioConfig};
use core::fmt;
use core::str::FromStr;

/// The least budget that a session takes, in bytes a second.
pub const BUDGET_MIN: u32 = flockmap::sync::BYTES_PER_S_MIN;

/// A radio that people use.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub enum RadioPreset {
    /// Cable: 0.2 ms, no loss, 100 Mbit/s a node.
    Lan,
    /// Good Wi-Fi on a shared channel: 2 ms + 3 ms of jitter, 1 % loss, 6 Mbit/s for all, 0.3 ms of air for
    /// each datagram.
    Wifi,
    /// Wi-Fi at its edge: 5 ms + 20 ms, 15 % loss and bursts of 300 ms every 4 s that take 80 %, 0.1 %
    /// damaged, 2 % twice.
    WifiLossy,
    /// A full channel: 20 ms + 60 ms, 5 % loss, 1 Mbit/s for all, a queue of 32 KiB, bursts of 100 ms every
    /// second that take half.
    WifiCongested,
    /// A mesh in a row, each node hears the next one only: 10 ms + 10 ms a hop, 5 % loss, 2 Mbit/s a node.
    MeshLine,
    /// Contact that comes and goes: 15 ms + 15 ms, 10 % loss, 3 s of contact and 2 s without on the mean, 2
    /// Mbit/s a node.
    Intermittent,
    /// A long-range modem, 50 kbit/s half-duplex for all: 30 ms + 20 ms, 3 % loss, 10 ms of preamble for each
    /// datagram, a queue of 8 KiB. (A modem with such a rate splits datagrams into its own frames.)
    Lora,
}

/// Who hears whom.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Topology {
    /// Everyone hears everyone.
    Full,
    /// Each hears the one before and the one after.
    Line,
    /// As the line, and the last hears the first.
    Ring,
    /// The first hears all, the others hear only the first.
    Star,
}

/// The numbers of a radio.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct RadioNumbers {
    /// Each link and the air. Without a seed: that of the flight is used.
    pub config: RadioConfig,
    /// Who hears whom.
    pub topology: Topology,
    /// Budget of a robot in bytes a second, where the radio is one node's own. Of a shared one each robot
    /// gets its part of 70 % of the rate.
    pub budget_bytes_per_s: Option<u32>,
}

impl RadioPreset {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::Lan,
        Self::Wifi,
        Self::WifiLossy,
        Self::WifiCongested,
        Self::MeshLine,
        Self::Intermittent,
        Self::Lora,
    ];

    /// Its numbers.
    pub fn numbers(self) -> RadioNumbers {
        let node = RadioConfig { overhead_bytes: IP_UDP_BYTES, ..RadioConfig::default() };
        let mesh = RadioConfig { rate_bytes_per_s: Some(250_000), ..node };
        let wifi = RadioConfig {
            rate_bytes_per_s: Some(750_000),
            is_shared: true,
            airtime_overhead_micros: 300,
            ..node
        };
        let config = match self {
            Self::Lan => RadioConfig { link: link(200, 0, 0.0), rate_bytes_per_s: Some(12_500_000), ..node },
            Self::Wifi => RadioConfig { link: link(2_000, 3_000, 0.01), ..wifi },
            Self::WifiLossy => {
                let burst = Some(Burst { good_ms: 4_000, bad_ms: 300, loss: 0.8 });
                let link = Link { duplication: 0.02, damage: 0.001, burst, ..link(5_000, 20_000, 0.15) };
                RadioConfig { link, ..wifi }
            }
            Self::WifiCongested => {
                let burst = Some(Burst { good_ms: 1_000, bad_ms: 100, loss: 0.5 });
                RadioConfig {
                    link: Link { burst, ..link(20_000, 60_000, 0.05) },
                    rate_bytes_per_s: Some(125_000),
                    airtime_overhead_micros: 500,
                    queue_bytes_max: 32 << 10,
                    ..wifi
                }
            }
            Self::MeshLine => {
                RadioConfig { link: link(10_000, 10_000, 0.05), airtime_overhead_micros: 300, ..mesh }
            }
            Self::Intermittent => {
                let burst = Some(Burst { good_ms: 3_000, bad_ms: 2_000, loss: 1.0 });
                RadioConfig { link: Link { burst, ..link(15_000, 15_000, 0.1) }, ..mesh }
            }
            Self::Lora => RadioConfig {
                link: link(30_000, 20_000, 0.03),
                rate_bytes_per_s: Some(6_250),
                airtime_overhead_micros: 10_000,
                queue_bytes_max: 8 << 10,
                ..wifi
            },
        };
        let budget = if matches!(self, Self::MeshLine | Self::Intermittent) { 150_000 } else { 2_000_000 };
        let topology = if self == Self::MeshLine { Topology::Line } else { Topology::Full };
        RadioNumbers { config, topology, budget_bytes_per_s: Some(budget) }
    }

    /// Its name, as the program has it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Lan => "lan",
            Self::Wifi => "wifi",
            Self::WifiLossy => "wifi_lossy",
            Self::WifiCongested => "wifi_congested",
            Self::MeshLine => "mesh_line",
            Self::Intermittent => "intermittent",
            Self::Lora => "lora",
        }
    }
}

/// A link with nothing but delay, jitter and plain loss.
const fn link(delay_micros: i64, jitter_micros: i64, loss: f64) -> Link {
    Link { delay_micros, jitter_micros, loss, ..Link::PERFECT }
}

impl RadioNumbers {
    /// What one of so many robots may send in a second, at least [`BUDGET_MIN`].
    pub fn budget(&self, robots: usize) -> Option<u32> {
        let shared = self.config.rate_bytes_per_s.filter(|_| self.config.is_shared);
        let part = shared.map(|rate| (u64::from(rate) * 7 / 10 / robots.max(1) as u64) as u32);
        part.or(self.budget_bytes_per_s).map(|budget| budget.max(BUDGET_MIN))
    }

    /// Links between the robots 0 … n − 1, both directions alike.
    pub(super) fn is_linked(&self, a: usize, b: usize, robots: usize) -> bool {
        let (low, high) = (a.min(b), a.max(b));
        match self.topology {
            Topology::Full => a != b,
            Topology::Line => high - low == 1,
            Topology::Ring => high - low == 1 || (low == 0 && high == robots - 1 && a != b),
            Topology::Star => low == 0 && a != b,
        }
    }

    /// Most hops between two of so many robots.
    pub(super) const fn hops(&self, robots: usize) -> usize {
        match self.topology {
            Topology::Full => 1,
            Topology::Line => robots - 1,
            Topology::Ring => robots / 2,
            Topology::Star => 2,
        }
    }
}

impl fmt::Display for RadioPreset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for RadioPreset {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|preset| preset.name() == name).ok_or_else(|| {
            format!("unknown radio \"{name}\"; known are {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}
