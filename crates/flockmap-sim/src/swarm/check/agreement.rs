//! Once links heal, all robots hold the same packages, and with them the same layers, within a time that follows from the settings.
//!
//! Asked for is: of every run that still flies all packages; of a run that has ended all that any robot still has (packages that
//! it stores, and what it holds without a gap from the first on). Left out are ended runs that somebody has to forget (`epochs_max`)
//! or that nobody passes on (`Relay::Never`).
//!
//! The time is the sum of: 50 s in which refused packages, declined present states and abandoned transfers are tried again; for
//! each hop four requests, and each robot's relay delay; and what all packages together take through the smallest budget, six times
//! for each robot that has to get them.

use super::quiet::period_micros;
use crate::swarm::truth::Truth;
use flockmap::sync::Relay;
use flockmap::{Cast, Robot, RobotId, Stream};

pub(in crate::swarm) const NAME: &str = "agreement";

/// In microseconds.
pub(in crate::swarm) fn bound(robots: &[&Robot], hops: usize, told_bytes: u64, told_packages: u64) -> i64 {
    let configs = || robots.iter().map(|robot| robot.session().config());
    let period = configs().map(period_micros).max().unwrap_or(0);
    let relay = configs().map(|config| 1_000 * i64::from(config.relay_delay_ms)).max().unwrap_or(0);
    let budgets = configs().flat_map(|config| {
        let copies =
            if config.cast == Cast::Unicast { (robots.len() as u64).saturating_sub(1).max(1) } else { 1 };
        [
            config.radio_bytes_per_s.map(|rate| u64::from(rate) / copies),
            config.link_bytes_per_s.map(u64::from),
        ]
    });
    let budget = budgets.flatten().min().unwrap_or(2_000_000).max(1);
    // Each package alone in its datagram.
    let bytes = told_bytes + 80 * told_packages;
    let copies = robots.len() as u64;
    let sending = (6 * copies * bytes).saturating_mul(1_000_000) / budget;
    50_000_000 + hops as i64 * (4 * period + robots.len() as i64 * relay + 2_000_000) + sending as i64
}

/// The first thing that a robot lacks, in words; `None`: all agree.
pub(in crate::swarm) fn disagreement(truth: &Truth, robots: &[&Robot]) -> Option<(RobotId, String)> {
    for (stream, _) in truth.streams() {
        let is_alive = robots.iter().any(|robot| robot.own_stream() == stream);
        if !is_alive && !is_passed_on(truth, robots, stream) {
            continue;
        }
        for robot in robots {
            let id = robot.own_stream().origin;
            let lacks = |low: u32, high: u32| {
                let held = robot.session().held(stream)?;
                held.missing(low, high).next()
            };
            let missing = |low: u32, high: u32| match robot.session().held(stream) {
                None if low <= high => Some((low, high)),
                None => None,
                Some(_) => lacks(low, high),
            };
            if is_alive {
                if let Some((low, high)) = missing(1, truth.last(stream)) {
                    return Some((id, format!("packages {low} to {high} of {stream:?}")));
                }
                continue;
            }
            for other in robots {
                let prefix = other.session().held(stream).map_or(0, flockmap::sync::IntervalSet::prefix);
                let stored = || other.session().store().range(stream, prefix + 1, u32::MAX);
                let gap =
                    missing(1, prefix).or_else(|| stored().find_map(|(index, _)| missing(index, index)));
                if let Some((low, high)) = gap {
                    let whose = other.own_stream();
                    return Some((
                        id,
                        format!("packages {low} to {high} of {stream:?}, which {whose:?} has"),
                    ));
                }
            }
        }
    }
    None
}

/// Whether robots have to pass on what they hold of a run that has ended.
fn is_passed_on(truth: &Truth, robots: &[&Robot], stream: Stream) -> bool {
    let runs = truth.streams().filter(|(other, _)| other.origin == stream.origin).count();
    let configs = || robots.iter().map(|robot| robot.session().config());
    configs().all(|config| config.relay != Relay::Never && runs <= config.epochs_max)
}

/// The first layer that is not its origin's, where all is held.
pub(in crate::swarm) fn unequal_layer(robots: &[&Robot]) -> Option<(RobotId, String)> {
    for origin in robots {
        let stream = origin.own_stream();
        let Some(own) = origin.fusion().layer(stream) else { continue };
        let digest = own.digest();
        for robot in robots {
            if robot.fusion().layer(stream).map(flockmap::grid::Layer::digest) != Some(digest) {
                let differs = format!("its layer of {stream:?} is not the one of {stream:?} itself");
                return Some((robot.own_stream().origin, differs));
            }
        }
    }
    None
}
