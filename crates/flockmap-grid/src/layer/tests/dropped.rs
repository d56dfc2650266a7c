//! What is dropped, comes late, and comes back.

use super::*;
use std::collections::BTreeSet;

/// A voxel in one of a dozen cubes.
fn place() -> impl Strategy<Value = Voxel> {
    (0..12i32, 0..3i32).prop_map(|(cube, x)| Voxel::new(cube * 32 + x, 0, 0))
}

fn state() -> impl Strategy<Value = State> {
    prop::sample::select(vec![State::Free, State::Occupied])
}

/// What happens at two robots: one that sends snapshots, and one that receives packages and these.
#[derive(Clone, Debug)]
enum Step {
    /// A package comes to the receiver, or to the sender.
    Comes { index: usize, is_sender: bool },
    /// A cube is dropped.
    Dropped { cube: i32, is_sender: bool },
    /// What comes of a package finds no room.
    Refused { index: usize, is_sender: bool },
    /// The receiver gets a snapshot.
    Snapshot { since: usize },
}

fn step() -> impl Strategy<Value = Step> {
    let index = || (0..20usize, prop::bool::ANY);
    prop_oneof![
        10 => index().prop_map(|(index, is_sender)| Step::Comes { index, is_sender }),
        3 => (0..12i32, prop::bool::ANY).prop_map(|(cube, is_sender)| Step::Dropped { cube, is_sender }),
        1 => index().prop_map(|(index, is_sender)| Step::Refused { index, is_sender }),
        3 => (0..20usize).prop_map(|since| Step::Snapshot { since }),
    ]
}

/// A layer with what its robot knows beside it.
#[derive(Default)]
struct Robot {
    layer: Layer,
    /// Packages held, from 1. The stamp of each is its number.
    held: BTreeSet<usize>,
    begun: Option<(usize, Stamp)>,
}

type Packages = [Vec<(Voxel, State)>];

impl Robot {
    fn prefix(&self) -> usize {
        (1..).take_while(|index| self.held.contains(index)).last().unwrap_or(0)
    }

    /// Packages with as much as is lacking.
    fn lacking_upto(&self) -> Option<usize> {
        let lost = self.layer.lost_upto()?;
        let begun = self.begun.filter(|(_, stamp)| lost <= *stamp).map(|(index, _)| index);
        Some(begun.unwrap_or(usize::MAX).min(lost.0 as usize))
    }

    fn take(&mut self, index: usize, packages: &Packages, is_refused: bool) {
        let (changes, stamp) =
            (Changes::from_voxels(packages[index].iter().copied()), Stamp(index as i64 + 1));
        if is_refused {
            changes.blocks().iter().for_each(|(block, _)| drop(self.layer.refuse(cube_of(*block), stamp)));
        } else {
            self.layer.apply(&changes, stamp);
        }
        self.held.insert(index + 1);
    }

    /// What is known is the newest of what is held; and of what is not known, nothing is newer than the limit.
    fn check(&self, packages: &Packages) {
        let mut newest = BTreeMap::<Voxel, (State, Stamp)>::new();
        for index in &self.held {
            for (voxel, state) in Changes::from_voxels(packages[*index - 1].iter().copied()).voxels() {
                newest.insert(voxel, (state, Stamp(*index as i64)));
            }
        }
        let known: BTreeSet<Voxel> = self.layer.voxels().map(|(voxel, _)| voxel).collect();
        for voxel in &known {
            assert_eq!(self.layer.get(*voxel), newest.get(voxel).copied(), "{voxel:?}");
        }
        for (voxel, (_, stamp)) in newest {
            let limit = self.layer.limit_of(cube_of(voxel.block()));
            assert!(
                known.contains(&voxel) || limit.is_some_and(|limit| stamp <= limit),
                "{voxel:?} {stamp:?}"
            );
            // Nothing is coded against what others have otherwise.
            let has_all = self.layer.known_before(voxel.block(), Stamp(99)).is_ok();
            assert!(known.contains(&voxel) || !has_all);
        }
        check_counts(&self.layer);
    }
}

proptest! {
    #[test]
    fn whatever_was_dropped_no_voxel_is_older_than_what_is_held_and_a_whole_snapshot_brings_all_back(
        packages in prop::collection::vec(prop::collection::vec((place(), state()), 1..6), 20..21),
        steps in prop::collection::vec(step(), 1..60),
    ) {
        let mut robots = [Robot::default(), Robot::default()];
        for step in steps {
            match step {
                Step::Comes { index, is_sender } => {
                    // The sender gets them in order, so that it has something to give.
                    let robot = &mut robots[usize::from(is_sender)];
                    let index = if is_sender { robot.prefix().min(19) } else { index };
                    robot.take(index, &packages, false);
                }
                Step::Refused { index, is_sender } => {
                    robots[usize::from(is_sender)].take(index, &packages, true)
                }
                Step::Dropped { cube, is_sender } => {
                    robots[usize::from(is_sender)].layer.drop_cube(BlockIndex::new(cube, 0, 0));
                }
                Step::Snapshot { since } => {
                    let [receiver, sender] = &mut robots;
                    let upto = sender.prefix();
                    let since = since.min(receiver.prefix());
                    let newer = Some(Stamp(since as i64)).filter(|_| since > 0);
                    let lost = sender.layer.lost_upto();
                    if upto <= since || lost.is_some_and(|lost| lost.0 as usize > upto) {
                        continue;
                    }
                    let lost = lost.filter(|lost| newer.is_none_or(|newer| *lost > newer));
                    let is_held = (1..=upto).all(|index| receiver.held.contains(&index));
                    if let Some(lost) = lost
                        && !is_held
                        && receiver.begun.is_none_or(|(index, stamp)| index < upto || stamp < lost)
                    {
                        let (index, stamp) = receiver.begun.unwrap_or((upto, lost));
                        receiver.begun = Some((index.max(upto), stamp.max(lost)));
                        receiver.layer.begin_part(lost);
                        receiver.check(&packages);
                    }
                    let has_lacking = receiver.lacking_upto().is_some_and(|lacking| upto >= lacking);
                    if let Some(snapshot) = sender.layer.read_snapshot(newer).finish().map(|v| v.to_state()) {
                        if has_lacking {
                            receiver.layer.apply_rest(&snapshot);
                        } else {
                            receiver.layer.apply_snapshot(&snapshot);
                        }
                    }
                    receiver.held.extend(1..=upto);
                    if has_lacking && newer.is_none() && lost.is_none() {
                        receiver.layer.end_lack();
                        receiver.begun = None;
                        // Nothing is lacking.
                        receiver.check(&packages);
                    }
                }
            }
            robots.iter().for_each(|robot| robot.check(&packages));
        }
    }
}

#[test]
fn of_too_many_cubes_that_were_dropped_the_oldest_are_remembered_as_one() {
    let mut layer = Layer::default();
    let at = |cube: i32| Changes::from_voxels([(Voxel::new(32 * cube, 0, 0), State::Free)]);
    for cube in 0..40 {
        layer.apply(&at(cube), Stamp(i64::from(cube)));
        layer.drop_cube(BlockIndex::new(cube, 0, 0));
        assert!(layer.dropped.cubes.len() <= 11);
    }
    assert!(layer.lacks_anywhere());
    assert!(layer.apply(&at(3), Stamp(3)).is_empty(), "it is forgotten that this very one was dropped");
    assert_eq!(layer.apply(&at(39), Stamp(40)).len(), 1);
    assert!(layer.known_before(BlockIndex::new(400, 0, 0), Stamp(99)).is_err());
}
