//! What each method does, and what it does not.

use flockmap::grid::{Changes, Stamp, State, Voxel};

use super::{Run, batch, config, state};
use crate::baselines::{Method, Receiver, Sender};

#[test]
fn a_lossless_method_gives_exactly_what_was_packed() {
    for method in Method::ALL.into_iter().filter(|method| method.is_lossless()) {
        for seed in 1..3 {
            let run = Run::new(method, seed, 20);
            assert!(run.truth().len() > 5_000, "too easy");
            assert!(run.received() == run.truth(), "{method}, seed {seed}");
            if let Some(layer) = run.receiver.layer() {
                assert_eq!(layer.digest(), run.truth.digest(), "{method}: stamps");
            }
            let voxel = *run.truth().keys().next().unwrap();
            assert_eq!(run.state(voxel), run.truth.state(voxel));
        }
    }
}

#[test]
fn a_lossy_method_is_not_called_lossless() {
    for method in Method::ALL.into_iter().filter(|method| !method.is_lossless()) {
        let run = Run::new(method, 1, 130);
        let (received, truth) = (run.received(), run.truth());
        assert!(received != truth, "{method}");
        let equal = received.iter().filter(|(voxel, state)| truth.get(voxel) == Some(state)).count();
        assert!(equal * 2 > truth.len(), "{method}: {equal} of {} arrive", truth.len());
    }
}

#[test]
fn equal_flights_give_equal_messages() {
    for method in Method::ALL {
        assert!(Run::new(method, 5, 12).messages == Run::new(method, 5, 12).messages, "{method}");
    }
}

/// A method that is given changes by hand.
struct ByHand {
    sender: Box<dyn Sender>,
    receiver: Box<dyn Receiver>,
}

impl ByHand {
    fn new(method: Method) -> Self {
        let config = config();
        Self { sender: method.sender(&config), receiver: method.receiver(&config).unwrap() }
    }

    /// The bytes of the messages.
    fn batch(&mut self, ms: i64, changes: &Changes) -> usize {
        let mut out = Vec::new();
        let now = Stamp(ms * 1_000);
        self.sender.batch(now, &batch(now), changes, &mut out).unwrap();
        out.iter().for_each(|message| self.receiver.receive(message).unwrap());
        out.iter().map(Vec::len).sum()
    }
}

/// Voxels of the block at the origin, by their number in it.
fn of_block(numbers: core::ops::Range<i32>, state: State) -> Changes {
    Changes::from_voxels(numbers.map(|n| (Voxel::new(n & 7, n >> 3 & 7, n >> 6), state)))
}

#[test]
fn gvp_sends_a_block_that_is_nearly_known_at_once_and_a_tail_never() {
    let mut gvp = ByHand::new(Method::Gvp);
    assert_eq!(gvp.batch(0, &of_block(0..499, State::Free)), 0, "499 of 512 are 97.46 %");
    assert_eq!(gvp.batch(100, &of_block(499..500, State::Occupied)), 8 + 128);
    assert_eq!(state(&*gvp.receiver, Voxel::new(0, 0, 0)), State::Free);
    // Later changes wait for 15 % and 2 s.
    assert_eq!(gvp.batch(9_000, &of_block(0..76, State::Occupied)), 0, "76 of 512 are 14.8 %");
    assert_eq!(state(&*gvp.receiver, Voxel::new(0, 0, 0)), State::Free, "stale");
    assert_eq!(gvp.batch(9_100, &of_block(76..77, State::Occupied)), 8 + 128);
    assert_eq!(state(&*gvp.receiver, Voxel::new(0, 0, 0)), State::Occupied);
    assert_eq!(gvp.batch(20_000, &of_block(100..110, State::Occupied)), 0, "a tail is not flushed");
}

#[test]
fn gvp_waits_two_seconds_for_a_block_that_is_not_known_well() {
    let mut gvp = ByHand::new(Method::Gvp);
    assert_eq!(gvp.batch(0, &of_block(0..200, State::Free)), 0);
    assert_eq!(gvp.batch(1_999, &of_block(200..201, State::Free)), 0);
    assert_eq!(gvp.batch(2_000, &of_block(201..202, State::Free)), 136);
    // A block all of one state is 8 bytes.
    assert_eq!(gvp.batch(2_500, &of_block(202..512, State::Free)), 8);
}

#[test]
fn marble_sends_every_ten_seconds_and_only_if_it_is_worth_it() {
    let mut marble = ByHand::new(Method::OctomapDiff10s);
    let rod = |from: i32, state| {
        Changes::from_voxels((from..from + 1_500).map(move |x| (Voxel::new(x, 0, 0), state)))
    };
    assert_eq!(marble.batch(500, &rod(0, State::Free)), 0);
    assert!(marble.batch(10_000, &rod(3_000, State::Free)) > 0);
    assert_eq!(state(&*marble.receiver, Voxel::new(0, 0, 0)), State::Free);
    // There and back is no change, and a few voxels are not worth a message.
    assert_eq!(marble.batch(12_000, &rod(0, State::Occupied)), 0);
    assert_eq!(marble.batch(15_000, &rod(0, State::Free)), 0);
    assert_eq!(marble.batch(20_000, &of_block(0..5, State::Occupied)), 0);
    assert_eq!(state(&*marble.receiver, Voxel::new(0, 0, 0)), State::Free, "stale");
}

#[test]
fn colag_lists_what_is_unknown_again_and_again() {
    let mut colag = ByHand::new(Method::Colag);
    let corners = |a: i32, b: i32| {
        Changes::from_voxels([(Voxel::new(a, a, a), State::Free), (Voxel::new(b, b, b), State::Occupied)])
    };
    let head = 1 + 12 + 3 + 1;
    assert_eq!(colag.batch(0, &corners(0, 9)), head + 4 * 999, "one free voxel in 1,000");
    assert_eq!(colag.batch(500, &corners(0, 9)), head + 4 * 999, "sent before, sent again");
    let mut blocks = ByHand::new(Method::ColagBlocks);
    assert!(blocks.batch(0, &corners(0, 9)) < 50);
}

#[test]
fn what_has_no_room_in_the_form_of_a_method_is_an_error() {
    let far = Changes::from_voxels([(Voxel::new(1 << 20, 0, 0), State::Free)]);
    let wide = Changes::from_voxels([
        (Voxel::new(0, 0, 0), State::Free),
        (Voxel::new(1 << 20, 1 << 20, 9), State::Free),
    ]);
    for (method, changes, expected) in [
        (Method::OctomapDiff, &far, "octomap-diff cannot send this"),
        (Method::Colag, &wide, "colag cannot send this"),
    ] {
        let mut by_hand = ByHand::new(method);
        let error = by_hand.sender.batch(Stamp(0), &batch(Stamp(0)), changes, &mut Vec::new());
        assert!(error.unwrap_err().to_string().contains(expected));
    }
    let mut near = ByHand::new(Method::AddressDeltaZstd);
    assert!(near.batch(0, &wide) < 60, "a list does not mind a wide box");
}
