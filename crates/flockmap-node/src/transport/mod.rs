//! How datagrams leave a node and come to it.

mod udp;

use std::future::Future;
use std::io;

use flockmap::{Destination, RobotId};

pub(crate) use udp::is_unreachable;
pub use udp::{UdpError, UdpOptions, UdpSockets, UdpTransport};

/// A way for datagrams of up to 1,200 bytes between robots. They may be lost, doubled and reordered.
///
/// It lives on the one thread of its node, within a tokio runtime.
pub trait Transport: 'static {
    /// Waits for the next datagram and writes it to `buffer`; returns its length. Dropping the future loses nothing. An
    /// error is counted, and the node goes on.
    fn receive(&mut self, buffer: &mut [u8]) -> impl Future<Output = io::Result<usize>>;

    /// The datagram that [`receive`](Self::receive) gave last is sound, and this robot sent it: the place where it came
    /// from is where the robot can be reached.
    fn note_sender(&mut self, robot: RobotId);

    /// Sends a datagram, or drops it: to a robot that cannot be reached, or where the system has no room.
    fn send(&mut self, to: Destination, bytes: &[u8]) -> impl Future<Output = Sent>;
}

/// What became of a datagram.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Sent {
    /// Copies handed to the system.
    pub copies: u32,
    /// Copies that could not be sent.
    pub failed: u32,
}
