//! From the configuration to the options of the parts, where a rule lies in between.

use std::ffi::OsString;
use std::ops::{Bound, RangeBounds};
use std::path::PathBuf;
use std::time::Duration;

use flockmap::{FusionConfig, Pose, Robot, RobotConfig, RobotId, Stamp, StatesUpdate};

use super::error::ConfigError;
use super::{AlignmentSection, NodeConfig};
use crate::{EndOptions, FlightOptions, MapOutput, MessageLimits, Recording};

/// Most points that a scan may have.
const SCAN_POINTS_MAX: u32 = 1 << 26;

/// Most readers of the map.
const READERS_MAX: u32 = 1_024;

/// Fewest bytes of a record.
const RECORD_BYTES_MIN: u64 = 1 << 20;

impl NodeConfig {
    /// Checks all that can be known without the machine that it is for.
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        Robot::new(self.robot(1)?, Stamp(0)).map_err(ConfigError::Robot)?;
        self.alignments()?;
        self.clock_offsets()?;
        self.unix_mode()?;
        self.map_output()?;
        self.recording()?;
        self.view_token()?;
        self.end_options()?;
        self.message_limits()?;
        self.ros.check()?;
        seconds("[metrics] status_period_s", self.metrics.status_period_s)?;
        seconds("[sensor] start_s", self.sensor.start_s)?;
        speed("[sensor] speed", self.sensor.speed)?;
        let least = flockmap_store::BYTES_MAX_MIN;
        within("[store] bytes_max", self.store.bytes_max, least.., &format!("at least {least}"))?;
        within("[sensor] repeat", self.sensor.repeat, 1.., "1 or more")?;
        Ok(())
    }

    /// When the node ends by itself.
    pub(crate) fn end_options(&self) -> Result<EndOptions, ConfigError> {
        let output = &self.output;
        Ok(EndOptions {
            after: output.end_after_s.map(|s| seconds("[output] end_after_s", s)).transpose()?,
            when_quiet: output
                .end_when_quiet_s
                .map(|s| seconds("[output] end_when_quiet_s", s))
                .transpose()?,
            linger: Duration::from_millis(output.linger_ms.into()),
        })
    }

    /// What a sensor program may send.
    pub(crate) fn message_limits(&self) -> Result<MessageLimits, ConfigError> {
        let section = &self.sensor;
        let points_max = section.scan_points_max;
        let error = seconds("[sensor] stamp_error_max_s", section.stamp_error_max_s)?;
        Ok(MessageLimits {
            scan_points_max: within(
                "[sensor] scan_points_max",
                points_max,
                1..=SCAN_POINTS_MAX,
                "1 to 67,108,864",
            )?,
            states_max: within(
                "[sensor] states_max",
                section.states_max,
                1..=StatesUpdate::VOXELS_MAX as u32,
                "1 to 4,194,304",
            )?,
            box_states_max: within(
                "[sensor] box_states_max",
                section.box_states_max,
                1..=StatesUpdate::BOX_VOXELS_MAX as u32,
                "1 to 33,554,432",
            )?,
            stamp_error_max_micros: i64::try_from(error.as_micros()).unwrap_or(i64::MAX),
        })
    }

    /// The name for logs.
    pub fn robot_name(&self) -> String {
        self.name.clone().unwrap_or_else(|| format!("robot{}", self.id))
    }

    /// The options of the robot in a run with this epoch. The swarm key is not among them:
    /// [`swarm_key`](Self::swarm_key) finds it.
    ///
    /// # Errors
    /// Names the key, its value and what was expected.
    pub fn robot(&self, epoch: u64) -> Result<RobotConfig, ConfigError> {
        let Self { map, codec, teammates, .. } = self;
        // What is wrong with range_m itself, the mapper says.
        if map.range_m > 0.0 {
            let expected = "0 or more, and less than range_m";
            within("[map] range_min_m", map.range_min_m, 0.0..map.range_m, expected)?;
        }
        let default = RobotConfig::new(self.id, map.resolution, map.range_m);
        let radius = teammates.radius_m.unwrap_or(default.teammate_radius_m);
        let submap_length_m = self.submaps.length_m;
        let submap_length_m = submap_length_m
            .map(|length| within("[submaps] length_m", length, 0.1..=1e6, "0.1 to 1,000,000"))
            .transpose()?;
        Ok(RobotConfig {
            epoch,
            submap_length_m,
            mapper: map.clone(),
            batch: self.batch,
            codec: codec.name.unwrap_or(default.codec),
            repair_delay_max_ms: codec.repair_delay_max_ms.unwrap_or(default.repair_delay_max_ms),
            session: self.session.clone(),
            fusion: FusionConfig {
                streams_max: self.fusion.streams_max.max(self.session.streams_max + 1),
                ..self.fusion.clone()
            },
            teammate_radius_m: within("[teammates] radius_m", radius, 0.0..=100.0, "0 to 100")?,
            teammate_timeout_ms: teammates.timeout_ms.unwrap_or(default.teammate_timeout_ms),
            ..default
        })
    }

    /// The folder for the epoch: `[state] path`, else that which systemd gives (`STATE_DIRECTORY`), else
    /// `flockmap` in `XDG_STATE_HOME`, else `.local/state/flockmap` in `HOME`, each as far as it is an
    /// absolute path. `variable` looks up the environment.
    pub fn state_folder(&self, variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
        let absolute = |path: PathBuf| path.is_absolute().then_some(path);
        let folder = |name: &str| variable(name).map(PathBuf::from).and_then(absolute);
        // A service may have several; the first one will do.
        let systemd = variable("STATE_DIRECTORY").and_then(|all| std::env::split_paths(&all).next());
        let configured = self.state.path.clone();
        configured
            .or_else(|| systemd.and_then(absolute))
            .or_else(|| folder("XDG_STATE_HOME").map(|path| path.join("flockmap")))
            .or_else(|| folder("HOME").map(|path| path.join(".local/state/flockmap")))
    }

    /// Permissions of the file of the sensor's Unix socket.
    ///
    /// # Errors
    /// It is not octal, or would keep the owner out.
    pub fn unix_mode(&self) -> Result<u32, ConfigError> {
        unix_mode("[sensor] unix_mode", &self.sensor.unix_mode)
    }

    /// Where the map is given out; `None` if nowhere.
    ///
    /// # Errors
    /// Names the key, its value and what was expected.
    pub(crate) fn map_output(&self) -> Result<Option<MapOutput>, ConfigError> {
        let section = &self.map_output;
        let mode = unix_mode("[map_output] unix_mode", &section.unix_mode)?;
        let readers = within("[map_output] readers_max", section.readers_max, 1..=READERS_MAX, "1 to 1,024")?;
        let period = within("[map_output] period_ms", section.period_ms, 1..=60_000, "1 to 60,000")?;
        if section.listen_unix.is_none() && section.listen_tcp.is_none() && self.view.listen.is_none() {
            return Ok(None);
        }
        Ok(Some(MapOutput {
            unix: section.listen_unix.clone().map(|path| (path, mode)),
            tcp: section.listen_tcp,
            readers_max: readers as usize,
            period: Duration::from_millis(period.into()),
            frame: self.sensor.map_frame.clone().unwrap_or_else(|| "map".into()),
        }))
    }

    /// How the flight is recorded; `None` if it is not.
    ///
    /// # Errors
    /// Names the key, its value and what was expected.
    pub(crate) fn recording(&self) -> Result<Option<Recording>, ConfigError> {
        let section = &self.record;
        let options = FlightOptions {
            scans: section.scans,
            origins: section.origins,
            picture_period: seconds("[record] picture_period_s", section.picture_period_s)?,
            bytes_max: within(
                "[record] bytes_max",
                section.bytes_max,
                RECORD_BYTES_MIN..,
                "at least 1,048,576",
            )?,
        };
        Ok(section.path.clone().map(|path| Recording { path, options }))
    }

    /// `T_own_origin` of each robot that has one.
    ///
    /// # Errors
    /// Numbers that are no rotation.
    pub fn alignments(&self) -> Result<Vec<(RobotId, Pose)>, ConfigError> {
        let pose = |(&id, section): (&RobotId, &AlignmentSection)| {
            let fail = |key: &str, got: String, expected: &str| {
                value(&format!("[alignment.{id}] {key}"), got, expected)
            };
            let rotation = match (section.quaternion_xyzw, section.yaw_deg.unwrap_or(0.0).to_radians() / 2.0)
            {
                (Some(_), _) if section.yaw_deg.is_some() => {
                    return Err(fail("yaw_deg", "given, and quaternion_xyzw too".into(), "one of them"));
                }
                (Some(quaternion), _) => quaternion,
                (None, half) => [0.0, 0.0, half.sin(), half.cos()],
            };
            let no_rotation = || match (section.quaternion_xyzw, section.yaw_deg) {
                (None, Some(degrees)) => fail("yaw_deg", degrees.to_string(), "a finite number of degrees"),
                _ => {
                    let expected = "finite numbers, x, y, z, w, that are not all 0";
                    fail("quaternion_xyzw", format!("{rotation:?}"), expected)
                }
            };
            Pose::new([0.0; 3], rotation).ok_or_else(no_rotation)?;
            let translation = section.translation_m;
            let pose =
                Pose::new(translation, rotation).filter(|pose| pose.check(self.map.resolution).is_ok());
            let no_translation = || {
                let expected = "finite numbers of metres, from an origin near the robots";
                fail("translation_m", format!("{translation:?}"), expected)
            };
            Ok((id, pose.ok_or_else(no_translation)?))
        };
        self.alignment.iter().map(pose).collect()
    }

    /// How far the clocks of others are ahead of the own one, in microseconds.
    ///
    /// # Errors
    /// What is no number of milliseconds.
    pub fn clock_offsets(&self) -> Result<Vec<(RobotId, i64)>, ConfigError> {
        let offset = |(&id, ms): (&RobotId, &f64)| {
            let key = format!("[clock_offset_ms] {id}");
            let ms = within(&key, *ms, f64::MIN..=f64::MAX, "a finite number of milliseconds")?;
            Ok((id, (ms * 1e3).round() as i64))
        };
        self.clock_offset_ms.iter().map(offset).collect()
    }
}

/// Permissions in octal.
fn unix_mode(key: &str, text: &str) -> Result<u32, ConfigError> {
    let mode = u32::from_str_radix(text, 8).ok().filter(|mode| mode & 0o600 == 0o600 && *mode <= 0o777);
    mode.filter(|_| text.bytes().all(|b| b.is_ascii_digit())).ok_or_else(|| {
        let expected = "permissions in octal that let the owner in: \"0600\", or \"0660\" for the group too";
        value(key, format!("\"{text}\""), expected)
    })
}

/// A time in seconds that is a time.
pub(crate) fn seconds(key: &str, seconds: f64) -> Result<Duration, ConfigError> {
    within(key, seconds, 0.0..=1e8, "seconds, 0 to 100,000,000").map(Duration::from_secs_f64)
}

/// How fast a record may be played.
pub(crate) fn speed(key: &str, speed: f64) -> Result<f64, ConfigError> {
    within(key, speed, (Bound::Excluded(0.0), Bound::Included(1e6)), "more than 0 and at most 1,000,000")
}

/// A number that is among those allowed.
pub(crate) fn within<T: PartialOrd + ToString>(
    key: &str,
    number: T,
    allowed: impl RangeBounds<T>,
    expected: &str,
) -> Result<T, ConfigError> {
    if allowed.contains(&number) { Ok(number) } else { Err(value(key, number, expected)) }
}

pub(crate) fn value(key: &str, got: impl ToString, expected: impl Into<String>) -> ConfigError {
    ConfigError::Value { key: key.to_owned(), got: got.to_string(), expected: expected.into() }
}
