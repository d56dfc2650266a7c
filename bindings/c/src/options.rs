//! The options of a robot, and the robot that they make.

use std::ffi::c_char;
use std::time::{SystemTime, UNIX_EPOCH};

use flockmap_core::sync::SwarmKey;
use flockmap_core::{
    Cast, MapperConfig, Pose, Preset, Resolution, Robot, RobotConfig, RobotId, Stamp, epoch,
};
use flockmap_node::NodeConfig;

use crate::args::{Args, flag, one, text};
use crate::result::{Failure, Outcome, guard};
use crate::robot::RobotHandle;

/// Longest text of options, in bytes.
const TOML_BYTES_MAX: usize = 1 << 20;

/// Whose rules the mapper follows: flockmap_robot_options.mapper.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum MapperKind {
    /// ROG-Map: every ray counts, and hits win over the misses of the same scan. The default.
    RogMap = 0,
    /// RACER: one update for a voxel and scan; the first touch decides.
    Racer = 1,
    /// OctoMap's insertPointCloud with its default sensor model.
    Octomap = 2,
}

/// What most robots need to say. flockmap_robot_new_from_toml takes all options.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Number of this run, which no two runs of a robot may share: flockmap_epoch makes one. 0 (default): made of the
    /// system's clock and random bits.
    pub epoch: u64,
    /// Moves requests of different robots apart in time; the same for all will do. Default 0.
    pub seed: u64,
    /// Side of a voxel in metres, 0.001 to 100; the same for all robots of a swarm. Default 0.1.
    pub resolution_m: f64,
    /// Longer rays are cut here. Metres, above 0, at most 500 voxels. Default 7.
    pub range_m: f64,
    /// Nearer points are ignored: the robot's own body. Metres. Default 0.
    pub range_min_m: f64,
    /// Bytes of the own map; the blocks farthest away are forgotten beyond it. Default 512 MiB.
    pub map_bytes_max: u64,
    /// One of flockmap_mapper_kind. Default FLOCKMAP_MAPPER_KIND_ROG_MAP.
    pub mapper: i32,
    /// Changes are packed after so many milliseconds, 1 or more. Default 500.
    pub publish_period_ms: u32,
    /// Obstacles go out after so many milliseconds, ahead of free space. 0 (default): both together.
    pub obstacle_period_ms: u32,
    /// Bytes that may go out in a second, over all links; 0: no limit. Default 2,000,000.
    pub radio_bytes_per_s: u32,
    /// Bytes that may go out to one robot in a second; 0 (default): no limit.
    pub link_bytes_per_s: u32,
    /// Number of this robot, 0 to 65535. No two robots of a swarm may have the same. Default 1.
    pub id: u16,
    /// Robots of other swarms are ignored. Default 0.
    pub swarm: u16,
    /// 0 (default): a datagram for each robot; 1: one for all, by broadcast or multicast.
    pub broadcast: u8,
    /// Whether swarm_key is given, 0 (default) or 1. Without, anybody in reach of the radio can read and change the map.
    pub has_swarm_key: u8,
    /// The secret of the swarm, from a random generator.
    pub swarm_key: [u8; 32],
}

/// Writes the defaults. `options` is the caller's; null is FLOCKMAP_ERROR_NULL. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_options_default(options: *mut Options) -> Outcome {
    guard("flockmap_robot_options_default", || {
        // SAFETY: the caller's word, as of the header.
        unsafe { one(&mut Args::default(), options, "options") }?.set(0, defaults());
        Ok(Outcome::Ok)
    })
}

fn defaults() -> Options {
    const RESOLUTION: Resolution = Resolution::from_micrometres(100_000).unwrap();
    let config = RobotConfig::new(RobotId(1), RESOLUTION, 7.0);
    Options {
        epoch: 0,
        seed: config.seed,
        resolution_m: RESOLUTION.metres(),
        range_m: config.mapper.range_m,
        range_min_m: config.mapper.range_min_m,
        map_bytes_max: config.mapper.memory_bytes_max as u64,
        mapper: MapperKind::RogMap as i32,
        publish_period_ms: config.batch.publish_period_ms,
        obstacle_period_ms: config.batch.obstacle_period_ms.unwrap_or(0),
        radio_bytes_per_s: config.session.radio_bytes_per_s.unwrap_or(0),
        link_bytes_per_s: config.session.link_bytes_per_s.unwrap_or(0),
        id: config.id.0,
        swarm: config.session.swarm,
        broadcast: 0,
        has_swarm_key: 0,
        swarm_key: [0; SwarmKey::BYTES],
    }
}

/// A number for a run: of the seconds since 1970 and 32 random bits. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn flockmap_epoch(seconds_since_1970: u32, random: u32) -> u64 {
    epoch(seconds_since_1970, random)
}

/// Makes a robot with an empty map.
///
/// `options` is read and not kept. `now_us` is the time on the robot's clock, in microseconds from any beginning; time
/// that goes back later stands still. `*robot` is the new robot, to be freed by flockmap_robot_free; null on an error.
/// FLOCKMAP_ERROR_CONFIG names the option that cannot work; a null is FLOCKMAP_ERROR_NULL. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_new(
    options: *const Options,
    now_us: i64,
    robot: *mut *mut RobotHandle,
) -> Outcome {
    guard("flockmap_robot_new", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (mut to, options) =
            unsafe { (one(&mut args, robot, "robot")?, args.input(options, 1, "options")) };
        to.set(0, std::ptr::null_mut());
        let config = config_of(&options?[0])?;
        let made = Robot::new(config, Stamp(now_us)).map_err(|e| Failure::new(Outcome::ErrorConfig, e))?;
        to.set(0, RobotHandle::boxed(made));
        Ok(Outcome::Ok)
    })
}

fn config_of(options: &Options) -> Result<RobotConfig, Failure> {
    let wrong = |text: String| Failure::new(Outcome::ErrorConfig, text);
    let resolution = Resolution::from_metres(options.resolution_m).ok_or_else(|| {
        wrong(format!("resolution_m is {}, expected the side of a voxel, 0.001 to 100", options.resolution_m))
    })?;
    let preset = match options.mapper {
        0 => Preset::RogMap,
        1 => Preset::Racer,
        2 => Preset::OctoMap,
        other => return Err(wrong(format!("mapper is {other}, expected a flockmap_mapper_kind, 0 to 2"))),
    };
    let (range, nearest) = (options.range_m, options.range_min_m);
    if range > 0.0 && !(0.0..range).contains(&nearest) {
        return Err(wrong(format!("range_min_m is {nearest}, expected 0 or more, and less than range_m")));
    }
    let mut config = RobotConfig::new(RobotId(options.id), resolution, range);
    config.epoch = if options.epoch == 0 { new_epoch()? } else { options.epoch };
    config.seed = options.seed;
    config.mapper = MapperConfig {
        range_min_m: nearest,
        memory_bytes_max: usize::try_from(options.map_bytes_max).unwrap_or(usize::MAX),
        ..MapperConfig::preset(preset, resolution, range)
    };
    config.batch.publish_period_ms = options.publish_period_ms;
    let unless_zero = |value: u32| (value != 0).then_some(value);
    config.batch.obstacle_period_ms = unless_zero(options.obstacle_period_ms);
    config.session.radio_bytes_per_s = unless_zero(options.radio_bytes_per_s);
    config.session.link_bytes_per_s = unless_zero(options.link_bytes_per_s);
    config.session.swarm = options.swarm;
    config.session.cast =
        if flag(options.broadcast.into(), "broadcast")? { Cast::Broadcast } else { Cast::Unicast };
    if flag(options.has_swarm_key.into(), "has_swarm_key")? {
        if options.swarm_key == [options.swarm_key[0]; SwarmKey::BYTES] {
            return Err(wrong(
                "swarm_key is one byte repeated, expected 32 random ones: `flockmap key` makes them".into(),
            ));
        }
        config.session.swarm_key = Some(SwarmKey::from_bytes(options.swarm_key));
    }
    config.session.salt = random()?;
    Ok(config)
}

/// Makes a robot from the text of a node's configuration: `crates/flockmap-node/robot.example.toml` has every option.
///
/// The mapper has the threads that `[map] threads` says; where it does not, half of the cores, at most 4.
///
/// Sections that are for a node (network, sensor, map_output, store, state, metrics, output) are checked and not used:
/// sockets and files are the caller's. A swarm key is taken from the text or the file that it names, not from the
/// environment. `toml` ends with a 0, is UTF-8 of at most 1 MiB, and not kept. `epoch`, `now_us` and `robot` as for
/// flockmap_robot_new. FLOCKMAP_ERROR_CONFIG names the key and its line. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_new_from_toml(
    toml: *const c_char,
    epoch: u64,
    now_us: i64,
    robot: *mut *mut RobotHandle,
) -> Outcome {
    guard("flockmap_robot_new_from_toml", || {
        // SAFETY: the caller's word, as of the header.
        let (mut to, toml) = unsafe { (one(&mut Args::default(), robot, "robot")?, text(toml, "toml")) };
        to.set(0, std::ptr::null_mut());
        to.set(0, RobotHandle::boxed(robot_of(toml?, epoch, Stamp(now_us))?));
        Ok(Outcome::Ok)
    })
}

fn robot_of(toml: &str, epoch: u64, now: Stamp) -> Result<Robot, Failure> {
    if toml.len() > TOML_BYTES_MAX {
        return Err(Failure::argument(format_args!("toml has {} bytes, expected at most 1 MiB", toml.len())));
    }
    let wrong = |error: flockmap_node::ConfigError| Failure::new(Outcome::ErrorConfig, error);
    let options: NodeConfig = toml.parse().map_err(wrong)?;
    let mut config = options.robot(if epoch == 0 { new_epoch()? } else { epoch }).map_err(wrong)?;
    config.session.swarm_key =
        options.swarm_key("toml".as_ref(), None).map_err(wrong)?.map(|found| found.key);
    config.session.salt = random()?;
    let alignments: Vec<(RobotId, Pose)> = options.alignments().map_err(wrong)?;
    let offsets = options.clock_offsets().map_err(wrong)?;
    let mut robot = Robot::new(config, now).map_err(|e| Failure::new(Outcome::ErrorConfig, e))?;
    for (origin, pose) in alignments {
        robot.set_alignment(origin, &pose).map_err(|e| Failure::new(Outcome::ErrorConfig, e))?;
    }
    for (origin, micros) in offsets {
        robot.set_clock_offset(origin, Some(micros));
    }
    for origin in options.muted {
        robot.set_muted(origin, true);
    }
    Ok(robot)
}

fn new_epoch() -> Result<u64, Failure> {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    Ok(epoch(seconds as u32, u32::from_le_bytes(random()?)))
}

/// Bytes that nobody can guess.
fn random<const N: usize>() -> Result<[u8; N], Failure> {
    let mut bytes = [0; N];
    let fail =
        |e| Failure::new(Outcome::ErrorInternal, format_args!("the system gives no random bytes: {e}"));
    getrandom::fill(&mut bytes).map_err(fail)?;
    Ok(bytes)
}
