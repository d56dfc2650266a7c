//! From how many robots on a swarm is a crowd.

/// Peers of a small swarm: of more, what each sends adds up on the radio.
pub(crate) const SMALL_SWARM: usize = 8;
/// With more than these, one request of each already takes seconds of a thin radio.
pub(crate) const LARGE_CROWD: usize = 24;
