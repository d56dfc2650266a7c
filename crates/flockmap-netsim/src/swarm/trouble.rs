//! Trouble that comes on top of what `settings` draws: a day in the field, small limits, clocks that step,
//! repeat and rewind, disks that fail, paths, a faulty robot whose packages cost much. Drawn from random
//! numbers of its own: where none is drawn, a flight is the one that it would be without this file.

use super::SwarmOptions;
use super::crowd::Crowd;
use super::preset::{RadioNumbers, Topology};
use super::purpose;
use flockmap::{Cast, FusionConfig, SessionConfig};
use flockmap_worlds::random::Random;

/// Share of flights with each kind.
const FIELD: f64 = 0.15;
const LIMITS: f64 = 0.2;
const CLOCKS: f64 = 0.2;
const DISKS: f64 = 0.15;
const PATHS: f64 = 0.8;
const COSTLY: f64 = 0.1;
const CAPS: f64 = 0.25;
const PIECES: f64 = 0.25;
const CROWD: f64 = 0.25;
const SUBMAPS: f64 = 0.2;

/// What a clock shows when its robot starts again.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Boot {
    /// The time, as ever.
    GoesOn,
    /// Every run begins at the same reading: a clock without a battery.
    Repeats,
    /// Less than it showed before, by up to an hour.
    Rewinds,
}

/// What is drawn for a whole flight.
#[derive(Clone, Debug)]
pub(super) struct Trouble {
    /// A day in the field: restarts by the dozen up to hundreds. So many.
    pub(super) restarts: usize,
    /// Limits of sessions drawn small.
    pub(super) has_small_limits: bool,
    /// What clocks show at a start.
    pub(super) boot: Boot,
    /// Scans are stamped by clocks that are stepped while flying.
    pub(super) has_steps: bool,
    /// Disks fail.
    pub(super) has_faulty_disks: bool,
    /// Robots hear by path, where there is a key and each is sent to on its own.
    pub(super) has_paths: bool,
    /// A faulty robot sends packages that cost more than they may.
    pub(super) is_costly: bool,
    /// Limits of layers drawn small.
    pub(super) has_small_layers: bool,
    /// Snapshots go in small pieces.
    pub(super) has_pieces: bool,
    /// Robots begin submaps and move them.
    pub(super) has_submaps: bool,
    /// The radio carries less than is sent.
    pub(super) crowd: Option<Crowd>,
}

impl Trouble {
    pub(super) fn draw(options: &SwarmOptions) -> Self {
        let mut random = Random::new(options.seed, purpose::TROUBLE);
        let mut has = |share: f64| random.happens(share) && !options.is_calm;
        let (is_field, has_small_limits) = (has(FIELD), has(LIMITS));
        let (has_clocks, has_repeat, has_rewind, has_steps) = (has(CLOCKS), has(0.4), has(0.6), has(0.6));
        let (has_faulty_disks, has_paths, is_costly) = (has(DISKS), has(PATHS), has(COSTLY));
        let boot = match (has_clocks, has_repeat, has_rewind) {
            (true, true, _) => Boot::Repeats,
            (true, false, true) => Boot::Rewinds,
            _ => Boot::GoesOn,
        };
        let has_small_layers = Random::new(options.seed, purpose::CAPS).happens(CAPS) && !options.is_calm;
        let has_pieces = Random::new(options.seed, purpose::PIECES).happens(PIECES) && !options.is_calm;
        let has_submaps = Random::new(options.seed, purpose::SUBMAPS).happens(SUBMAPS) && !options.is_calm;
        let crowd = Crowd::draw(options.seed, CROWD).filter(|_| !options.is_calm && options.radio.is_none());
        let mut random = Random::new(options.seed, purpose::FIELD);
        // Seldom hundreds.
        let restarts = 12 + (random.unit() * random.unit() * random.unit() * 288.0) as usize;
        Self {
            restarts: if is_field { restarts } else { 0 },
            has_small_limits,
            boot,
            has_steps: has_clocks && has_steps,
            has_faulty_disks,
            has_paths,
            is_costly,
            has_small_layers,
            has_pieces,
            has_submaps,
            crowd,
        }
    }

    /// Whether a run takes its epoch from what its clock shows, its disk and random bits, as a node does.
    /// Else epochs are counted.
    pub(super) fn has_epochs_of_clocks(&self) -> bool {
        self.restarts > 0 || self.boot != Boot::GoesOn || self.has_faulty_disks
    }

    /// Whether clocks are other ones after a restart, so that nobody can know them beforehand.
    pub(super) fn has_other_clocks(&self) -> bool {
        self.boot != Boot::GoesOn
    }

    /// Seconds of mapping that the restarts want.
    pub(super) fn seconds(&self) -> f64 {
        self.restarts as f64 / 12.0
    }

    pub(super) fn notes(&self) -> Vec<String> {
        let (restarts, boot) = (self.restarts, self.boot);
        let field = format!("a day in the field: {restarts} restarts");
        let notes = [
            (restarts > 0, field.as_str()),
            (boot == Boot::Repeats, "every run begins at the same reading of its clock"),
            (boot == Boot::Rewinds, "clocks are set back at each start"),
            (self.has_steps, "clocks that stamp scans are stepped while flying"),
            (self.has_faulty_disks, "disks fail"),
            (self.has_pieces, "snapshots go in small pieces"),
            (self.has_submaps, "submaps are begun and moved"),
            (self.is_costly, "packages that cost more than they may"),
        ];
        let notes = notes.into_iter().filter(|(holds, _)| *holds).map(|(_, note)| note.to_owned());
        notes.chain(self.crowd.map(|crowd| crowd.note())).collect()
    }
}

/// Small limits of one session, and what they are, as text. Never so small that a robot that is there cannot
/// be heard, or has no place.
pub(super) fn limit(
    random: &mut Random,
    session: &mut SessionConfig,
    robots: usize,
    cast: Cast,
    radio: &RadioNumbers,
) -> String {
    let mut notes = Vec::new();
    let least_peers = match radio.topology {
        Topology::Full | Topology::Star => robots - 1,
        Topology::Line | Topology::Ring => (robots - 1).min(2),
    };
    if random.happens(0.8) {
        session.streams_max = robots - 1 + random.below(4) as usize;
        notes.push(format!("{} streams", session.streams_max));
    }
    if random.happens(0.5) {
        session.epochs_max = 1 + random.below(3) as usize;
        notes.push(format!("{} runs of a robot", session.epochs_max));
    }
    if random.happens(0.4) {
        session.store_bytes_max = 1_000 + random.below(6_000) as usize;
        notes.push(format!("a store of {} bytes", session.store_bytes_max));
    }
    if random.happens(0.5) {
        session.peers_max = least_peers + random.below(2) as usize;
        notes.push(format!("{} peers", session.peers_max));
    }
    if random.happens(0.4) {
        let copies = if cast == Cast::Unicast { robots as u32 - 1 } else { 1 };
        let small = (400 * copies).max(500) + random.below(600) as u32;
        let budget = session.radio_bytes_per_s.map_or(small, |budget| budget.min(small));
        session.radio_bytes_per_s = Some(budget);
        notes.push(format!("{budget} bytes/s"));
    }
    notes.join(", ")
}

/// Small limits of the layers of one robot, and what they are, as text.
pub(super) fn cap(random: &mut Random, fusion: &mut FusionConfig) -> String {
    let mut notes = Vec::new();
    if random.happens(0.6) {
        fusion.layer_bytes_max = 12_000 + random.below(120_000) as usize;
        notes.push(format!("{} bytes of layers of others", fusion.layer_bytes_max));
    }
    if random.happens(0.4) {
        fusion.own_layer_bytes_max = 12_000 + random.below(60_000) as usize;
        notes.push(format!("{} bytes of its own layer", fusion.own_layer_bytes_max));
    }
    if notes.is_empty() { "as much as ever".to_owned() } else { notes.join(", ") }
}

/// Steps of the clock that stamps a robot's scans: when, and by how many microseconds.
pub(super) fn steps(random: &mut Random, mapping: i64) -> Vec<(i64, i64)> {
    let mut steps: Vec<(i64, i64)> = (0..1 + random.below(3))
        .map(|_| {
            let at = random.below(mapping as u64) as i64;
            let most = [50_000.0, 15e6, 3_600e6][random.below(3) as usize];
            (at, random.range(-most, most) as i64)
        })
        .collect();
    steps.sort_unstable();
    steps
}
