//! From the words of the configuration to the options of the parts.

use std::ffi::OsString;
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::time::Duration;

use flockmap::sync::{InFlight, Order, Relay};
use flockmap::{
    BatchConfig, Cast, Codec, MapperConfig, Pose, Preset, Resolution, RobotConfig, RobotId, SessionConfig,
};

use super::parse::nearest;
use super::{AlignmentSection, ConfigError, NodeConfig};
use crate::UdpOptions;

impl NodeConfig {
    /// The name for logs.
    pub fn robot_name(&self) -> String {
        self.name.clone().unwrap_or_else(|| format!("robot{}", self.id))
    }

    /// The options of the robot in a run with this epoch. The swarm key is not among them: [`swarm_key`](Self::swarm_key) finds it.
    ///
    /// # Errors
    /// Names the key, its value and what was expected.
    pub fn robot(&self, epoch: u64) -> Result<RobotConfig, ConfigError> {
        let map = &self.map;
        let resolution = Resolution::from_metres(map.resolution_m).ok_or_else(|| {
            value("[map] resolution_m", map.resolution_m, "the side of a voxel in metres, for example 0.1")
        })?;
        let preset: Preset = choose(
            "[map] mapper",
            &map.mapper,
            &[("rog-map", Preset::RogMap), ("racer", Preset::Racer), ("octomap", Preset::OctoMap)],
        )?;
        let mut config = RobotConfig::new(RobotId(self.id), resolution, map.range_m);
        config.epoch = epoch;
        config.mapper = MapperConfig::preset(preset, resolution, map.range_m);
        if !(0.0..map.range_m).contains(&map.range_min_m) {
            return Err(value("[map] range_min_m", map.range_min_m, "0 or more, and less than range_m"));
        }
        config.mapper.range_min_m = map.range_min_m;
        config.mapper.update_box_m = map.update_box_m;
        config.mapper.memory_bytes_max = (map.memory_mb as usize) << 20;
        let sensor = &mut config.mapper.sensor;
        for (given, value) in [
            (map.p_hit, &mut sensor.p_hit),
            (map.p_miss, &mut sensor.p_miss),
            (map.p_min, &mut sensor.p_min),
            (map.p_max, &mut sensor.p_max),
            (map.p_occupied, &mut sensor.p_occupied),
            (map.p_free, &mut sensor.p_free),
        ] {
            *value = given.unwrap_or(*value);
        }

        let batch = BatchConfig::default();
        config.batch = BatchConfig {
            voxels_max: self.batch.voxels_max.unwrap_or(batch.voxels_max),
            publish_period_ms: self.batch.publish_period_ms.unwrap_or(batch.publish_period_ms),
            obstacle_period_ms: self.batch.obstacle_period_ms,
        };
        if let Some(delay) = self.codec.repair_delay_max_ms {
            config.repair_delay_max_ms = delay;
        }
        if let Some(name) = &self.codec.name {
            config.codec = choose("[codec] name", name, &Codec::ALL.map(|codec| (codec.name(), codec)))?;
        }
        config.session = self.session()?;

        let fusion = &self.fusion;
        if let Some(ms) = fusion.own_priority_ms {
            config.fusion.own_priority_micros = i64::from(ms) * 1_000;
        }
        if let Some(mb) = fusion.layers_mb {
            config.fusion.layer_bytes_max = (mb as usize) << 20;
        }
        if let Some(mb) = fusion.own_layer_mb {
            config.fusion.own_layer_bytes_max = (mb as usize) << 20;
        }
        if let Some(radius) = self.teammates.radius_m {
            if !(0.0..=100.0).contains(&radius) {
                return Err(value("[teammates] radius_m", radius, "0 to 100"));
            }
            config.teammate_radius_m = radius;
        }
        if let Some(timeout) = self.teammates.timeout_ms {
            config.teammate_timeout_ms = timeout;
        }
        Ok(config)
    }

    /// The folder for the epoch: `[state] path`, else that which systemd gives (`STATE_DIRECTORY`), else `flockmap` in `XDG_STATE_HOME`, else
    /// `.local/state/flockmap` in `HOME`, each as far as it is an absolute path. `variable` looks up the environment.
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

    fn session(&self) -> Result<SessionConfig, ConfigError> {
        let given = &self.session;
        let behaviour = given.behaviour.as_deref().unwrap_or("default");
        let mut session = choose(
            "[session] behaviour",
            behaviour,
            &[("default", SessionConfig::default()), ("paper", SessionConfig::paper())],
        )?;
        fn set<T: Copy>(given: Option<T>, option: &mut T) {
            *option = given.unwrap_or(*option);
        }
        set(given.swarm, &mut session.swarm);
        set(given.request_period_active_ms, &mut session.request_period_active_ms);
        set(given.request_period_idle_ms, &mut session.request_period_idle_ms);
        set(given.active_for_ms, &mut session.active_for_ms);
        set(given.gap_requests, &mut session.gap_requests);
        set(given.reorder_patience_ms, &mut session.reorder_patience_ms);
        set(given.gap_request_pause_ms, &mut session.gap_request_pause_ms);
        set(given.push, &mut session.push);
        set(given.relay_delay_ms, &mut session.relay_delay_ms);
        set(given.round_trip_initial_ms, &mut session.round_trip_initial_ms);
        set(given.burst_ms, &mut session.burst_ms);
        set(given.peer_timeout_ms, &mut session.peer_timeout_ms);
        set(given.peers_max, &mut session.peers_max);
        set(given.streams_max, &mut session.streams_max);
        set(given.epochs_max, &mut session.epochs_max);
        set(given.store_mb.map(|mb| (mb as usize) << 20), &mut session.store_bytes_max);
        if let Some(cast) = &given.cast {
            let known = [("unicast", Cast::Unicast), ("broadcast", Cast::Broadcast)];
            session.cast = choose("[session] cast", cast, &known)?;
        }
        if let Some(order) = &given.order {
            let known = [("newest-first", Order::NewestFirst), ("oldest-first", Order::OldestFirst)];
            session.order = choose("[session] order", order, &known)?;
        }
        if let Some(relay) = &given.relay {
            let known = [("ranked", Relay::Ranked), ("always", Relay::Always), ("never", Relay::Never)];
            session.relay = choose("[session] relay", relay, &known)?;
        }
        if let Some(in_flight) = &given.in_flight {
            let known =
                [("round-trip", InFlight::RoundTrip), ("previous-request", InFlight::PreviousRequest)];
            session.in_flight = choose("[session] in_flight", in_flight, &known)?;
        }
        if let Some(kb_s) = given.budget_kb_s {
            session.radio_bytes_per_s = budget("[session] budget_kb_s", kb_s)?;
        }
        if let Some(kb_s) = given.link_budget_kb_s {
            session.link_bytes_per_s = budget("[session] link_budget_kb_s", kb_s)?;
        }
        if let Some(kb) = given.snapshot_kb_min {
            session.snapshot_bytes_min = (kb > 0).then(|| kb.saturating_mul(1_024));
        }
        if let Some(range) = given.snapshot_range_max {
            session.snapshot_range_max = (range > 0).then_some(range);
        }
        Ok(session)
    }

    /// The options of the sockets. Names among the peers are looked up here, once.
    ///
    /// # Errors
    /// A peer that is no address and whose name is not known.
    pub fn udp(&self) -> Result<UdpOptions, ConfigError> {
        let network = &self.network;
        let mut peers = Vec::with_capacity(network.peers.len());
        for peer in &network.peers {
            let expected = "ADDRESS:PORT, [ADDRESS]:PORT or NAME:PORT of a robot";
            let found = peer
                .to_socket_addrs()
                .map_err(|error| value("[network] peers", format!("\"{peer}\" ({error})"), expected))?;
            let mut found: Vec<SocketAddr> = found.collect();
            // A socket that was bound to IPv4 cannot reach the rest.
            found.sort_by_key(|address| address.is_ipv4() != network.bind.is_ipv4());
            let Some(&first) = found.first() else {
                return Err(value("[network] peers", peer, expected));
            };
            peers.push(first);
        }
        Ok(UdpOptions {
            bind: network.bind,
            peers,
            broadcast: network.broadcast,
            multicast: network.multicast,
            multicast_interface_v4: network.multicast_interface,
            multicast_interface_v6: network.multicast_interface_index,
            multicast_ttl: network.multicast_ttl,
            receive_buffer_bytes: (network.receive_buffer_kb as usize) << 10,
            send_buffer_bytes: (network.send_buffer_kb as usize) << 10,
        })
    }

    /// Permissions of the file of the Unix socket.
    ///
    /// # Errors
    /// It is not octal, or would keep the owner out.
    pub fn unix_mode(&self) -> Result<u32, ConfigError> {
        let text = &self.sensor.unix_mode;
        let mode = u32::from_str_radix(text, 8).ok().filter(|mode| mode & 0o600 == 0o600 && *mode <= 0o777);
        mode.filter(|_| text.bytes().all(|b| b.is_ascii_digit())).ok_or_else(|| {
            let expected =
                "permissions in octal that let the owner in: \"0600\", or \"0660\" for the group too";
            value("[sensor] unix_mode", format!("\"{text}\""), expected)
        })
    }

    /// `T_own_origin` of each robot that has one.
    ///
    /// # Errors
    /// A key that is no robot, or numbers that are no rotation.
    pub fn alignments(&self) -> Result<Vec<(RobotId, Pose)>, ConfigError> {
        let pose = |(id, section): (&String, &AlignmentSection)| {
            let key = format!("[alignment.{id}]");
            let fail = |expected: &str| value(&key, format!("{section:?}"), expected);
            let pose = match (section.quaternion_xyzw, section.yaw_deg) {
                (Some(_), Some(_)) => {
                    return Err(fail("quaternion_xyzw or yaw_deg, not both"));
                }
                (Some(quaternion), None) => Pose::new(section.translation_m, quaternion),
                (None, yaw) => {
                    let half = yaw.unwrap_or(0.0).to_radians() / 2.0;
                    Pose::new(section.translation_m, [0.0, 0.0, half.sin(), half.cos()])
                }
            };
            let pose = pose.ok_or_else(|| fail("finite numbers and a quaternion that is not 0"))?;
            if let Some(resolution) = Resolution::from_metres(self.map.resolution_m) {
                pose.check(resolution).map_err(|error| fail(&format!("a pose in the grid: {error}")))?;
            }
            Ok((robot(&key, id)?, pose))
        };
        self.alignment.iter().map(pose).collect()
    }

    /// How far the clocks of others are ahead of the own one, in microseconds.
    ///
    /// # Errors
    /// A key that is no robot.
    pub fn clock_offsets(&self) -> Result<Vec<(RobotId, i64)>, ConfigError> {
        let offset = |(id, ms): (&String, &f64)| {
            if !ms.is_finite() {
                return Err(value(&format!("[clock_offset_ms] {id}"), ms, "a finite number of milliseconds"));
            }
            Ok((robot("[clock_offset_ms]", id)?, (ms * 1e3).round() as i64))
        };
        self.clock_offset_ms.iter().map(offset).collect()
    }
}

/// A time in seconds that is a time.
pub(crate) fn seconds(key: &str, seconds: f64) -> Result<Duration, ConfigError> {
    if !(0.0..=1e8).contains(&seconds) {
        return Err(value(key, seconds, "seconds, 0 to 100,000,000"));
    }
    Ok(Duration::from_secs_f64(seconds))
}

pub(crate) fn value(key: &str, got: impl ToString, expected: impl Into<String>) -> ConfigError {
    ConfigError::Value { key: key.to_owned(), got: got.to_string(), expected: expected.into() }
}

fn choose<T: Clone>(key: &str, word: &str, known: &[(&str, T)]) -> Result<T, ConfigError> {
    if let Some((_, choice)) = known.iter().find(|(name, _)| *name == word) {
        return Ok(choice.clone());
    }
    let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
    let hint = nearest(word, names.iter().copied())
        .map_or_else(String::new, |name| format!("; did you mean \"{name}\"?"));
    Err(value(key, format!("\"{word}\""), format!("one of {}{hint}", names.join(", "))))
}

fn robot(key: &str, id: &str) -> Result<RobotId, ConfigError> {
    id.parse().map(RobotId).map_err(|_| value(key, id, "the id of a robot, 0 to 65535"))
}

/// KiB per second to bytes per second; 0 is no limit.
fn budget(key: &str, kb_s: f64) -> Result<Option<u32>, ConfigError> {
    let bytes = kb_s * 1_024.0;
    match bytes {
        0.0 => Ok(None),
        500.0..=4e9 => Ok(Some(bytes as u32)),
        _ => Err(value(key, kb_s, "0 for no limit, or at least 0.49 (KiB in a second; 500 bytes)")),
    }
}
