//! What happens to datagrams between the robots: the emulated radio of `flockmap-netsim`, in the time of the
//! wall.

use flockmap::{RobotId, Stamp};
use flockmap_netsim::{Delivery, IP_UDP_BYTES, Link, RadioConfig, RadioEmulator, To, Traffic};
use flockmap_worlds::Random;

use super::command::{LinkChange, Links, RadioCommand};

/// The figures of one link.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
struct Figures {
    link: Link,
    bit_flips: f64,
}

/// The radio between robots 1 to N.
pub struct Air {
    radio: RadioEmulator,
    /// By the sender's number, then the receiver's, both less one.
    links: Vec<Vec<Figures>>,
    random: Random,
    /// Datagrams to each robot that arrived with a wrong bit.
    flipped: Vec<u64>,
}

impl Air {
    /// A radio where every link has the same figures.
    pub fn new(robots: usize, seed: u64, rate_bytes_per_s: Option<u32>, figures: LinkChange) -> Self {
        let config =
            RadioConfig { seed, rate_bytes_per_s, overhead_bytes: IP_UDP_BYTES, ..RadioConfig::default() };
        let mut air = Self {
            radio: RadioEmulator::new((1..=robots).map(id), config),
            links: vec![vec![Figures::default(); robots]; robots],
            random: Random::new(seed, 0x666c_6970),
            flipped: vec![0; robots],
        };
        air.change(Links::All, figures);
        air
    }

    /// Carries out a command that is about links; the others change nothing.
    pub fn command(&mut self, command: &RadioCommand) {
        match command {
            RadioCommand::Split(groups) => {
                let group_of = |robot| groups.iter().position(|group| group.contains(&robot));
                self.open(Links::All, |from, to| group_of(from).is_some() && group_of(from) == group_of(to));
            }
            RadioCommand::Cut(links) => self.open(*links, |_, _| false),
            RadioCommand::Join(links) => self.open(*links, |_, _| true),
            RadioCommand::Heal => self.open(Links::All, |_, _| true),
            RadioCommand::Link(links, figures) => self.change(*links, *figures),
            RadioCommand::Status | RadioCommand::End => {}
        }
    }

    /// A robot has sent a datagram to another one.
    pub fn send(&mut self, now: Stamp, from: usize, to: usize, bytes: &[u8]) {
        self.radio.send(now, id(from), To::Node(id(to)), bytes);
    }

    /// When the next datagram comes through.
    pub fn next_due(&self) -> Option<Stamp> {
        self.radio.next_due()
    }

    /// The next datagram that has come through by now, perhaps with a wrong bit. Call it until it gives `None`.
    pub fn deliver_due(&mut self, now: Stamp) -> Option<Delivery> {
        let mut delivery = self.radio.deliver_due(now)?;
        let [from, to] = [delivery.from, delivery.to].map(|id| usize::from(id.0) - 1);
        if self.random.happens(self.links[from][to].bit_flips) && !delivery.bytes.is_empty() {
            let mut bytes = delivery.bytes.to_vec();
            let bit = self.random.below(bytes.len() as u64 * 8) as usize;
            bytes[bit / 8] ^= 1 << (bit % 8);
            delivery.bytes = bytes.into();
            self.flipped[to] += 1;
        }
        Some(delivery)
    }

    /// What a robot sent and received, and with how many wrong bits.
    pub fn traffic(&self, robot: usize) -> (Traffic, u64) {
        (self.radio.traffic(id(robot)), self.flipped[robot - 1])
    }

    /// Opens or cuts links.
    fn open(&mut self, links: Links, is_open: impl Fn(usize, usize) -> bool) {
        for (from, to) in links.among(self.links.len()) {
            self.radio.set_open(id(from), id(to), is_open(from, to));
        }
    }

    fn change(&mut self, links: Links, change: LinkChange) {
        for (from, to) in links.among(self.links.len()) {
            let figures = &mut self.links[from - 1][to - 1];
            figures.apply(change);
            self.radio.set_link(id(from), id(to), figures.link);
        }
    }
}

impl Figures {
    fn apply(&mut self, change: LinkChange) {
        let micros = |ms: f64| (ms * 1_000.0) as i64;
        self.link.loss = change.loss.unwrap_or(self.link.loss);
        self.link.delay_micros = change.delay_ms.map_or(self.link.delay_micros, micros);
        self.link.jitter_micros = change.jitter_ms.map_or(self.link.jitter_micros, micros);
        self.link.duplication = change.duplication.unwrap_or(self.link.duplication);
        self.bit_flips = change.bit_flips.unwrap_or(self.bit_flips);
    }
}

/// Robots are numbered in the order of the command line; what ids they have in the swarm is their own affair.
fn id(robot: usize) -> RobotId {
    RobotId(robot as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Who gets a datagram that robot `from` sends to all others, right now.
    fn reached(air: &mut Air, from: usize) -> Vec<usize> {
        (1..=4).filter(|to| *to != from).for_each(|to| air.send(Stamp(0), from, to, b"hello"));
        std::iter::from_fn(|| air.deliver_due(Stamp(1_000_000)))
            .map(|delivery| usize::from(delivery.to.0))
            .collect()
    }

    #[test]
    fn a_split_ends_with_heal_and_the_figures_stay() {
        let mut air = Air::new(4, 1, None, LinkChange::default());
        let say = |air: &mut Air, line: &str| air.command(&line.parse().unwrap());
        assert_eq!(reached(&mut air, 1), [2, 3, 4]);
        say(&mut air, "link 1>3 loss=1");
        say(&mut air, "split 1,2,3/4");
        assert_eq!(reached(&mut air, 1), [2]);
        assert_eq!(reached(&mut air, 3), [1, 2]);
        assert!(reached(&mut air, 4).is_empty());
        say(&mut air, "split 1,2");
        assert!(reached(&mut air, 3).is_empty(), "who is not named hears nobody");
        say(&mut air, "heal");
        assert_eq!(reached(&mut air, 1), [2, 4]);
        say(&mut air, "cut 2>1");
        assert_eq!(reached(&mut air, 2), [3, 4]);
        say(&mut air, "cut 3");
        say(&mut air, "join 3-4");
        assert_eq!(reached(&mut air, 4), [1, 2, 3]);
        assert_eq!(reached(&mut air, 3), [4]);
    }

    #[test]
    fn a_flipped_datagram_differs_in_one_bit_and_is_counted() {
        let figures = LinkChange { bit_flips: Some(1.0), delay_ms: Some(40.0), ..LinkChange::default() };
        let mut air = Air::new(2, 1, None, figures);
        air.send(Stamp(0), 1, 2, &[0; 30]);
        assert!(air.deliver_due(Stamp(39_999)).is_none());
        let bytes = air.deliver_due(Stamp(40_000)).unwrap().bytes;
        assert_eq!(bytes.iter().map(|byte| byte.count_ones()).sum::<u32>(), 1);
        let (traffic, flipped) = air.traffic(2);
        assert_eq!((traffic.received, flipped), (1, 1));
    }
}
