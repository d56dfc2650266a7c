//! flockmap-node
