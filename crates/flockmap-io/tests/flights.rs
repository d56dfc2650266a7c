//! Flights of a node: what is recorded, and what is read back of it.

mod common;

use std::path::Path;
use std::time::Duration;

use common::Folder;
use flockmap_feed::{
    Block, Blocks, Event, Link, Message, Mirror, NodeCounts, NodeHello, RobotPose, SeenScan,
};
use flockmap_grid::{BlockIndex, Pose, Resolution, RobotId, Scan, Stamp, State, StateBlock, Stream};
use flockmap_io::{
    FlightOptions, FlightRecorder, FlightView, Problem, RecordOptions, ViewOptions, ViewSink, WriteError,
    open_flight, open_record,
};

const SECONDS: i64 = 20;

fn at(second: i64) -> Stamp {
    Stamp(1_700_000_000_000_000 + second * 1_000_000)
}

/// What a node says in a second of its flight: a few blocks more, where it and another robot are, counters, links.
fn frames(second: i64) -> Vec<u8> {
    let version = second as u64 + 1;
    let mut states = StateBlock::default();
    for voxel in 0..512 {
        let state =
            if (voxel * 7 + second as usize).is_multiple_of(11) { State::Occupied } else { State::Free };
        states.set(voxel, state);
    }
    let block = |y| Block { index: BlockIndex::new(second as i32, y, 0), states, origins: Vec::new() };
    let stream = |robot| Stream { origin: RobotId(robot), epoch: 3 };
    let pose = |robot, orientation| RobotPose {
        stream: stream(robot),
        position: [second as f64, f64::from(robot), 1.0],
        orientation,
        age: Duration::from_millis(20),
    };
    let mut messages = Vec::new();
    if second == 0 {
        messages.push(Message::Hello(NodeHello {
            origins: false,
            goes_on: false,
            robot: RobotId(7),
            resolution: Resolution::from_metres(0.2).unwrap(),
            feed: 5,
            name: "alpha".into(),
            frame: "map".into(),
        }));
        messages.push(Message::Anew { began: 0 });
    }
    messages.push(Message::Blocks(Blocks {
        upto: version,
        newest: version,
        stamp: at(second),
        origins: false,
        blocks: (0..20).map(block).collect(),
    }));
    messages.push(Message::Poses(vec![pose(7, Some([0.0, 0.0, 0.0, 1.0])), pose(2, None)]));
    let counters = vec![("node_frames".to_owned(), version), ("session requests".to_owned(), 2 * version)];
    messages.push(Message::Counters(NodeCounts { now: at(second), counters }));
    messages.push(Message::Links(vec![Link {
        stream: stream(2),
        hears_us: true,
        round_trip: Some(Duration::from_millis(30)),
        loss: 6_554,
        bytes_in: 1_000 * version,
        bytes_out: 500 * version,
        missing: 1,
        unconfirmed: 2,
        silence: Duration::from_millis(100),
    }]));
    messages.iter().flat_map(Message::emit).collect()
}

fn scan(second: i64) -> (Scan, Pose) {
    let points = (0..500).map(|i| [i as f32 * 0.1, second as f32, -0.5]).collect();
    let pose = Pose::new([second as f64, 7.0, 1.0], [0.0, 0.0, 0.6, 0.8]).unwrap();
    (Scan { stamp: at(second), points, no_returns: Vec::new() }, pose)
}

/// Records so many seconds, each flushed, and gives the recorder back.
fn recorded(path: &Path, options: FlightOptions, seconds: i64) -> Result<FlightRecorder, WriteError> {
    let mut recorder = FlightRecorder::create(path, "alpha", options)?;
    assert!(!recorder.hello().is_empty());
    for second in 0..seconds {
        // Cut in the middle of a frame.
        let bytes = frames(second);
        let (head, tail) = bytes.split_at(bytes.len() / 3);
        recorder.push(at(second), head)?;
        recorder.push(at(second), tail)?;
        if options.scans {
            let (scan, pose) = scan(second);
            recorder.write_scan(&scan, &pose)?;
        }
        recorder.flush()?;
    }
    Ok(recorder)
}

fn sent(seconds: i64) -> Vec<u8> {
    (0..seconds).flat_map(frames).collect()
}

#[test]
fn the_feed_comes_back_frame_by_frame_and_makes_the_same_map() {
    let folder = Folder::new();
    recorded(&folder.join("flight.mcap"), FlightOptions::default(), SECONDS)
        .unwrap()
        .finish(at(SECONDS))
        .unwrap();
    let frames: Vec<_> = open_flight(folder.join("flight.mcap")).unwrap().collect::<Result<_, _>>().unwrap();
    assert_eq!(frames.iter().flat_map(|frame| frame.bytes.clone()).collect::<Vec<_>>(), sent(SECONDS));
    assert!(frames.iter().all(|frame| &*frame.topic == "/alpha/feed"));
    assert!(frames.windows(2).all(|pair| pair[0].stamp <= pair[1].stamp));
    assert_eq!((frames[0].stamp, frames[frames.len() - 1].stamp), (at(0), at(SECONDS - 1)));
    let mut mirror = Mirror::default();
    for frame in &frames {
        let event = mirror.push(&mut &frame.bytes[..]).unwrap().unwrap();
        assert!(!matches!(event, Event::Unknown(_)));
    }
    assert_eq!(mirror.map().unwrap().block_count(), 20 * SECONDS as usize);
    assert!(mirror.is_complete() && mirror.links().len() == 1);
}

#[test]
fn a_flight_with_scans_is_a_record_that_reads_back_bit_for_bit() {
    let folder = Folder::new();
    let options = FlightOptions { scans: true, ..FlightOptions::default() };
    recorded(&folder.join("flight.mcap"), options, SECONDS).unwrap().finish(at(SECONDS)).unwrap();
    let record = open_record(folder.join("flight.mcap"), &RecordOptions::default()).unwrap();
    assert_eq!(record.summary.points_topic.as_deref(), Some("/alpha/points"));
    assert_eq!(record.summary.map_frame.as_deref(), Some("map"));
    let read: Vec<_> = record.frames.collect::<Result<_, _>>().unwrap();
    assert_eq!(read.len() as i64, SECONDS);
    for (second, frame) in (0..).zip(&read) {
        assert_eq!((&frame.scan, &frame.t_map_sensor), (&scan(second).0, &scan(second).1));
    }
}

#[test]
fn people_find_pictures_poses_counters_and_links_and_an_index() {
    let folder = Folder::new();
    recorded(&folder.join("flight.mcap"), FlightOptions::default(), SECONDS)
        .unwrap()
        .finish(at(SECONDS))
        .unwrap();
    let bytes = std::fs::read(folder.join("flight.mcap")).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().expect("a summary");
    let stats = summary.stats.unwrap();
    let count = |topic: &str| {
        let channel = summary.channels.values().find(|channel| channel.topic == topic).expect("the topic");
        (channel.schema.as_ref().unwrap().name.as_str(), stats.channel_message_counts[&channel.id])
    };
    // They never outweigh the feed; the last one is of the end.
    assert_eq!(count("/alpha/viewer/map"), ("foxglove.PointCloud", 3));
    assert_eq!(count("/alpha/viewer/paths"), ("foxglove.PointCloud", 3));
    assert_eq!(count("/tf"), ("tf2_msgs/msg/TFMessage", 20));
    assert_eq!(count("/alpha/counters"), ("flockmap.Counters", 20));
    assert_eq!(count("/alpha/links/robot2"), ("flockmap.Link", 20));
    assert_eq!(count("/alpha/feed"), ("flockmap.FeedFrame", 82));
    assert_eq!(summary.channels.len(), 6, "no topics of scans: {:?}", summary.channels);
    let error = open_record(folder.join("flight.mcap"), &RecordOptions::default()).unwrap_err().to_string();
    assert!(error.contains("`scans = true` in its [record]"), "{error}");
}

#[test]
fn an_old_flight_is_never_overwritten() {
    let folder = Folder::new();
    let mut paths = Vec::new();
    for seconds in [1, 2, 3] {
        let recorder = recorded(&folder.join("flight.mcap"), FlightOptions::default(), seconds).unwrap();
        paths.push(recorder.path().to_owned());
        recorder.finish(at(seconds)).unwrap();
    }
    let names: Vec<_> = paths.iter().map(|path| path.file_name().unwrap().to_str().unwrap()).collect();
    assert_eq!(names, ["flight.mcap", "flight-2.mcap", "flight-3.mcap"]);
    for (seconds, path) in (1..).zip(&paths) {
        let frames = open_flight(path).unwrap().map(|frame| frame.unwrap().bytes);
        assert_eq!(frames.flatten().collect::<Vec<_>>(), sent(seconds));
    }
}

#[test]
fn what_was_flushed_survives_a_kill() {
    let folder = Folder::new();
    let mut recorder = recorded(&folder.join("flight.mcap"), FlightOptions::default(), SECONDS).unwrap();
    recorder.push(at(SECONDS), &frames(SECONDS)).unwrap();
    // As the end of the program by SIGKILL: nothing more is written.
    std::mem::forget(recorder);
    let mut read: Vec<_> = open_flight(folder.join("flight.mcap")).unwrap().collect();
    let end = read.pop().unwrap().unwrap_err();
    assert!(matches!(end.problem, Problem::Truncated { .. }), "{end}");
    let frames = read.into_iter().map(|frame| frame.unwrap().bytes);
    assert_eq!(frames.flatten().collect::<Vec<_>>(), sent(SECONDS));
}

#[test]
fn a_full_file_ends_whole_and_within_its_size() {
    let folder = Folder::new();
    let bytes_max = 120_000;
    let options = FlightOptions { bytes_max, ..FlightOptions::default() };
    let mut recorder = FlightRecorder::create(folder.join("flight.mcap"), "alpha", options).unwrap();
    recorder.hello();
    let full = (0..100_000).find_map(|second| recorder.push(at(second), &frames(second)).err()).unwrap();
    assert!(matches!(full, WriteError::Full { .. }), "{full}");
    recorder.finish(at(100_000)).unwrap();
    let length = std::fs::metadata(folder.join("flight.mcap")).unwrap().len();
    assert!(length <= bytes_max && length > bytes_max / 4, "{length} bytes");
    assert!(mcap::Summary::read(&std::fs::read(folder.join("flight.mcap")).unwrap()).unwrap().is_some());
    let frames: Vec<_> = open_flight(folder.join("flight.mcap")).unwrap().collect::<Result<_, _>>().unwrap();
    let read: Vec<u8> = frames.into_iter().flat_map(|frame| frame.bytes).collect();
    assert!(sent(1_000).starts_with(&read) && read.len() > 50_000, "{} bytes", read.len());
}

#[test]
fn damaged_flights_are_read_as_far_as_they_go_and_never_panic() {
    let folder = Folder::new();
    recorded(&folder.join("flight.mcap"), FlightOptions::default(), 4).unwrap().finish(at(4)).unwrap();
    let whole = std::fs::read(folder.join("flight.mcap")).unwrap();
    let bent_path = folder.join("bent.mcap");
    let count = |bytes: &[u8]| {
        std::fs::write(&bent_path, bytes).unwrap();
        open_flight(&bent_path).map_or(0, |frames| frames.filter(Result::is_ok).count())
    };
    let all = count(&whole);
    for place in (0..whole.len()).step_by(whole.len() / 400) {
        let mut bent = whole.clone();
        bent[place] ^= 0x55;
        assert!(count(&bent) <= all);
        assert!(count(&whole[..place]) <= all);
    }
    assert_eq!(all, 4 * 4 + 2);
}

#[test]
fn a_record_of_other_things_has_no_feed_and_what_is_no_record_is_an_error() {
    let folder = Folder::new();
    let mut writer = flockmap_io::RecordWriter::create(folder.join("flight.mcap"), "alpha").unwrap();
    let (scan, pose) = scan(1);
    writer.write(&scan, &pose).unwrap();
    writer.finish().unwrap();
    assert_eq!(open_flight(folder.join("flight.mcap")).unwrap().count(), 0);
    std::fs::write(folder.join("flight.mcap"), "no record at all").unwrap();
    assert!(open_flight(folder.join("flight.mcap")).is_err());
}

/// Keeps what it is given: topics with their schemas, and messages.
#[derive(Default)]
struct Kept {
    channels: Vec<(String, String, Vec<u8>)>,
    messages: Vec<(usize, Vec<u8>)>,
}

impl ViewSink for Kept {
    type Channel = usize;
    type Error = std::convert::Infallible;

    fn channel(
        &mut self,
        topic: &str,
        _: &str,
        (name, _, data): (&str, &str, &[u8]),
    ) -> Result<usize, Self::Error> {
        let channel = (topic.to_owned(), name.to_owned(), data.to_vec());
        let known = self.channels.iter().position(|known| *known == channel);
        Ok(known.unwrap_or_else(|| {
            self.channels.push(channel);
            self.channels.len() - 1
        }))
    }

    fn message(&mut self, channel: usize, _: Stamp, data: &[u8]) -> Result<(), Self::Error> {
        self.messages.push((channel, data.to_vec()));
        Ok(())
    }
}

impl Kept {
    fn count(&self, topic: &str) -> usize {
        self.messages.iter().filter(|(channel, _)| self.channels[*channel].0 == topic).count()
    }
}

/// Shows an app what comes.
fn show(view: &mut FlightView<usize>, kept: &mut Kept, mirror: &mut Mirror, mut bytes: &[u8]) {
    while let Some(event) = mirror.push(&mut bytes).unwrap() {
        view.note(kept, mirror, event, at(0)).unwrap();
    }
}

#[test]
fn a_view_shows_thinned_scans_where_the_sensor_was_if_they_are_wanted() {
    let scan = Message::Scan(SeenScan {
        stamp: at(0),
        position: [3.0, 0.0, 0.0],
        orientation: [0.0, 0.0, 0.6, 0.8],
        points_all: 2,
        points: vec![[1.0, 2.0, 4.0]; 2],
    });
    for scans in [false, true] {
        let (mut kept, mut mirror) = (Kept::default(), Mirror::default());
        let options = ViewOptions { scans, origins: false };
        let mut view = FlightView::new(&mut kept, "alpha", options).unwrap();
        show(&mut view, &mut kept, &mut mirror, &[frames(0), scan.emit()].concat());
        assert_eq!(kept.count("/alpha/viewer/scan"), usize::from(scans));
        if scans {
            let message = &kept.messages.last().unwrap().1;
            for double in [3.0f64, 0.6, 0.8] {
                assert!(message.windows(8).any(|bytes| bytes == double.to_le_bytes()), "{double} is missing");
            }
        }
        assert!(view.is_changed(&mirror));
        assert_eq!(view.picture(&mirror, at(0)).len(), 2);
        assert!(!view.is_changed(&mirror));
    }
}

#[test]
fn a_node_that_comes_back_with_other_counters_has_them_under_their_own_names() {
    let (mut kept, mut mirror) = (Kept::default(), Mirror::default());
    let mut view = FlightView::new(&mut kept, "alpha", ViewOptions::default()).unwrap();
    show(&mut view, &mut kept, &mut mirror, &frames(0));
    mirror.connect();
    show(&mut view, &mut kept, &mut mirror, &frames(0));
    let schemas = |kept: &Kept| kept.channels.iter().filter(|channel| channel.0 == "/alpha/counters").count();
    assert_eq!((schemas(&kept), kept.count("/alpha/counters")), (1, 2), "the same counters");
    mirror.connect();
    let again = frames(0);
    let length = 4 + u32::from_le_bytes(again[..4].try_into().unwrap()) as usize;
    let counters = NodeCounts { now: at(1), counters: vec![("other".to_owned(), 5)] };
    let again = [&again[..length], &Message::Counters(counters).emit()].concat();
    show(&mut view, &mut kept, &mut mirror, &again);
    assert_eq!(schemas(&kept), 2);
    let (_, last) = kept.messages.last().unwrap();
    assert_eq!(last[..], [&[9][..], &5.0f64.to_le_bytes()].concat(), "field 1 is 5");
}
