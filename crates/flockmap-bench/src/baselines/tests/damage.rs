//! Damaged messages are errors or other maps, never a panic.

use proptest::prelude::*;

use super::{Random, Run, config};
use crate::baselines::Method;

/// A flight that is long enough for the method to send something.
fn scans(method: Method) -> i64 {
    if method == Method::OctomapDiff10s { 110 } else { 25 }
}

#[test]
fn a_message_cut_short_or_with_flipped_bits_never_panics() {
    for method in Method::ALL {
        let run = Run::new(method, 3, scans(method));
        let message = run.messages.iter().max_by_key(|message| message.len()).expect("something is sent");
        let mut random = Random::new(7);
        let mut refused = 0;
        for round in 0..60 {
            let mut receiver = method.receiver(&config()).unwrap();
            let mut bytes = message.clone();
            // Where a message says how much comes, and anywhere.
            let reach = if round % 2 == 0 { 64.min(bytes.len()) } else { bytes.len() };
            let at = random.next() as usize % reach;
            if round % 3 == 0 {
                bytes.truncate(at);
            } else {
                bytes[at] ^= 1 << (random.next() % 8);
            }
            refused += usize::from(receiver.receive(&bytes).is_err());
        }
        assert!(refused > 12, "{method}: {refused} of 60 refused");
    }
}

#[test]
fn bytes_after_the_end_are_refused() {
    for method in Method::ALL {
        let run = Run::new(method, 4, scans(method));
        let mut message = run.messages.last().expect("something is sent").clone();
        message.push(1);
        assert!(method.receiver(&config()).unwrap().receive(&message).is_err(), "{method}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400), small in any::<bool>()) {
        // Small numbers get further.
        let bytes: Vec<u8> = bytes.into_iter().map(|byte| if small { byte & 3 } else { byte }).collect();
        for method in Method::ALL {
            let _ = method.receiver(&config()).unwrap().receive(&bytes);
        }
    }
}
