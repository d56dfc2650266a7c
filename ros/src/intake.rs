//! All that comes in, on its way to the node.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use flockmap::{RobotId, Stamp};
use flockmap_io::Frame;
use flockmap_io::ros::{
    Bytes, Clock as ClockMessage, Odometry, PointCloud2, PoseArray, PoseStamped, TFMessage, Time,
};
use flockmap_node::{ConfiguredNode, Log, RosPoses, RosSection, Signals};
use futures::stream::{self, BoxStream, SelectAll, StreamExt};
use ros2_client::Subscription;
use ros2_client::dds::rustdds::StatusEvented;
use tokio::sync::mpsc::Sender;

use crate::clock::{Jump, RosClock};
use crate::links::Links;
use crate::scans::{ScanCounts, Scans, Taken};
use crate::team::Team;
use crate::topics::{CLOCK, POSES, SENSOR, SENSOR_RELIABLE, STATUS, TF, TF_STATIC, Topics};

/// One warning of a kind in so long.
const WARNING_PERIOD: Duration = Duration::from_secs(10);

/// Something that came on a topic.
pub(crate) enum Input {
    Cloud(PointCloud2<Bytes>),
    Transforms(TFMessage, bool),
    Odometry(Box<Odometry>),
    Clock(ClockMessage),
    Teammate(RobotId, PoseStamped),
    Alignment(RobotId, PoseStamped),
    Submaps(PoseArray),
    /// A message that is none, of a cloud or of something else.
    Damaged(String, bool),
}

/// All topics that are taken, in turn.
pub(crate) type Inputs = SelectAll<BoxStream<'static, Input>>;

/// Subscribes to what the configuration asks for.
pub(crate) fn subscribe(topics: &mut Topics, section: &RosSection) -> Result<Inputs> {
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
    if !section.submaps.is_empty() {
        let poses = topics.subscribe(&section.submaps, STATUS)?;
        inputs.push(messages(poses, topics.names().topic(&section.submaps), false, Input::Submaps));
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

/// What has come, on its way to the node.
pub(crate) struct Intake {
    pub(crate) scans: Scans,
    pub(crate) clock: Arc<RosClock>,
    pub(crate) frames: Sender<Frame>,
    pub(crate) node: Arc<ConfiguredNode>,
    pub(crate) links: Links,
    pub(crate) stamp_error_max: i64,
    pub(crate) team: Team,
    /// What was counted, for whoever says it.
    pub(crate) counts: Arc<Mutex<ScanCounts>>,
    /// When a kind of warning was said last.
    pub(crate) warned: BTreeMap<&'static str, Instant>,
    pub(crate) log: Log,
}

impl Intake {
    /// Until the node has ended.
    pub(crate) async fn run(&mut self, mut inputs: Inputs, topics: &Topics, mut signals: Signals) {
        let listener = topics.discovery();
        let mut discovery = listener.as_async_status_stream();
        let (node, frames) = (self.node.clone(), self.frames.clone());
        let ended = node.node.ended();
        tokio::pin!(ended);
        loop {
            self.hand_over();
            *self.counts.lock().unwrap_or_else(PoisonError::into_inner) = *self.scans.counts();
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
                Some(pose) => self.team.set_position(robot, pose.translation()),
                None => self.warn("teammate", format!("the position of robot {} is none", robot.0)),
            },
            Input::Alignment(robot, message) => match message.pose.checked() {
                Some(pose) => self.team.set_alignment(robot, pose),
                None => self.warn("alignment", format!("the alignment of robot {} is no pose", robot.0)),
            },
            Input::Submaps(message) => {
                let checked: Option<Vec<_>> =
                    message.poses.iter().map(flockmap_io::ros::Pose::checked).collect();
                match checked {
                    Some(poses) => self.team.set_submaps(poses),
                    None => {
                        self.warn("submaps", "one of the poses of submaps is none: all are left out".into())
                    }
                }
            }
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
                    self.scans.count_off_time();
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

    fn warn(&mut self, kind: &'static str, text: String) {
        let now = Instant::now();
        let last = self.warned.get(kind);
        if last.is_none_or(|last| now.saturating_duration_since(*last) >= WARNING_PERIOD) {
            self.warned.insert(kind, now);
            self.log.warn(text);
        }
    }
}
