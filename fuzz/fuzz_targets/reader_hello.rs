#![no_main]

#[path = "../../crates/flockmap-feed/tests/fuzz/mod.rs"]
#[allow(dead_code, reason = "each target uses a part of it")]
mod fuzz;

libfuzzer_sys::fuzz_target!(|input: &[u8]| fuzz::hello(input));
