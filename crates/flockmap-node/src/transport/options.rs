//! Where a node listens and whom it sends to.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};

use schemars::JsonSchema;
use serde::Deserialize;

/// Where to listen and whom to send to: `[network]`.
#[derive(Clone, PartialEq, Eq, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct UdpOptions {
    /// Own address and port. Port 0: the system chooses. `[::]` serves IPv4 too. Default `0.0.0.0:7700`.
    pub bind: SocketAddr,
    /// Robots that are sent to before they were heard, as `ADDRESS:PORT` or `NAME:PORT`; names are looked up
    /// once. Those heard from elsewhere are sent to there once an answer has come back from there.
    pub peers: Vec<String>,
    /// What is for everyone goes here in one datagram. IPv4.
    pub broadcast: Option<SocketAddr>,
    /// What is for everyone goes to this group in one datagram. IPv4 or IPv6.
    pub multicast: Option<SocketAddr>,
    /// Address of the interface for an IPv4 group; default: the system chooses.
    pub multicast_interface: Option<Ipv4Addr>,
    /// Index of the interface for an IPv6 group; default 0: the system chooses.
    pub multicast_interface_index: u32,
    /// How many networks a datagram to the group may cross. Default 1: the own one.
    pub multicast_ttl: u32,
    /// Room for datagrams that were not read yet, in KiB, if the system grants it. Default 4,096.
    pub receive_buffer_kb: u32,
    /// Room for datagrams that were not sent yet, in KiB, if the system grants it. Default 1,024.
    pub send_buffer_kb: u32,
}

impl UdpOptions {
    /// The defaults, listening at this address.
    pub const fn new(bind: SocketAddr) -> Self {
        Self {
            bind,
            peers: Vec::new(),
            broadcast: None,
            multicast: None,
            multicast_interface: None,
            multicast_interface_index: 0,
            multicast_ttl: 1,
            receive_buffer_kb: 4_096,
            send_buffer_kb: 1_024,
        }
    }
}

impl Default for UdpOptions {
    fn default() -> Self {
        Self::new(SocketAddr::from(([0, 0, 0, 0], 7_700)))
    }
}

/// Why the sockets could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum UdpError {
    /// The options do not fit together.
    #[error("[network] {0}")]
    Options(String),
    /// The system refused.
    #[error("cannot {what} {address}: {error}")]
    System {
        /// What was asked of it.
        what: &'static str,
        /// The address in question.
        address: SocketAddr,
        /// Its answer.
        error: io::Error,
    },
}
