use super::*;
use flockmap::RobotId;
use std::net::SocketAddr;

fn block_on<F: Future>(future: F) -> F::Output {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async { tokio::time::timeout(Duration::from_secs(10), future).await.unwrap() })
}

fn address(text: &str) -> SocketAddr {
    text.parse().unwrap()
}

fn bound(text: &str) -> UdpSockets {
    UdpSockets::bind(&UdpOptions::new(address(text))).unwrap()
}

fn to_all(bytes: &[u8]) -> Transmit {
    Transmit { to: Destination::Everyone, path: None, bytes: bytes.to_vec() }
}

fn to_one(path: Option<Path>, bytes: &[u8]) -> Transmit {
    Transmit { to: Destination::Peer(RobotId(1)), path, bytes: bytes.to_vec() }
}

/// Receives a datagram; its length and its path.
async fn get(transport: &mut UdpTransport) -> (usize, Path) {
    transport.receive(&mut [0; 64]).await.unwrap()
}

#[test]
fn a_robot_is_reached_on_its_path_and_nowhere_before() {
    block_on(async {
        let mut a = bound("127.0.0.1:0");
        let b = bound("127.0.0.1:0");
        a.add_peer(b.local_addr().unwrap());
        let (mut a, mut b) = (a.into_transport().unwrap(), b.into_transport().unwrap());

        // B knows nobody yet.
        assert_eq!(b.send(&to_one(None, b"no")).await, SendResult { copies: 0, failed: 1 });
        assert_eq!(b.send(&to_one(Some(Path(1)), b"no")).await, SendResult { copies: 0, failed: 1 });
        assert_eq!(b.send(&to_all(b"no")).await, SendResult::default());

        assert_eq!(a.send(&to_all(b"hello")).await.copies, 1);
        let (length, path) = get(&mut b).await;
        assert_eq!(length, 5);
        // That it was heard is no reason to send there; the session may.
        assert_eq!(b.send(&to_all(b"no")).await, SendResult::default());
        assert_eq!(b.send(&to_one(Some(path), b"hi")).await.copies, 1);
        assert_eq!(get(&mut a).await.0, 2);
        b.set_paths(&[path]);
        assert_eq!(b.send(&to_all(b"all")).await.copies, 1);
        assert_eq!(get(&mut a).await.0, 3);
        assert_eq!(a.send(&to_all(b"again")).await.copies, 1);
        assert_eq!(get(&mut b).await, (5, path), "the same address, the same path");
        b.set_paths(&[]);
        assert_eq!(b.send(&to_all(b"no")).await, SendResult::default());
    });
}

#[test]
fn what_is_for_everyone_goes_to_each_address_once() {
    block_on(async {
        let (mut a, mut b) = (bound("127.0.0.1:0"), bound("127.0.0.1:0"));
        let (at_a, at_b) = (a.local_addr().unwrap(), b.local_addr().unwrap());
        for _ in 0..2 {
            a.add_peer(at_b);
        }
        b.add_peer(at_a);
        let (mut a, mut b) = (a.into_transport().unwrap(), b.into_transport().unwrap());
        assert_eq!(a.send(&to_all(b"one")).await, SendResult { copies: 1, failed: 0 });
        let (_, path) = get(&mut b).await;
        // Two robots behind one address.
        b.set_paths(&[path, path]);
        assert_eq!(b.send(&to_all(b"one")).await, SendResult { copies: 1, failed: 0 });
    });
}

#[test]
fn one_datagram_to_a_group_reaches_every_member() {
    // A port that is free for sure: bound once, then given back.
    let port = bound("127.0.0.1:0").local_addr().unwrap().port();
    let options = UdpOptions {
        multicast: Some(address(&format!("239.77.7.7:{port}"))),
        multicast_interface: Some(Ipv4Addr::LOCALHOST),
        ..UdpOptions::new(address("127.0.0.1:0"))
    };
    let (a, b, c) = match [0; 3].map(|_| UdpSockets::bind(&options)) {
        [Ok(a), Ok(b), Ok(c)] => (a, b, c),
        [result, ..] => return println!("skipped: no multicast here: {result:?}"),
    };
    block_on(async {
        let at_a = a.local_addr().unwrap();
        let [mut a, mut b, mut c] = [a, b, c].map(|sockets| sockets.into_transport().unwrap());
        let sent = a.send(&to_all(b"to all")).await;
        if sent.failed > 0 {
            return println!("skipped: no route for multicast on loopback");
        }
        for member in [&mut b, &mut c] {
            let (length, path) = get(member).await;
            assert_eq!(length, 6);
            assert_eq!(member.send(&to_one(Some(path), b"got it")).await.copies, 1);
            // Who sends to the group hears the group, and does not get a second copy.
            member.set_paths(&[path]);
            assert_eq!(member.send(&to_all(b"to all")).await.copies, 1);
        }
        // One that is not in the group is reached on its path.
        let mut d = bound("127.0.0.1:0");
        d.add_peer(at_a);
        d.into_transport().unwrap().send(&to_all(b"from outside")).await;
        let path = loop {
            if let (12, path) = get(&mut a).await {
                break path;
            }
        };
        a.set_paths(&[path]);
        assert_eq!(a.send(&to_all(b"to all")).await.copies, 2);
    });
}

#[test]
fn one_broadcast_reaches_every_robot() {
    let port = bound("127.0.0.1:0").local_addr().unwrap().port();
    let options = UdpOptions {
        broadcast: Some(address(&format!("127.255.255.255:{port}"))),
        ..UdpOptions::new(address("127.0.0.1:0"))
    };
    let [a, b, c] = [0; 3].map(|_| UdpSockets::bind(&options).unwrap());
    block_on(async {
        let [mut a, mut b, mut c] = [a, b, c].map(|sockets| sockets.into_transport().unwrap());
        assert_eq!(a.send(&to_all(b"to all")).await, SendResult { copies: 1, failed: 0 });
        for robot in [&mut b, &mut c] {
            assert_eq!(get(robot).await.0, 6);
        }
    });
}

#[test]
fn ipv6_and_ipv4_robots_talk() {
    let Ok(v6) = UdpSockets::bind(&UdpOptions::new(address("[::]:0"))) else {
        return println!("skipped: no IPv6 here");
    };
    block_on(async {
        let v4 = bound("127.0.0.1:0");
        let mut v6 = v6;
        v6.add_peer(v4.local_addr().unwrap());
        let (mut v4, mut v6) = (v4.into_transport().unwrap(), v6.into_transport().unwrap());
        assert_eq!(v6.send(&to_all(b"six")).await.copies, 1);
        let (length, path) = get(&mut v4).await;
        assert_eq!(length, 3);
        assert_eq!(v4.send(&to_one(Some(path), b"four")).await.copies, 1);
        let (length, path) = get(&mut v6).await;
        assert_eq!(length, 4);
        // A configured IPv4 address is the one that is heard from.
        v6.set_paths(&[path]);
        assert_eq!(v6.send(&to_all(b"six")).await.copies, 1);
    });
}

#[test]
fn a_robot_that_is_off_does_not_stop_the_others() {
    block_on(async {
        let off = bound("127.0.0.1:0").local_addr().unwrap();
        let on = bound("127.0.0.1:0");
        let mut a = bound("127.0.0.1:0");
        a.add_peer(off);
        a.add_peer(on.local_addr().unwrap());
        let (mut a, mut on) = (a.into_transport().unwrap(), on.into_transport().unwrap());
        for _ in 0..20 {
            assert_eq!(a.send(&to_all(b"hello")).await, SendResult { copies: 2, failed: 0 });
            assert_eq!(get(&mut on).await.0, 5);
        }
    });
}

#[test]
fn options_that_contradict_each_other_are_refused() {
    let base = || UdpOptions::new(address("127.0.0.1:0"));
    let refused = |options: UdpOptions, word: &str| {
        let text = UdpSockets::bind(&options).unwrap_err().to_string();
        assert!(text.contains(word), "{text}");
    };
    refused(UdpOptions { peers: vec!["[::1]:7700".into()], ..base() }, "[::]:PORT");
    refused(UdpOptions { multicast: Some(address("10.0.0.1:7700")), ..base() }, "expected a group");
    refused(UdpOptions { multicast: Some(address("[ff02::77]:7700")), ..base() }, "the same IP version");
    refused(UdpOptions { peers: vec!["10.0.0.1:0".into()], ..base() }, "expected the port");
    refused(UdpOptions { peers: vec!["0.0.0.0:7700".into()], ..base() }, "address of another robot");
    refused(UdpOptions { peers: vec!["239.7.7.7:7700".into()], ..base() }, "belongs into multicast");
    refused(UdpOptions { peers: vec!["10.0.0.1:7700".into(); 2], ..base() }, "10.0.0.1:7700 twice");
    let both = UdpOptions {
        broadcast: Some(address("10.0.0.255:7700")),
        multicast: Some(address("239.7.7.7:7700")),
        ..base()
    };
    refused(both, "one of them");
}

#[test]
fn a_robot_that_is_its_own_peer_is_refused_wherever_it_listens() {
    for (bind, own) in
        [("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1"), ("[::]", "127.0.0.1"), ("[::]", "[::1]")]
    {
        // Free a moment ago.
        let Ok(free) = UdpSocket::bind(format!("{bind}:0")) else { continue };
        let port = free.local_addr().unwrap().port();
        drop(free);
        let at = |peer: String| UdpOptions {
            peers: vec![peer],
            ..UdpOptions::new(address(&format!("{bind}:{port}")))
        };
        let text = UdpSockets::bind(&at(format!("{own}:{port}"))).unwrap_err().to_string();
        assert!(text.contains("which is this robot itself"), "{text}");
        // Another robot on this machine, and one elsewhere with the same port.
        let other = port.wrapping_sub(1).max(1);
        assert!(UdpSockets::bind(&at(format!("{own}:{other}"))).is_ok());
        assert!(UdpSockets::bind(&at(format!("192.0.2.7:{port}"))).is_ok());
    }
}

#[test]
fn a_port_in_use_is_named() {
    let taken = bound("127.0.0.1:0").local_addr().unwrap();
    let _holder = UdpSocket::bind(taken).unwrap();
    let text = UdpSockets::bind(&UdpOptions::new(taken)).unwrap_err().to_string();
    assert!(text.contains(&taken.to_string()) && text.contains("listen on"), "{text}");
}

#[test]
fn a_second_node_does_not_get_what_is_sent_to_a_live_one() {
    let port = bound("127.0.0.1:0").local_addr().unwrap().port();
    let options = UdpOptions {
        multicast: Some(address(&format!("239.77.7.8:{port}"))),
        multicast_interface: Some(Ipv4Addr::LOCALHOST),
        ..UdpOptions::new(address(&format!("0.0.0.0:{port}")))
    };
    // A robot with a port of its own disturbs nobody.
    let beside = UdpOptions { bind: address("127.0.0.1:0"), ..options.clone() };
    let (_beside, _first) = match [&beside, &options].map(UdpSockets::bind) {
        [Ok(beside), Ok(first)] => (beside, first),
        results => return println!("skipped: no multicast here: {results:?}"),
    };
    let text = UdpSockets::bind(&options).unwrap_err().to_string();
    assert!(text.contains(&format!("0.0.0.0:{port}")) && text.contains("choose another port"), "{text}");
    assert!(UdpSockets::bind(&beside).is_ok());
}
