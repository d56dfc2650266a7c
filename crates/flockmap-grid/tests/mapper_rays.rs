//! One ray for each voxel in which rays end.

use flockmap_grid::{
    LOG_ODDS_UNITS_PER_NAT, Mapper, MapperConfig, Pose, Preset, RaysWalked, Resolution, Scan, Stamp, Voxel,
};
use proptest::prelude::*;
use std::collections::BTreeSet;

fn config(preset: Preset, rays: RaysWalked) -> MapperConfig {
    MapperConfig { rays, ..MapperConfig::preset(preset, Resolution::from_metres(0.25).unwrap(), 10.0) }
}

fn map(config: MapperConfig, scan: &Scan) -> BTreeSet<(Voxel, i64)> {
    let mut mapper = Mapper::new(config).unwrap();
    mapper.insert(scan, &Pose::IDENTITY, &[]);
    let voxels = mapper.blocks().flat_map(|(index, _)| (0..512).map(move |bit| index.voxel(bit)));
    let units = |voxel| Some((mapper.log_odds(voxel)? * LOG_ODDS_UNITS_PER_NAT).round() as i64);
    voxels.filter_map(|voxel| Some((voxel, units(voxel)?))).collect()
}

/// The first point of each voxel.
fn firsts(points: &[[f32; 3]], known: &mut BTreeSet<[i32; 3]>) -> Vec<[f32; 3]> {
    let voxel = |point: &[f32; 3]| point.map(|at| (at / 0.25).floor() as i32);
    points.iter().copied().filter(|point| known.insert(voxel(point))).collect()
}

fn points() -> impl Strategy<Value = Vec<[f32; 3]>> {
    // Many in one voxel, and some in both lists.
    let point = prop_oneof![prop::array::uniform3(-3.0f32..3.0), prop::array::uniform3(1.0f32..1.6)];
    prop::collection::vec(point, 0..200)
}

proptest! {
    #[test]
    fn only_the_first_ray_to_a_voxel_is_walked(
        returned in points(), lost in points(),
    ) {
        let mut known = BTreeSet::new();
        let (points, no_returns) = (firsts(&returned, &mut known), firsts(&lost, &mut known));
        let once = Scan { stamp: Stamp(1), points, no_returns };
        let scan = Scan { stamp: Stamp(1), points: returned, no_returns: lost };
        let expected = map(config(Preset::OctoMap, RaysWalked::All), &once);
        prop_assert_eq!(map(config(Preset::OctoMap, RaysWalked::OnePerEndVoxel), &scan), expected);
    }
}

#[test]
fn every_hit_counts_where_every_ray_does_but_passes_once() {
    let scan = Scan { stamp: Stamp(1), points: vec![[2.1, 0.1, 0.1]; 2], no_returns: vec![[2.1, 0.1, 0.1]] };
    let log_odds = |rays| -> Vec<i64> {
        map(config(Preset::RogMap, rays), &scan).into_iter().map(|(_, units)| units).collect()
    };
    let (all, single) = (log_odds(RaysWalked::All), log_odds(RaysWalked::OnePerEndVoxel));
    assert_eq!((all.len(), single.len()), (9, 9));
    // Eight voxels that three rays pass, or one; then the one in which two end.
    assert!(
        all[..8].iter().all(|units| *units == 3 * single[0])
            && single[..8].iter().all(|units| *units == single[0])
    );
    assert_eq!(all[8], single[8]);
    assert!(single[0] < 0 && single[8] > 0);
}
