//! What a package of changes is coded against.

use flockmap_grid::{BLOCK_SIDE, Layer, Stamp, VOXEL_LIMIT, Voxel, VoxelBox};

/// What every receiver of a cycle will hold of its stream: all packages before it.
/// [`Codec::Flock`](crate::Codec::Flock) tells a cycle against that in fewer bytes; the other codecs do not
/// look at it.
#[derive(Clone, Copy, Debug)]
pub struct Reference<'a> {
    /// What the packages before the cycle said, all of them. `None`: the cycle is told without, so that
    /// nobody has to wait for what is still to be repaired. It takes more bytes.
    pub layer: Option<&'a Layer>,
    /// End of each cycle before and the index of its last package, ascending. May begin with the first cycle
    /// that is still remembered; may be empty, then packages name the one before their cycle.
    pub cycles: &'a [(Stamp, u32)],
    /// Index and box of the newest packages before that were told against a layer, ascending. A package of
    /// the cycle that changes what one of them looked at names it too: a receiver that merged it first could
    /// not decode the other any more.
    pub readers: &'a [(u32, VoxelBox)],
}

impl Reference<'_> {
    /// The newest package before that may have looked at a block of `region`; 0 for none.
    pub(crate) fn newest_reader(&self, region: &VoxelBox) -> u32 {
        // A package looks at its box and the blocks round it.
        let (min, max) = (region.min(), region.max());
        let moved = |at: Voxel, by: i32| {
            let [x, y, z] = [at.x, at.y, at.z].map(|at| (at + by).clamp(-VOXEL_LIMIT, VOXEL_LIMIT));
            Voxel::new(x, y, z)
        };
        let wide = VoxelBox::spanning(moved(min, -BLOCK_SIDE), moved(max, BLOCK_SIDE)).unwrap_or(*region);
        self.readers
            .iter()
            .rev()
            .find(|(_, looked_at)| looked_at.intersection(&wide).is_some())
            .map_or(0, |(index, _)| *index)
    }

    /// The newest package of the cycles up to `stamp`, or of a later one if those are forgotten.
    pub(crate) fn newest_package(&self, stamp: Stamp, first_index: u32) -> u32 {
        let later = self.cycles.partition_point(|(end, _)| *end <= stamp);
        let (_, last) = self.cycles.get(later.saturating_sub(1)).copied().unwrap_or((stamp, u32::MAX));
        last.min(first_index - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Codec, Content, Cycle, Decoder, Encoder};
    use flockmap_grid::{Changes, Resolution, RobotId, State, Stream};

    #[test]
    fn whoever_looks_at_a_block_or_beside_it_is_named() {
        let region = |x: i32, blocks: u32| VoxelBox::new(Voxel::new(x, 0, 0), [8 * blocks, 8, 8]).unwrap();
        let readers = [(3, region(0, 1)), (5, region(16, 2)), (9, region(-80, 1))];
        let reference = Reference { layer: None, cycles: &[], readers: &readers };
        for (x, blocks, newest) in
            [(0, 1, 3), (8, 1, 5), (-8, 1, 3), (-16, 1, 0), (-72, 1, 9), (32, 9, 5), (40, 1, 0), (-80, 30, 9)]
        {
            assert_eq!(reference.newest_reader(&region(x, blocks)), newest, "{x}, {blocks} blocks");
        }
    }

    #[test]
    fn so_it_is_at_the_ends_of_the_grid() {
        let (low, high) = (-VOXEL_LIMIT, VOXEL_LIMIT);
        let region = |x: i32, width| VoxelBox::new(Voxel::new(x, low, low), [width, 8, 8]).unwrap();
        let readers = [(3, region(low + 8, 8)), (5, region(high - 8, 8))];
        let reference = Reference { layer: None, cycles: &[], readers: &readers };
        for (x, width, newest) in [(low, 8, 3), (low + 24, 8, 0), (high, 1, 5), (low, u32::MAX >> 3, 5)] {
            assert_eq!(reference.newest_reader(&region(x, width)), newest, "{x}");
        }
    }

    #[test]
    fn told_alone_it_is_decoded_by_anybody_and_names_what_goes_before() {
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let resolution = Resolution::from_metres(0.1).unwrap();
        let cycle = |end| Cycle { stream, start: Stamp(0), end: Stamp(end), resolution, sensor: [0; 3] };
        let (mut encoder, mut layer) = (Encoder::new(), Layer::default());
        // A wall: fewer bytes with what was before than as voxels without a pattern.
        let wall = |state| (0..320).map(move |at| (Voxel::new(20, at % 16, at / 16), state));
        let changes = |state| Changes::from_voxels(wall(state));
        layer.apply(&changes(State::Free), Stamp(1));
        let against = Reference { layer: Some(&layer), cycles: &[(Stamp(1), 1)], readers: &[] };
        let mut encode = |end, index, state, reference: &Reference<'_>| {
            let packages = encoder.encode_cycle_against(
                Codec::Flock,
                &cycle(end),
                index,
                &changes(state),
                Some(reference),
                1150,
            );
            let [package] = packages.unwrap().try_into().unwrap();
            package
        };
        let two = encode(2, 2, State::Occupied, &against);
        assert_eq!((two.header().reference, two.header().is_alone), (1, false));
        assert!(two.decode().is_err());
        assert_eq!(
            Decoder::new().decode_against(&two, Some(&layer)),
            Ok(Content::Changes(changes(State::Occupied)))
        );
        let alone = Reference {
            layer: None,
            cycles: &[(Stamp(1), 1), (Stamp(2), 2)],
            readers: &[(2, two.header().region)],
        };
        let three = encode(3, 3, State::Free, &alone);
        assert_eq!((three.header().reference, three.header().is_alone), (2, true));
        assert_eq!(crate::Package::parse(three.bytes()).unwrap().header(), three.header());
        assert_eq!(three.decode(), Ok(Content::Changes(changes(State::Free))));
    }
}
