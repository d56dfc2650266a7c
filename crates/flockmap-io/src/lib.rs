//! flockmap-io
