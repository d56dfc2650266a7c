use super::*;
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

#[test]
fn a_robot_is_answered_where_it_was_heard() {
    block_on(async {
        let mut a = bound("127.0.0.1:0");
        let b = bound("127.0.0.1:0");
        a.add_peer(b.local_addr().unwrap());
        let (mut a, mut b) = (a.into_transport().unwrap(), b.into_transport().unwrap());
        let mut buffer = [0; 64];

        // B knows nobody yet.
        assert_eq!(b.send(Destination::Peer(RobotId(1)), b"no").await, Sent { copies: 0, failed: 1 });
        assert_eq!(b.send(Destination::Everyone, b"no").await, Sent::default());

        assert_eq!(a.send(Destination::Everyone, b"hello").await.copies, 1);
        assert_eq!(b.receive(&mut buffer).await.unwrap(), 5);
        b.note_sender(RobotId(1));
        assert_eq!(b.send(Destination::Peer(RobotId(1)), b"hi").await.copies, 1);
        assert_eq!(a.receive(&mut buffer).await.unwrap(), 2);
        assert_eq!(&buffer[..2], b"hi");
        assert_eq!(b.send(Destination::Everyone, b"all").await.copies, 1);
        assert_eq!(a.receive(&mut buffer).await.unwrap(), 3);
    });
}

#[test]
fn one_datagram_to_a_group_reaches_every_member() {
    // A port that is free for sure: bound once, then given back.
    let port = bound("127.0.0.1:0").local_addr().unwrap().port();
    let options = UdpOptions {
        multicast: Some(address(&format!("239.77.7.7:{port}"))),
        multicast_interface_v4: Some(Ipv4Addr::LOCALHOST),
        ..UdpOptions::new(address("127.0.0.1:0"))
    };
    let (a, b, c) = match [0; 3].map(|_| UdpSockets::bind(&options)) {
        [Ok(a), Ok(b), Ok(c)] => (a, b, c),
        [result, ..] => return println!("skipped: no multicast here: {result:?}"),
    };
    block_on(async {
        let [mut a, mut b, mut c] = [a, b, c].map(|sockets| sockets.into_transport().unwrap());
        let sent = a.send(Destination::Everyone, b"to all").await;
        if sent.failed > 0 {
            return println!("skipped: no route for multicast on loopback");
        }
        let mut buffer = [0; 64];
        for member in [&mut b, &mut c] {
            assert_eq!(member.receive(&mut buffer).await.unwrap(), 6);
            member.note_sender(RobotId(1));
            assert_eq!(member.send(Destination::Peer(RobotId(1)), b"got it").await.copies, 1);
        }
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
        assert_eq!(a.send(Destination::Everyone, b"to all").await, Sent { copies: 1, failed: 0 });
        let mut buffer = [0; 64];
        for robot in [&mut b, &mut c] {
            assert_eq!(robot.receive(&mut buffer).await.unwrap(), 6);
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
        let mut buffer = [0; 64];
        assert_eq!(v6.send(Destination::Everyone, b"six").await.copies, 1);
        assert_eq!(v4.receive(&mut buffer).await.unwrap(), 3);
        v4.note_sender(RobotId(6));
        assert_eq!(v4.send(Destination::Peer(RobotId(6)), b"four").await.copies, 1);
        assert_eq!(v6.receive(&mut buffer).await.unwrap(), 4);
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
        let mut buffer = [0; 64];
        for _ in 0..20 {
            assert_eq!(a.send(Destination::Everyone, b"hello").await, Sent { copies: 2, failed: 0 });
            assert_eq!(on.receive(&mut buffer).await.unwrap(), 5);
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
    refused(UdpOptions { peers: vec![address("[::1]:7700")], ..base() }, "[::]:PORT");
    refused(UdpOptions { multicast: Some(address("10.0.0.1:7700")), ..base() }, "no group");
    refused(UdpOptions { multicast: Some(address("[ff02::77]:7700")), ..base() }, "IP versions");
    refused(UdpOptions { peers: vec![address("10.0.0.1:0")], ..base() }, "port 0");
    let both = UdpOptions {
        broadcast: Some(address("10.0.0.255:7700")),
        multicast: Some(address("239.7.7.7:7700")),
        ..base()
    };
    refused(both, "one of them");
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
        multicast_interface_v4: Some(Ipv4Addr::LOCALHOST),
        ..UdpOptions::new(address(&format!("0.0.0.0:{port}")))
    };
    // A robot with a port of its own is in nobody's way.
    let beside = UdpOptions { bind: address("127.0.0.1:0"), ..options.clone() };
    let (_beside, _first) = match [&beside, &options].map(UdpSockets::bind) {
        [Ok(beside), Ok(first)] => (beside, first),
        results => return println!("skipped: no multicast here: {results:?}"),
    };
    let text = UdpSockets::bind(&options).unwrap_err().to_string();
    assert!(text.contains(&format!("0.0.0.0:{port}")) && text.contains("choose another port"), "{text}");
    assert!(UdpSockets::bind(&beside).is_ok());
}
