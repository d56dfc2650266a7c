//! What happens to a swarm while it maps: crashes, restarts, partitions, links that work in one direction.

use flockmap_worlds::random::Random;

/// Something that happens. Robots are numbered from 0.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Action {
    /// A robot falls silent, and what it had is gone.
    Crash(usize),
    /// It starts again, with an empty store and a higher epoch.
    Restart(usize),
    /// A link closes in one direction. Closed twice, it has to be opened twice.
    Close { from: usize, to: usize },
    /// A link opens again in one direction.
    Open { from: usize, to: usize },
    /// The swarm falls into two parts: those of the set bits, and the others.
    Part(u64),
    /// The parts hear each other again.
    Join(u64),
}

impl Action {
    /// What to call it in an account.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Crash(_) => "crash",
            Self::Restart(_) => "restart",
            Self::Close { .. } => "half-open link",
            Self::Open { .. } => "link open again",
            Self::Part(_) => "partition",
            Self::Join(_) => "partition over",
        }
    }
}

/// Draws what happens in so many microseconds.
pub(super) fn draw(random: &mut Random, robots: usize, mapping: i64) -> Vec<(i64, Action)> {
    let mut plan = Vec::new();
    let moment = |random: &mut Random| {
        let from = random.below(mapping as u64) as i64;
        (from, from + random.below((mapping - from).max(1) as u64) as i64)
    };
    if random.happens(0.35) {
        for _ in 0..1 + random.below(2) {
            let (from, to) = moment(random);
            let robot = random.below(robots as u64) as usize;
            // One robot crashes once at a time.
            if plan.iter().any(|(_, action)| *action == Action::Crash(robot)) {
                continue;
            }
            plan.push((from, Action::Crash(robot)));
            if random.happens(0.8) {
                plan.push((to, Action::Restart(robot)));
                if random.happens(0.3) {
                    let again =
                        [(to + 200_000, Action::Crash(robot)), (to + 700_000, Action::Restart(robot))];
                    plan.extend(again);
                }
            }
        }
    }
    if random.happens(0.35) {
        for _ in 0..1 + random.below(2) {
            let (from, to) = moment(random);
            let parts = random.next_u64();
            plan.extend([(from, Action::Part(parts)), (to, Action::Join(parts))]);
        }
    }
    if random.happens(0.3) {
        for _ in 0..1 + random.below(3) {
            let (start, end) = moment(random);
            let from = random.below(robots as u64) as usize;
            let to = (from + 1 + random.below(robots as u64 - 1) as usize) % robots;
            plan.extend([(start, Action::Close { from, to }), (end, Action::Open { from, to })]);
        }
    }
    plan.retain(|(at, _)| *at < mapping);
    plan.sort_by_key(|(at, _)| *at);
    plan
}

/// A day in the field on top of a plan: so many restarts, spread over all robots, now and then of several at
/// once.
pub(super) fn add_field_day(
    plan: &mut Vec<(i64, Action)>,
    random: &mut Random,
    robots: usize,
    mapping: i64,
    restarts: usize,
) {
    let mut left = restarts;
    while left > 0 {
        let at = random.below(mapping as u64) as i64;
        let together = if random.happens(0.25) { 2 + random.below(robots as u64 - 1) as usize } else { 1 };
        let first = random.below(robots as u64) as usize;
        for robot in (first..first + together.min(left)).map(|robot| robot % robots) {
            plan.push((at, Action::Crash(robot)));
            plan.push((at + 10_000 + random.below(300_000) as i64, Action::Restart(robot)));
        }
        left -= together.min(left);
    }
    plan.retain(|(at, _)| *at < mapping);
    plan.sort_by_key(|(at, _)| *at);
}
