//! What a node sees and sends, recorded while it flies.

use std::path::Path;
use std::time::Duration;

use flockmap_feed::{FRAME_BYTES_MAX, Mirror, MirrorOptions, Splitter};
use flockmap_grid::{Pose, Scan, Stamp};

use crate::error::WriteError;
use crate::flight_file::{ChannelId, FlightFile};
use crate::flight_view::{FlightView, ViewOptions, ViewSink, ros_schema};
use crate::protobuf::{Kind, Message, ProtoFile, Schema};
use crate::record_scan::{SUBMAPS, check_stamp, scan_messages, submaps_message};
use crate::record_view::ViewSchedule;
use crate::ros;

/// Schema of the messages that hold the feed.
pub(crate) const FEED_SCHEMA: &str = "flockmap.FeedFrame";
/// In such a message, the field with the frame.
pub(crate) const FEED_FIELD: u32 = 1;

/// What is recorded.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct FlightOptions {
    /// Whether scans are: as [`RecordWriter`](crate::RecordWriter) has them, and a part of them in the feed.
    pub scans: bool,
    /// Whether it is asked who saw each voxel last: the feed has it then, and the map is drawn in the colours of the
    /// robots. The node pays for that.
    pub origins: bool,
    /// The map is drawn so often at most, for people. Zero: never.
    pub picture_period: Duration,
    /// Bytes that the file may have.
    pub bytes_max: u64,
}

impl Default for FlightOptions {
    /// No scans, no origins, a picture each 2 s, 2 GiB.
    fn default() -> Self {
        Self { scans: false, origins: false, picture_period: Duration::from_secs(2), bytes_max: 2 << 30 }
    }
}

/// Writes a flight as an MCAP file: the feed of the node as it comes, for [`open_flight`](crate::open_flight), and
/// for people what Foxglove and Rerun both show. `docs/flights.md` has the topics. Reads the feed as any reader does:
/// [`Self::hello`] goes to the node, and what comes from it is [pushed](Self::push).
///
/// A map that has no room in a mirror (2²⁰ blocks) is not drawn any more, nor is what stands beside it; its feed is
/// recorded all the same.
///
/// Memory: a [`Mirror`] of the map, a chunk of 1 MiB and a message, a picture of 8 MiB while it is drawn and 16 bytes
/// for each occupied voxel, the ways of 64 robots (6 MB), and 1 kB for each chunk of the file, which is 3.6 MB an hour.
pub struct FlightRecorder {
    file: FlightFile,
    robot: String,
    options: FlightOptions,
    splitter: Splitter,
    mirror: Mirror,
    /// Nothing is drawn any more: the mirror has no room.
    is_blind: bool,
    schedule: ViewSchedule,
    view: FlightView<ChannelId>,
    feed: ChannelId,
}

impl FlightRecorder {
    /// Makes a file; if there is one of that name, the new one gets a number: `flight-2.mcap`. `robot` names topics
    /// and frames.
    ///
    /// # Errors
    /// The file cannot be made.
    pub fn create(path: impl AsRef<Path>, robot: &str, options: FlightOptions) -> Result<Self, WriteError> {
        let mut file = FlightFile::create(path.as_ref(), options.bytes_max)?;
        let frame = ProtoFile::new("flockmap/feed_frame.proto", "flockmap", &[])
            .message("FeedFrame", &[("frame", FEED_FIELD, Kind::Bytes)]);
        let frame = Schema::default().file(frame).into_bytes();
        let feed = file.channel(&format!("/{robot}/feed"), "protobuf", (FEED_SCHEMA, "protobuf", &frame))?;
        // Whole scans are written, in place of those of the feed.
        let view = ViewOptions { origins: options.origins, scans: false };
        let view = FlightView::new(&mut file, robot, view)?;
        let mirror = MirrorOptions {
            origins: options.origins,
            links: true,
            scans: options.scans,
            submaps: true,
            ..Default::default()
        };
        Ok(Self {
            file,
            robot: robot.to_owned(),
            options,
            splitter: Splitter::new(FRAME_BYTES_MAX),
            mirror: Mirror::new(mirror),
            is_blind: false,
            schedule: ViewSchedule::new(options.picture_period),
            view,
            feed,
        })
    }

    /// Where it is written.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Bytes that are safe from the end of the program, and of the power.
    pub const fn bytes(&self) -> u64 {
        self.file.bytes()
    }

    /// What to send to the node first, and all there is to send.
    pub fn hello(&mut self) -> Vec<u8> {
        self.splitter = Splitter::new(FRAME_BYTES_MAX);
        self.mirror.connect()
    }

    /// Records what the node sent, cut anywhere. `now` is the time on its clock.
    ///
    /// # Errors
    /// [`WriteError::Full`]: the file has reached its size; [finish](Self::finish) it. Any other: it cannot be
    /// written; [abandon](Self::abandon) it. What is no feed is an error too.
    pub fn push(&mut self, now: Stamp, mut bytes: &[u8]) -> Result<(), WriteError> {
        loop {
            let unfit = |error| WriteError::unfit(self.file.path(), "a frame of the feed", error);
            let frame = match self.splitter.next(&mut bytes).map_err(|e| unfit(e.to_string()))? {
                None => return Ok(()),
                Some((kind, body)) => {
                    let length = (body.len() + 1) as u32;
                    [&length.to_le_bytes()[..], &[kind], body].concat()
                }
            };
            self.write_frame(now, &frame)?;
            if self.is_blind {
                continue;
            }
            match self.mirror.push(&mut &frame[..]) {
                Ok(Some(event)) => self.view.note(&mut self.file, &self.mirror, event, now)?,
                Ok(None) => {}
                // The feed goes on to be recorded.
                Err(_) => self.is_blind = true,
            }
            if self.schedule.is_due(now) {
                self.draw(now)?;
            }
        }
    }

    /// Records a scan and `T_map_sensor` at its time.
    ///
    /// # Errors
    /// As of [`Self::push`]. A stamp that ROS 2 has no time for.
    pub fn write_scan(&mut self, scan: &Scan, t_map_sensor: &Pose) -> Result<(), WriteError> {
        check_stamp(self.file.path(), scan.stamp)?;
        let path = self.path().to_owned();
        let file = &mut self.file;
        scan_messages(&path, &self.robot, scan, t_map_sensor, |topic, schema, data| {
            let channel = file.channel(topic, "cdr", ros_schema(schema))?;
            file.message(channel, scan.stamp, data)
        })?;
        self.schedule.scan_written(12 * (scan.points.len() + scan.no_returns.len()));
        Ok(())
    }

    /// Records `T_map_submap` of all submaps of the robot, in their order, as they are from a time on, as
    /// [`RecordWriter::write_submaps`](crate::RecordWriter::write_submaps) does.
    ///
    /// # Errors
    /// As of [`Self::push`]. A stamp that ROS 2 has no time for, or too many submaps.
    pub fn write_submaps(&mut self, now: Stamp, t_map_submaps: &[Pose]) -> Result<(), WriteError> {
        let message = submaps_message(self.path(), now, t_map_submaps)?;
        let topic = format!("/{}{SUBMAPS}", self.robot);
        let channel = self.file.channel(&topic, "cdr", ros_schema(ros::POSES))?;
        self.file.message(channel, now, &message)?;
        self.schedule.scan_written(message.len());
        Ok(())
    }

    /// Makes what was recorded safe from the end of the program, and of the power. To be called about once a second.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        self.file.flush()
    }

    /// Draws the map as it is at the end, writes the index and ends the file.
    ///
    /// # Errors
    /// It cannot be written; it ends behind what was flushed last.
    pub fn finish(mut self, now: Stamp) -> Result<(), WriteError> {
        if !self.options.picture_period.is_zero()
            && let Err(error) = self.draw(now)
        {
            self.file.abandon();
            return Err(error);
        }
        self.file.finish()
    }

    /// Ends the file behind what was flushed last, after an error.
    pub fn abandon(self) {
        self.file.abandon();
    }

    fn write_frame(&mut self, now: Stamp, frame: &[u8]) -> Result<(), WriteError> {
        let mut message = Message::default();
        message.bytes(FEED_FIELD, frame);
        self.file.message(self.feed, now, &message.into_bytes())?;
        self.schedule.scan_written(frame.len());
        Ok(())
    }

    /// Draws the occupied voxels and the ways, if the map is another than the one drawn last.
    fn draw(&mut self, now: Stamp) -> Result<(), WriteError> {
        if !self.view.is_changed(&self.mirror) {
            return Ok(());
        }
        let pictures = self.view.picture(&self.mirror, now);
        self.schedule.view_written(now, pictures.iter().map(|(_, picture)| picture.len()).sum());
        for (channel, picture) in pictures {
            match self.file.message(channel, now, &picture) {
                // What is smaller may still have room.
                Ok(()) | Err(WriteError::Full { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

impl core::fmt::Debug for FlightRecorder {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "FlightRecorder of {} into {}", self.robot, self.path().display())
    }
}
