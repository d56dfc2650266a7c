//! What a robot knows, frame by frame: its own map and its layers, each in submaps, brought to where they lie.

use std::collections::BTreeMap;

use rustc_hash::FxHashMap;

use flockmap::grid::{BlockIndex, Layer, Mapper, Sheet, bit_of};
use flockmap::{Pose, Robot, RobotId, Stamp, State, Stream, SubmapId, Voxel};

/// Who says so, and when it was seen: `None` if it is this robot.
pub(super) type Word = (Option<RobotId>, State, Stamp);

/// Voxels that lie together.
type Frame = FxHashMap<Voxel, (State, Stamp)>;

/// All that is said of each voxel of the fused map. O(voxels).
pub(super) fn words(robot: &Robot) -> BTreeMap<Voxel, Vec<Word>> {
    let (own, mapper, mut words) = (robot.own_stream(), robot.mapper(), BTreeMap::new());
    for (submap, frame) in of_mapper(mapper) {
        add(&mut words, robot, None, robot.fusion().submap_pose(own, submap), &frame);
    }
    for (stream, layer) in robot.fusion().layers() {
        let who = (stream != own).then_some(stream.origin);
        let is_left = |local: BlockIndex, sheet: Sheet| {
            who.is_some() || mapper.place_of(local).is_some_and(|(_, now)| now > sheet)
        };
        for ((submap, _), frame) in of_layer(robot, stream, layer, is_left) {
            add(&mut words, robot, who, robot.fusion().submap_pose(stream, submap), &frame);
        }
    }
    words
}

fn of_mapper(mapper: &Mapper) -> BTreeMap<SubmapId, Frame> {
    let mut frames = BTreeMap::<SubmapId, Frame>::new();
    for (index, block) in mapper.blocks() {
        let Some((submap, _)) = mapper.place_of(index) else { continue };
        let frame = frames.entry(submap).or_default();
        for bit in (0..512).filter(|bit| block.get(*bit) != State::Unknown) {
            let voxel = voxel_of(index, bit);
            frame.insert(voxel, (block.get(bit), mapper.last_seen(voxel).unwrap_or(Stamp(i64::MIN))));
        }
    }
    frames
}

/// What lies on a sheet in a submap; what is in a submap of which it is not known that it has begun is left out.
fn of_layer(
    robot: &Robot,
    stream: Stream,
    layer: &Layer,
    is_left: impl Fn(BlockIndex, Sheet) -> bool,
) -> BTreeMap<(SubmapId, Sheet), Frame> {
    let fusion = robot.fusion();
    let begun: Vec<_> = fusion
        .submaps(stream)
        .filter_map(|submap| Some((submap, fusion.submap_began(stream, submap)?)))
        .collect();
    let mut frames = BTreeMap::<(SubmapId, Sheet), Frame>::new();
    for (index, block) in layer.blocks() {
        let Some(sheet) = Sheet::of(index) else { continue };
        let local = sheet.local(index);
        let said = (0..512).filter_map(|bit| {
            let (state, stamp) = layer.get(voxel_of(index, bit))?;
            Some((voxel_of(local, bit), (state, stamp)))
        });
        let said: Vec<_> = said.collect();
        let Some(newest) = said.iter().map(|(_, (_, stamp))| *stamp).max() else { continue };
        let submap = begun.iter().filter(|(_, began)| *began <= newest).map(|(submap, _)| *submap).max();
        let submap = submap.unwrap_or_default();
        if !block.is_empty() && submap.number() >= sheet.number() && is_left(local, sheet) {
            frames.entry((submap, sheet)).or_default().extend(said);
        }
    }
    frames
}

/// Brings a frame to where it lies: Occupied forwards, Free backwards.
fn add(
    words: &mut BTreeMap<Voxel, Vec<Word>>,
    robot: &Robot,
    who: Option<RobotId>,
    pose: Pose,
    frame: &Frame,
) {
    let resolution = robot.config().mapper.resolution;
    let back = pose.inverse();
    let there = |voxel: Voxel| resolution.voxel_at(pose.transform(resolution.centre(voxel)));
    let mut images = BTreeMap::<Voxel, (State, Stamp)>::new();
    for (voxel, (_, stamp)) in frame.iter().filter(|(_, (state, _))| *state == State::Occupied) {
        let Some(image) = there(*voxel) else { continue };
        let newest = images.entry(image).or_insert((State::Occupied, *stamp));
        newest.1 = newest.1.max(*stamp);
    }
    for voxel in frame.iter().filter(|(_, (state, _))| *state == State::Free).map(|(voxel, _)| *voxel) {
        let Some(at) = there(voxel) else { continue };
        for near in (0..27).map(|n| Voxel::new(at.x + n % 3 - 1, at.y + n / 3 % 3 - 1, at.z + n / 9 - 1)) {
            let source = resolution.voxel_at(back.transform(resolution.centre(near)));
            if let Some((State::Free, stamp)) = source.and_then(|source| frame.get(&source)) {
                images.entry(near).or_insert((State::Free, *stamp));
            }
        }
    }
    for (voxel, (state, stamp)) in images {
        words.entry(voxel).or_default().push((who, state, stamp));
    }
}

const fn voxel_of(index: BlockIndex, bit: usize) -> Voxel {
    let ([x, y, z], corner) = (bit_of(bit), index.corner());
    Voxel::new(corner.x + x, corner.y + y, corner.z + z)
}
