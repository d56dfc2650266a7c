//! Submaps: what is fused of them is what the rules say, whenever what is known of them comes.

use super::*;
use crate::{MAP_BLOCK_BYTES, Sheet, SubmapId, SubmapRecord};

#[derive(Clone, Debug)]
enum Step {
    Scan([f64; 3], Vec<[f32; 3]>),
    /// The own map publishes what is to be said of submaps, and then what has changed.
    Publish,
    Begin,
    Move(u16, Pose),
    /// On a sheet, at a time.
    Package(u16, u16, i64, Vec<(Voxel, State)>),
    Record(u16, u16, i64, Option<Pose>),
    Align(u16, Pose),
    Work(usize),
}

/// Submap n of another robot begins then.
fn began(submap: u16) -> Stamp {
    Stamp(i64::from(submap) * 500_000)
}

fn pose() -> impl Strategy<Value = Pose> {
    let pose = ([-3.0..3.0f64, -3.0..3.0, -1.0..1.0], [-1.0..1.0f64, -1.0..1.0, -1.0..1.0, 0.3..1.0f64]);
    let pose = prop_oneof![
        3 => pose.prop_map(|(t, q)| Pose::new(t, q).unwrap()),
        1 => Just(Pose::IDENTITY),
        2 => (-3..3i32).prop_map(|x| Pose::from_translation([f64::from(x) * 4.0, 0.0, 0.0])),
    ];
    pose.prop_map(|pose| pose.rounded().unwrap())
}

fn step() -> impl Strategy<Value = Step> {
    let point = [-5.0..5.0f32, -5.0..5.0f32, -2.0..2.0f32];
    let voxel = (-9..9i32, -9..9i32, -5..5i32).prop_map(|(x, y, z)| Voxel::new(x, y, z));
    let state = prop_oneof![Just(State::Free), Just(State::Occupied)];
    let origin = 2..4u16;
    let at = (-3..3i32).prop_map(|x| [f64::from(x) * 3.0 + 0.1, 0.2, 0.3]);
    prop_oneof![
        4 => (at, prop::collection::vec(point, 1..12)).prop_map(|(at, points)| Step::Scan(at, points)),
        2 => Just(Step::Publish),
        2 => Just(Step::Begin),
        2 => (0..9u16, pose()).prop_map(|(submap, pose)| Step::Move(submap, pose)),
        5 => (origin.clone(), prop_oneof![3 => Just(0u16), 2 => 0..3u16], 0..3_000_000i64, prop::collection::vec((voxel, state), 1..60))
            .prop_map(|(origin, sheet, stamp, voxels)| Step::Package(origin, sheet, stamp, voxels)),
        4 => (origin.clone(), 0..5u16, 0..3_000_000i64, prop::option::of(pose()))
            .prop_map(|(origin, submap, stamp, pose)| Step::Record(origin, submap, stamp, pose)),
        1 => (origin, pose()).prop_map(|(origin, pose)| Step::Align(origin, pose)),
        4 => (0..40usize).prop_map(Step::Work),
    ]
}

/// What is known of the submaps of a stream, in plain words.
#[derive(Clone, Default)]
struct Known {
    begins: BTreeMap<u16, Stamp>,
    poses: BTreeMap<u16, (Stamp, Pose)>,
}

impl Known {
    fn pose(&self, submap: u16, is_own: bool) -> Pose {
        let known = self.poses.range(..=submap).rev();
        let is_known = |submap: u16| is_own || submap == 0 || self.begins.contains_key(&submap);
        let mut known = known.filter(|(submap, _)| is_known(**submap));
        known.next().map_or(Pose::IDENTITY, |(_, (_, pose))| *pose)
    }

    /// The submap of a block with this newest stamp.
    fn at(&self, newest: Stamp) -> u16 {
        self.begins
            .iter()
            .filter(|(_, began)| **began <= newest)
            .map(|(submap, _)| *submap)
            .max()
            .unwrap_or(0)
    }
}

/// What lies in one frame: of a submap of a stream, its pose, and voxels with states and stamps.
struct Frame {
    of: (Stream, u16),
    pose: Pose,
    voxels: BTreeMap<Voxel, (State, Stamp)>,
}

/// What a frame knows of voxels of the fused map: when that was observed, whether Occupied.
struct Observed {
    of: (Stream, u16),
    voxels: BTreeMap<Voxel, (Stamp, bool)>,
}

/// What lies in one frame of a layer: for each submap and sheet. Without blocks of which the submap is not known.
fn frames_of(
    stream: Stream,
    layer: &Layer,
    known: &Known,
    is_own: bool,
    origin: Pose,
    is_in: impl Fn(BlockIndex, Sheet) -> bool,
) -> Vec<Frame> {
    let mut newest = BTreeMap::<BlockIndex, Stamp>::new();
    for (voxel, _) in layer.voxels() {
        let stamp = newest.entry(voxel.block()).or_insert(Stamp(i64::MIN));
        *stamp = layer.get(voxel).unwrap().1.max(*stamp);
    }
    let mut frames = BTreeMap::<(u16, Sheet), Frame>::new();
    for (voxel, _) in layer.voxels() {
        let Some(sheet) = Sheet::of(voxel.block()) else { continue };
        let submap = known.at(newest[&voxel.block()]);
        let local = sheet.local(voxel.block());
        if submap < sheet.number() || !is_in(local, sheet) {
            continue;
        }
        let pose = known.pose(submap, is_own);
        let pose = if pose == Pose::IDENTITY { origin } else { origin.compose(&pose) };
        let new = || Frame { of: (stream, submap), pose, voxels: BTreeMap::new() };
        let frame = frames.entry((submap, sheet)).or_insert_with(new);
        frame.voxels.insert(local.voxel(voxel_bit(voxel)), layer.get(voxel).unwrap());
    }
    frames.into_values().collect()
}

/// What a frame knows of each voxel of the fused map.
fn observe(Frame { of, pose, voxels }: &Frame, made: impl Fn(Stamp) -> Stamp) -> Observed {
    let resolution = resolution();
    let mut images = BTreeMap::<Voxel, Stamp>::new();
    for (voxel, (_, stamp)) in voxels.iter().filter(|(_, (state, _))| *state == State::Occupied) {
        let image = resolution.voxel_at(pose.transform(resolution.centre(*voxel))).unwrap();
        let newest = images.entry(image).or_insert(*stamp);
        *newest = (*newest).max(*stamp);
    }
    let back = pose.inverse();
    let everywhere = VoxelBox::spanning(Voxel::new(-100, -60, -60), Voxel::new(100, 60, 60)).unwrap();
    let near =
        voxels.keys().map(|voxel| resolution.voxel_at(pose.transform(resolution.centre(*voxel))).unwrap());
    let near: BTreeSet<Voxel> = near
        .flat_map(|v| {
            (0..125).map(move |n| Voxel::new(v.x + n % 5 - 2, v.y + n / 5 % 5 - 2, v.z + n / 25 - 2))
        })
        .collect();
    let mut observed = BTreeMap::new();
    for target in near {
        assert!(everywhere.contains(target));
        let occupied = images.get(&target).map(|stamp| (made(*stamp), true));
        let source = resolution.voxel_at(back.transform(resolution.centre(target))).unwrap();
        let free = voxels.get(&source).filter(|(state, _)| *state == State::Free);
        let newest = occupied.or_else(|| free.map(|(_, stamp)| (made(*stamp), false)));
        observed.extend(newest.map(|newest| (target, newest)));
    }
    Observed { of: *of, voxels: observed }
}

/// Takes out obstacles that lie within so many voxels, in the same block, of those of a newer submap of the stream.
fn clear_older(observed: &mut [Observed], voxels: u8) {
    let is_near = |a: Voxel, b: Voxel| {
        let apart = [a.x - b.x, a.y - b.y, a.z - b.z].map(i32::abs);
        a.block() == b.block() && apart.into_iter().all(|apart| apart <= i32::from(voxels))
    };
    let obstacles: Vec<_> = observed
        .iter()
        .flat_map(|one| {
            one.voxels.iter().filter(|(_, (_, is_occupied))| *is_occupied).map(|(at, _)| (one.of, *at))
        })
        .collect();
    for Observed { of: (stream, submap), voxels: known } in observed.iter_mut().filter(|_| voxels > 0) {
        let newer = obstacles.iter().filter(|((of, other), _)| of == stream && other > submap);
        let newer: Vec<Voxel> = newer.map(|(_, at)| *at).collect();
        known.retain(|at, (_, is_occupied)| !*is_occupied || newer.iter().all(|other| !is_near(*at, *other)));
    }
}

/// Every own scan, package and record that came, in plain words.
#[derive(Default)]
struct Model {
    known: BTreeMap<u16, Known>,
    /// Of the own submaps, the newest of each, not published yet.
    unsaid: BTreeMap<SubmapId, SubmapRecord>,
    alignments: BTreeMap<u16, Pose>,
    arrivals: Vec<(Stream, Stamp, Stamp)>,
}

impl Model {
    fn map(&self, mapper: &Mapper, fusion: &Fusion) -> BTreeMap<Voxel, State> {
        let mut observed = Vec::new();
        let none = Known::default();
        let priority = fusion.config.own_priority_micros;
        let own = self.known.get(&OWN.origin.0).unwrap_or(&none);
        let mut frames = BTreeMap::<u16, Frame>::new();
        for (index, block) in mapper.blocks() {
            let (submap, _) = mapper.place_of(index).unwrap();
            let frame = frames.entry(submap.number()).or_insert_with(|| Frame {
                of: (OWN, submap.number()),
                pose: own.pose(submap.number(), true),
                voxels: BTreeMap::new(),
            });
            for bit in set_bits(&block.known()) {
                let stamp = mapper.last_seen(index.voxel(bit)).unwrap();
                frame.voxels.insert(index.voxel(bit), (block.get(bit), stamp));
            }
        }
        let mut frames: Vec<Frame> = frames.into_values().collect();
        if let Some(layer) = fusion.layer(OWN) {
            frames.extend(frames_of(OWN, layer, own, true, Pose::IDENTITY, |local, sheet| {
                mapper.place_of(local).is_some_and(|(_, now)| now > sheet)
            }));
        }
        observed.extend(frames.iter().map(|frame| observe(frame, |stamp| stamp.plus_micros(priority))));
        for (stream, layer) in fusion.layers().filter(|(stream, _)| *stream != OWN) {
            let came_by = |stamp: Stamp| {
                let as_new = self.arrivals.iter().filter(|(of, newest, _)| *of == stream && *newest >= stamp);
                let by = as_new.map(|(_, _, now)| (now.0 / 250_000 + 1) * 250_000).min().unwrap();
                stamp.min(Stamp(by))
            };
            let known = self.known.get(&stream.origin.0).unwrap_or(&none);
            let origin = self.alignments.get(&stream.origin.0).copied().unwrap_or_default();
            let frames = frames_of(stream, layer, known, false, origin, |_, _| true);
            observed.extend(frames.iter().map(|frame| observe(frame, came_by)));
        }
        clear_older(&mut observed, fusion.config.submap_clears_voxels);
        let mut last = BTreeMap::<Voxel, (Stamp, bool)>::new();
        for (voxel, one) in observed.into_iter().flat_map(|one| one.voxels) {
            let newest = last.entry(voxel).or_insert(one);
            *newest = one.max(*newest);
        }
        last.into_iter()
            .map(|(voxel, (_, is_occupied))| (voxel, if is_occupied { State::Occupied } else { State::Free }))
            .collect()
    }
}

/// One thing done to a robot's map.
fn take(step: &Step, mapper: &mut Mapper, fusions: &mut [&mut Fusion], model: &mut Model, now: Stamp) {
    let mut apply = |mapper: &Mapper, model: &mut Model, stream: Stream, changes: &Changes, stamp: Stamp| {
        model.arrivals.push((stream, stamp, now));
        fusions.iter_mut().for_each(|fusion| {
            fusion.apply(mapper, stream, changes, stamp, now).unwrap();
        });
    };
    match step {
        Step::Scan(at, points) => {
            let scan = Scan { stamp: now, points: points.clone(), no_returns: Vec::new() };
            let report = mapper.insert(&scan, &Pose::from_translation(*at), &[]);
            fusions.iter_mut().for_each(|fusion| fusion.own_scan(mapper, &report));
        }
        Step::Publish => {
            let unsaid = std::mem::take(&mut model.unsaid);
            for record in unsaid.values().filter(|record| record.begins) {
                model.known.entry(OWN.origin.0).or_default().begins.insert(record.submap.number(), now);
            }
            for record in unsaid.into_values() {
                apply(mapper, model, OWN, &SubmapRecord::changes(&[record]).unwrap(), now);
            }
            let changes = mapper.take_changes(Which::All);
            if !changes.is_empty() {
                apply(mapper, model, OWN, &changes, now);
            }
        }
        Step::Begin => {
            let submap = mapper.begin_submap().unwrap();
            model.unsaid.insert(submap, SubmapRecord { submap, begins: true, pose: None });
        }
        Step::Move(submap, pose) => {
            let submap = SubmapId::new((*submap).min(mapper.submap().number())).unwrap();
            model.known.entry(OWN.origin.0).or_default().poses.insert(submap.number(), (now, *pose));
            fusions.iter_mut().for_each(|fusion| fusion.set_submap_pose(OWN, submap, *pose));
            let record = SubmapRecord { submap, begins: false, pose: None };
            model.unsaid.entry(submap).or_insert(record).pose = Some(*pose);
        }
        Step::Package(origin, sheet, stamp, voxels) => {
            let sheet = Sheet::new(*sheet).unwrap();
            let on_sheet = |voxel: Voxel| sheet.block(voxel.block()).unwrap().voxel(voxel_bit(voxel));
            let voxels = voxels.iter().map(|(voxel, state)| (on_sheet(*voxel), *state));
            apply(mapper, model, stream(*origin), &Changes::from_voxels(voxels), Stamp(*stamp));
        }
        Step::Record(origin, number, stamp, pose) => {
            let submap = SubmapId::new(*number).unwrap();
            let known = model.known.entry(*origin).or_default();
            let begins = *number > 0 && pose.is_none();
            let stamp = if begins { began(*number) } else { Stamp(*stamp) };
            if begins {
                known.begins.insert(*number, stamp);
            }
            if let Some(pose) = pose {
                let newest = known.poses.entry(*number).or_insert((stamp, *pose));
                if newest.0 < stamp {
                    *newest = (stamp, *pose);
                }
            }
            let record = SubmapRecord { submap, begins, pose: *pose };
            apply(mapper, model, stream(*origin), &SubmapRecord::changes(&[record]).unwrap(), stamp);
        }
        Step::Align(origin, pose) => {
            model.alignments.insert(*origin, *pose);
            fusions.iter_mut().for_each(|fusion| fusion.set_alignment(RobotId(*origin), pose).unwrap());
        }
        Step::Work(_) => {}
    }
}

fn voxels(fusion: &Fusion) -> BTreeMap<Voxel, State> {
    fusion.map().voxels().collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    /// Whatever is seen, published, received and moved in whatever order: the map that is kept up to date, a slice at a
    /// time, is the one that is made at once, and that of the rules.
    #[test]
    fn submaps_are_fused_as_the_rules_say(
        steps in prop::collection::vec(step(), 1..50), blocks_max in prop_oneof![3 => Just(1_000), 2 => 4..60usize],
        clears in prop_oneof![2 => Just(0), 1 => 1..9u8],
    ) {
        let config = MapperConfig {
            memory_bytes_max: blocks_max * MAP_BLOCK_BYTES, ..MapperConfig::preset(Preset::OctoMap, resolution(), 12.0)
        };
        let (mut mapper, mut now, mut model) = (Mapper::new(config).unwrap(), Stamp(0), Model::default());
        let config = FusionConfig { submap_clears_voxels: clears, ..FusionConfig::default() };
        let new = || Fusion::new(OWN, resolution(), config.clone());
        let (mut sliced, mut at_once) = (new(), new());
        for step in &steps {
            now = now.plus_micros(100_000);
            take(step, &mut mapper, &mut [&mut sliced, &mut at_once], &mut model, now);
            if let Step::Work(blocks_max) = step {
                sliced.work(&mapper, *blocks_max);
                at_once.rebuild(&mapper);
            }
        }
        take(&Step::Publish, &mut mapper, &mut [&mut sliced, &mut at_once], &mut model, now.plus_micros(1));
        finish(&mut sliced, &mapper);
        let expected = model.map(&mapper, &sliced);
        at_once.rebuild(&mapper);
        prop_assert_eq!(&voxels(&at_once), &expected);
        let differs: Vec<_> = voxels(&sliced).into_iter().filter(|(at, state)| expected.get(at) != Some(state)).collect();
        prop_assert_eq!(differs, vec![], "wrong, or not known");
        prop_assert_eq!(voxels(&sliced), expected);
        for fusion in [&sliced, &at_once] {
            let of_others = fusion.sources.iter().filter(|(stream, _)| *stream != OWN);
            let bytes: usize = of_others.map(|(_, source)| source.memory_bytes()).sum();
            prop_assert_eq!(fusion.sources.bytes(), bytes);
        }
    }
}

#[test]
fn a_submap_that_was_moved_just_before_another_run_began_is_shown_moved() {
    let (mut mapper, mut fusion) = (mapper(), Fusion::new(OWN, resolution(), FusionConfig::default()));
    let scan = Scan { stamp: Stamp(0), points: vec![[1.1, 0.1, 0.1]], no_returns: Vec::new() };
    let report = mapper.insert(&scan, &Pose::IDENTITY, &[]);
    fusion.own_scan(&mapper, &report);
    let seen = voxels(&fusion);
    fusion.set_submap_pose(OWN, SubmapId::FIRST, Pose::from_translation([4.0, 0.0, 0.0]));
    fusion.begin_run(Stream { epoch: OWN.epoch + 1, ..OWN });
    finish(&mut fusion, &mapper);
    let by = (4.0 / resolution().metres()).round() as i32;
    let moved = seen.into_iter().map(|(at, state)| (Voxel::new(at.x + by, at.y, at.z), state));
    assert_eq!(voxels(&fusion), moved.collect());
}
