//! From messages to scans with poses. Knows no DDS and no clock: the times of arrival are handed in.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use flockmap::{Pose, Scan, Stamp};
use flockmap_io::Frame;
use flockmap_io::ros::{
    Bytes, FrameForest, NoPose, NoPoseThen, Odometry, PointCloud2, Reach, TFMessage, Time, Track, points_of,
};
use flockmap_node::{RosPoses, RosSection};

/// Clouds that may wait for their poses.
const WAITING_MAX: usize = 32;
/// Bytes of these.
const WAITING_BYTES_MAX: usize = 256 << 20;
/// Frames of tf that are known.
const FRAMES_MAX: usize = 1_000;
/// Poses of each that are kept: 10 s at 1 kHz. 64 bytes each: 640 MB at most.
const POSES_MAX: usize = 10_000;
/// Poses that are older than the newest by more than this are forgotten, as tf2 does it.
const KEPT_MICROS: i64 = 10_000_000;
/// A single pose that is no further away than this is taken where there are not two.
const NEAR_MICROS: i64 = 10_000;

/// What came, and what became of it.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) struct ScanCounts {
    /// Clouds that came.
    pub(crate) clouds: u64,
    /// Handed to the map.
    pub(crate) mapped: u64,
    /// Left out: no pose came in time.
    pub(crate) without_pose: u64,
    /// Left out: the message is none, or the cloud too large.
    pub(crate) damaged: u64,
    /// Left out: too many waited.
    pub(crate) crowded_out: u64,
    /// Left out: the time jumped back while they waited.
    pub(crate) of_another_time: u64,
    /// Left out: their stamps are off the time of ROS, or this is not known yet.
    pub(crate) off_time: u64,
    /// Points that are no finite numbers, left out.
    pub(crate) points_dropped: u64,
    /// Poses that came, by tf or odometry.
    pub(crate) poses: u64,
    /// Of these, left out: they are none, or of a frame too many.
    pub(crate) poses_damaged: u64,
}

/// What has come out of the messages.
#[derive(Debug)]
pub(crate) enum Taken {
    /// A scan, with its stamp in ROS.
    Scan(Frame, Time),
    /// Something is left out: a line for people.
    Fault(String),
}

/// Clouds on their way to the map, in the order in which they came, and the poses for them.
#[derive(Debug)]
pub(crate) struct Scans {
    poses: RosPoses,
    map_frame: String,
    wait: Duration,
    gap_max: i64,
    points_max: u64,
    frames: FrameForest,
    odometry: Track,
    /// Parent and child of the odometry.
    odometry_frames: Option<(String, String)>,
    newest_pose: Option<Stamp>,
    waiting: VecDeque<Waiting>,
    waiting_bytes: usize,
    counts: ScanCounts,
}

#[derive(Debug)]
struct Waiting {
    cloud: PointCloud2<Bytes>,
    until: Instant,
}

impl Scans {
    /// `points_max`: most points of a cloud.
    pub(crate) fn new(section: &RosSection, points_max: u64) -> Self {
        Self {
            poses: section.poses,
            map_frame: section.map_frame.clone(),
            wait: Duration::from_secs_f64(section.pose_wait_s),
            gap_max: (section.pose_gap_max_s * 1e6) as i64,
            points_max,
            frames: FrameForest::new(FRAMES_MAX, POSES_MAX),
            odometry: Track::default(),
            odometry_frames: None,
            newest_pose: None,
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            counts: ScanCounts::default(),
        }
    }

    pub(crate) const fn counts(&self) -> &ScanCounts {
        &self.counts
    }

    /// Transforms; `is_fixed`: from `/tf_static`, so they hold at any time.
    pub(crate) fn take_transforms(&mut self, message: TFMessage, is_fixed: bool) {
        for transform in message.transforms {
            self.counts.poses += 1;
            let Some(pose) = transform.transform.checked() else {
                self.counts.poses_damaged += 1;
                continue;
            };
            let (parent, child) = (transform.header.frame_id, transform.child_frame_id);
            let has_room = if is_fixed {
                self.frames.push_fixed("", parent, child, pose)
            } else {
                let stamp = transform.header.stamp.into();
                self.newest_pose = self.newest_pose.max(Some(stamp));
                self.frames.push("", parent, child, stamp, pose)
            };
            self.counts.poses_damaged += u64::from(!has_room);
        }
        if let Some(newest) = self.newest_pose {
            self.frames.forget_before(newest.plus_micros(-KEPT_MICROS));
        }
    }

    /// A pose of the robot.
    pub(crate) fn take_odometry(&mut self, message: Odometry) {
        self.counts.poses += 1;
        let Some(pose) = message.pose.pose.checked() else {
            self.counts.poses_damaged += 1;
            return;
        };
        let stamp: Stamp = message.header.stamp.into();
        self.odometry_frames = Some((message.header.frame_id, message.child_frame_id));
        self.odometry.push(stamp, pose);
        self.odometry.keep_newest(POSES_MAX);
        self.odometry.forget_before(stamp.plus_micros(-KEPT_MICROS));
    }

    /// A cloud. It waits behind those before it.
    pub(crate) fn take_cloud(&mut self, cloud: PointCloud2<Bytes>, now: Instant) -> Option<String> {
        self.counts.clouds += 1;
        self.waiting_bytes += cloud.data.0.len();
        self.waiting.push_back(Waiting { cloud, until: now + self.wait });
        let mut crowded_out = 0;
        // The newest stays, however large it is.
        while self.waiting.len() > WAITING_MAX
            || (self.waiting_bytes > WAITING_BYTES_MAX && self.waiting.len() > 1)
        {
            self.pop();
            crowded_out += 1;
        }
        self.counts.crowded_out += crowded_out;
        (crowded_out > 0)
            .then(|| "scans come faster than their poses: the oldest that waited is left out".into())
    }

    /// A message that is none.
    pub(crate) fn take_damaged(&mut self) {
        self.counts.clouds += 1;
        self.counts.damaged += 1;
    }

    /// A scan that came out of [`Self::poll`] has a stamp that cannot be.
    pub(crate) fn count_off_time(&mut self) {
        self.counts.mapped -= 1;
        self.counts.off_time += 1;
    }

    /// The time has jumped back: what is known is of another run.
    pub(crate) fn begin_anew(&mut self) {
        self.counts.of_another_time += self.waiting.len() as u64;
        self.waiting.clear();
        self.waiting_bytes = 0;
        self.frames.forget_moving();
        self.odometry = Track::default();
        self.newest_pose = None;
    }

    /// The next scan with its pose, or why one is left out; `None`: nothing is ready.
    pub(crate) fn poll(&mut self, now: Instant) -> Option<Taken> {
        let first = self.waiting.front()?;
        let stamp: Stamp = first.cloud.header.stamp.into();
        let frame = &first.cloud.header.frame_id;
        let found = match self.pose(frame, stamp, 0) {
            Err(why) if why.may_come() && now < first.until => return None,
            // A pose that is this near will do, as in a recording.
            Err(why) => self.pose(frame, stamp, NEAR_MICROS).map_err(|_| why),
            found => found,
        };
        match found {
            Err(why) => {
                self.pop();
                self.counts.without_pose += 1;
                Some(Taken::Fault(format!("a scan of {:.6} s is left out: {why}", stamp.0 as f64 / 1e6)))
            }
            Ok(Posed { pose, is_in_map }) => {
                let cloud = self.pop()?;
                Some(self.scan(&cloud, stamp, pose, is_in_map))
            }
        }
    }

    /// When [`Self::poll`] should be asked again though nothing comes.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        self.waiting.front().map(|first| first.until)
    }

    fn pop(&mut self) -> Option<PointCloud2<Bytes>> {
        let Waiting { cloud, .. } = self.waiting.pop_front()?;
        self.waiting_bytes -= cloud.data.0.len();
        Some(cloud)
    }

    fn scan(&mut self, cloud: &PointCloud2<Bytes>, stamp: Stamp, pose: Pose, is_in_map: bool) -> Taken {
        let back = is_in_map.then(|| pose.inverse());
        match points_of(cloud, self.points_max, back.as_ref()) {
            Ok(points) => {
                self.counts.mapped += 1;
                self.counts.points_dropped += points.dropped;
                let scan = Scan { stamp, points: points.points, no_returns: Vec::new() };
                Taken::Scan(
                    Frame { scan, t_map_sensor: pose, points_dropped: points.dropped },
                    cloud.header.stamp,
                )
            }
            Err(fault) => {
                self.counts.damaged += 1;
                Taken::Fault(format!("a scan of {:.6} s is left out: {fault}", stamp.0 as f64 / 1e6))
            }
        }
    }

    /// Where the sensor was, in the frame of the map.
    fn pose(&self, frame: &str, stamp: Stamp, near: i64) -> Result<Posed, NoPose> {
        let reach = Reach { gap_max: self.gap_max, near };
        let tree = self.frames.seen_from("");
        if self.poses == RosPoses::Tf {
            let pose = tree.pose(&self.map_frame, frame, stamp, reach)?;
            return Ok(Posed { pose, is_in_map: false });
        }
        let link = |reason, (parent, child): (&str, &str)| NoPose::Link {
            parent: parent.to_owned(),
            child: child.to_owned(),
            stamp,
            reason,
        };
        let Some((parent, child)) = &self.odometry_frames else {
            return Err(link(NoPoseThen::NotYet { newest: None }, (&self.map_frame, frame)));
        };
        let robot = self.odometry.at(stamp, reach).map_err(|reason| link(reason, (parent, child)))?;
        if frame == child || child.is_empty() {
            return Ok(Posed { pose: robot, is_in_map: false });
        }
        if frame == parent {
            return Ok(Posed { pose: robot, is_in_map: true });
        }
        let sensor = tree.pose(child, frame, stamp, reach)?;
        Ok(Posed { pose: robot.compose(&sensor), is_in_map: false })
    }
}

/// Where a sensor was, and whether its points are in the map already.
struct Posed {
    pose: Pose,
    is_in_map: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_io::ros::{Header, Pose as RosPose, PoseWithCovariance, TransformStamped, cloud_of_points};

    fn section(poses: RosPoses) -> RosSection {
        RosSection { poses, ..RosSection::default() }
    }

    fn cloud(micros: i64, frame: &str) -> PointCloud2<Bytes> {
        cloud_of_points(Header::new(Stamp(micros), frame), &[[1.0, 0.0, 0.0], [f32::NAN, 0.0, 0.0]])
    }

    fn at(x: f64) -> RosPose {
        RosPose { position: [x, 0.0, 0.0], ..RosPose::default() }
    }

    fn transform(micros: i64, parent: &str, child: &str, x: f64) -> TFMessage {
        let header = Header::new(Stamp(micros), parent);
        TFMessage {
            transforms: vec![TransformStamped { header, child_frame_id: child.into(), transform: at(x) }],
        }
    }

    fn odometry(micros: i64, x: f64) -> Odometry {
        Odometry {
            header: Header::new(Stamp(micros), "map"),
            child_frame_id: "base".into(),
            pose: PoseWithCovariance { pose: at(x), ..PoseWithCovariance::default() },
            ..Odometry::default()
        }
    }

    /// Where the sensor of the next scan was, along x, and its first point; `Err` is the line for people.
    fn next(scans: &mut Scans, now: Instant) -> Option<Result<(f64, f32), String>> {
        Some(match scans.poll(now)? {
            Taken::Scan(frame, _) => Ok((frame.t_map_sensor.translation()[0], frame.scan.points[0][0])),
            Taken::Fault(text) => Err(text),
        })
    }

    #[test]
    fn a_scan_waits_for_the_poses_around_it_and_no_longer_than_it_may() {
        let (mut scans, now) = (Scans::new(&section(RosPoses::Tf), 100), Instant::now());
        scans.take_cloud(cloud(1_000_000, "lidar"), now);
        assert!(next(&mut scans, now).is_none());
        scans.take_transforms(transform(0, "base", "lidar", 0.5), true);
        scans.take_transforms(transform(900_000, "map", "base", 1.0), false);
        assert!(next(&mut scans, now).is_none());
        scans.take_transforms(transform(1_100_000, "map", "base", 2.0), false);
        let (x, point) = next(&mut scans, now).unwrap().unwrap();
        assert!((x - 2.0).abs() < 1e-12 && point == 1.0);
        // The pose of this one never comes, and the one behind it has its own time.
        scans.take_cloud(cloud(1_200_000, "lidar"), now);
        scans.take_cloud(cloud(1_300_000, "lidar"), now + Duration::from_millis(300));
        assert!(next(&mut scans, now + Duration::from_millis(499)).is_none());
        let late = now + Duration::from_millis(500);
        assert!(next(&mut scans, late).unwrap().unwrap_err().contains("1.200000 s is left out"));
        assert!(next(&mut scans, late).is_none());
        scans.take_transforms(transform(1_300_000, "map", "base", 3.0), false);
        assert_eq!(next(&mut scans, late).unwrap().unwrap().0, 3.5);
        let counts = *scans.counts();
        assert_eq!((counts.clouds, counts.mapped, counts.without_pose, counts.points_dropped), (3, 2, 1, 2));
    }

    #[test]
    fn a_scan_older_than_all_poses_or_in_a_gap_is_not_waited_for() {
        let (mut scans, now) = (Scans::new(&section(RosPoses::Tf), 100), Instant::now());
        scans.take_transforms(transform(1_000_000, "map", "lidar", 0.0), false);
        scans.take_transforms(transform(3_000_000, "map", "lidar", 0.0), false);
        for (stamp, is_mapped) in [(900_000, false), (995_000, true), (2_000_000, false), (2_995_000, true)] {
            scans.take_cloud(cloud(stamp, "lidar"), now);
            assert_eq!(next(&mut scans, now).unwrap().is_ok(), is_mapped, "{stamp}");
        }
    }

    #[test]
    fn odometry_gives_the_pose_of_its_own_frame_of_one_fixed_to_it_and_of_points_in_the_map() {
        let (mut scans, now) = (Scans::new(&section(RosPoses::Odometry), 100), Instant::now());
        scans.take_cloud(cloud(0, "base"), now);
        assert!(next(&mut scans, now).is_none());
        scans.take_odometry(odometry(0, 4.0));
        scans.take_transforms(transform(0, "base", "lidar", 0.5), true);
        assert_eq!(next(&mut scans, now), Some(Ok((4.0, 1.0))));
        scans.take_cloud(cloud(0, "lidar"), now);
        assert_eq!(next(&mut scans, now), Some(Ok((4.5, 1.0))));
        scans.take_cloud(cloud(0, "map"), now);
        assert_eq!(next(&mut scans, now), Some(Ok((4.0, -3.0))));
        scans.take_cloud(cloud(0, "elsewhere"), now);
        let late = now + Duration::from_secs(1);
        assert!(next(&mut scans, late).unwrap().unwrap_err().contains("\"elsewhere\" is unknown"));
    }

    #[test]
    fn what_waits_is_bounded_and_ends_where_time_goes_back() {
        let (mut scans, now) = (Scans::new(&section(RosPoses::Tf), 100), Instant::now());
        for stamp in 0..40 {
            let text = scans.take_cloud(cloud(stamp, "lidar"), now);
            assert_eq!(text.is_some(), stamp >= WAITING_MAX as i64);
        }
        assert_eq!((scans.counts().crowded_out, scans.waiting.len()), (8, WAITING_MAX));
        scans.begin_anew();
        assert_eq!((scans.counts().of_another_time, scans.waiting_bytes), (WAITING_MAX as u64, 0));
        assert!(next(&mut scans, now).is_none() && scans.poll_timeout().is_none());
        // What is fixed is said once and stays; what moves is of another time.
        scans.take_transforms(transform(0, "base", "lidar", 0.5), true);
        scans.take_transforms(transform(9_000_000, "map", "base", 1.0), false);
        scans.begin_anew();
        scans.take_cloud(cloud(1_000_000, "lidar"), now);
        assert!(next(&mut scans, now).is_none());
        scans.take_transforms(transform(1_000_000, "map", "base", 2.0), false);
        assert_eq!(next(&mut scans, now), Some(Ok((2.5, 1.0))));
        // Large clouds too.
        let mut large = cloud(0, "lidar");
        large.data = Bytes(vec![0; WAITING_BYTES_MAX / 2]);
        for _ in 0..4 {
            scans.take_cloud(large.clone(), now);
        }
        assert_eq!(scans.waiting.len(), 2);
    }

    #[test]
    fn poses_and_clouds_that_are_none_are_counted() {
        let (mut scans, now) = (Scans::new(&section(RosPoses::Tf), 1), Instant::now());
        let mut message = transform(0, "map", "lidar", f64::NAN);
        message.transforms.push(transform(0, "map", "lidar", 0.0).transforms.remove(0));
        scans.take_transforms(message, false);
        assert_eq!((scans.counts().poses, scans.counts().poses_damaged), (2, 1));
        scans.take_cloud(cloud(0, "lidar"), now);
        assert!(next(&mut scans, now).unwrap().unwrap_err().contains("number of points"));
        assert_eq!(scans.counts().damaged, 1);
    }
}
