//! Datagrams over UDP: to each robot at its address, by broadcast, or by multicast.

use std::future::poll_fn;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::task::Poll;
use std::time::Duration;

use flockmap::{Destination, Path, Transmit};
use socket2::{Domain, Protocol, Socket, Type};
use tokio::io::ReadBuf;

use super::addresses::Addresses;
use super::check::{check, look_up, refuse_itself};
use super::options::{UdpError, UdpOptions};
use super::{SendResult, Transport};
use crate::advice::{listen_error, with};

/// A radio whose queue stays full for so long loses the datagram, which is repaired later; the node must go on.
const SEND_WAIT_MAX: Duration = Duration::from_millis(20);

/// Sockets that are open. Datagrams wait in them until [`into_transport`](Self::into_transport).
#[derive(Debug)]
pub struct UdpSockets {
    main: UdpSocket,
    /// Receives what is sent to everyone, where the main socket does not.
    group: Option<UdpSocket>,
    peers: Vec<SocketAddr>,
    everyone: Option<SocketAddr>,
}

impl UdpSockets {
    /// Opens the sockets.
    ///
    /// # Errors
    /// The options contradict each other, a peer is this robot itself, or the system refuses (port in use, no
    /// such address, not allowed).
    pub fn bind(options: &UdpOptions) -> Result<Self, UdpError> {
        let peers = look_up(options)?;
        check(options, &peers)?;
        let everyone = options.multicast.or(options.broadcast);
        let shares_port = everyone
            .is_some_and(|all| all.port() == options.bind.port() && options.bind.ip().is_unspecified());
        if shares_port {
            refuse_a_second_node(options.bind)?;
        }
        let main = open(options, options.bind, shares_port)?;
        if let Some(group) = options.multicast {
            send_to_group(&main, options, group)?;
        }
        if options.broadcast.is_some() {
            main.set_broadcast(true).map_err(system("allow broadcast on", options.bind))?;
        }
        let group = match everyone {
            Some(all) if !shares_port => Some(open(options, all, true)?),
            _ => None,
        };
        if let Some(all) = options.multicast {
            join(group.as_ref().unwrap_or(&main), options, all)?;
        }
        let main: UdpSocket = main.into();
        refuse_itself(&peers, main.local_addr().map_err(system("look at", options.bind))?)?;
        let mut sockets = Self { main, group: group.map(Into::into), peers: Vec::new(), everyone };
        peers.into_iter().for_each(|peer| sockets.add_peer(peer));
        Ok(sockets)
    }

    /// The address that was bound, with the port that the system chose.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.main.local_addr()
    }

    /// Adds a robot that is sent to before it was heard.
    pub fn add_peer(&mut self, peer: SocketAddr) {
        let is_v6 = self.local_addr().is_ok_and(|own| own.is_ipv6());
        let peer = in_family(peer, is_v6);
        if !self.peers.contains(&peer) {
            self.peers.push(peer);
        }
    }

    /// Puts the sockets to work. Call it within a tokio runtime.
    pub fn into_transport(self) -> io::Result<UdpTransport> {
        Ok(UdpTransport {
            main: tokio::net::UdpSocket::from_std(self.main)?,
            group: self.group.map(tokio::net::UdpSocket::from_std).transpose()?,
            peers: self.peers,
            everyone: self.everyone,
            addresses: Addresses::default(),
            group_first: false,
            to_everyone: 0,
        })
    }
}

/// UDP sockets at work.
#[derive(Debug)]
pub struct UdpTransport {
    main: tokio::net::UdpSocket,
    group: Option<tokio::net::UdpSocket>,
    peers: Vec<SocketAddr>,
    everyone: Option<SocketAddr>,
    addresses: Addresses,
    /// Which socket is read first, in turn, so that neither starves the other.
    group_first: bool,
    /// Datagrams to everyone so far.
    to_everyone: usize,
}

impl Transport for UdpTransport {
    async fn receive(&mut self, buffer: &mut [u8]) -> io::Result<(usize, Path)> {
        let (main, group, group_first) = (&self.main, self.group.as_ref(), self.group_first);
        // Where one socket serves both, all who are heard there count as members of the group.
        let is_shared = self.everyone.is_some() && group.is_none();
        let received = poll_fn(|context| {
            let mut order = [(Some(main), is_shared), (group, true)];
            if group_first {
                order.reverse();
            }
            for (socket, by_group) in order.into_iter().filter_map(|(socket, by)| Some((socket?, by))) {
                let mut buffer = ReadBuf::new(buffer);
                if let Poll::Ready(result) = socket.poll_recv_from(context, &mut buffer) {
                    return Poll::Ready(result.map(|from| (buffer.filled().len(), from, by_group)));
                }
            }
            Poll::Pending
        })
        .await;
        self.group_first = !self.group_first;
        received.map(|(length, from, by_group)| (length, self.addresses.note(from, by_group)))
    }

    fn set_paths(&mut self, paths: &[Path]) {
        self.addresses.set_used(paths);
    }

    async fn send(&mut self, transmit: &Transmit) -> SendResult {
        let to: Vec<Option<SocketAddr>> = match transmit.to {
            Destination::Peer(_) => vec![transmit.path.and_then(|path| self.addresses.address(path))],
            Destination::Everyone => {
                // Configured robots are reached even where the group does not reach.
                let configured = self.everyone.iter().chain(&self.peers).copied();
                // The members of the group have got it.
                let used = self.addresses.used().filter(|(_, is_in_group)| !is_in_group);
                let used = used.map(|(address, _)| address).filter(|address| !self.peers.contains(address));
                let mut addresses: Vec<_> = configured.chain(used).map(Some).collect();
                // A queue that is full takes the first only: let that be another one each time.
                let first = self.to_everyone % addresses.len().max(1);
                addresses.rotate_left(first);
                self.to_everyone = self.to_everyone.wrapping_add(1);
                addresses
            }
        };
        let mut sent = SendResult::default();
        for address in to {
            match address {
                Some(address) if is_sent(&self.main, address, &transmit.bytes).await => sent.copies += 1,
                _ => sent.failed += 1,
            }
        }
        sent
    }
}

async fn is_sent(socket: &tokio::net::UdpSocket, address: SocketAddr, bytes: &[u8]) -> bool {
    for _ in 0..2 {
        match tokio::time::timeout(SEND_WAIT_MAX, socket.send_to(bytes, address)).await {
            Ok(Ok(_)) => return true,
            // The error is about an earlier datagram and is used up now.
            Ok(Err(error)) if is_unreachable(&error) => {}
            _ => return false,
        }
    }
    false
}

/// What ICMP reported of an earlier datagram: the robot there is off, which is no fault of this one.
pub(crate) fn is_unreachable(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, ConnectionReset, HostUnreachable};
    matches!(error.kind(), ConnectionRefused | ConnectionReset | HostUnreachable)
}

fn open(options: &UdpOptions, address: SocketAddr, shared: bool) -> Result<Socket, UdpError> {
    let fail = system("open a UDP socket for", address);
    let socket = Socket::new(Domain::for_address(address), Type::DGRAM, Some(Protocol::UDP)).map_err(fail)?;
    if address.is_ipv6() {
        socket.set_only_v6(false).map_err(system("serve IPv4 too on", address))?;
    }
    if shared {
        // Several robots on one machine listen to the same group.
        socket.set_reuse_address(true).map_err(system("share", address))?;
        #[cfg(unix)]
        socket.set_reuse_port(true).map_err(system("share", address))?;
    }
    // The system may grant less; bursts are then lost and repaired.
    let _ = socket.set_recv_buffer_size((options.receive_buffer_kb as usize) << 10);
    let _ = socket.set_send_buffer_size((options.send_buffer_kb as usize) << 10);
    socket.set_nonblocking(true).map_err(system("set non-blocking", address))?;
    let option = if address == options.bind { "[network] bind" } else { "[network]" };
    socket
        .bind(&address.into())
        .map_err(|error| system("listen on", address)(listen_error(option, error)))?;
    Ok(socket)
}

/// A socket that shares its port with sockets of the group would share it with another node just as well, and
/// either would get what is sent to the other. That one is found at an address that nobody shares.
fn refuse_a_second_node(bind: SocketAddr) -> Result<(), UdpError> {
    let v4 = IpAddr::V4(Ipv4Addr::LOCALHOST);
    let loopbacks = if bind.is_ipv4() { vec![v4] } else { vec![v4, Ipv6Addr::LOCALHOST.into()] };
    for ip in loopbacks {
        // Another error is that there is no such address here: nobody has it.
        if let Err(error) = UdpSocket::bind((ip, bind.port()))
            && error.kind() == io::ErrorKind::AddrInUse
        {
            let advice = "another program listens there: stop that one, or choose another port in [network] bind; the port of the group \
                          stays the same for all";
            return Err(system("listen on", bind)(with(error, advice)));
        }
    }
    Ok(())
}

fn send_to_group(socket: &Socket, options: &UdpOptions, group: SocketAddr) -> Result<(), UdpError> {
    let hops = options.multicast_ttl;
    match group {
        SocketAddr::V4(_) => socket
            .set_multicast_if_v4(&interface_v4(options))
            .and_then(|()| socket.set_multicast_ttl_v4(hops)),
        SocketAddr::V6(_) => socket
            .set_multicast_if_v6(options.multicast_interface_index)
            .and_then(|()| socket.set_multicast_hops_v6(hops)),
    }
    .map_err(system("send to the group", group))
}

fn join(socket: &Socket, options: &UdpOptions, group: SocketAddr) -> Result<(), UdpError> {
    match group.ip() {
        IpAddr::V4(ip) => socket.join_multicast_v4(&ip, &interface_v4(options)),
        IpAddr::V6(ip) => socket.join_multicast_v6(&ip, options.multicast_interface_index),
    }
    .map_err(system("join the group", group))
}

/// The interface for an IPv4 group; 0.0.0.0 leaves the choice to the system.
fn interface_v4(options: &UdpOptions) -> Ipv4Addr {
    options.multicast_interface.unwrap_or(Ipv4Addr::UNSPECIFIED)
}

fn system(what: &'static str, address: SocketAddr) -> impl Fn(io::Error) -> UdpError {
    move |error| UdpError::System { what, address, error }
}

/// An IPv6 socket reaches IPv4 robots at mapped addresses, and hears them from there.
fn in_family(address: SocketAddr, is_v6: bool) -> SocketAddr {
    match address.ip() {
        IpAddr::V4(ip) if is_v6 => SocketAddr::new(ip.to_ipv6_mapped().into(), address.port()),
        _ => address,
    }
}

#[cfg(test)]
mod tests;
