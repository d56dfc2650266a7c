//! From how many peers on a swarm is a crowd.

/// Peers of a small swarm: of more, what each sends adds up on the radio.
pub(crate) const SMALL_SWARM: usize = 8;
