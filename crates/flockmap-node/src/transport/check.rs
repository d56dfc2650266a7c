//! Addresses of a configuration that cannot work: with each other, or at all.

use std::net::{IpAddr, SocketAddr, ToSocketAddrs as _, UdpSocket};

use super::options::{UdpError, UdpOptions};

/// The addresses of the robots that are configured, each once.
pub(super) fn look_up(options: &UdpOptions) -> Result<Vec<SocketAddr>, UdpError> {
    let mut peers = Vec::with_capacity(options.peers.len());
    for peer in &options.peers {
        let fail = |error: &str| {
            fail(format!(
                "peers has \"{peer}\"{error}, expected ADDRESS:PORT, [ADDRESS]:PORT or NAME:PORT of a robot"
            ))
        };
        let found = peer.to_socket_addrs().map_err(|error| fail(&format!(" ({error})")))?;
        // A socket that was bound to IPv4 cannot reach the rest.
        let found = found.min_by_key(|address| address.is_ipv4() != options.bind.is_ipv4());
        let found = found.ok_or_else(|| fail(" (the name has no address)"))?;
        if peers.contains(&found) {
            return Err(self::fail(format!("peers has {found} twice, expected each robot once")));
        }
        peers.push(found);
    }
    Ok(peers)
}

/// Checks what can be known without the system.
pub(super) fn check(options: &UdpOptions, peers: &[SocketAddr]) -> Result<(), UdpError> {
    let UdpOptions { bind, broadcast, multicast, .. } = options;
    for peer in peers {
        check_peer(*peer, *bind)?;
    }
    if let (Some(_), Some(group)) = (broadcast, multicast) {
        return Err(fail(format!("multicast is {group}, and broadcast is given too, expected one of them")));
    }
    if let Some(group) = multicast {
        if !group.ip().is_multicast() {
            return Err(fail(format!(
                "multicast is {group}, expected a group: 224.0.0.0 to 239.255.255.255, or an IPv6 address that starts with ff"
            )));
        }
        if group.is_ipv4() != bind.is_ipv4() {
            return Err(fail(format!(
                "multicast is {group}, expected the same IP version as bind, which is {bind}"
            )));
        }
    }
    if let Some(address) = broadcast {
        if address.is_ipv6() || bind.is_ipv6() {
            return Err(fail(format!(
                "broadcast is {address} with bind = {bind}: IPv6 has no broadcast, expected multicast in place of it"
            )));
        }
        if address.ip().is_unspecified() || address.ip().is_multicast() {
            return Err(fail(format!(
                "broadcast is {address}, expected the broadcast address of a network, such as 10.0.0.255:7700"
            )));
        }
    }
    for (key, address) in [("broadcast", broadcast), ("multicast", multicast)] {
        if let Some(address) = address.filter(|address| address.port() == 0) {
            return Err(fail(format!("{key} is {address}, expected the port where the others listen")));
        }
    }
    Ok(())
}

fn check_peer(peer: SocketAddr, bind: SocketAddr) -> Result<(), UdpError> {
    let expected = match peer.ip() {
        _ if peer.port() == 0 => "the port where that robot listens",
        ip if ip.is_unspecified() => "the address of another robot; 0.0.0.0 and [::] are for bind",
        ip if ip.is_multicast() => "the address of one robot; a group belongs into multicast",
        IpAddr::V4(ip) if ip.is_broadcast() => "the address of one robot; this one belongs into broadcast",
        IpAddr::V6(_) if bind.is_ipv4() => {
            return Err(fail(format!(
                "peers has {peer}, which is IPv6, and bind is {bind}, which is IPv4, expected bind = \"[::]:PORT\" to reach both"
            )));
        }
        _ => return Ok(()),
    };
    Err(fail(format!("peers has {peer}, expected {expected}")))
}

/// A robot that sends to itself takes its own datagrams for those of another robot with its id.
pub(super) fn refuse_itself(peers: &[SocketAddr], own: SocketAddr) -> Result<(), UdpError> {
    // Only addresses of this machine can be bound.
    let is_here = |ip: IpAddr| UdpSocket::bind((ip, 0)).is_ok();
    let is_own = |peer: &&SocketAddr| {
        let ip = peer.ip().to_canonical();
        peer.port() == own.port()
            && (ip == own.ip().to_canonical() || (own.ip().is_unspecified() && is_here(ip)))
    };
    match peers.iter().find(is_own) {
        Some(peer) => Err(fail(format!(
            "peers has {peer}, which is this robot itself, as it listens on {own}, expected the addresses of the others"
        ))),
        None => Ok(()),
    }
}

fn fail(text: String) -> UdpError {
    UdpError::Options(text)
}
