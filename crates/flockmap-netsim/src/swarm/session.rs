//! Options of the sessions of a swarm, drawn from the seed.

use super::plan::Action;
use super::preset::{RadioNumbers, Topology};
use flockmap::sync::{InFlight, Order, Relay};
use flockmap::{Cast, SessionConfig};
use flockmap_worlds::random::Random;

/// What is drawn already.
pub(super) struct Drawn<'a> {
    pub(super) robots: usize,
    pub(super) cast: Cast,
    pub(super) radio: &'a RadioNumbers,
    pub(super) plan: &'a [(i64, Action)],
    pub(super) is_calm: bool,
    pub(super) has_budgets: bool,
}

/// The session of each robot, and what is special about them, as text.
pub(super) fn draw(random: &mut Random, swarm: &Drawn<'_>) -> (Vec<SessionConfig>, Vec<String>) {
    let mut notes = Vec::new();
    let budget = if swarm.has_budgets { swarm.radio.budget(swarm.robots) } else { None };
    let budget_text =
        |budget: Option<u32>| budget.map_or_else(|| "none".to_owned(), |b| format!("{b} bytes/s"));
    let mut common =
        SessionConfig { cast: swarm.cast, radio_bytes_per_s: budget, ..SessionConfig::default() };
    common.peers_max = common.peers_max.max(swarm.robots);
    common.streams_max = common.streams_max.max(4 * swarm.robots);
    if swarm.is_calm {
        notes.push(format!("budget {}", budget_text(budget)));
        return (vec![common; swarm.robots], notes);
    }
    if random.happens(0.1) {
        notes.push("the paper's own session".to_owned());
        common = SessionConfig {
            cast: swarm.cast,
            radio_bytes_per_s: budget,
            peers_max: common.peers_max,
            streams_max: common.streams_max,
            ..SessionConfig::paper()
        };
    }
    let is_paper = common.in_flight == InFlight::PreviousRequest;
    // Requests to all others have to fit.
    let peers = if swarm.cast == Cast::Unicast { swarm.robots as u32 - 1 } else { 1 };
    let least = (400 * peers).max(500);
    common.radio_bytes_per_s = budget.map(|budget| budget.max(least));
    if random.happens(0.25) {
        let small = least + random.below(4_000) as u32;
        common.radio_bytes_per_s = Some(budget.map_or(small, |budget| budget.max(least).min(small)));
    }
    if random.happens(0.1) {
        common.link_bytes_per_s = Some(500 + random.below(5_000) as u32);
    }
    notes.push(format!("budget {}", budget_text(common.radio_bytes_per_s)));
    if let Some(link) = common.link_bytes_per_s {
        notes.push(format!("each link {link} bytes/s"));
    }
    let is_mixed = random.happens(0.3);
    if is_mixed {
        notes.push("each robot with options of its own".to_owned());
    }
    let is_tight = random.happens(0.25);
    if is_tight {
        notes.push("tight limits".to_owned());
    }
    let restarts = swarm.plan.iter().filter(|(_, action)| matches!(action, Action::Restart(_))).count();
    let sessions = (0..swarm.robots).scan(None, |first, _| {
        let mut session = match first {
            Some(first) if !is_mixed => SessionConfig::clone(first),
            _ => {
                let mut session = common.clone();
                if !is_paper {
                    vary(random, &mut session, swarm);
                }
                if is_tight {
                    tighten(random, &mut session, restarts);
                }
                session
            }
        };
        session.cast = swarm.cast;
        first.get_or_insert_with(|| session.clone());
        Some(session)
    });
    let mut sessions: Vec<SessionConfig> = sessions.collect();
    // Long enough to hear four requests of everybody, however rare they are.
    let rarest = sessions.iter().map(|session| session.request_period_idle_ms).max().unwrap_or(0);
    for session in &mut sessions {
        session.peer_timeout_ms = session.peer_timeout_ms.max(4 * rarest);
    }
    (sessions, notes)
}

fn vary(random: &mut Random, session: &mut SessionConfig, swarm: &Drawn<'_>) {
    session.request_period_active_ms = 200 + random.below(1_300) as u32;
    session.request_period_idle_ms = session.request_period_active_ms + random.below(2_500) as u32;
    session.active_for_ms = 500 + random.below(3_500) as u32;
    session.gap_requests = random.happens(0.9);
    session.reorder_patience_ms = 5 + random.below(80) as u32;
    session.gap_request_pause_ms = 20 + random.below(300) as u32;
    session.push = random.happens(0.85);
    session.order = if random.happens(0.8) { Order::NewestFirst } else { Order::OldestFirst };
    session.relay = match random.below(10) {
        0 if swarm.radio.topology == Topology::Full => Relay::Never,
        1 | 2 => Relay::Always,
        _ => Relay::Ranked,
    };
    session.relay_delay_ms = 200 + random.below(2_000) as u32;
    session.round_trip_initial_ms = 50 + random.below(600) as u32;
    session.burst_ms = 10 + random.below(400) as u32;
    session.peer_timeout_ms = 4 * session.request_period_idle_ms + random.below(6_000) as u32;
    if random.happens(0.3) {
        session.snapshot_bytes_min = Some(200 + random.below(4_000) as u32);
    }
    if random.happens(0.1) {
        session.snapshot_range_max = Some(3 + random.below(30) as u32);
    }
}

/// Small limits on what others can make a robot keep.
fn tighten(random: &mut Random, session: &mut SessionConfig, restarts: usize) {
    if random.happens(0.6) {
        session.store_bytes_max = 1_000 + random.below(12_000) as usize;
    }
    if random.happens(0.5) {
        session.in_flight_max = 2 + random.below(30) as usize;
    }
    if random.happens(0.5) {
        session.transfers_max = 1 + random.below(3) as usize;
    }
    if random.happens(0.3) {
        session.epochs_max = 1 + random.below(restarts as u64 + 1) as usize;
    }
    // A snapshot that is larger cannot be sent at all.
    if random.happens(0.3) {
        session.snapshot_bytes_max = 50_000 + random.below(100_000) as usize;
    }
}
