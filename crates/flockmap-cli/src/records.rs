//! Which records there are, one for each robot, and how each is read.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{anyhow, bail, ensure};
use flockmap_io::{Problem, ReadError, Record, RecordKind, RecordOptions, TopicOf, open_record};

use crate::options::SourceArgs;
use crate::program;

/// A record that a robot sees, not yet opened.
pub struct RobotRecord {
    pub path: PathBuf,
    pub options: RecordOptions,
}

/// The records of the command line, one for each robot, with the options of each. One record with several
/// topics of scans is a robot for each of them.
pub fn records(paths: &[PathBuf], source: &SourceArgs) -> anyhow::Result<Vec<RobotRecord>> {
    let paths = match paths {
        [only] if source.points_topic.len() > 1 => &vec![only.clone(); source.points_topic.len()],
        paths => paths,
    };
    let kinds: Vec<RecordKind> = paths.iter().map(RecordKind::of).collect::<Result<_, _>>()?;
    let are_folders: Vec<bool> = kinds.iter().map(|kind| *kind == RecordKind::Scans).collect();
    let have_topics: Vec<bool> = are_folders.iter().map(|is_folder| !is_folder).collect();
    let are_others = paths.iter().map(|path| canonical(path)).collect::<BTreeSet<_>>().len() == paths.len();
    let bags = |option, once| Repeated { option, what: "records with topics (.mcap, rosbag2 folders)", once };
    let folders = |option, once| Repeated { option, what: "folders of scans", once };
    let points = bags("--points-topic", true).for_each(&source.points_topic, &have_topics)?;
    // Robots of one record have poses of their own.
    let odometry = bags("--odometry-topic", are_others).for_each(&source.odometry_topic, &have_topics)?;
    let map_frames = bags("--map-frame", true).for_each(&source.map_frame, &have_topics)?;
    let submaps = bags("--submaps-topic", are_others).for_each(&source.submaps_topic, &have_topics)?;
    let poses = folders("--poses", false).for_each(&source.poses, &are_folders)?;
    let periods = folders("--scan-period", true).for_each(&source.scan_period, &are_folders)?;
    let options = points.into_iter().zip(odometry).zip(map_frames).zip(submaps).zip(poses).zip(periods);
    let records = paths.iter().zip(options).map(|(path, options)| {
        let (((((points, odometry), map), submaps), poses), period) = options;
        let options = RecordOptions {
            points_topic: points,
            odometry_topic: odometry,
            map_frame: map,
            submaps_topic: submaps,
            poses,
            scan_period_s: period,
            ..RecordOptions::default()
        };
        RobotRecord { path: path.clone(), options }
    });
    Ok(records.collect())
}

/// Opens a record. Where it has several topics to choose from, the error has the commands that choose.
pub fn open(record: &RobotRecord) -> anyhow::Result<Record> {
    open_record(&record.path, &record.options).map_err(|error| {
        let advice = match (&record.options.points_topic, advice(&error)) {
            (None, Some(commands)) => format!("\n{commands}"),
            (Some(_), Some(_)) | (_, None) => topic_option(&error),
        };
        anyhow!("{error}{advice}")
    })
}

/// The commands that choose between several topics of scans: one of them, or a robot for each.
pub fn advice(error: &ReadError) -> Option<String> {
    let Problem::SeveralTopics { of: TopicOf::Scans, topics } = &error.problem else { return None };
    let replay = format!("flockmap replay {}", program::quoted(error.path.display().to_string()));
    let chosen = |topic: &String| format!(" --points-topic {}", program::quoted(topic.clone()));
    let one = topics.first().map(chosen).unwrap_or_default();
    let each: String = topics.iter().map(chosen).collect();
    Some(format!("  the scans of one robot: {replay}{one}\n  a robot for each topic: {replay}{each}"))
}

fn topic_option(error: &ReadError) -> String {
    match &error.problem {
        Problem::SeveralTopics { of: TopicOf::Scans, .. } => " (--points-topic, once for each robot)",
        Problem::SeveralTopics { of: TopicOf::Odometry, .. } => " (--odometry-topic, once for each robot)",
        _ => "",
    }
    .to_owned()
}

/// Two robots have not seen the same scans: then both maps would be one, and agree.
pub fn refuse_twice(records: &[Record]) -> anyhow::Result<()> {
    let mut seen = BTreeMap::new();
    for (robot, record) in records.iter().enumerate() {
        for file in &record.files {
            let topic = record.summary.points_topic.as_deref();
            let Some(other) = seen.insert((canonical(file), topic), robot) else { continue };
            let scans = topic.map(|topic| format!(", topic {topic}")).unwrap_or_default();
            bail!(
                "robots {} and {} would have the same scans ({}{scans}): name another record for each, or, for robots \
                 in one bag, another --points-topic for each",
                other + 1,
                robot + 1,
                file.display()
            );
        }
    }
    Ok(())
}

/// The frames of the robots' poses, if they are known and not all the same: then their maps do not lie in
/// one frame either, unless the frames are one under several names.
pub fn several_frames(records: &[Record]) -> Option<String> {
    let frames = records.iter().filter_map(|record| record.summary.map_frame.as_deref());
    let frames: BTreeSet<&str> = frames.collect();
    (frames.len() > 1).then(|| frames.into_iter().collect::<Vec<_>>().join(", "))
}

/// A name for each robot; where records have the same one, with the topic of the scans.
pub fn names(records: &[Record]) -> Vec<String> {
    let name = |record: &Record| match &record.summary.points_topic {
        Some(topic) if records.iter().filter(|other| other.name == record.name).count() > 1 => {
            format!("{} {topic}", record.name)
        }
        _ => record.name.clone(),
    };
    records.iter().map(name).collect()
}

/// The same file by any spelling of its path.
fn canonical(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}

/// An option for records that may be given several times.
struct Repeated {
    option: &'static str,
    /// The records that it is for.
    what: &'static str,
    /// Whether one value may be right for all.
    once: bool,
}

impl Repeated {
    /// The value for each record: one for all, or one for each that it fits, in their order.
    fn for_each<T: Clone>(&self, values: &[T], fits: &[bool]) -> anyhow::Result<Vec<Option<T>>> {
        let Self { option, what, once } = *self;
        let records = fits.iter().filter(|fits| **fits).count();
        ensure!(values.is_empty() || records > 0, "{option} is for {what}, and there are none");
        let one_for_all = values.len() == 1 && (once || records == 1);
        ensure!(
            values.is_empty() || one_for_all || values.len() == records,
            "{option} is given {} for {records} {what}: give it once for each, in their order{}",
            if values.len() == 1 { "once".to_owned() } else { format!("{} times", values.len()) },
            if once { ", or once for all" } else { "" }
        );
        let mut values = values.iter().cycle();
        Ok(fits.iter().map(|fits| if *fits { values.next().cloned() } else { None }).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(given: &[&str], fits: &[bool], once: bool) -> Result<Vec<Option<String>>, String> {
        let given: Vec<String> = given.iter().map(|&value| value.to_owned()).collect();
        let option = Repeated { option: "--poses", what: "folders of scans", once };
        option.for_each(&given, fits).map_err(|error| error.to_string())
    }

    #[test]
    fn an_option_is_for_all_records_or_for_each_that_it_fits() {
        let some = |value: &str| Some(value.to_owned());
        assert_eq!(values(&[], &[true, true], false).unwrap(), [None, None]);
        assert_eq!(values(&["a"], &[true, false, true], true).unwrap(), [some("a"), None, some("a")]);
        assert_eq!(values(&["a", "b"], &[true, false, true], false).unwrap(), [some("a"), None, some("b")]);
        assert_eq!(values(&["a"], &[false, true], false).unwrap(), [None, some("a")]);
    }

    #[test]
    fn an_option_that_cannot_be_right_for_all_is_refused() {
        let error = values(&["a"], &[true, true], false).unwrap_err();
        assert!(
            error.contains("--poses is given once for 2 folders of scans: give it once for each"),
            "{error}"
        );
        assert!(!error.contains("for all"), "{error}");
        let error = values(&["a", "b"], &[true, true, true], true).unwrap_err();
        assert!(error.contains("2 times for 3") && error.contains("or once for all"), "{error}");
        let error = values(&["a"], &[false], true).unwrap_err();
        assert!(error.contains("--poses is for folders of scans, and there are none"), "{error}");
    }

    /// A record with poses in this frame.
    fn record(name: &str, points_topic: &str, map_frame: &str) -> Record {
        let summary = flockmap_io::RecordSummary {
            points_topic: Some(points_topic.to_owned()),
            map_frame: Some(map_frame.to_owned()),
            ..Default::default()
        };
        let frames = flockmap_io::Frames::new(std::iter::empty());
        let (files, poses, submaps) = Default::default();
        Record { name: name.to_owned(), files, summary, poses, submaps, frames }
    }

    #[test]
    fn robots_with_several_frames_and_one_name_are_told_apart() {
        let records = [record("bag", "/a/points", "map"), record("bag", "/b/points", "map")];
        assert_eq!(names(&records), ["bag /a/points", "bag /b/points"]);
        assert_eq!(several_frames(&records), None);
        let records = [record("a", "/points", "a/odom"), record("b", "/points", "b/odom")];
        assert_eq!(names(&records), ["a", "b"]);
        assert_eq!(several_frames(&records).unwrap(), "a/odom, b/odom");
    }
}
