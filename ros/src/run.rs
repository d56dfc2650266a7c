//! All parts at work, until the node ends.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use flockmap::{Pose, RobotId, Stamp};
use flockmap_io::Frame;
use flockmap_io::ros::{
    Bytes, Clock as ClockMessage, Header, Odometry, PointCloud2, PoseStamped, TFMessage, Time,
};
use flockmap_node::{Configuration, ConfiguredNode, Log, RosPoses, RosSection, Sensor};
use futures::stream::{self, BoxStream, SelectAll, StreamExt};
use ros2_client::Subscription;
use ros2_client::dds::rustdds::StatusEvented;
use tokio::sync::mpsc::Sender;

use crate::arguments::RosArguments;
use crate::clock::{Jump, RosClock};
use crate::links::Links;
use crate::names::Names;
use crate::output::{Cloud, Diagnostics, Field, Grid, Outlet, Output, Robots, Shot, Tree};
use crate::parameters;
use crate::scans::{ScanCounts, Scans, Taken};
use crate::topics::{CLOCK, MAP, POSES, SENSOR, SENSOR_RELIABLE, STATUS, TF, TF_STATIC, Topics};

/// Scans that may wait for the node.
const FRAMES_WAITING_MAX: usize = 4;
/// One warning of a kind in so long.
const WARNING_PERIOD: Duration = Duration::from_secs(10);
/// The outputs are looked at no more often than this.
const OUTPUT_PERIOD: Duration = Duration::from_millis(10);

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
    let node = ConfiguredNode::start_with(configuration, Some(Sensor::Channel(frames_in)), log.clone())?;
    let clock = Arc::new(RosClock::new(node.node.clock(), section.use_sim_time));
    log.info(format!(
        "{} takes scans from {} and poses from {}",
        topics.names().node_path(),
        topics.names().topic("points"),
        topics.names().topic(if section.poses == RosPoses::Tf { "/tf" } else { "odom" }),
    ));
    let node = Arc::new(node);
    let (counts, counts_in) = mpsc::channel();
    let publishing = {
        let (node, clock, log, links) = (node.clone(), clock.clone(), log.clone(), topics.links());
        let publish = move || {
            publish(&node.node, &clock, &section.map_frame, outputs, diagnostics, (&links, &counts_in), &log)
        };
        std::thread::Builder::new().name("outputs".into()).spawn(publish).context("cannot start a thread")?
    };
    let mut intake = Intake {
        scans,
        clock,
        frames,
        node: node.clone(),
        links: topics.links(),
        stamp_error_max,
        alignments: BTreeMap::new(),
        warned: BTreeMap::new(),
        log: log.clone(),
    };
    runtime.block_on(intake.run(inputs, &topics, signals, &counts));
    // It ends with the node.
    drop((counts, intake));
    if publishing.join().is_err() {
        log.warn("the thread of the outputs has panicked");
    }
    let Some(node) = Arc::into_inner(node) else { bail!("the node is still in use") };
    let (_, saved) = node.join()?;
    saved
}

/// Something that came on a topic.
enum Input {
    Cloud(PointCloud2<Bytes>),
    Transforms(TFMessage, bool),
    Odometry(Box<Odometry>),
    Clock(ClockMessage),
    Teammate(RobotId, PoseStamped),
    Alignment(RobotId, PoseStamped),
    /// A message that is none, of a cloud or of something else.
    Damaged(String, bool),
}

type Inputs = SelectAll<BoxStream<'static, Input>>;

fn subscribe(topics: &mut Topics, section: &RosSection) -> Result<Inputs> {
    let mut inputs = SelectAll::new();
    let clouds =
        topics.subscribe("points", if section.points_reliable { SENSOR_RELIABLE } else { SENSOR })?;
    inputs.push(messages(clouds, topics.names().topic("points"), true, Input::Cloud));
    let tf: Subscription<TFMessage> = topics.subscribe("/tf", TF)?;
    inputs
        .push(messages(tf, topics.names().topic("/tf"), false, |message| Input::Transforms(message, false)));
    let fixed: Subscription<TFMessage> = topics.subscribe("/tf_static", TF_STATIC)?;
    let name = topics.names().topic("/tf_static");
    inputs.push(messages(fixed, name, false, |message| Input::Transforms(message, true)));
    if section.poses == RosPoses::Odometry {
        let odometry = topics.subscribe("odom", POSES)?;
        inputs.push(messages(odometry, topics.names().topic("odom"), false, |pose| {
            Input::Odometry(Box::new(pose))
        }));
    }
    if section.use_sim_time {
        let clock = topics.subscribe("/clock", CLOCK)?;
        inputs.push(messages(clock, topics.names().topic("/clock"), false, Input::Clock));
    }
    for (robot, name) in &section.teammates {
        let (robot, poses) = (*robot, topics.subscribe(name, STATUS)?);
        let name = topics.names().topic(name);
        inputs.push(messages(poses, name, false, move |pose| Input::Teammate(robot, pose)));
    }
    for (robot, name) in &section.alignments {
        let (robot, poses) = (*robot, topics.subscribe(name, STATUS)?);
        let name = topics.names().topic(name);
        inputs.push(messages(poses, name, false, move |pose| Input::Alignment(robot, pose)));
    }
    Ok(inputs)
}

/// The messages of a topic as inputs, without end.
fn messages<M: serde::de::DeserializeOwned + Send + Sync + 'static>(
    subscription: Subscription<M>,
    topic: String,
    is_cloud: bool,
    input: impl Fn(M) -> Input + Send + 'static,
) -> BoxStream<'static, Input> {
    stream::unfold((subscription, topic, input), move |(subscription, topic, input)| async move {
        let taken = match subscription.async_take().await {
            Ok((message, _)) => input(message),
            Err(error) => Input::Damaged(format!("a message on {topic} is none: {error}"), is_cloud),
        };
        Some((taken, (subscription, topic, input)))
    })
    .boxed()
}

/// All that comes in, on its way to the node.
struct Intake {
    scans: Scans,
    clock: Arc<RosClock>,
    frames: Sender<Frame>,
    node: Arc<ConfiguredNode>,
    links: Links,
    stamp_error_max: i64,
    /// What was set last: an alignment that is said again costs nothing.
    alignments: BTreeMap<RobotId, Pose>,
    /// When a kind of warning was said last.
    warned: BTreeMap<&'static str, Instant>,
    log: Log,
}

impl Intake {
    async fn run(
        &mut self,
        mut inputs: Inputs,
        topics: &Topics,
        mut signals: Signals,
        counts: &mpsc::Sender<ScanCounts>,
    ) {
        let listener = topics.discovery();
        let mut discovery = listener.as_async_status_stream();
        let (node, frames) = (self.node.clone(), self.frames.clone());
        let ended = node.node.ended();
        tokio::pin!(ended);
        loop {
            self.hand_over();
            // Nobody counts any more if this fails.
            let _ = counts.send(*self.scans.counts());
            let is_full = self.frames.capacity() == 0;
            let until = self.scans.poll_timeout().unwrap_or_else(|| Instant::now() + Duration::from_secs(60));
            tokio::select! {
                () = &mut ended => return,
                name = signals.next() => {
                    self.log.info(format!("{name}: ending; once more ends at once"));
                    self.node.node.stop();
                }
                Some(input) = inputs.next() => self.take(input),
                Some(event) = discovery.next() => {
                    if let Some(text) = self.links.take(event) {
                        self.log.warn(text);
                    }
                }
                _ = frames.reserve(), if is_full => {}
                () = tokio::time::sleep_until(until.into()), if !is_full => {}
            }
        }
    }

    fn take(&mut self, input: Input) {
        match input {
            Input::Cloud(cloud) => {
                if let Some(text) = self.scans.take_cloud(cloud, Instant::now()) {
                    self.warn("crowded", text);
                }
            }
            Input::Transforms(message, is_fixed) => self.scans.take_transforms(message, is_fixed),
            Input::Odometry(message) => self.scans.take_odometry(*message),
            Input::Clock(message) => match self.clock.take_clock(message.clock.into()) {
                Some(Jump::Back(by)) => {
                    self.scans.begin_anew();
                    let seconds = by as f64 / 1e6;
                    self.warn(
                        "clock",
                        format!("/clock went back by {seconds:.3} s: poses so far are forgotten"),
                    );
                }
                Some(Jump::On(by)) => {
                    let seconds = by as f64 / 1e6;
                    self.warn("clock", format!("/clock jumped on by {seconds:.3} s"));
                }
                None => {}
            },
            Input::Teammate(robot, message) => match message.pose.checked() {
                Some(pose) => self.with_robot("teammate", move |node, now| {
                    node.set_teammate(robot, pose.translation(), now).map_err(|error| error.to_string())
                }),
                None => self.warn("teammate", format!("the position of robot {} is none", robot.0)),
            },
            Input::Alignment(robot, message) => match message.pose.checked() {
                Some(pose) if self.alignments.get(&robot) == Some(&pose) => {}
                Some(pose) => {
                    self.alignments.insert(robot, pose);
                    self.with_robot("alignment", move |node, _| {
                        node.set_alignment(robot, &pose).map_err(|error| error.to_string())
                    });
                }
                None => self.warn("alignment", format!("the alignment of robot {} is no pose", robot.0)),
            },
            Input::Damaged(text, is_cloud) => {
                if is_cloud {
                    self.scans.take_damaged();
                }
                self.warn("damaged", text);
            }
        }
    }

    /// Hands what is ready to the node, as far as it has room.
    fn hand_over(&mut self) {
        while self.frames.capacity() > 0 {
            // Before the first /clock a scan waits for that too.
            let now = Instant::now();
            if self.clock.now().is_none() && self.scans.poll_timeout().is_none_or(|until| now < until) {
                return;
            }
            let (mut frame, stamp) = match self.scans.poll(now) {
                Some(Taken::Scan(frame, stamp)) => (frame, stamp),
                Some(Taken::Fault(text)) => {
                    self.warn("scan", text);
                    continue;
                }
                None => return,
            };
            match self.stamp(stamp) {
                Ok(stamp) => {
                    frame.scan.stamp = stamp;
                    // There is room, unless the node has ended.
                    let _ = self.frames.try_send(frame);
                }
                Err(text) => {
                    self.scans.take_back();
                    self.warn("stamp", text);
                }
            }
        }
    }

    /// The stamp of a scan on the node's clock.
    fn stamp(&self, ros: Time) -> Result<Stamp, String> {
        let nothing =
            || "scans are left out until /clock says what time it is: use_sim_time is set".to_owned();
        let now = self.clock.now().ok_or_else(nothing)?;
        let off = Stamp::from(ros).micros_since(now);
        if off.saturating_abs() > self.stamp_error_max {
            return Err(format!(
                "a scan is left out: its stamp is {:.3} s {} the time of ROS. For a recording play /clock and set use_sim_time; else set the clock of the sensor",
                off.unsigned_abs() as f64 / 1e6,
                if off < 0 { "behind" } else { "ahead of" },
            ));
        }
        self.clock.to_node(ros).ok_or_else(nothing)
    }

    /// Does something with the robot without waiting for it.
    fn with_robot(
        &self,
        what: &'static str,
        call: impl FnOnce(&mut flockmap::Robot, Stamp) -> Result<(), String> + Send + 'static,
    ) {
        let (node, log) = (self.node.clone(), self.log.clone());
        tokio::task::spawn_blocking(move || {
            if let Some(Err(text)) = node.node.with_robot(call) {
                log.warn(format!("{what}: {text}"));
            }
        });
    }

    fn warn(&mut self, kind: &'static str, text: String) {
        let now = Instant::now();
        let last = self.warned.get(kind);
        if last.is_none_or(|last| now.saturating_duration_since(*last) >= WARNING_PERIOD) {
            self.warned.insert(kind, now);
            self.log.warn(text);
        }
    }
}

fn outputs(topics: &mut Topics, section: &RosSection, own: RobotId) -> Result<Vec<Box<dyn Output>>> {
    let mut all: Vec<Box<dyn Output>> = Vec::new();
    let s = section;
    if s.near_period_s > 0.0 {
        let outlet = outlet(topics, "~/occupied_points", s.near_period_s)?;
        all.push(Box::new(Cloud::new(outlet, Some(s.near_range_m))));
    }
    if s.all_period_s > 0.0 {
        all.push(Box::new(Cloud::new(outlet(topics, "~/occupied_points_all", s.all_period_s)?, None)));
    }
    if s.grid_period_s > 0.0 {
        let updates = topics.publish("~/grid_updates", MAP)?;
        all.push(Box::new(Grid::new(outlet(topics, "~/grid", s.grid_period_s)?, updates, s.grid_band_m)));
    }
    if s.octomap_period_s > 0.0 {
        all.push(Box::new(Tree::new(outlet(topics, "~/octomap_binary", s.octomap_period_s)?)));
    }
    if s.field_period_s > 0.0 {
        let outlet = outlet(topics, "~/distance_field", s.field_period_s)?;
        all.push(Box::new(Field::new(outlet, s.field_range_m, s.field_distance_max_m)));
    }
    if s.robots_period_s > 0.0 {
        all.push(Box::new(Robots::new(outlet(topics, "~/robots", s.robots_period_s)?, own)));
    }
    Ok(all)
}

fn outlet<M>(topics: &mut Topics, name: &str, period_s: f64) -> Result<Outlet<M>>
where
    M: flockmap_io::ros::RosMessage + serde::Serialize,
{
    let publisher = topics.publish(name, MAP)?;
    Ok(Outlet::new(topics.names().topic(name), publisher, topics.links(), period_s))
}

fn diagnostics(topics: &mut Topics, section: &RosSection) -> Result<Option<Diagnostics>> {
    if section.diagnostics_period_s == 0.0 {
        return Ok(None);
    }
    let publisher = topics.publish("/diagnostics", STATUS)?;
    Ok(Some(Diagnostics::new(publisher, topics.names().node_path(), section.diagnostics_period_s)))
}

/// Publishes until the node has ended.
fn publish(
    node: &flockmap_node::NodeHandle,
    clock: &RosClock,
    frame: &str,
    mut outputs: Vec<Box<dyn Output>>,
    mut diagnostics: Option<Diagnostics>,
    (links, counts): (&Links, &mpsc::Receiver<ScanCounts>),
    log: &Log,
) {
    let mut newest = ScanCounts::default();
    let mut warned: Option<Instant> = None;
    loop {
        let now = Instant::now();
        let mut faults = Vec::new();
        if outputs.iter().any(|output| output.due() <= now) {
            let Some((view, poses, own)) =
                node.with_robot(|robot, _| (robot.view(), robot.poses(), robot.own_stream()))
            else {
                return;
            };
            let sensor = poses.iter().find(|pose| pose.stream == own);
            let stamp = sensor.map_or_else(|| clock.now().map(Time::from), |pose| clock.to_ros(pose.seen));
            if let Some(stamp) = stamp {
                let position = sensor.map(|pose| pose.position);
                let header = Header { stamp, frame_id: frame.into() };
                let shot = Shot { view, header, poses, position };
                faults.extend(outputs.iter_mut().filter_map(|output| output.publish(&shot, now).err()));
            }
        }
        newest = counts.try_iter().last().unwrap_or(newest);
        if let Some(diagnostics) = diagnostics.as_mut().filter(|diagnostics| diagnostics.due() <= now) {
            let Some(status) = node.status() else { return };
            let header = Header::new(clock.now().unwrap_or(Stamp(0)), "");
            faults.extend(diagnostics.publish(header, &status, (&newest, links.incompatible()), now).err());
        }
        if let Some(fault) = faults.first()
            && warned.is_none_or(|last| now.saturating_duration_since(last) >= WARNING_PERIOD)
        {
            warned = Some(now);
            log.warn(fault);
        }
        let due =
            outputs.iter().map(|output| output.due()).chain(diagnostics.as_ref().map(Diagnostics::due)).min();
        let rest = due.map_or(OUTPUT_PERIOD, |due| due.saturating_duration_since(Instant::now()));
        std::thread::sleep(rest.clamp(OUTPUT_PERIOD, Duration::from_millis(200)));
        if node.has_ended() {
            return;
        }
    }
}

struct Signals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

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
