//! flockmap
#![forbid(unsafe_code)]
