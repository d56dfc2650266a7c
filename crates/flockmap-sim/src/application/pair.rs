//! Two robots with their maps, joined by an emulated radio in virtual time.

use super::{ApplicationOptions, MapSync, RobotTraffic};
use crate::{IN_THE_WORLD, IP_UDP_BYTES, Link, RadioConfig, RadioEmulator, To};
use flockmap::{CycleConfig, Event, Robot, RobotConfig, RobotError, SessionConfig};
use flockmap_grid::{Changes, Layer, Pose, RobotId, Scan, Stamp, State};

/// The leader's number among the two.
pub(super) const LEADER: usize = 0;
/// The follower's number among the two.
pub(super) const FOLLOWER: usize = 1;

/// Leader and follower.
pub(super) struct Pair {
    robots: [Robot; 2],
    radio: Option<RadioEmulator>,
    now: Stamp,
    /// How often something was due that was due already.
    stuck: u32,
    /// When each voxel of the follower got the state that it has now in its own map.
    onset: Layer,
    /// From the scan that saw an obstacle to its presence in the leader's map, in microseconds.
    ages: Vec<i64>,
    sent: [Window; 2],
    received: [Window; 2],
}

impl Pair {
    pub(super) fn new(options: &ApplicationOptions, now: Stamp) -> Result<Self, RobotError> {
        let rate = match options.sync {
            MapSync::Radio { rate_bytes_per_s, .. } => rate_bytes_per_s,
            MapSync::None => None,
        };
        let config = |number: usize| {
            let id = id(number);
            let mut config = RobotConfig::new(id, options.resolution, options.range_m);
            config.mapper.update_box_m = Some(options.update_box_m);
            config.cycle = CycleConfig {
                t_l_ms: options.t_l_ms,
                t_l_occupied_ms: options.t_l_occupied_ms,
                ..CycleConfig::default()
            };
            config.codec = options.codec;
            config.seed = options.seed;
            if rate.is_some() {
                config.session = SessionConfig { radio_bytes_per_s: rate, ..config.session };
            }
            config
        };
        let radio = match options.sync {
            MapSync::None => None,
            MapSync::Radio { rate_bytes_per_s, loss, delay_ms } => Some(RadioConfig {
                seed: options.seed,
                link: Link { loss, delay_micros: i64::from(delay_ms) * 1_000, ..Link::default() },
                rate_bytes_per_s,
                overhead_bytes: IP_UDP_BYTES,
                ..RadioConfig::default()
            }),
        };
        Ok(Self {
            robots: [Robot::new(config(LEADER), now)?, Robot::new(config(FOLLOWER), now)?],
            radio: radio.map(|radio| RadioEmulator::new([id(LEADER), id(FOLLOWER)], radio)),
            now,
            stuck: 0,
            onset: Layer::default(),
            ages: Vec::new(),
            sent: Default::default(),
            received: Default::default(),
        })
    }

    pub(super) const fn robot(&self, number: usize) -> &Robot {
        &self.robots[number]
    }

    /// Takes in a scan of one of them. `other` is where the other one is.
    #[allow(non_snake_case)]
    pub(super) fn insert_scan(&mut self, number: usize, scan: &Scan, T_map_sensor: &Pose, other: [f64; 3]) {
        let robot = &mut self.robots[number];
        robot.set_teammate(id(1 - number), other, self.now).expect(IN_THE_WORLD);
        let report = robot.insert_scan(self.now, scan, T_map_sensor).expect(IN_THE_WORLD);
        if number == FOLLOWER {
            self.onset.apply(&Changes::from_blocks(report.changed), scan.stamp);
        }
    }

    /// Lets everything happen that is due until then. Without a radio the robots only map.
    pub(super) fn advance(&mut self, until: Stamp) {
        while let Some(next) = self.next_due().filter(|next| *next <= until) {
            if next > self.now {
                self.now = next;
                self.stuck = 0;
            } else {
                // Due now again and again: let a millisecond pass, as a real clock would.
                self.stuck += 1;
                if self.stuck > 100 {
                    self.now = self.now.plus_micros(1_000).min(until);
                }
                if self.stuck > 10_000 {
                    break;
                }
            }
            self.deliver();
            for robot in &mut self.robots {
                if robot.poll_timeout().is_some_and(|at| at <= self.now) {
                    robot.handle_timeout(self.now);
                }
            }
            self.note_events();
            self.transmit();
        }
        self.now = until;
        self.stuck = 0;
    }

    /// What each of them sent and received.
    pub(super) fn traffic(&self) -> [RobotTraffic; 2] {
        [LEADER, FOLLOWER].map(|number| RobotTraffic {
            sent_bytes: self.sent[number].bytes,
            sent_datagrams: self.sent[number].datagrams,
            sent_bytes_per_s_max: self.sent[number].largest,
            received_bytes: self.received[number].bytes,
            received_datagrams: self.received[number].datagrams,
            received_bytes_per_s_max: self.received[number].largest,
        })
    }

    /// Ages of obstacles in the leader's map when they came in, in microseconds, ascending.
    pub(super) fn into_ages(mut self) -> Vec<i64> {
        self.ages.sort_unstable();
        self.ages
    }

    fn next_due(&self) -> Option<Stamp> {
        let radio = self.radio.as_ref()?;
        self.robots.iter().filter_map(Robot::poll_timeout).chain(radio.next_due()).min()
    }

    fn deliver(&mut self) {
        let Some(radio) = &mut self.radio else { return };
        while let Some(delivery) = radio.deliver_due(self.now) {
            let number = usize::from(delivery.to == id(FOLLOWER));
            self.received[number].add(self.now, delivery.bytes.len());
            // Errors are counted by the session.
            let _ = self.robots[number].handle_datagram(self.now, &delivery.bytes);
        }
    }

    fn transmit(&mut self) {
        let Some(radio) = &mut self.radio else { return };
        for (number, robot) in self.robots.iter_mut().enumerate() {
            while let Some(transmit) = robot.poll_transmit(self.now) {
                self.sent[number].add(self.now, transmit.bytes.len());
                // There is only one other: everyone is that one.
                radio.send(self.now, id(number), To::Node(id(1 - number)), &transmit.bytes);
            }
        }
    }

    fn note_events(&mut self) {
        let follower = self.robots[FOLLOWER].own_stream();
        while let Some(event) = self.robots[LEADER].poll_event() {
            let Event::Merged { stream, changes, .. } = event else { continue };
            if stream != follower {
                continue;
            }
            for (voxel, state) in changes.voxels().filter(|(_, state)| *state == State::Occupied) {
                if let Some((still, since)) = self.onset.get(voxel)
                    && still == state
                {
                    self.ages.push(self.now.micros_since(since));
                }
            }
        }
        while self.robots[FOLLOWER].poll_event().is_some() {}
    }
}

const fn id(number: usize) -> RobotId {
    RobotId(number as u16 + 1)
}

/// Bytes over time.
#[derive(Default)]
struct Window {
    bytes: u64,
    datagrams: u64,
    /// Most bytes within any second.
    largest: u64,
    recent: std::collections::VecDeque<(Stamp, u64)>,
    recent_bytes: u64,
}

impl Window {
    fn add(&mut self, now: Stamp, bytes: usize) {
        let bytes = bytes as u64;
        self.bytes += bytes;
        self.datagrams += 1;
        self.recent.push_back((now, bytes));
        self.recent_bytes += bytes;
        while let Some((at, old)) = self.recent.front()
            && now.micros_since(*at) >= 1_000_000
        {
            self.recent_bytes -= old;
            self.recent.pop_front();
        }
        self.largest = self.largest.max(self.recent_bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_second_is_a_sliding_one() {
        let mut window = Window::default();
        for (ms, bytes) in [(0, 10), (600, 20), (1_200, 30), (1_500, 40), (5_000, 60)] {
            window.add(Stamp(ms * 1_000), bytes);
        }
        assert_eq!((window.bytes, window.datagrams, window.largest), (160, 5, 90));
    }
}
