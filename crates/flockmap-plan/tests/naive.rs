//! Everything that is made of bit planes, against a model that asks voxel by voxel.

use std::collections::{BTreeMap, BTreeSet};

use flockmap_grid::{BlockIndex, Changes, MapView, Resolution, State, StateBlock, Voxel, VoxelBox};
use flockmap_plan::{
    ColumnRule, FrontierConfig, HeightMap, OccupancyGrid, TooLarge, frontier_cells, frontiers,
};
use proptest::prelude::*;

type Model = BTreeMap<Voxel, State>;

fn side() -> Resolution {
    Resolution::from_metres(0.1).unwrap()
}

fn state_of(model: &Model, voxel: Voxel) -> State {
    model.get(&voxel).copied().unwrap_or(State::Unknown)
}

fn view_of(model: &Model) -> MapView {
    let mut view = MapView::new(side());
    for (index, block) in Changes::from_voxels(model.iter().map(|(v, s)| (*v, *s))).blocks() {
        view.set_block(*index, block);
    }
    view
}

fn voxel() -> impl Strategy<Value = Voxel> {
    (-20..28i32, -20..28i32, -12..14i32).prop_map(|(x, y, z)| Voxel::new(x, y, z))
}

fn region() -> impl Strategy<Value = VoxelBox> {
    (voxel(), voxel()).prop_map(|(a, b)| VoxelBox::spanning(a, b).unwrap())
}

/// Boxes of one state in each other, and single voxels: edges and insides of blocks, whole blocks, holes.
fn model() -> impl Strategy<Value = Model> {
    let state = || prop_oneof![3 => Just(State::Free), 1 => Just(State::Occupied), 1 => Just(State::Unknown)];
    let boxes = prop::collection::vec((voxel(), [1..14u32, 1..14, 1..14], state()), 0..5);
    let single = prop::collection::vec((voxel(), state()), 0..60);
    (boxes, single).prop_map(|(boxes, single)| {
        let mut model = Model::new();
        for (low, size, state) in boxes {
            model.extend(VoxelBox::new(low, size).unwrap().voxels().map(|voxel| (voxel, state)));
        }
        model.extend(single);
        model.retain(|_, state| *state != State::Unknown);
        model
    })
}

fn column(model: &Model, region: &VoxelBox, x: usize, y: usize) -> Vec<(i32, State)> {
    let (low, high) = (region.min(), region.max());
    let state = |z| state_of(model, Voxel::new(low.x + x as i32, low.y + y as i32, z));
    (low.z..=high.z).map(|z| (z, state(z))).collect()
}

fn cells_of(region: &VoxelBox) -> impl Iterator<Item = (usize, usize)> + use<> {
    let [width, height, _] = region.size().map(|n| n as usize);
    (0..height).flat_map(move |y| (0..width).map(move |x| (x, y)))
}

/// The frontier cells by their definition, in the order z, y, x.
fn naive_cells(model: &Model, region: &VoxelBox) -> Vec<Voxel> {
    let is_cell = |v: &Voxel| {
        let beside = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]
            .map(|(x, y, z)| Voxel::new(v.x + x, v.y + y, v.z + z));
        state_of(model, *v) == State::Free
            && beside.iter().any(|b| region.contains(*b) && state_of(model, *b) == State::Unknown)
    };
    let mut cells: Vec<Voxel> = region.voxels().filter(is_cell).collect();
    cells.sort_by_key(|v| (v.z, v.y, v.x));
    cells
}

fn touch(a: Voxel, b: Voxel) -> bool {
    (a.x - b.x).abs() <= 1 && (a.y - b.y).abs() <= 1 && (a.z - b.z).abs() <= 1
}

/// Clusters by their definition: what can be reached from the first cell that is left, until nothing changes.
fn naive_clusters(cells: &[Voxel], config: &FrontierConfig) -> Vec<BTreeSet<Voxel>> {
    let mut left: BTreeSet<Voxel> = cells.iter().copied().collect();
    let mut clusters = Vec::new();
    for seed in cells {
        if !left.contains(seed) {
            continue;
        }
        let near = |v: &Voxel| {
            let d = [v.x - seed.x, v.y - seed.y, v.z - seed.z].map(f64::from);
            d.iter().map(|d| d * d).sum::<f64>().sqrt() * 0.1 <= config.reach_m
        };
        let mut cluster = BTreeSet::from([*seed]);
        loop {
            let next: Vec<Voxel> = left
                .iter()
                .filter(|v| !cluster.contains(v) && near(v) && cluster.iter().any(|c| touch(*c, **v)))
                .copied()
                .collect();
            if next.is_empty() {
                break;
            }
            cluster.extend(next);
        }
        if cluster.len() >= config.cells_min {
            left.retain(|v| !cluster.contains(v));
            clusters.push(cluster);
        }
    }
    clusters
}

proptest! {
    #[test]
    fn a_cell_is_what_its_column_makes_it(model in model(), region in region()) {
        let view = view_of(&model);
        for rule in [ColumnRule::AnyFree, ColumnRule::AllFree] {
            let grid = OccupancyGrid::new(&view, &region, rule).unwrap();
            let mut ros = Vec::new();
            for (x, y) in cells_of(&region) {
                let column = column(&model, &region, x, y);
                let is_free = match rule {
                    ColumnRule::AnyFree => column.iter().any(|(_, state)| *state == State::Free),
                    ColumnRule::AllFree => column.iter().all(|(_, state)| *state == State::Free),
                };
                let (state, value) = if column.iter().any(|(_, state)| *state == State::Occupied) {
                    (State::Occupied, 100)
                } else if is_free {
                    (State::Free, 0)
                } else {
                    (State::Unknown, -1)
                };
                prop_assert_eq!(grid.state(x, y), state, "{:?} {} {}", rule, x, y);
                ros.push(value);
            }
            let count = |value| ros.iter().filter(|v| **v == value).count();
            prop_assert_eq!(grid.count(), (count(0), count(100)));
            prop_assert_eq!(grid.to_ros(), ros);
            prop_assert_eq!(grid.state(grid.size()[0], 0), State::Unknown);
            prop_assert_eq!(grid.state(0, grid.size()[1]), State::Unknown);
        }
    }

    #[test]
    fn heights_are_the_ends_of_what_stands_in_a_column(model in model(), region in region()) {
        let heights = HeightMap::new(&view_of(&model), &region).unwrap();
        let (mut bottoms, mut tops) = (Vec::new(), Vec::new());
        for (x, y) in cells_of(&region) {
            let column = column(&model, &region, x, y);
            let occupied: Vec<i32> =
                column.iter().filter(|(_, state)| *state == State::Occupied).map(|(z, _)| *z).collect();
            prop_assert_eq!(heights.lowest(x, y), occupied.first().copied());
            prop_assert_eq!(heights.highest(x, y), occupied.last().copied());
            prop_assert_eq!(heights.is_known(x, y), column.iter().any(|(_, s)| *s != State::Unknown));
            bottoms.push(occupied.first().map(|z| (f64::from(*z) * 0.1) as f32));
            tops.push(occupied.last().map(|z| (f64::from(*z + 1) * 0.1) as f32));
        }
        let or_none = |faces: Vec<f32>| faces.into_iter().map(|v| (!v.is_nan()).then_some(v)).collect::<Vec<_>>();
        prop_assert_eq!(or_none(heights.bottoms_m()), bottoms);
        prop_assert_eq!(or_none(heights.tops_m()), tops);
        prop_assert_eq!(heights.lowest(heights.size()[0], 0), None);
        prop_assert_eq!(heights.highest(0, heights.size()[1]), None);
    }

    #[test]
    fn frontier_cells_are_free_and_beside_the_unknown(model in model(), region in region()) {
        let found = frontier_cells(&view_of(&model), &region);
        prop_assert!(found.is_sorted_by(|a, b| a.0 < b.0));
        let mut cells: Vec<Voxel> = found
            .iter()
            .flat_map(|(index, plane)| flockmap_grid::set_bits(plane).map(|bit| index.voxel(bit)))
            .collect();
        cells.sort_by_key(|v| (v.z, v.y, v.x));
        prop_assert_eq!(cells, naive_cells(&model, &region));
    }

    #[test]
    fn clusters_hang_together_and_reach_so_far(
        model in model(), region in region(), reach_m in 0.05..1.5f64, cells_min in 1..12usize,
    ) {
        let config = FrontierConfig { reach_m, cells_min };
        let expected = naive_clusters(&naive_cells(&model, &region), &config);
        let found = frontiers(&view_of(&model), &region, &config).unwrap();
        prop_assert_eq!(found.len(), expected.len());
        for (frontier, expected) in found.iter().zip(&expected) {
            prop_assert_eq!(frontier.voxels.len(), expected.len());
            prop_assert_eq!(&frontier.voxels.iter().copied().collect::<BTreeSet<_>>(), expected);
            let mean = |axis: fn(&Voxel) -> i32| {
                expected.iter().map(|v| (f64::from(axis(v)) + 0.5) * 0.1).sum::<f64>() / expected.len() as f64
            };
            for (found, mean) in frontier.centroid_m.iter().zip([mean(|v| v.x), mean(|v| v.y), mean(|v| v.z)]) {
                prop_assert!((found - mean).abs() < 1e-9);
            }
            let ends = |axis: fn(&Voxel) -> i32| {
                (expected.iter().map(axis).min().unwrap(), expected.iter().map(axis).max().unwrap())
            };
            let (x, y, z) = (ends(|v| v.x), ends(|v| v.y), ends(|v| v.z));
            prop_assert_eq!(frontier.bounds.min(), Voxel::new(x.0, y.0, z.0));
            prop_assert_eq!(frontier.bounds.max(), Voxel::new(x.1, y.1, z.1));
        }
    }
}

#[test]
fn what_is_too_large_is_refused_before_anything_is_held() {
    let view = MapView::new(side());
    let wide = VoxelBox::new(Voxel::new(-(1 << 27), 0, 0), [1 << 28, 1, 1]).unwrap();
    let refused = |error: TooLarge, what: &str, max: u64| {
        assert_eq!((error.what, error.max, error.region), (what, max, wide));
        assert!(error.to_string().contains("take a smaller part of the map"), "{error}");
    };
    refused(OccupancyGrid::new(&view, &wide, ColumnRule::AnyFree).unwrap_err(), "an occupancy grid", 1 << 26);
    refused(HeightMap::new(&view, &wide).unwrap_err(), "a height map", 1 << 24);
    let cube = VoxelBox::new(Voxel::default(), [1 << 10, 1 << 9, (1 << 9) + 1]).unwrap();
    let error = frontiers(&view, &cube, &FrontierConfig::default()).unwrap_err();
    assert_eq!((error.cells, error.max), ((1 << 28) + (1 << 19), 1 << 28));
}

/// As high as the grid is, a box costs what is known of it.
#[test]
fn a_band_may_be_as_high_as_the_grid() {
    let mut view = MapView::new(side());
    for z in [-(1 << 20), 3, 1 << 20] {
        view.set_block(BlockIndex::new(0, 0, z), &StateBlock::new([1; 8], [2; 8]));
    }
    let low = Voxel::new(0, 0, -(1 << 28));
    let region = VoxelBox::new(low, [8, 8, (1 << 29) + 1]).unwrap();
    let grid = OccupancyGrid::new(&view, &region, ColumnRule::AnyFree).unwrap();
    assert_eq!(grid.count(), (1, 1));
    assert_eq!(OccupancyGrid::new(&view, &region, ColumnRule::AllFree).unwrap().count(), (0, 1));
    let heights = HeightMap::new(&view, &region).unwrap();
    assert_eq!((heights.lowest(1, 0), heights.highest(1, 0)), (Some(-(1 << 23)), Some((1 << 23) + 7)));
    // Eight in each block, each with an Unknown voxel beside it along y.
    assert_eq!(
        frontier_cells(&view, &region)
            .iter()
            .map(|(_, p)| p.map(u64::count_ones).iter().sum::<u32>())
            .sum::<u32>(),
        24
    );
}
