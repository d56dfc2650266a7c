//! flockmap-sync
#![forbid(unsafe_code)]
