//! A bad radio inside a program, between nodes of that program.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::thread::JoinHandle;

use anyhow::anyhow;

use super::air::Air;
use super::command::LinkChange;
use super::relay::{Datagram, Relay, WAITING_MAX};

/// A radio that works on a thread of its own until [`Self::end`].
pub struct RadioInside {
    /// Where the robots appear to the others, in the order of their numbers.
    pub ports: Vec<SocketAddr>,
    is_over: Arc<AtomicBool>,
    thread: JoinHandle<Relay>,
}

/// Datagrams that a radio let through, and that it lost.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Passed {
    pub received: u64,
    pub lost: u64,
}

impl RadioInside {
    /// Puts a radio between robots that listen at these addresses of the loopback.
    ///
    /// # Errors
    /// No port or no thread is to be had.
    pub fn start(robots: Vec<SocketAddr>, seed: u64, figures: LinkChange) -> anyhow::Result<Self> {
        let (sender, inputs) = sync_channel::<Datagram>(WAITING_MAX);
        let any: SocketAddr = "127.0.0.1:0".parse()?;
        let air = Air::new(robots.len(), seed, None, figures);
        let any = vec![any; robots.len()];
        let mut relay = Relay::open(robots, &any, air, &sender)?;
        let ports = relay.ports()?;
        let is_over = Arc::new(AtomicBool::new(false));
        let ends = Arc::clone(&is_over);
        let work = move || {
            while !ends.load(Ordering::Relaxed) {
                relay.deliver_due();
                if let Ok(datagram) = inputs.recv_timeout(relay.wait(None)) {
                    relay.take(datagram);
                }
            }
            relay
        };
        let thread = std::thread::Builder::new().name("radio".into()).spawn(work)?;
        Ok(Self { ports, is_over, thread })
    }

    /// Ends it: what is still on the air is lost.
    ///
    /// # Errors
    /// It has panicked.
    pub fn end(self) -> anyhow::Result<Passed> {
        self.is_over.store(true, Ordering::Relaxed);
        let relay = self.thread.join().map_err(|_| anyhow!("the radio has panicked"))?;
        let mut passed = Passed::default();
        for robot in 1..=relay.robots.len() {
            let (traffic, _) = relay.air.traffic(robot);
            passed.received += traffic.received;
            passed.lost += traffic.lost;
        }
        Ok(passed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::UdpSocket;
    use std::time::Duration;

    #[test]
    fn a_datagram_comes_from_where_its_sender_appears() {
        let robots = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        robots[1].set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let addresses = robots.iter().map(|robot| robot.local_addr().unwrap()).collect();
        let radio = RadioInside::start(addresses, 1, LinkChange::default()).unwrap();
        let ports = radio.ports.clone();
        robots[0].send_to(b"hello", ports[1]).unwrap();
        let mut buffer = [0; 16];
        let (length, from) = robots[1].recv_from(&mut buffer).unwrap();
        assert_eq!((&buffer[..length], from), (&b"hello"[..], ports[0]));
        assert_eq!(radio.end().unwrap(), Passed { received: 1, lost: 0 });
    }

    #[test]
    fn what_the_radio_loses_is_counted_and_does_not_arrive() {
        let robots = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        let addresses: Vec<_> = robots.iter().map(|robot| robot.local_addr().unwrap()).collect();
        let lossy = LinkChange { loss: Some(1.0), ..LinkChange::default() };
        let (sender, inputs) = sync_channel::<Datagram>(1);
        let any = vec!["127.0.0.1:0".parse().unwrap(); 2];
        let mut relay = Relay::open(addresses, &any, Air::new(2, 1, None, lossy), &sender).unwrap();
        robots[0].send_to(b"hello", relay.ports().unwrap()[1]).unwrap();
        relay.take(inputs.recv_timeout(Duration::from_secs(20)).unwrap());
        relay.deliver_due();
        let (traffic, _) = relay.air.traffic(2);
        assert_eq!((traffic.received, traffic.lost), (0, 1));
        robots[1].set_nonblocking(true).unwrap();
        assert!(robots[1].recv_from(&mut [0; 16]).is_err(), "nothing may come through");
    }
}
