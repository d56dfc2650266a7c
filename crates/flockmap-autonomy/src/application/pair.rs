//! Two robots with their maps, joined by an emulated radio in virtual time.

use super::{ApplicationOptions, MapSync, RobotTraffic};
use flockmap::{BatchConfig, Event, Robot, RobotConfig, RobotError, SessionConfig};
use flockmap_grid::{Changes, Layer, Pose, RobotId, Scan, Stamp, State};
use flockmap_netsim::{Datagram, Delivery, IP_UDP_BYTES, Link, Network, RadioConfig, Watch};
use flockmap_worlds::IN_THE_WORLD;

/// The leader's number among the two.
pub(super) const LEADER: usize = 0;
/// The follower's number among the two.
pub(super) const FOLLOWER: usize = 1;

/// Leader and follower.
pub(super) struct Pair {
    network: Network<Robot>,
    has_radio: bool,
    now: Stamp,
    meters: Meters,
}

/// What is measured of them.
#[derive(Default)]
struct Meters {
    /// When each voxel of the follower got the state that it has now in its own map.
    onset: Layer,
    /// From the scan that saw an obstacle to its presence in the leader's map, in microseconds.
    ages: Vec<i64>,
    sent: [Window; 2],
    received: [Window; 2],
}

impl Pair {
    pub(super) fn new(options: &ApplicationOptions, now: Stamp) -> Result<Self, RobotError> {
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
        let rate = radio.and_then(|radio| radio.rate_bytes_per_s);
        let config = |number: usize| {
            let mut config = RobotConfig::new(id(number), options.resolution, options.range_m);
            config.mapper.update_box_m = Some(options.update_box_m);
            config.batch = BatchConfig {
                publish_period_ms: options.publish_period_ms,
                obstacle_period_ms: options.obstacle_period_ms,
                ..BatchConfig::default()
            };
            config.codec = options.codec;
            config.seed = options.seed;
            if rate.is_some() {
                config.session = SessionConfig { radio_bytes_per_s: rate, ..config.session };
            }
            config
        };
        let robots = vec![Robot::new(config(LEADER), now)?, Robot::new(config(FOLLOWER), now)?];
        let has_radio = radio.is_some();
        let network = Network::new(robots, radio.unwrap_or_default(), now);
        Ok(Self { network, has_radio, now, meters: Meters::default() })
    }

    pub(super) fn robot(&self, number: usize) -> &Robot {
        &self.network.nodes()[number]
    }

    /// Takes in a scan of one of them. `other` is where the other one is.
    #[allow(non_snake_case)]
    pub(super) fn insert_scan(&mut self, number: usize, scan: &Scan, T_map_sensor: &Pose, other: [f64; 3]) {
        let robot = &mut self.network.nodes_mut()[number];
        robot.set_teammate(id(1 - number), other, self.now).expect(IN_THE_WORLD);
        let report = robot.insert_scan(self.now, scan, T_map_sensor).expect(IN_THE_WORLD);
        if number == FOLLOWER {
            self.meters.onset.apply(&Changes::from_blocks(report.changed), scan.stamp);
        }
    }

    /// Lets everything happen that is due until then. Without a radio the robots only map.
    pub(super) fn advance(&mut self, until: Stamp) {
        if self.has_radio {
            self.network.run_until(until, &mut self.meters);
        }
        self.now = until;
    }

    /// What each of them sent and received.
    pub(super) fn traffic(&self) -> [RobotTraffic; 2] {
        [LEADER, FOLLOWER].map(|number| RobotTraffic {
            sent_bytes: self.meters.sent[number].bytes,
            sent_datagrams: self.meters.sent[number].datagrams,
            sent_bytes_per_s_max: self.meters.sent[number].largest,
            received_bytes: self.meters.received[number].bytes,
            received_datagrams: self.meters.received[number].datagrams,
            received_bytes_per_s_max: self.meters.received[number].largest,
        })
    }

    /// Ages of obstacles in the leader's map when they came in, in microseconds, ascending.
    pub(super) fn into_ages(mut self) -> Vec<i64> {
        self.meters.ages.sort_unstable();
        self.meters.ages
    }
}

impl Watch<Robot> for Meters {
    fn begins(&mut self, now: Stamp, number: usize, _robot: &mut Robot, delivery: Option<&Delivery>) {
        if let Some(delivery) = delivery {
            self.received[number].add(now, delivery.bytes.len());
        }
    }

    fn sent(
        &mut self,
        now: Stamp,
        number: usize,
        _robot: &mut Robot,
        datagram: &mut Datagram,
        _copies: usize,
    ) {
        self.sent[number].add(now, datagram.bytes.len());
    }

    fn called(&mut self, now: Stamp, number: usize, robot: &mut Robot) {
        while let Some(event) = robot.poll_event() {
            let Event::Merged { stream, changes, .. } = event else { continue };
            if number != LEADER || stream.origin != id(FOLLOWER) {
                continue;
            }
            for (voxel, state) in changes.voxels().filter(|(_, state)| *state == State::Occupied) {
                if let Some((still, since)) = self.onset.get(voxel)
                    && still == state
                {
                    self.ages.push(now.micros_since(since));
                }
            }
        }
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
