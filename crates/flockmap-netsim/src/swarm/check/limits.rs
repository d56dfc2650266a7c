//! The stated limits: `memory` on what a session and its robot keep, `in_flight` on packages sent and not yet
//! confirmed.

use super::Finding;
use flockmap::grid::Layer;
use flockmap::{Cast, Robot};

const MEMORY: &str = "memory";
const IN_FLIGHT: &str = "in_flight";

/// Pending packages and chunks, as the session states it.
const PENDING_MAX: usize = 4_096;
/// Backed-off ones that are remembered.
const BACKED_OFF_MAX: usize = 1_024;
/// Packages that wait for their base at a robot, and their bytes.
const WAITING_MAX: usize = 1_024;
const WAITING_BYTES_MAX: usize = 1 << 20;
/// Intervals in the indices of one stream.
const INTERVALS_MAX: usize = 1_024;
/// By how much one merge may go beyond the limit of layers, in a map that is as small as the simulator's.
const VIEW_SLACK: usize = 64 << 10;

/// After every input of a robot. O(peers + streams).
pub(in crate::swarm) fn limits(robot: &Robot) -> Option<Finding> {
    let (session, config) = (robot.session(), robot.session().config());
    let load = session.load();
    let received = session.streams().filter_map(|stream| session.received(stream));
    let intervals = received.map(|received| received.intervals().len()).max();
    let fusion = &robot.config().fusion;
    let others = robot.fusion().memory_bytes_of_others(robot.mapper());
    let own = robot.fusion().layer(robot.own_stream()).map_or(0, Layer::memory_bytes);
    // By broadcast, what goes to another peer is noted beyond the limit, up to twice as much.
    let in_flight_max = config.in_flight_max * if config.cast == Cast::Broadcast { 2 } else { 1 };
    let limits = [
        (MEMORY, "peers", load.peers, config.peers_max),
        (MEMORY, "streams of others", load.streams, config.streams_max),
        (MEMORY, "bytes in the store", session.store().bytes(), config.store_bytes_max),
        (MEMORY, "packages pending", load.pending, PENDING_MAX),
        (MEMORY, "packages backed off", load.backed_off, BACKED_OFF_MAX),
        (MEMORY, "snapshots received at once", load.transfers, config.transfers_max),
        (MEMORY, "packages that wait", load.waiting, WAITING_MAX),
        (MEMORY, "bytes of packages that wait", load.waiting_bytes, WAITING_BYTES_MAX),
        (MEMORY, "bytes of layers of others", others, fusion.layer_bytes_max + VIEW_SLACK),
        (MEMORY, "bytes of the own layer", own, fusion.own_layer_bytes_max + VIEW_SLACK),
        (MEMORY, "intervals received of a stream", intervals.unwrap_or(0), INTERVALS_MAX),
        (IN_FLIGHT, "packages in flight to a peer", load.in_flight_most, in_flight_max),
    ];
    let (checker, what, found, most) = limits.into_iter().find(|(_, _, found, most)| found > most)?;
    Some(Finding::new(checker, format!("{what}: at most {most}"), found.to_string()))
}
