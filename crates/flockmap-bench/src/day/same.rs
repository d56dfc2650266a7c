//! Whether two hold the same, voxel by voxel, without a copy of all of it.

use flockmap::MapView;
use flockmap::grid::{Layer, Plane, StateBlock, set_bits};
use flockmap_cli::progress::Progress;
use flockmap_cli::stop;
use serde::Serialize;

/// Voxels in which one that holds something differs from one that it should be like.
#[derive(Clone, Copy, PartialEq, Eq, Default, Serialize, Debug)]
pub struct Difference {
    /// Known there and not here.
    pub lacking: u64,
    /// Known here and not there.
    pub beyond: u64,
    /// Known on both sides, and not the same.
    pub different: u64,
}

impl Difference {
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

/// How a layer differs from another one, stamps included. `None` if Ctrl-C ended it.
pub fn of_layers(held: Option<&Layer>, wanted: &Layer, progress: &Progress) -> Option<Difference> {
    let Some(held) = held else {
        return Some(Difference { lacking: wanted.len() as u64, ..Difference::default() });
    };
    let (mut difference, mut met) = (Difference::default(), 0);
    for (index, wanted_block) in wanted.blocks() {
        if stop::requested() {
            return None;
        }
        let both = in_both(&wanted_block, &held.block(index).unwrap_or_default());
        let is_other = |bit: &usize| held.get(index.voxel(*bit)) != wanted.get(index.voxel(*bit));
        difference.different += set_bits(&both).filter(is_other).count() as u64;
        difference.lacking += u64::from(wanted_block.known_count()) - count(&both);
        met += count(&both);
        progress.step();
    }
    difference.beyond = (held.len() as u64).saturating_sub(met);
    Some(difference)
}

/// How a fused map differs from that of a robot with this own layer, and how many voxels it has beyond that as the own
/// layer says them: no change to Unknown is published, so that others keep what a robot takes back or forgets. `None` if
/// Ctrl-C ended it.
pub fn of_maps(
    held: &MapView,
    wanted: &MapView,
    published: Option<&Layer>,
    progress: &Progress,
) -> Option<(Difference, u64)> {
    let (mut difference, mut met, mut kept) = (Difference::default(), 0, 0);
    for (index, held) in held.blocks() {
        if stop::requested() {
            return None;
        }
        let wanted = wanted.block(index).unwrap_or_default();
        let both = in_both(&held, &wanted);
        difference.different +=
            set_bits(&both).filter(|bit| held.get(*bit) != wanted.get(*bit)).count() as u64;
        met += count(&both);
        let beyond = held.masked(&both.map(|slice| !slice));
        if !beyond.is_empty() {
            let published = published.and_then(|layer| layer.block(index)).unwrap_or_default();
            let in_layer = in_both(&beyond, &published);
            let same =
                set_bits(&in_layer).filter(|bit| beyond.get(*bit) == published.get(*bit)).count() as u64;
            kept += same;
            difference.beyond += u64::from(beyond.known_count()) - same;
        }
        progress.step();
    }
    let (free, occupied) = wanted.count();
    difference.lacking = (free as u64 + occupied as u64).saturating_sub(met);
    Some((difference, kept))
}

/// The voxels that are known in both.
fn in_both(a: &StateBlock, b: &StateBlock) -> Plane {
    let (a, b) = (a.known(), b.known());
    core::array::from_fn(|z| a[z] & b[z])
}

fn count(plane: &Plane) -> u64 {
    plane.iter().map(|slice| u64::from(slice.count_ones())).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::grid::BlockIndex;
    use flockmap::{Changes, Resolution, Stamp, State};

    fn block(voxels: impl IntoIterator<Item = usize>) -> StateBlock {
        let mut block = StateBlock::default();
        voxels.into_iter().for_each(|bit| block.set(bit, State::Free));
        block
    }

    fn changes(x: i32, voxels: impl IntoIterator<Item = usize>) -> Changes {
        Changes::from_blocks(vec![(BlockIndex::new(x, 0, 0), block(voxels))])
    }

    #[test]
    fn layers_differ_where_a_stamp_or_a_voxel_does() {
        let progress = Progress::new("blocks", 0);
        let mut wanted = Layer::default();
        wanted.apply(&changes(0, 0..100), Stamp(1));
        wanted.apply(&changes(9, 0..10), Stamp(2));
        let difference = of_layers(Some(&wanted.clone()), &wanted, &progress).unwrap();
        assert!(difference.is_none(), "{difference:?}");
        let difference = of_layers(None, &wanted, &progress).unwrap();
        assert_eq!(difference, Difference { lacking: 110, ..Difference::default() });

        let mut held = Layer::default();
        held.apply(&changes(0, 1..103), Stamp(1));
        held.apply(&changes(0, 50..52), Stamp(3));
        held.apply(&changes(-5, 0..4), Stamp(3));
        held.pack();
        let difference = of_layers(Some(&held), &wanted, &progress).unwrap();
        assert_eq!(difference, Difference { lacking: 11, beyond: 7, different: 2 });
    }

    #[test]
    fn maps_differ_where_a_state_does() {
        let progress = Progress::new("blocks", 0);
        let at = BlockIndex::new(0, 0, 0);
        let mut wanted = MapView::new(Resolution::from_micrometres(100_000).unwrap());
        let mut held = wanted.clone();
        wanted.set_block(at, &block(0..20));
        wanted.set_block(BlockIndex::new(3, 0, 0), &block(0..2));
        let mut states = block(5..24);
        states.set(7, State::Occupied);
        states.set(21, State::Occupied);
        held.set_block(at, &states);
        let difference = Difference { lacking: 7, beyond: 4, different: 1 };
        assert_eq!(of_maps(&held, &wanted, None, &progress), Some((difference, 0)));

        // What was published and taken back; of one voxel it was another state.
        let mut published = Layer::default();
        published.apply(&changes(0, 0..23), Stamp(1));
        let difference = Difference { beyond: 2, ..difference };
        assert_eq!(of_maps(&held, &wanted, Some(&published), &progress), Some((difference, 2)));
    }
}
