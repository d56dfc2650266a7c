#![no_main]

#[path = "../../crates/flockmap-store/tests/fuzz/store.rs"]
#[allow(dead_code, reason = "the target uses a part of it")]
mod store;

libfuzzer_sys::fuzz_target!(|input: &[u8]| store::run(input));
