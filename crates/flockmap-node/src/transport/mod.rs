//! How datagrams leave a node and come to it.

mod addresses;
mod check;
mod options;
mod udp;

use std::future::Future;
use std::io;

use flockmap::{Path, Transmit};

pub use options::{UdpError, UdpOptions};
pub(crate) use udp::is_unreachable;
pub use udp::{UdpSockets, UdpTransport};

/// Carries datagrams of up to 1,200 bytes between robots. They may be lost, doubled and reordered.
///
/// It lives on the one thread of its node, within a tokio runtime.
pub trait Transport: 'static {
    /// Whether others may be heard on it. Where not, nobody wonders at that.
    const HEARS_OTHERS: bool = true;

    /// Bytes that it adds to a datagram, counted in budgets. Default 28: IPv4 and UDP headers.
    const OVERHEAD_BYTES: u32 = 28;

    /// Waits for the next datagram and writes it to `buffer`; returns its length, and the path on which it
    /// came: the same for all that come from one address, and never that of another address. Dropping the
    /// future loses nothing. An error is counted, and the node goes on.
    fn receive(&mut self, buffer: &mut [u8]) -> impl Future<Output = io::Result<(usize, Path)>>;

    /// On these paths robots are reached, from now on until the next call: what is for everyone goes there
    /// too, and they are not forgotten.
    fn set_paths(&mut self, paths: &[Path]);

    /// Sends a datagram, or drops it where the system has no room: one for a robot on its path and nowhere
    /// else, without a path not at all; one for everyone to all who are configured, and on the paths that
    /// were set.
    fn send(&mut self, transmit: &Transmit) -> impl Future<Output = SendResult>;
}

/// What became of a datagram.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct SendResult {
    /// Copies handed to the system.
    pub copies: u32,
    /// Copies that could not be sent.
    pub failed: u32,
}

/// No radio at all: for a node that gets packages of others by another way, [`flockmap::Robot::receive_package`].
#[derive(Clone, Copy, Debug, Default)]
pub struct NoRadio;

impl Transport for NoRadio {
    const HEARS_OTHERS: bool = false;

    async fn receive(&mut self, _: &mut [u8]) -> io::Result<(usize, Path)> {
        std::future::pending().await
    }

    fn set_paths(&mut self, _: &[Path]) {}

    async fn send(&mut self, _: &Transmit) -> SendResult {
        SendResult::default()
    }
}
