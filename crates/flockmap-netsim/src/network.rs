//! Nodes joined by the emulated radio, in virtual time: whatever is due next happens next, and nothing waits.

use crate::{Delivery, RadioConfig, RadioEmulator, To};
use flockmap::{Cast, Destination, Robot};
use flockmap_grid::{RobotId, Stamp};

/// A robot, of Flockmap or of a rival, as a [`Network`] drives it.
pub trait Node {
    /// Its name on the radio.
    fn id(&self) -> RobotId;
    /// Takes in a datagram. What is wrong with it, the node counts itself.
    fn handle_datagram(&mut self, now: Stamp, delivery: &Delivery);
    /// Lets time pass.
    fn handle_timeout(&mut self, now: Stamp);
    /// When it wants to be called: later than when it was called last.
    fn poll_timeout(&self) -> Option<Stamp>;
    /// The next datagram to send, until `None`.
    fn poll_transmit(&mut self, now: Stamp) -> Option<Datagram>;
}

/// A datagram that a node sends.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Datagram {
    /// Whom to.
    pub to: Addressees,
    /// The payload.
    pub bytes: Vec<u8>,
}

/// Whom a datagram goes to.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Addressees {
    /// This node.
    One(RobotId),
    /// Every other node, each with a datagram of its own, beginning with another one each time: where a queue is full, it
    /// takes the first only.
    Each,
    /// Every other node, with one datagram for all.
    All,
}

/// Whatever holds a robot of Flockmap is a node.
impl<T: AsRef<Robot> + AsMut<Robot>> Node for T {
    fn id(&self) -> RobotId {
        self.as_ref().own_stream().origin
    }

    fn handle_datagram(&mut self, now: Stamp, delivery: &Delivery) {
        // Errors are counted by the session.
        let _ = self.as_mut().handle_datagram(now, &delivery.bytes);
    }

    fn handle_timeout(&mut self, now: Stamp) {
        self.as_mut().handle_timeout(now);
    }

    fn poll_timeout(&self) -> Option<Stamp> {
        self.as_ref().poll_timeout()
    }

    fn poll_transmit(&mut self, now: Stamp) -> Option<Datagram> {
        let transmit = self.as_mut().poll_transmit(now)?;
        let to = match (transmit.to, self.as_ref().config().session.cast) {
            (Destination::Peer(peer), _) => Addressees::One(peer),
            (Destination::Everyone, Cast::Unicast) => Addressees::Each,
            (Destination::Everyone, Cast::Broadcast) => Addressees::All,
        };
        Some(Datagram { to, bytes: transmit.bytes })
    }
}

/// Sees what happens in a [`Network`], and takes the events of its nodes. Nodes have numbers from 0 on.
pub trait Watch<N> {
    /// A node is about to be called, with a datagram or because its time has come.
    fn begins(&mut self, _now: Stamp, _number: usize, _node: &mut N, _delivery: Option<&Delivery>) {}
    /// A node was called, and has not sent anything yet.
    fn called(&mut self, _now: Stamp, _number: usize, _node: &mut N) {}
    /// A node sends a datagram, so many copies of it. What is done to it here, the radio carries.
    fn sent(&mut self, _now: Stamp, _number: usize, _node: &mut N, _datagram: &mut Datagram, _copies: usize) {
    }
    /// A node has sent all that it has to send now.
    fn settled(&mut self, _now: Stamp, _number: usize, _node: &mut N) {}
}

/// Nobody watches.
impl<N> Watch<N> for () {}

/// Nodes and the radio between them.
pub struct Network<N> {
    nodes: Vec<N>,
    ids: Vec<RobotId>,
    /// Datagrams of each node that went to each of the others.
    to_each: Vec<usize>,
    radio: RadioEmulator,
    now: Stamp,
}

impl<N: Node> Network<N> {
    /// Joins nodes by a radio.
    pub fn new(nodes: Vec<N>, radio: RadioConfig, now: Stamp) -> Self {
        let ids: Vec<RobotId> = nodes.iter().map(Node::id).collect();
        let radio = RadioEmulator::new(ids.iter().copied(), radio);
        Self { to_each: vec![0; ids.len()], nodes, ids, radio, now }
    }

    /// One node more.
    pub fn join(&mut self, node: N) {
        self.radio.add(node.id());
        self.ids.push(node.id());
        self.to_each.push(0);
        self.nodes.push(node);
    }

    /// The nodes, when it is over.
    pub fn into_nodes(self) -> Vec<N> {
        self.nodes
    }

    /// The time.
    pub const fn now(&self) -> Stamp {
        self.now
    }

    /// The nodes.
    pub fn nodes(&self) -> &[N] {
        &self.nodes
    }

    /// The nodes, for what is not an input: use [`call`](Self::call) for that.
    pub fn nodes_mut(&mut self) -> &mut [N] {
        &mut self.nodes
    }

    /// Their names.
    pub fn ids(&self) -> &[RobotId] {
        &self.ids
    }

    /// The radio.
    pub const fn radio(&self) -> &RadioEmulator {
        &self.radio
    }

    /// The radio, to close and open links.
    pub const fn radio_mut(&mut self) -> &mut RadioEmulator {
        &mut self.radio
    }

    /// When something happens next by itself. O(nodes).
    pub fn next_due(&self) -> Option<Stamp> {
        self.nodes.iter().filter_map(Node::poll_timeout).chain(self.radio.next_due()).min()
    }

    /// Lets everything happen that is due up to a time; then it is that time.
    pub fn run_until(&mut self, until: Stamp, watch: &mut impl Watch<N>) {
        while self.next_due().is_some_and(|due| due <= until) {
            self.step(Some(until), watch);
        }
        self.skip_to(until);
    }

    /// Lets everything happen that is due before a time; then it is that time.
    pub fn run_before(&mut self, until: Stamp, watch: &mut impl Watch<N>) {
        self.run_until(until.plus_micros(-1), watch);
        self.skip_to(until);
    }

    /// Goes on to the next thing that is due, but not beyond `until`, and lets everything happen that is due
    /// then. With nothing due and no `until`, a tenth of a second passes.
    pub fn step(&mut self, until: Option<Stamp>, watch: &mut impl Watch<N>) {
        let next = self.next_due().into_iter().chain(until).min();
        self.skip_to(next.unwrap_or_else(|| self.now.plus_micros(100_000)));
        self.deliver_due(watch);
        (0..self.nodes.len()).for_each(|number| self.call_if_due(number, watch));
    }

    /// It is a later time, whatever was due before.
    pub fn skip_to(&mut self, now: Stamp) {
        self.now = self.now.max(now);
    }

    /// Delivers what arrives now.
    pub fn deliver_due(&mut self, watch: &mut impl Watch<N>) {
        while let Some(delivery) = self.radio.deliver_due(self.now) {
            if let Some(number) = self.ids.iter().position(|id| *id == delivery.to) {
                let node = &mut self.nodes[number];
                watch.begins(self.now, number, node, Some(&delivery));
                node.handle_datagram(self.now, &delivery);
                self.settle(number, watch);
            }
        }
    }

    /// Calls a node if its time has come.
    pub fn call_if_due(&mut self, number: usize, watch: &mut impl Watch<N>) {
        if self.nodes[number].poll_timeout().is_some_and(|due| due <= self.now) {
            self.call(number, watch, N::handle_timeout);
        }
    }

    /// Gives a node an input from outside, and sends what it has to send then.
    pub fn call<R>(
        &mut self,
        number: usize,
        watch: &mut impl Watch<N>,
        input: impl FnOnce(&mut N, Stamp) -> R,
    ) -> R {
        watch.begins(self.now, number, &mut self.nodes[number], None);
        let result = input(&mut self.nodes[number], self.now);
        self.settle(number, watch);
        result
    }

    fn settle(&mut self, number: usize, watch: &mut impl Watch<N>) {
        let (now, own, node) = (self.now, self.ids[number], &mut self.nodes[number]);
        watch.called(now, number, node);
        while let Some(mut datagram) = node.poll_transmit(now) {
            let others = self.ids.iter().filter(|id| **id != own);
            let to: Vec<To> = match datagram.to {
                Addressees::One(peer) => vec![To::Node(peer)],
                Addressees::All => vec![To::All],
                Addressees::Each => {
                    let mut each: Vec<To> = others.map(|id| To::Node(*id)).collect();
                    let first = self.to_each[number] % each.len().max(1);
                    each.rotate_left(first);
                    self.to_each[number] += 1;
                    each
                }
            };
            watch.sent(now, number, node, &mut datagram, to.len());
            to.into_iter().for_each(|to| self.radio.send(now, own, to, &datagram.bytes));
        }
        watch.settled(now, number, node);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Link;

    /// Sends a datagram every second to everybody else, and notes what it hears.
    struct Talker {
        id: RobotId,
        next: Stamp,
        due: bool,
        heard: Vec<(Stamp, RobotId)>,
    }

    impl Node for Talker {
        fn id(&self) -> RobotId {
            self.id
        }
        fn handle_datagram(&mut self, now: Stamp, delivery: &Delivery) {
            self.heard.push((now, delivery.from));
        }
        fn handle_timeout(&mut self, _now: Stamp) {
            self.next = self.next.plus_micros(1_000_000);
            self.due = true;
        }
        fn poll_timeout(&self) -> Option<Stamp> {
            Some(self.next)
        }
        fn poll_transmit(&mut self, _now: Stamp) -> Option<Datagram> {
            std::mem::take(&mut self.due).then(|| Datagram { to: Addressees::Each, bytes: vec![7; 10] })
        }
    }

    #[derive(Default)]
    struct Counts {
        delivered: usize,
        called: usize,
        copies: usize,
    }

    impl Watch<Talker> for Counts {
        fn begins(&mut self, _now: Stamp, _number: usize, _node: &mut Talker, delivery: Option<&Delivery>) {
            self.delivered += usize::from(delivery.is_some());
        }
        fn called(&mut self, _now: Stamp, _number: usize, _node: &mut Talker) {
            self.called += 1;
        }
        fn sent(&mut self, _now: Stamp, _number: usize, _node: &mut Talker, _: &mut Datagram, copies: usize) {
            self.copies += copies;
        }
    }

    #[test]
    fn what_is_sent_arrives_after_its_delay_and_the_watch_sees_all_of_it() {
        let talkers = (1..=3).map(|id| Talker {
            id: RobotId(id),
            next: Stamp(i64::from(id) * 100_000),
            due: false,
            heard: Vec::new(),
        });
        let link = Link { delay_micros: 50_000, ..Link::default() };
        let radio = RadioConfig { link, ..RadioConfig::default() };
        let mut network = Network::new(talkers.collect(), radio, Stamp(0));
        let mut counts = Counts::default();
        network.run_until(Stamp(1_000_000), &mut counts);
        assert_eq!(network.now(), Stamp(1_000_000));
        let heard = [(Stamp(250_000), RobotId(2)), (Stamp(350_000), RobotId(3))];
        assert_eq!(network.nodes()[0].heard, heard);
        assert_eq!((counts.delivered, counts.called, counts.copies), (6, 6 + 3, 6));
        assert_eq!(network.next_due(), Some(Stamp(1_100_000)));
    }

    #[test]
    fn a_queue_that_takes_one_datagram_of_two_leaves_nobody_out() {
        let talker = |id, next| Talker { id: RobotId(id), next: Stamp(next), due: false, heard: Vec::new() };
        let talkers = vec![talker(1, 0), talker(2, i64::MAX), talker(3, i64::MAX)];
        let radio = RadioConfig { rate_bytes_per_s: Some(10), queue_bytes_max: 10, ..RadioConfig::default() };
        let mut network = Network::new(talkers, radio, Stamp(0));
        network.run_until(Stamp(4_500_000), &mut ());
        let heard = |number: usize| network.nodes()[number].heard.len();
        assert_eq!((heard(1), heard(2)), (2, 2));
    }
}
