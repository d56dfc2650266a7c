//! All parts at work, until the node ends.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use anyhow::{Context, Result, bail};
use flockmap_node::{Configuration, ConfiguredNode, Embedding, Log, RosPoses, Sensor, Signals};

use crate::arguments::RosArguments;
use crate::clock::RosClock;
use crate::intake::{Intake, subscribe};
use crate::names::Names;
use crate::parameters;
use crate::publishing::{diagnostics, outputs, publish};
use crate::scans::{ScanCounts, Scans};
use crate::team::{Team, set_all};
use crate::topics::Topics;

/// Scans that may wait for the node.
const FRAMES_WAITING_MAX: usize = 4;

/// Runs a robot until it is asked to end.
pub(crate) fn run(config: Option<&Path>, arguments: &RosArguments) -> Result<()> {
    let names = Names::new(arguments)?;
    let values = parameters::values(&arguments.parameters, &names.node_path())?;
    if config.is_none() && values.is_empty() {
        bail!("there is no configuration: --config FILE, or parameters behind --ros-args (--help)");
    }
    let configuration = Configuration::read_with(config, &values, "the parameters")?;
    let section = configuration.config.ros.clone();
    let log = Log::to_stderr(&configuration.config.robot_name());
    for ignored in &arguments.ignored {
        log.info(format!("{ignored} behind --ros-args has no effect here"));
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let _context = runtime.enter();
    let signals = Signals::new().context("cannot listen to signals")?;

    let mut topics = Topics::open(&section, names)?;
    if let Some(open) = section.interfaces.iter().find(|interface| !interface.starts_with("127.")) {
        log.warn(format!(
            "DDS uses the interface {open}: if that is the radio, every map that is published goes over it"
        ));
    }
    let scans = Scans::new(&section, configuration.config.sensor.scan_points_max.into());
    let stamp_error_max = (configuration.config.sensor.stamp_error_max_s * 1e6) as i64;
    let inputs = subscribe(&mut topics, &section)?;
    let own = configuration.config.id;
    let outputs = outputs(&mut topics, &section, own)?;
    let diagnostics = diagnostics(&mut topics, &section)?;

    let (frames, frames_in) = tokio::sync::mpsc::channel(FRAMES_WAITING_MAX);
    let embedding = Embedding { sensor: Some(Sensor::Channel(frames_in)), ..Embedding::default() };
    let node = ConfiguredNode::start_with(configuration, embedding, log.clone())?;
    let clock = Arc::new(RosClock::new(node.node.clock(), section.use_sim_time));
    log.info(format!(
        "{} takes scans from {} and poses from {}",
        topics.names().node_path(),
        topics.names().topic("points"),
        topics.names().topic(if section.poses == RosPoses::Tf { "/tf" } else { "odom" }),
    ));
    let node = Arc::new(node);
    let counts = Arc::new(Mutex::new(ScanCounts::default()));
    let publishing = {
        let (node, clock, counts) = (node.clone(), clock.clone(), counts.clone());
        let (links, log, frame) = (topics.links(), log.clone(), section.map_frame);
        thread("outputs", move || {
            publish(&node.node, &clock, &frame, outputs, diagnostics, (&links, &counts), &log);
        })?
    };
    let (team, wanted, woken) = Team::new();
    let setting = {
        let (node, log) = (node.clone(), log.clone());
        thread("team", move || set_all(&wanted, &woken, &node.node, &log))?
    };
    let mut intake = Intake {
        scans,
        clock,
        frames,
        node: node.clone(),
        links: topics.links(),
        stamp_error_max,
        team,
        counts,
        warned: BTreeMap::new(),
        log: log.clone(),
    };
    runtime.block_on(intake.run(inputs, &topics, signals));
    // The threads end with it and with the node.
    drop(intake);
    for thread in [publishing, setting] {
        if thread.join().is_err() {
            log.warn("a thread has panicked");
        }
    }
    let Some(node) = Arc::into_inner(node) else { bail!("the node is still in use") };
    let (_, saved) = node.join()?;
    saved
}

fn thread(name: &str, work: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>> {
    std::thread::Builder::new().name(name.into()).spawn(work).context("cannot start a thread")
}
