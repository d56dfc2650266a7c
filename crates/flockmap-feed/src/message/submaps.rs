//! Which submaps there are, and how they lie in the map.

use flockmap_grid::{Pose, RobotId, Stream, SubmapId};

use super::field;
use crate::FeedError;
use crate::bytes::Fields;

/// A run in a submaps frame, before its poses.
const RUN_BYTES: usize = 2 + 8 + 3 * 2;
/// A submap with its pose.
const POSE_BYTES: usize = 2 + 3 * 8 + 4 * 8;

/// The square of the length of a quaternion is 1 within this.
const UNIT_WITHIN: f64 = 1e-3;

/// The submaps of one run of a robot, and how they lie in the map that is fed.
#[derive(Clone, PartialEq, Debug)]
pub struct RunSubmaps {
    /// The robot and its run.
    pub stream: Stream,
    /// The newest that is known to have begun; those before it have begun too.
    pub newest: SubmapId,
    /// `T_own_submap`, in metres: it takes what was written in the submap, by the robot whose run it is, to where that
    /// is in the map that is fed, as it is shown now. Ascending. One that is not there lies as the one before it does.
    pub poses: Vec<(SubmapId, Pose)>,
    /// Poses of older submaps that were left out, since a frame has no room for them.
    pub left_out: u16,
}

impl RunSubmaps {
    /// Most runs of which submaps are told.
    pub const RUNS_MAX: usize = 1_024;

    /// Most poses that are told, of all runs together.
    pub const POSES_MAX: usize = 8_192;

    /// How a submap lies in the map that is fed. `None`: it has not begun, or its pose was left out. O(log poses).
    pub fn pose(&self, submap: SubmapId) -> Option<Pose> {
        let upto = self.poses.partition_point(|(number, _)| *number <= submap);
        let (_, pose) = self.poses.get(upto.checked_sub(1)?)?;
        (submap <= self.newest).then_some(*pose)
    }

    /// What there is room for: the first [`Self::RUNS_MAX`] runs, and of those with the most poses the newest ones.
    #[must_use]
    pub fn within_limits(mut runs: Vec<Self>) -> Vec<Self> {
        runs.truncate(Self::RUNS_MAX);
        let each = poses_each(&runs);
        for run in &mut runs {
            let gone = run.poses.len().saturating_sub(each);
            run.poses.drain(..gone);
            run.left_out = run.left_out.saturating_add(u16::try_from(gone).unwrap_or(u16::MAX));
        }
        runs
    }

    pub(super) fn put_all(runs: &[Self], bytes: &mut Vec<u8>) {
        let runs = Self::within_limits(runs.to_vec());
        bytes.extend_from_slice(&(runs.len() as u16).to_le_bytes());
        runs.iter().for_each(|run| run.put(bytes));
    }

    fn put(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.stream.origin.0.to_le_bytes());
        bytes.extend_from_slice(&self.stream.epoch.to_le_bytes());
        for number in [self.newest.number(), self.left_out, self.poses.len() as u16] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        for (submap, pose) in &self.poses {
            bytes.extend_from_slice(&submap.number().to_le_bytes());
            let numbers = pose.translation().into_iter().chain(pose.quaternion_xyzw());
            numbers.for_each(|number| bytes.extend_from_slice(&number.to_le_bytes()));
        }
    }

    pub(super) fn parse_all(body: &[u8]) -> Result<Vec<Self>, FeedError> {
        let mut fields = Fields::new("submaps", body);
        let count = usize::from(fields.u16("count")?);
        if count > Self::RUNS_MAX {
            return Err(field("submaps", "count", count as u64, "1,024 runs at most"));
        }
        let count = fields.check_count("runs", count, RUN_BYTES)?;
        let (mut runs, mut room) = (Vec::<Self>::with_capacity(count), Self::POSES_MAX);
        for _ in 0..count {
            let run = Self::parse(&mut fields, room)?;
            if runs.last().is_some_and(|last| last.stream >= run.stream) {
                return Err(field("submaps", "robot id", run.stream.origin.0.into(), "runs that ascend"));
            }
            room -= run.poses.len();
            runs.push(run);
        }
        Ok(runs)
    }

    /// Reads one run, with no more poses than this.
    fn parse(fields: &mut Fields<'_>, room: usize) -> Result<Self, FeedError> {
        let stream = Stream { origin: RobotId(fields.u16("robot id")?), epoch: fields.u64("epoch")? };
        let newest = submap(fields, "newest submap", None)?;
        let left_out = fields.u16("number left out")?;
        let count = usize::from(fields.u16("number of poses")?);
        if count > room {
            return Err(field("submaps", "number of poses", count as u64, "8,192 in all at most"));
        }
        let count = fields.check_count("poses", count, POSE_BYTES)?;
        let mut poses = Vec::<(SubmapId, Pose)>::with_capacity(count);
        for _ in 0..count {
            let number = submap(fields, "submap", Some(newest))?;
            if poses.last().is_some_and(|(last, _)| *last >= number) {
                return Err(field("submaps", "submap", number.number().into(), "numbers that ascend"));
            }
            poses.push((number, pose(fields)?));
        }
        Ok(Self { stream, newest, poses, left_out })
    }
}

/// How many poses of each run there is room for: as many as all together may be, if those with few give what they do not
/// need to the others.
fn poses_each(runs: &[RunSubmaps]) -> usize {
    let mut counts: Vec<usize> = runs.iter().map(|run| run.poses.len()).collect();
    counts.sort_unstable();
    let mut room = RunSubmaps::POSES_MAX;
    for (place, count) in counts.iter().enumerate() {
        let each = room / (counts.len() - place);
        if *count > each {
            return each;
        }
        room -= count;
    }
    RunSubmaps::POSES_MAX
}

fn submap(
    fields: &mut Fields<'_>,
    name: &'static str,
    newest: Option<SubmapId>,
) -> Result<SubmapId, FeedError> {
    let number = fields.u16(name)?;
    let id = SubmapId::new(number).filter(|id| newest.is_none_or(|newest| *id <= newest));
    let expected = "4,095 at most, and no newer one than the newest";
    id.ok_or_else(|| field("submaps", name, number.into(), expected))
}

fn pose(fields: &mut Fields<'_>) -> Result<Pose, FeedError> {
    let (translation, rotation) = (fields.finite("translation")?, fields.finite::<4>("rotation")?);
    let square: f64 = rotation.iter().map(|number| number * number).sum();
    let pose = Pose::new(translation, rotation).filter(|_| (square - 1.0).abs() <= UNIT_WITHIN);
    pose.ok_or_else(|| field("submaps", "rotation", square.to_bits(), "a quaternion of length 1"))
}
