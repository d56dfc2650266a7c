//! Once links heal, all robots have received the same packages, and with them the same layers, within a time
//! that follows from the settings.
//!
//! Asked for is: of every run that still flies all packages, at every robot, whatever the limits are; of a
//! run that has ended all that any robot has, also beyond gaps. Left out are ended runs that a robot has
//! forgotten, or for which it has no place (`streams_max`, `epochs_max`), with those of the same robot before
//! them; and ended runs that nobody passes on (`Relay::Never`).
//!
//! The time is the sum of: 50 s in which backed-off packages, declined snapshots and abandoned transfers are
//! tried again; for each hop four requests, and each robot's relay delay; and what all packages together take
//! through the smallest budget, six times for each robot that has to get them. For each damaged package of
//! one run that a robot was sent, a pause and four requests more: that the next one is damaged may show only
//! when the one before it has arrived again (WIRE.md, "Packages that do not decode"). Where epochs come from
//! clocks and dice, 80 s more: a robot that has to begin anew more than once waits in between. Where layers have small
//! limits, 40 s more for each robot that may be asked in vain for what was dropped.
//!
//! A robot that had to drop something holds its packages, and need not have it back. One of which something is lacking
//! otherwise has all that a robot which it hears has.

use super::quiet::period_micros;
use crate::swarm::truth::Truth;
use flockmap::grid::Layer;
use flockmap::sync::{IntervalSet, Relay};
use flockmap::{Cast, Robot, RobotId, SessionConfig, Stream};

pub(in crate::swarm) const NAME: &str = "agreement";

/// Ended runs that robots which fly have forgotten; whether those of the same robot before them are not
/// wanted any more either.
pub(in crate::swarm) type Forgotten = Vec<(Stream, bool)>;

/// A robot that begins anew once more does so after pauses of 10, 20, 40 s.
const ANEW: i64 = 80_000_000;

/// Who was asked for what was dropped, and does not give it, is given up after so long.
const REST: i64 = 40_000_000;

/// The longest time without an answer after which something counts as lost.
const ROUND_TRIP_MAX: i64 = 30_000_000;

/// A package that does not decode is asked for again after so long.
const REFUSED: i64 = 10_000_000;

/// In microseconds, from how many hops there are, the bytes and the number of all packages, and the most
/// damaged packages of one run that one robot was sent.
pub(in crate::swarm) fn bound(
    sessions: &[SessionConfig],
    hops: usize,
    (published_bytes, published_packages): (u64, u64),
    [may_begin_anew, has_small_layers]: [bool; 2],
    damaged: u32,
) -> i64 {
    let configs = || sessions.iter();
    let period = configs().map(period_micros).max().unwrap_or(0);
    let relay = configs().map(|config| 1_000 * i64::from(config.relay_delay_ms)).max().unwrap_or(0);
    let budgets = configs().flat_map(|config| {
        let copies = if config.cast == Cast::Unicast { (sessions.len() as u32).max(2) - 1 } else { 1 };
        [config.radio_bytes_per_s.map(|rate| rate / copies), config.link_bytes_per_s]
    });
    let budget = u64::from(budgets.flatten().min().unwrap_or(2_000_000).max(1));
    // Each package in a datagram of its own.
    let bytes = published_bytes + 80 * published_packages;
    let copies = sessions.len() as u64;
    let sending = (6 * copies * bytes).saturating_mul(1_000_000) / budget;
    let anew = if may_begin_anew { ANEW } else { 0 };
    let damaged = i64::from(damaged) * (REFUSED + 4 * period);
    50_000_000
        + anew
        + if has_small_layers { REST * sessions.len() as i64 } else { 0 }
        + damaged
        + hops as i64 * (4 * period + sessions.len() as i64 * relay + 2_000_000)
        + sending as i64
}

/// How long nothing of a run that has ended may flow though somebody will still pass it on, in microseconds:
/// gaps stand for 10 s, then each robot waits its turn in the line of those who answer (WIRE.md, "Who
/// answers"). A turn is two round trips at the least, which a crowded radio makes as long as a session reckons with.
pub(in crate::swarm) fn pause_of_relays(robots: &[&Robot], is_crowded: bool) -> i64 {
    let delays = robots.iter().map(|robot| 1_000 * i64::from(robot.session().config().relay_delay_ms));
    let round_trips = if is_crowded { 2 * ROUND_TRIP_MAX } else { 0 };
    10_000_000 + robots.len() as i64 * delays.max().unwrap_or(0).max(round_trips)
}

/// The first robot that flies in a run below one of its own id that somebody knows: it has to begin anew.
pub(in crate::swarm) fn superseded(robots: &[&Robot]) -> Option<(RobotId, String)> {
    robots.iter().find_map(|robot| {
        let own = robot.own_stream();
        // Who has heard a later run, and not taken anything of it yet, knows that run as its peer only.
        let peers = robots.iter().flat_map(|other| other.session().peers().map(|peer| peer.stream));
        let known = robots.iter().flat_map(|other| other.session().streams()).chain(peers);
        let newer = known.filter(|run| run.origin == own.origin).max()?;
        (newer > own).then(|| (own.origin, format!("a run above {newer:?}")))
    })
}

/// The first thing that a robot lacks, as text; `None`: all agree.
pub(in crate::swarm) fn disagreement(
    truth: &Truth,
    robots: &[&Robot],
    forgotten: &Forgotten,
) -> Option<(RobotId, String)> {
    let nothing = IntervalSet::new(0);
    for (stream, _) in truth.streams() {
        let is_alive = robots.iter().any(|robot| robot.own_stream() == stream);
        if !is_alive && !is_passed_on(robots, forgotten, stream) {
            continue;
        }
        if let Some(robot) = robots.iter().find(|robot| lacks_rest(robots, robot, stream)) {
            return Some((robot.own_stream().origin, format!("the rest of {stream:?}")));
        }
        for robot in robots {
            let id = robot.own_stream().origin;
            let received = robot.session().received(stream).unwrap_or(&nothing);
            if is_alive {
                if let Some((low, high)) = received.missing(1, truth.last(stream)).next() {
                    return Some((id, format!("packages {low} to {high} of {stream:?}")));
                }
                continue;
            }
            for other in robots {
                let theirs = other.session().received(stream).unwrap_or(&nothing);
                if let Some((low, high)) = theirs.difference(received).intervals().first() {
                    let whose = other.own_stream();
                    let lacks = format!("packages {low} to {high} of {stream:?}, which {whose:?} has");
                    return Some((id, lacks));
                }
            }
        }
    }
    None
}

/// Whether something of a stream is lacking that was dropped elsewhere, and is there where the robot can have it from:
/// it has room for it.
fn lacks_rest(robots: &[&Robot], robot: &Robot, stream: Stream) -> bool {
    let session = robot.session();
    if session.lost_upto(stream).is_none() || stream == robot.own_stream() || robot.is_full() {
        return false;
    }
    // Some are asked that only seem to have all packages: what a robot cannot decode it states as held.
    let may_give = |peer: &&&Robot| {
        let received = peer.session().received(stream).map_or(0, IntervalSet::prefix);
        received >= session.store().newest_known(stream)
    };
    let has_all = |peer: &Robot| {
        let theirs = peer.session();
        let is_heard = session.peers().any(|known| known.stream == peer.own_stream() && known.hears_us);
        is_heard && theirs.lost_upto(stream).is_none()
    };
    let is_wanted = session.rests_wanted().any(|wanted| wanted == stream);
    robots.iter().filter(may_give).any(|peer| is_wanted || has_all(peer))
}

/// Whether some run that has ended is left out: then its packages may still be in flight to some robot when
/// all agree.
pub(in crate::swarm) fn leaves_out(truth: &Truth, robots: &[&Robot], forgotten: &Forgotten) -> bool {
    truth.streams().any(|(run, _)| {
        robots.iter().all(|robot| robot.own_stream() != run) && !is_passed_on(robots, forgotten, run)
    })
}

/// Whether robots have to hold what others hold of a run that has ended.
fn is_passed_on(robots: &[&Robot], forgotten: &Forgotten, run: Stream) -> bool {
    let is_forgotten = forgotten.iter().any(|&(gone, is_cut)| {
        gone == run || (is_cut && gone.origin == run.origin && gone.epoch > run.epoch)
    });
    !is_forgotten
        && robots.iter().all(|robot| {
            let (session, own) = (robot.session(), robot.own_stream());
            let config = session.config();
            let others = || session.streams().filter(|stream| *stream != own);
            let has_place = session.received(run).is_some()
                || (others().count() < config.streams_max
                    && others().filter(|other| other.origin == run.origin).count() < config.epochs_max);
            has_place && config.relay != Relay::Never
        })
}

/// The first layer that is not its origin's, where all is held.
pub(in crate::swarm) fn unequal_layer(robots: &[&Robot]) -> Option<(RobotId, String)> {
    for origin in robots {
        let stream = origin.own_stream();
        let Some(own) = origin.fusion().layer(stream) else { continue };
        let digest = own.digest();
        for robot in robots {
            let layer = robot.fusion().layer(stream);
            // Of what was dropped the checker `layer` knows that it is not wrong.
            let is_in_part = |layer: &Layer| layer.lost_upto().is_some();
            if is_in_part(own) || layer.is_some_and(is_in_part) {
                continue;
            }
            if layer.map(Layer::digest) != Some(digest) {
                let differs = format!("its layer of {stream:?} is not the one of {stream:?} itself");
                return Some((robot.own_stream().origin, differs));
            }
        }
    }
    None
}
