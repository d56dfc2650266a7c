//! flockmap-codec
#![forbid(unsafe_code)]
