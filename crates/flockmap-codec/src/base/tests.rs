//! Which packages a package names.

use super::*;
use crate::{Batch, Codec, Content, Decoder, Encoder};
use flockmap_grid::{Changes, Resolution, RobotId, State, Stream};

#[test]
fn whoever_looks_at_a_block_or_beside_it_is_named() {
    let region = |x: i32, blocks: u32| VoxelBox::new(Voxel::new(x, 0, 0), [8 * blocks, 8, 8]).unwrap();
    let readers = [(3, region(0, 1)), (5, region(16, 2)), (9, region(-80, 1))];
    let base = Base { layer: None, batches: &[], readers: &readers };
    for (x, blocks, newest) in
        [(0, 1, 3), (8, 1, 5), (-8, 1, 3), (-16, 1, 0), (-72, 1, 9), (32, 9, 5), (40, 1, 0), (-80, 30, 9)]
    {
        assert_eq!(base.newest_dependent(&region(x, blocks)), newest, "{x}, {blocks} blocks");
    }
}

#[test]
fn so_it_is_at_the_ends_of_the_grid() {
    let (low, high) = (-VOXEL_LIMIT, VOXEL_LIMIT);
    let region = |x: i32, width| VoxelBox::new(Voxel::new(x, low, low), [width, 8, 8]).unwrap();
    let readers = [(3, region(low + 8, 8)), (5, region(high - 8, 8))];
    let base = Base { layer: None, batches: &[], readers: &readers };
    for (x, width, newest) in [(low, 8, 3), (low + 24, 8, 0), (high, 1, 5), (low, u32::MAX >> 3, 5)] {
        assert_eq!(base.newest_dependent(&region(x, width)), newest, "{x}");
    }
}

#[test]
fn told_alone_it_is_decoded_by_anybody_and_names_what_goes_before() {
    let stream = Stream { origin: RobotId(1), epoch: 1 };
    let resolution = Resolution::from_metres(0.1).unwrap();
    let batch = |end| Batch { stream, start: Stamp(0), end: Stamp(end), resolution, sensor: [0; 3] };
    let (mut encoder, mut layer) = (Encoder::new(), Layer::default());
    // A wall: fewer bytes with what was before than as voxels without a pattern.
    let wall = |state| (0..320).map(move |at| (Voxel::new(20, at % 16, at / 16), state));
    let changes = |state| Changes::from_voxels(wall(state));
    layer.apply(&changes(State::Free), Stamp(1));
    let against = Base { layer: Some(&layer), batches: &[(Stamp(1), 1)], readers: &[] };
    let mut encode = |end, index, state, base: &Base<'_>| {
        let packages =
            encoder.encode_batch_against(Codec::Flock, &batch(end), index, &changes(state), Some(base), 1150);
        let [package] = packages.unwrap().try_into().unwrap();
        package
    };
    let two = encode(2, 2, State::Occupied, &against);
    assert_eq!((two.header().base, two.header().is_independent), (1, false));
    assert!(two.decode().is_err());
    assert_eq!(
        Decoder::new().decode_against(&two, Some(&layer)),
        Ok(Content::Changes(changes(State::Occupied)))
    );
    let alone =
        Base { layer: None, batches: &[(Stamp(1), 1), (Stamp(2), 2)], readers: &[(2, two.header().region)] };
    let three = encode(3, 3, State::Free, &alone);
    assert_eq!((three.header().base, three.header().is_independent), (2, true));
    assert_eq!(crate::Package::parse(three.bytes()).unwrap().header(), three.header());
    assert_eq!(three.decode(), Ok(Content::Changes(changes(State::Free))));
}
