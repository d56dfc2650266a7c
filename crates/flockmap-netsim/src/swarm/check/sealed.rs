//! With a key: `nonce`, no two datagrams of a swarm are sealed with the same salt, recipient and counter; and
//! `key`, nothing that an outsider made or changed is believed, and no datagram counts twice at a run of a
//! robot.

use super::Finding;
use flockmap::sync::wire::{Salt, SealedDatagram};
use flockmap::{RobotId, Stream};
use rustc_hash::FxHashSet;

const NONCE: &str = "nonce";
const KEY: &str = "key";

/// All sealed datagrams of a flight.
#[derive(Default)]
pub(in crate::swarm) struct Sealed {
    sent: FxHashSet<(Salt, Option<RobotId>, u64)>,
    /// Receiver, sender, whether it was for the receiver only, counter.
    taken: FxHashSet<(Stream, Stream, bool, u64)>,
}

impl Sealed {
    /// A robot with a key sends, to one or (`to` is `None`) to all.
    pub(in crate::swarm) fn sent(
        &mut self,
        to: Option<RobotId>,
        salt: Salt,
        bytes: &[u8],
    ) -> Option<Finding> {
        let Ok(datagram) = SealedDatagram::new_checked(bytes) else {
            return Some(Finding::new(KEY, "a sealed datagram", "one that is not"));
        };
        let (sender, counter) = (datagram.sender(), datagram.counter());
        (!self.sent.insert((salt, to, counter))).then(|| {
            let expected = format!("a counter that {sender:?} has not used for {to:?} before");
            Finding::new(NONCE, expected, format!("{counter} again"))
        })
    }

    /// A robot has accepted a datagram. `is_genuine`: it is as a robot sent it.
    pub(in crate::swarm) fn taken(
        &mut self,
        receiver: Stream,
        bytes: &[u8],
        is_genuine: bool,
    ) -> Option<Finding> {
        let datagram = SealedDatagram::new_checked(bytes).ok();
        let Some(datagram) = datagram.filter(|_| is_genuine) else {
            return Some(Finding::new(KEY, "that what an outsider made is refused", "it was taken"));
        };
        let (sender, counter) = (datagram.sender(), datagram.counter());
        // Own ones that are heard back are counted, and nothing else.
        let is_new = sender.origin == receiver.origin
            || self.taken.insert((receiver, sender, datagram.is_for_one(), counter));
        (!is_new)
            .then(|| Finding::new(KEY, format!("datagram {counter} of {sender:?} taken once"), "taken again"))
    }
}
