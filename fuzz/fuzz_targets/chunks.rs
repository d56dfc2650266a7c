#![no_main]

#[path = "../../crates/flockmap-codec/tests/fuzz/mod.rs"]
#[allow(dead_code, reason = "each target uses a part of it")]
mod fuzz;

use std::cell::RefCell;

use fuzz::{Fuzz, chunks};

thread_local!(static FUZZ: RefCell<Fuzz> = RefCell::default());

libfuzzer_sys::fuzz_target!(|input: &[u8]| FUZZ.with_borrow_mut(|fuzz| chunks::run(fuzz, input)));
