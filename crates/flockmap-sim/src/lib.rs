//! flockmap-sim
