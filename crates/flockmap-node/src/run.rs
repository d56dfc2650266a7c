//! One robot from a configuration file, until it is asked to end.

use std::env::VarError;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::{fmt, io};

use anyhow::{Context, Result, anyhow, bail};
use flockmap::sync::SwarmKey;
use flockmap_io::{RecordOptions, open_record};
use flockmap_view::{Access, Token};

use crate::config::{Configuration, check_applies, seconds, speed, within};
use crate::kept::Kept;
use crate::outputs::Report;
use crate::sensor::repeated;
use crate::{
    Ended, KEY_VARIABLE, Log, MapOutput, Node, NodeConfig, NodeHandle, NodeOptions, Observer, RosSection,
    Sensor, Signals, Transport, UdpOptions, UdpSockets, ViewOptions, outputs,
};

/// Runs the robot of a configuration file: what `flockmap node --config` does. Ends on Ctrl-C, SIGTERM, or as
/// configured; then saves the map if asked, and writes a summary as JSON to the configured file, or to stdout.
///
/// # Errors
/// A configuration that cannot work, named by its key; a socket or file that cannot be opened. At the end, a
/// file that could not be written where it was wanted: the text says where it is in place of that.
pub fn run(config_path: &Path) -> Result<()> {
    let configuration = Configuration::read(config_path)?;
    let log = Log::to_stderr(&configuration.config.robot_name());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // Also while the node starts.
    let signals = runtime.block_on(async { Signals::new() }).context("cannot listen to signals")?;
    let node = ConfiguredNode::start_with(configuration, Embedding::default(), log)?;
    runtime.block_on(until_ended(&node.node, signals, &node.log));
    let (config, log) = (node.config, node.log);
    let ended = node.node.join()?;
    outputs::save(&config, &ended, &log, Report::Always)
}

/// A node started from a configuration, for programs that have signals and outputs of their own.
#[derive(Debug)]
pub struct ConfiguredNode {
    /// The node.
    pub node: NodeHandle,
    config: NodeConfig,
    log: Log,
}

impl ConfiguredNode {
    /// Starts the robot of a configuration file.
    ///
    /// # Errors
    /// As of [`run`], as far as the start goes.
    pub fn start(config_path: &Path, log: Option<Log>) -> Result<Self> {
        let configuration = Configuration::read(config_path)?;
        let log = log.unwrap_or_else(|| Log::to_stderr(&configuration.config.robot_name()));
        Self::start_with(configuration, Embedding::default(), log)
    }

    /// Starts the robot of a configuration that was read, on the radio that `[network]` says.
    ///
    /// # Errors
    /// As of [`Self::start`]; and a source of scans in `[sensor]` beside the one that is given.
    pub fn start_with(configuration: Configuration, embedding: Embedding, log: Log) -> Result<Self> {
        let open = |config: &NodeConfig, log: &Log| {
            let sockets = UdpSockets::bind(&config.network)?;
            log.info(format!("listens on {}", sockets.local_addr()?));
            let UdpOptions { peers, broadcast, multicast, .. } = &config.network;
            if peers.is_empty() && broadcast.is_none() && multicast.is_none() {
                log.warn("[network] has no peers, broadcast or multicast: this robot sends to nobody before somebody sends to it");
            }
            Ok(move || sockets.into_transport())
        };
        Self::start_over(configuration, embedding, open, log)
    }

    /// The same over a transport of the program's own, in place of `[network]`: `open` gets what is needed for it, and
    /// what it returns makes it, in the thread of the node.
    ///
    /// # Errors
    /// As of [`Self::start_with`].
    pub fn start_over<T: Transport, M: FnOnce() -> io::Result<T> + Send + 'static>(
        configuration: Configuration,
        embedding: Embedding,
        open: impl FnOnce(&NodeConfig, &Log) -> Result<M>,
        log: Log,
    ) -> Result<Self> {
        let node = start(&configuration, embedding, open, &log)
            // Whatever names a key says where in the file that is.
            .map_err(|error| anyhow!(configuration.places.locate(&format!("{error:#}"))))?;
        Ok(Self { node, config: configuration.config, log })
    }

    /// Waits until the node has ended, without stopping it, and writes the files of `[output]` that are configured.
    /// Nothing goes to stdout but a report that can be written nowhere else.
    ///
    /// # Errors
    /// The thread of the node panicked. The inner result says which file could not be written where it was wanted.
    pub fn join(self) -> Result<(Ended, Result<()>)> {
        let Self { node, config, log } = self;
        let ended = node.join()?;
        let saved = outputs::save(&config, &ended, &log, Report::IfConfigured);
        Ok((ended, saved))
    }
}

/// What a program that has a node in it brings along.
#[derive(Default)]
pub struct Embedding {
    /// Where scans come from, in place of what `[sensor]` says.
    pub sensor: Option<Sensor>,
    /// Called with every scan and event.
    pub observer: Option<Observer>,
    /// Counters of the program, given out with the node's own.
    pub counters: Vec<(&'static str, Arc<AtomicU64>)>,
}

impl fmt::Debug for Embedding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Embedding").field("sensor", &self.sensor).finish_non_exhaustive()
    }
}

/// Looks at all that can be wrong, and then starts.
fn start<T: Transport, M: FnOnce() -> io::Result<T> + Send + 'static>(
    configuration: &Configuration,
    embedding: Embedding,
    open: impl FnOnce(&NodeConfig, &Log) -> Result<M>,
    log: &Log,
) -> Result<NodeHandle> {
    let Configuration { config, places, path } = configuration;
    let Embedding { sensor: given, observer, counters } = embedding;
    check_applies(places, given.is_some())?;
    outputs::check(&config.output)?;
    outputs::check_record(&config.record)?;
    let sensor = match given {
        Some(sensor) => sensor,
        None => sensor(config, T::HEARS_OTHERS, log)?,
    };
    let swarm_key = if T::HEARS_OTHERS { swarm_key(config, path, log)? } else { None };
    let make_transport = open(config, log)?;
    // Last, as an epoch is used up.
    let kept = Kept::open(config, &config.robot(0)?, u32::from_le_bytes(random_bytes()?), log)?;
    let mut options = NodeOptions::new(config.robot(kept.epoch)?);
    options.robot.session.swarm_key = swarm_key;
    options.robot.session.datagram_overhead_bytes = T::OVERHEAD_BYTES;
    options.robot.session.salt = random_bytes()?;
    (options.store, options.epoch_file) = (kept.store, kept.epoch_file);
    options.name = config.robot_name();
    options.sensor = sensor;
    options.alignments = config.alignments()?;
    options.clock_offsets = config.clock_offsets()?;
    options.muted = config.muted.clone();
    options.map_output = map_output(config, log)?;
    options.record = config.recording()?;
    options.view = view(config, log)?;
    options.prometheus = config.metrics.prometheus;
    let period = seconds("[metrics] status_period_s", config.metrics.status_period_s)?;
    options.status_period = (!period.is_zero()).then_some(period);
    options.end = config.end_options()?;
    options.log = log.clone();
    (options.observer, options.counters_beside) = (observer, counters);
    let own = (options.robot.id, options.robot.epoch);
    let node = Node::start(options, make_transport)?;
    log.info(format!("robot {} epoch {} has started", own.0, own.1));
    if let Some(sensor) = node.sensor_address() {
        log.info(format!("takes scans at {sensor}"));
    }
    for address in node.map_addresses() {
        log.info(format!("gives the map out at {address}"));
    }
    if let Some(url) = node.view_url() {
        log.info(format!("shows the map in a browser at {url}"));
    }
    if let Some(address) = node.prometheus_address() {
        log.info(format!("serves counters at http://{address}/metrics"));
    }
    Ok(node)
}

/// The key of the swarm; says where it comes from, or what it means that there is none.
fn swarm_key(config: &NodeConfig, config_path: &Path, log: &Log) -> Result<Option<SwarmKey>> {
    let variable = match std::env::var(KEY_VARIABLE) {
        Ok(text) => Some(text),
        Err(VarError::NotPresent) => None,
        Err(VarError::NotUnicode(_)) => {
            bail!("the environment variable {KEY_VARIABLE} is no text, expected 64 hex digits")
        }
    };
    let Some(found) = config.swarm_key(config_path, variable.as_deref())? else {
        log.warn(
            "no swarm key: anybody in reach of the radio can read and change the map; `flockmap key --help` says how to have one",
        );
        return Ok(None);
    };
    log.info(format!("all that is sent is sealed with the swarm key from {}", found.place));
    if let Some(warning) = found.warning {
        log.warn(warning);
    }
    Ok(Some(found.key))
}

/// Bytes that nobody can guess.
fn random_bytes<const N: usize>() -> Result<[u8; N]> {
    let mut bytes = [0; N];
    getrandom::fill(&mut bytes).context("the system gives no random bytes")?;
    Ok(bytes)
}

/// `has_radio`: without one, a robot without a sensor is nothing to wonder at.
fn sensor(config: &NodeConfig, has_radio: bool, log: &Log) -> Result<Sensor> {
    if config.ros != RosSection::default() {
        log.warn("[ros] is for flockmap-ros: this program has no topics of ROS");
    }
    let section = &config.sensor;
    let limits = config.message_limits()?;
    match (&section.record, section.listen_tcp, &section.listen_unix) {
        (None, None, None) => {
            if has_radio {
                log.warn("no sensor is configured: this robot only listens and passes on what it hears");
            }
            Ok(Sensor::None)
        }
        (Some(path), None, None) => {
            let speed = speed("[sensor] speed", section.speed)?;
            let skip = seconds("[sensor] start_s", section.start_s)?;
            let options = RecordOptions {
                points_topic: section.points_topic.clone(),
                odometry_topic: section.odometry_topic.clone(),
                map_frame: section.map_frame.clone(),
                submaps_topic: section.submaps_topic.clone(),
                poses: section.poses.clone(),
                scan_points_max: u64::from(limits.scan_points_max),
                ..RecordOptions::default()
            };
            let repeat = within("[sensor] repeat", section.repeat, 1.., "1 or more")?;
            let record = open_record(path, &options).context("[sensor] record")?;
            let summary = &record.summary;
            let (scans, length) = (summary.frames, summary.duration_s());
            let submaps = record.submaps;
            let begun = submaps.iter().map(|pose| pose.submap.number() + 1).max();
            let in_submaps = begun.map(|count| format!(", {count} submaps")).unwrap_or_default();
            let rounds = if repeat == 1 { String::new() } else { format!(", {repeat} times") };
            log.info(format!("plays {}: {scans} scans, {length:.1} s{in_submaps}{rounds}", path.display()));
            let again = path.clone();
            let open = move || open_record(&again, &options).map(|record| record.frames);
            let frames = repeated(record.frames, repeat, open);
            Ok(Sensor::Play { frames, submaps, speed, skip, begin: None })
        }
        (None, Some(address), None) => {
            if !address.ip().is_loopback() {
                log.warn(format!("anybody who reaches {address} can feed scans; 127.0.0.1 keeps others out"));
            }
            Ok(Sensor::Tcp(address, limits))
        }
        (None, None, Some(path)) => {
            let mode = config.unix_mode()?;
            if mode & 0o002 != 0 {
                let path = path.display();
                log.warn(format!(
                    "with unix_mode {mode:04o} every user of this machine can feed scans at {path}"
                ));
            }
            Ok(Sensor::Unix { path: path.clone(), mode, limits })
        }
        _ => bail!("[sensor] has more than one of record, listen_tcp and listen_unix, expected one of them"),
    }
}

/// Where the map is given out, with a word on who may read it there.
fn map_output(config: &NodeConfig, log: &Log) -> Result<Option<MapOutput>> {
    let Some(output) = config.map_output()? else { return Ok(None) };
    if let Some(address) = output.tcp.filter(|address| !address.ip().is_loopback()) {
        log.warn(format!("anybody who reaches {address} can read the map; 127.0.0.1 keeps others out"));
    }
    if let Some((path, mode)) = output.unix.as_ref().filter(|(_, mode)| mode & 0o002 != 0) {
        let path = path.display();
        log.warn(format!("with unix_mode {mode:04o} every user of this machine can read the map at {path}"));
    }
    Ok(Some(output))
}

/// Where the map is shown, and to whom.
fn view(config: &NodeConfig, log: &Log) -> Result<Option<ViewOptions>> {
    let Some(address) = config.view.listen else { return Ok(None) };
    let token = config.view_token()?;
    let access = match token {
        Some(token) => Access::Token(token),
        None if address.ip().is_loopback() => Access::Loopback,
        None => {
            log.info("[view] has no token: one is drawn, and another one at the next start");
            Access::Token(Token::draw().context("the system gives no random bytes")?)
        }
    };
    Ok(Some(ViewOptions { address, access }))
}

/// Waits for the node, and stops it on a signal; a second one stops it at once.
async fn until_ended(node: &NodeHandle, mut signals: Signals, log: &Log) {
    let ended = node.ended();
    tokio::pin!(ended);
    loop {
        tokio::select! {
            () = &mut ended => return,
            name = signals.next() => {
                log.info(format!("{name}: ending; once more ends at once"));
                node.stop();
            }
        }
    }
}
