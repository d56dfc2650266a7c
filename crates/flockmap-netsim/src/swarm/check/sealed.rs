//! With a key: `nonce`, no two datagrams of a swarm are sealed with the same salt, recipient and counter; and `key`, nothing that an outsider made or
//! changed is believed, and no datagram counts twice at a run of a robot.

use super::Finding;
use flockmap::sync::wire::{Salt, SealedDatagram};
use flockmap::{Destination, RobotId, Stream};
use rustc_hash::FxHashSet;

const NONCE: &str = "nonce";
const KEY: &str = "key";

/// All sealed datagrams of a flight.
#[derive(Default)]
pub(in crate::swarm) struct Sealed {
    sent: FxHashSet<(Salt, Option<RobotId>, u64)>,
    /// Receiver, sender, whether it was for the receiver alone, counter.
    taken: FxHashSet<(Stream, Stream, bool, u64)>,
}

impl Sealed {
    /// A robot with a key sends.
    pub(in crate::swarm) fn sent(&mut self, to: Destination, salt: Salt, bytes: &[u8]) -> Option<Finding> {
        let Ok(datagram) = SealedDatagram::new_checked(bytes) else {
            let expected = "a sealed datagram".to_owned();
            return Some(Finding { checker: KEY, expected, found: "one that is not".to_owned() });
        };
        let (sender, counter) = (datagram.sender(), datagram.counter());
        let recipient = match to {
            Destination::Peer(robot) => Some(robot),
            Destination::Everyone => None,
        };
        (!self.sent.insert((salt, recipient, counter))).then(|| Finding {
            checker: NONCE,
            expected: format!("a counter that {sender:?} has not used for {recipient:?} before"),
            found: format!("{counter} again"),
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
            let expected = "that what an outsider made is refused".to_owned();
            return Some(Finding { checker: KEY, expected, found: "it was taken".to_owned() });
        };
        let (sender, counter) = (datagram.sender(), datagram.counter());
        // Own ones that are heard back are counted, and nothing else.
        let is_new = sender.origin == receiver.origin
            || self.taken.insert((receiver, sender, datagram.is_for_one(), counter));
        (!is_new).then(|| Finding {
            checker: KEY,
            expected: format!("datagram {counter} of {sender:?} taken once"),
            found: "taken again".to_owned(),
        })
    }
}
