//! What a link between two nodes is like.

/// What happens to datagrams between one node and another. All draws are seeded; each link has random
/// numbers of its own, so what happens on one does not depend on the traffic of another.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Link {
    /// Share of datagrams that are lost, 0 … 1. Default 0.
    pub loss: f64,
    /// How long a datagram takes, in microseconds. Default 0. Negative times count as 0.
    pub delay_micros: i64,
    /// What it takes beyond that, uniform between 0 and this, in microseconds, drawn for each datagram: more
    /// than the time between two datagrams puts them out of order. Default 0.
    pub jitter_micros: i64,
    /// Share of the datagrams that arrive twice, each copy with its own jitter, 0 … 1. Default 0.
    pub duplication: f64,
    /// Bursts of loss, on top of `loss`. Default none.
    pub burst: Option<Burst>,
    /// Share of the datagrams that arrive with one to three flipped bits, 0 … 1. Default 0.
    pub damage: f64,
}

impl Link {
    /// A perfect link: everything arrives at once. The default.
    pub const PERFECT: Self =
        Self { loss: 0.0, delay_micros: 0, jitter_micros: 0, duplication: 0.0, burst: None, damage: 0.0 };
}

/// A link that is good and bad alternately (Gilbert, Elliott). How long each lasts is uniform between 0 and
/// twice its mean.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Burst {
    /// Mean time between bursts of loss, in milliseconds. At least 1.
    pub good_ms: u32,
    /// Mean time of a burst, in milliseconds. At least 1.
    pub bad_ms: u32,
    /// Share of the datagrams that are lost in a burst, 0 … 1.
    pub loss: f64,
}
