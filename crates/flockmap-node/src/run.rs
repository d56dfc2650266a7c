//! One robot from a configuration file, until it is asked to end.

use std::env::VarError;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use flockmap::sync::SwarmKey;
use flockmap_io::{ExportOptions, RecordOptions, export_map, open_record};

use crate::config::{seconds, speed, value, within};
use crate::kept::Kept;
use crate::sensor::repeated;
use crate::{
    EndOptions, Ended, KEY_VARIABLE, Log, MessageLimits, Node, NodeConfig, NodeHandle, NodeOptions, Sensor,
    UdpSockets,
};

/// Runs the robot of a configuration file: what `flockmap node --config` does. Ends on Ctrl-C, SIGTERM, or as
/// configured; then saves the map if asked, and writes a summary as JSON to the configured file, or to stdout.
///
/// # Errors
/// A configuration that cannot work, named by its key; a socket or file that cannot be opened.
pub fn run(config_path: &Path) -> Result<()> {
    let config = NodeConfig::read(config_path)?;
    let log = Log::to_stderr(&config.robot_name());
    let mut options = options(&config, &log)?;
    options.robot.session.swarm_key = swarm_key(&config, config_path, &log)?;
    options.robot.session.salt = random_bytes()?;
    let sockets = UdpSockets::bind(&config.network)?;
    let address = sockets.local_addr()?;
    let own = (options.robot.id, options.robot.epoch);

    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // Signals count from here on, also while the node starts.
    let signals = {
        let _context = runtime.enter();
        Signals::new().context("cannot listen to signals")?
    };
    let node = Node::start(options, move || sockets.into_transport())?;
    log.info(format!("robot {} epoch {} listens on {address}", own.0, own.1));
    if let Some(sensor) = node.sensor_address() {
        log.info(format!("takes scans at {sensor}"));
    }
    if let Some(address) = node.prometheus_address() {
        log.info(format!("serves counters at http://{address}/metrics"));
    }
    runtime.block_on(until_ended(&node, signals, &log));
    finish(&config, &node.join()?, &log)
}

fn options(config: &NodeConfig, log: &Log) -> Result<NodeOptions> {
    // Looked at before an epoch is used up.
    let robot = config.robot(0)?;
    let sensor = sensor(config, log)?;
    let kept = Kept::open(config, &robot, u32::from_le_bytes(random_bytes()?), log)?;
    let mut options = NodeOptions::new(config.robot(kept.epoch)?);
    options.store = kept.store;
    options.epoch_file = kept.epoch_file;
    options.name = config.robot_name();
    options.sensor = sensor;
    options.alignments = config.alignments()?;
    options.clock_offsets = config.clock_offsets()?;
    options.muted = config.muted.clone();
    options.prometheus = config.metrics.prometheus;
    let period = seconds("[metrics] status_period_s", config.metrics.status_period_s)?;
    options.status_period = (!period.is_zero()).then_some(period);
    let output = &config.output;
    options.end = EndOptions {
        after: output.end_after_s.map(|s| seconds("[output] end_after_s", s)).transpose()?,
        when_quiet: output.end_when_quiet_s.map(|s| seconds("[output] end_when_quiet_s", s)).transpose()?,
        linger: Duration::from_millis(output.linger_ms.into()),
    };
    // Better now than after the flight.
    if let Some(path) = &output.save_map_at_end
        && !path.extension().is_some_and(|end| ["ply", "pcd", "bt"].iter().any(|known| end == *known))
    {
        bail!(value("[output] save_map_at_end", path.display(), "a file that ends in .ply, .pcd or .bt"));
    }
    for (key, path) in
        [("[output] save_map_at_end", &output.save_map_at_end), ("[output] report_json", &output.report_json)]
    {
        path.as_deref().map_or(Ok(()), |path| check_output(key, path))?;
    }
    options.log = log.clone();
    Ok(options)
}

/// Looks whether a file can be written, and leaves everything as it was.
fn check_output(key: &str, path: &Path) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        let expected = format!("a file in a folder that is there (mkdir -p {})", folder.display());
        bail!(value(key, path.display(), expected));
    }
    let is_new = match std::fs::metadata(path) {
        Ok(there) if there.is_dir() => bail!(value(key, path.display(), "a file, and this is a folder")),
        Ok(there) if there.is_file() => false,
        // A device or a pipe.
        Ok(_) => return Ok(()),
        Err(_) => true,
    };
    std::fs::OpenOptions::new().append(true).create(true).open(path).map_err(|error| {
        value(key, format!("{} ({error})", path.display()), "a file that this user may write")
    })?;
    if is_new {
        std::fs::remove_file(path).with_context(|| format!("cannot remove {}", path.display()))?;
    }
    Ok(())
}

/// The key of the swarm; says where it comes from, or what it means that there is none.
fn swarm_key(config: &NodeConfig, config_path: &Path, log: &Log) -> Result<Option<SwarmKey>> {
    let variable = match std::env::var(KEY_VARIABLE) {
        Ok(text) => Some(text),
        Err(VarError::NotPresent) => None,
        Err(VarError::NotUnicode(_)) => bail!("{KEY_VARIABLE} is no text, expected 64 hex digits"),
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

fn sensor(config: &NodeConfig, log: &Log) -> Result<Sensor> {
    let section = &config.sensor;
    let error = seconds("[sensor] stamp_error_max_s", section.stamp_error_max_s)?;
    let points_max = section.scan_points_max;
    let limits = MessageLimits {
        scan_points_max: within("[sensor] scan_points_max", points_max, 1..=1 << 26, "1 to 67,108,864")?,
        stamp_error_max_micros: i64::try_from(error.as_micros()).unwrap_or(i64::MAX),
    };
    match (&section.record, section.listen_tcp, &section.listen_unix) {
        (None, None, None) => {
            log.warn("no sensor is configured: this robot only listens and passes on what it hears");
            Ok(Sensor::None)
        }
        (Some(path), None, None) => {
            let speed = speed("[sensor] speed", section.speed)?;
            let skip = seconds("[sensor] start_s", section.start_s)?;
            let options = RecordOptions {
                points_topic: section.points_topic.clone(),
                odometry_topic: section.odometry_topic.clone(),
                map_frame: section.map_frame.clone(),
                poses: section.poses.clone(),
                scan_points_max: u64::from(points_max),
                ..RecordOptions::default()
            };
            let repeat = within("[sensor] repeat", section.repeat, 1.., "1 or more")?;
            let record = open_record(path, &options)?;
            let summary = &record.summary;
            let (scans, length) = (summary.frames, summary.duration_s());
            let rounds = if repeat == 1 { String::new() } else { format!(", {repeat} times") };
            log.info(format!("plays {}: {scans} scans, {length:.1} s{rounds}", path.display()));
            let again = path.clone();
            let open = move || open_record(&again, &options).map(|record| record.frames);
            let frames = repeated(record.frames, repeat, open);
            Ok(Sensor::Play { frames, speed, skip, begin: None })
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

#[cfg(unix)]
struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

#[cfg(unix)]
impl Signals {
    fn new() -> std::io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self { interrupt: signal(SignalKind::interrupt())?, terminate: signal(SignalKind::terminate())? })
    }

    async fn next(&mut self) -> &'static str {
        tokio::select! {
            _ = self.interrupt.recv() => "Ctrl-C",
            _ = self.terminate.recv() => "SIGTERM",
        }
    }
}

#[cfg(not(unix))]
struct Signals;

#[cfg(not(unix))]
impl Signals {
    fn new() -> std::io::Result<Self> {
        Ok(Self)
    }

    async fn next(&mut self) -> &'static str {
        // Without signals there is nothing to wait for.
        if tokio::signal::ctrl_c().await.is_err() {
            std::future::pending::<()>().await;
        }
        "Ctrl-C"
    }
}

/// Saves what was asked for.
fn finish(config: &NodeConfig, ended: &Ended, log: &Log) -> Result<()> {
    let output = &config.output;
    let json = serde_json::to_string_pretty(&ended.summary)?;
    // One that cannot be written is no reason to lose the other.
    let summary = match &output.report_json {
        Some(path) => std::fs::write(path, json + "\n")
            .map(|()| log.info(format!("summary in {}", path.display())))
            .with_context(|| format!("cannot write {}", path.display())),
        None => {
            println!("{json}");
            Ok(())
        }
    };
    if let Some(path) = &output.save_map_at_end {
        let map = ended.robot.map();
        let options = ExportOptions { free: output.save_free };
        let count = export_map(path, map.resolution(), map.voxels(), &options)?;
        log.info(format!("{count} voxels in {}", path.display()));
    }
    summary
}
