//! All that a seed decides before the flight begins.

use super::clock::Clock;
use super::plan::{self, Action};
use super::preset::{BUDGET_MIN, RadioNumbers, RadioPreset, Topology};
use super::purpose;
use super::trouble::{self, Trouble};
use super::{SwarmOptions, session};
use crate::{Burst, IP_UDP_BYTES, Link, RadioConfig};
use flockmap::sync::SwarmKey;
use flockmap::{BatchConfig, Cast, Codec, FusionConfig, Resolution, RobotConfig, RobotId};
use flockmap_worlds::random::Random;

/// Side of a voxel in metres: coarse, so that a flight costs little.
const VOXEL_M: f64 = 0.5;
const RANGE_M: f64 = 5.0;
/// A table of figures wants more of a map.
const TABLE_VOXEL_M: f64 = 0.25;
const TABLE_RAYS: usize = 60;
/// Longer flights are without submaps.
const SUBMAPS_MAX_MICROS: i64 = 60_000_000;

/// One robot.
#[derive(Clone, Debug)]
pub(super) struct MemberSettings {
    pub(super) config: RobotConfig,
    pub(super) clock: Clock,
    pub(super) rays: usize,
    pub(super) scan_period: i64,
    pub(super) has_no_returns: bool,
    /// After a crash it begins with what it stored.
    pub(super) has_disk: bool,
    /// When the clock that stamps its scans is stepped, and by how much.
    pub(super) clock_steps: Vec<(i64, i64)>,
}

/// A whole flight.
#[derive(Clone, Debug)]
pub(super) struct Settings {
    pub(super) options: SwarmOptions,
    pub(super) members: Vec<MemberSettings>,
    /// Microseconds of mapping; then links heal.
    pub(super) mapping: i64,
    pub(super) radio_name: String,
    pub(super) radio: RadioNumbers,
    pub(super) cast: Cast,
    /// Robots know each other's clocks exactly.
    pub(super) clocks_given: bool,
    /// What happens when, in microseconds, ascending.
    pub(super) plan: Vec<(i64, Action)>,
    /// Share of the datagrams of packages that their sender damages before it makes their check, 0 … 1.
    pub(super) broken: f64,
    /// The swarm has a key, and somebody without it is in reach.
    pub(super) key: Option<SwarmKey>,
    /// What is special about the sessions, as text.
    pub(super) notes: Vec<String>,
    pub(super) trouble: Trouble,
    /// Each robot hears by path: the number of who sent it.
    pub(super) has_paths: bool,
}

impl Settings {
    pub(super) fn draw(options: &SwarmOptions) -> Self {
        let seed = options.seed;
        let is_table = options.until_agreement_s.is_some();
        let mut random = Random::new(seed, purpose::SWARM);
        let drawn = [2, 2, 3, 3, 3, 4, 4, 5, 6][random.below(9) as usize];
        let robots = options.robots.unwrap_or(drawn).clamp(2, 200);
        let drawn = 2.0 + random.unit() * random.unit() * 6.0;
        let seconds = options.seconds.unwrap_or_else(|| (drawn * 10.0).round() / 10.0);
        let mut trouble = Trouble::draw(options);
        let seconds = if options.seconds.is_none() { seconds.max(trouble.seconds()) } else { seconds };
        let mapping = (seconds.clamp(0.1, 3_600.0) * 1e6) as i64;
        // To fuse submaps that are turned, at each scan, takes a minute in a flight of five.
        trouble.has_submaps &= mapping <= SUBMAPS_MAX_MICROS;
        let drawn = if random.happens(0.5) { Cast::Broadcast } else { Cast::Unicast };
        let cast = options.cast.unwrap_or(drawn);
        let clocks_given = random.happens(0.5);
        let has_drift = !clocks_given && random.happens(0.5);
        let clocks_given = clocks_given && !trouble.has_other_clocks();

        let (radio_name, mut radio) = draw_radio(options, &mut Random::new(seed, purpose::RADIO));
        let mut plan_random = Random::new(seed, purpose::PLAN);
        let mut plan =
            if options.is_calm { Vec::new() } else { plan::draw(&mut plan_random, robots, mapping) };
        let is_broken = plan_random.happens(0.12) && !options.is_calm;
        let has_key = plan_random.happens(0.2) && !options.is_calm;
        let broken = if is_broken && !has_key { plan_random.range(0.005, 0.08) } else { 0.0 };
        let mut random = Random::new(seed, purpose::SESSION);
        let swarm = session::Drawn {
            robots,
            cast,
            radio: &radio,
            plan: &plan,
            is_calm: options.is_calm,
            has_budgets: !is_table,
        };
        let key = has_key
            .then(|| SwarmKey::from_bytes(core::array::from_fn(|at| (seed >> (at % 8)) as u8 ^ at as u8)));
        let (mut sessions, mut notes) = session::draw(&mut random, &swarm);
        let mut field = Random::new(seed, purpose::FIELD);
        plan::add_field_day(&mut plan, &mut field, robots, mapping, trouble.restarts);
        // The paper's own session does not find out what a radio carries.
        let finds = sessions.iter().all(|session| session.congestion_control);
        trouble.crowd = trouble.crowd.filter(|_| finds);
        notes.extend(trouble.notes());
        if trouble.has_small_limits {
            for (number, session) in sessions.iter_mut().enumerate() {
                let mut random = purpose::of_robot(seed, purpose::LIMITS, number);
                let limits = trouble::limit(&mut random, session, robots, cast, &radio);
                notes.push(format!("robot {} has room for {limits}", number + 1));
            }
        }
        let caps = sessions.iter().enumerate().map(|(number, _)| {
            let mut fusion = FusionConfig::default();
            if trouble.has_small_layers {
                let mut random = purpose::of_robot(seed, purpose::CAPS, number);
                let limits = trouble::cap(&mut random, &mut fusion);
                notes.push(format!("robot {} has room for {limits}", number + 1));
            }
            fusion
        });
        let mut caps: Vec<FusionConfig> = caps.collect();
        if let Some(crowd) = trouble.crowd {
            radio.config = crowd.radio(radio.config);
            sessions.iter_mut().for_each(|session| crowd.limit(session));
        }
        if let Some(budget) = options.budget_bytes_per_s {
            sessions.iter_mut().for_each(|session| session.radio_bytes_per_s = Some(budget.max(BUDGET_MIN)));
            notes.push(format!("but {budget} bytes/s, as asked"));
        }
        let has_paths = trouble.has_paths && key.is_some() && cast == Cast::Unicast;
        let members = sessions.into_iter().enumerate().map(|(number, session)| {
            let mut random = purpose::of_robot(seed, purpose::ROBOT, number);
            let resolution = Resolution::from_metres(if is_table { TABLE_VOXEL_M } else { VOXEL_M })
                .unwrap_or_else(|| unreachable!("these are allowed"));
            let mut config = RobotConfig::new(RobotId(number as u16 + 1), resolution, RANGE_M);
            config.session = session;
            config.fusion = core::mem::take(&mut caps[number]);
            if trouble.has_pieces {
                let mut random = purpose::of_robot(seed, purpose::PIECES, number);
                config.snapshot_piece_bytes = 3_000 + random.below(30_000) as usize;
            }
            config.session.swarm_key.clone_from(&key);
            config.seed = seed;
            config.batch = draw_batch(&mut random, options.is_calm);
            config.codec = draw_codec(&mut random, options.is_calm);
            let drawn = [1_000, 1_000, 0, 200][random.below(4) as usize];
            config.repair_delay_max_ms = if options.is_calm { 1_000 } else { drawn };
            let steps = || trouble::steps(&mut purpose::of_robot(seed, purpose::CLOCKS, number), mapping);
            let offset = random.range(-1e9, 1e9) as i64;
            let ppm = random.range(-100.0, 100.0) as i64;
            MemberSettings {
                config,
                clock: Clock { offset, ppm: if has_drift { ppm } else { 0 } },
                rays: if is_table { TABLE_RAYS } else { 20 + random.below(60) as usize },
                scan_period: if is_table { 100_000 } else { 1_000 * (100 + random.below(200) as i64) },
                has_no_returns: random.happens(0.4),
                has_disk: (random.happens(0.4) || trouble.has_faulty_disks) && !options.is_calm,
                clock_steps: if trouble.has_steps { steps() } else { Vec::new() },
            }
        });
        Self {
            options: *options,
            members: members.collect(),
            mapping,
            radio_name,
            radio,
            cast,
            clocks_given,
            plan,
            broken,
            key,
            notes,
            trouble,
            has_paths,
        }
    }
}

fn draw_batch(random: &mut Random, is_calm: bool) -> BatchConfig {
    let mut batch =
        BatchConfig { publish_period_ms: 200 + random.below(900) as u32, ..BatchConfig::default() };
    if random.happens(0.4) {
        batch.obstacle_period_ms = Some(50 + random.below(200) as u32);
    }
    if random.happens(0.2) {
        batch.voxels_max = 20 + random.below(300) as usize;
    }
    if is_calm { BatchConfig::default() } else { batch }
}

fn draw_codec(random: &mut Random, is_calm: bool) -> Codec {
    let other = Codec::ALL[random.below(Codec::ALL.len() as u64) as usize];
    if random.happens(0.7) || is_calm { Codec::Flock } else { other }
}

fn draw_radio(options: &SwarmOptions, random: &mut Random) -> (String, RadioNumbers) {
    if let Some(preset) = options.radio {
        return (preset.name().to_owned(), preset.numbers());
    }
    // The slow one less often.
    let known = random.below(RadioPreset::ALL.len() as u64 * 2 - 1) as usize / 2;
    let preset = RadioPreset::ALL[known];
    if random.happens(0.5) {
        return (preset.name().to_owned(), preset.numbers());
    }
    ("drawn".to_owned(), draw_numbers(random))
}

/// A radio like none.
fn draw_numbers(random: &mut Random) -> RadioNumbers {
    let some = |random: &mut Random, share: f64, most: f64| {
        if random.happens(share) { random.unit() * random.unit() * most } else { 0.0 }
    };
    let rate = random.happens(0.4).then(|| 8_000 + (random.unit() * random.unit() * 1e6) as u32);
    let is_shared = rate.is_some() && random.happens(0.5);
    let burst = random.happens(0.3).then(|| Burst {
        good_ms: 500 + random.below(4_000) as u32,
        bad_ms: 20 + random.below(1_000) as u32,
        loss: random.range(0.3, 1.0),
    });
    let topologies =
        [Topology::Full, Topology::Full, Topology::Full, Topology::Line, Topology::Ring, Topology::Star];
    let config = RadioConfig {
        link: Link {
            delay_micros: (random.unit() * random.unit() * 200_000.0) as i64,
            jitter_micros: some(random, 0.7, 150_000.0) as i64,
            loss: some(random, 0.7, 0.6),
            duplication: some(random, 0.3, 0.3),
            damage: some(random, 0.4, 0.2),
            burst,
        },
        rate_bytes_per_s: rate,
        is_shared,
        airtime_overhead_micros: if is_shared { random.below(3_000) as i64 } else { 0 },
        queue_bytes_max: (4 + random.below(60) as usize) << 10,
        overhead_bytes: IP_UDP_BYTES,
        ..RadioConfig::default()
    };
    let topology = topologies[random.below(6) as usize];
    RadioNumbers { config, topology, budget_bytes_per_s: rate.map(|rate| rate / 5 * 4) }
}
