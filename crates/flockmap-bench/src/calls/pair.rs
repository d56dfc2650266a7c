//! Two robots on a radio that loses nothing, as fast as they like.

use flockmap::{Destination, Event, Package, Robot, Stamp, Transmit};

use super::meter::{Call, Meter};

/// Simulated time between two looks at the robots.
const STEP_MICROS: i64 = 20_000;
/// Slices of work that a driver finds time for meanwhile.
const SLICES: usize = 8;

/// A robot, what it was given to keep, and how long its calls take.
pub struct Measured {
    pub robot: Robot,
    pub meter: Meter,
    /// Packages that it made or merged, in the order in which a store would have them.
    pub stored: Vec<Package>,
}

impl Measured {
    pub fn new(robot: Robot) -> Self {
        Self { robot, meter: Meter::default(), stored: Vec::new() }
    }

    pub fn take_events(&mut self) {
        while let Some(event) = self.robot.poll_event() {
            match event {
                Event::BatchClosed { packages, .. } => self.stored.extend(packages),
                Event::Merged { package, .. } => self.stored.push(package),
                _ => {}
            }
        }
    }

    /// Lets time pass, and goes on with what there is to do at once.
    pub fn pass(&mut self, now: Stamp) {
        for _ in 0..SLICES {
            let Self { robot, meter, .. } = self;
            if robot.poll_timeout().is_none_or(|due| due > now) {
                break;
            }
            meter.time(Call::HandleTimeout, || robot.handle_timeout(now));
            self.take_events();
        }
    }

    fn transmits(&mut self, now: Stamp) -> Vec<Transmit> {
        let Self { robot, meter, .. } = self;
        let all = core::iter::from_fn(|| meter.time(Call::PollTransmit, || robot.poll_transmit(now)));
        all.collect()
    }

    fn hear(&mut self, now: Stamp, transmits: &[Transmit]) {
        let own = self.robot.own_stream().origin;
        for transmit in transmits {
            if transmit.to == Destination::Everyone || transmit.to == Destination::Peer(own) {
                let Self { robot, meter, .. } = self;
                // What is wrong with it is counted.
                let _ = meter.time(Call::HandleDatagram, || robot.handle_datagram(now, &transmit.bytes));
                self.take_events();
            }
        }
    }

    /// Whether it holds all that another robot has published in its present run.
    pub fn holds_all_of(&self, other: &Robot) -> bool {
        let stream = other.own_stream();
        let newest = other.session().store().newest_known(stream);
        newest > 0 && self.robot.session().received(stream).is_some_and(|held| held.contains_range(1, newest))
    }
}

/// One step of time for both.
pub fn step(pair: &mut [Measured; 2], now: &mut Stamp) {
    *now = now.plus_micros(STEP_MICROS);
    for number in [0, 1] {
        pair[number].pass(*now);
        let sent = pair[number].transmits(*now);
        pair[1 - number].hear(*now, &sent);
    }
}
