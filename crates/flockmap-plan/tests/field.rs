//! The distance field beside one that looks at all pairs of voxels.

mod common;

use common::{empty, region, seen, voxels, write};
use flockmap_grid::{MapView, Resolution, State, Voxel, VoxelBox};
use flockmap_plan::{DistanceField, FieldConfig, FieldError, Obstacles, Updated, grown};
use proptest::prelude::*;

fn config(obstacles: Obstacles) -> FieldConfig {
    FieldConfig { obstacles, ..FieldConfig::default() }
}

/// Squared distances of all voxels of a box, by looking at all pairs.
fn all_pairs(view: &MapView, region: &VoxelBox, obstacles: Obstacles) -> Vec<Option<u32>> {
    let is_obstacle = |voxel: &Voxel| match view.state(*voxel) {
        State::Occupied => true,
        State::Unknown => obstacles == Obstacles::NotFree,
        State::Free => false,
    };
    let found: Vec<Voxel> = region.voxels().filter(is_obstacle).collect();
    let squared = |a: Voxel, b: Voxel| {
        (a.x - b.x).pow(2) as u32 + (a.y - b.y).pow(2) as u32 + (a.z - b.z).pow(2) as u32
    };
    region.voxels().map(|at| found.iter().map(|o| squared(at, *o)).min()).collect()
}

fn squares(field: &DistanceField) -> Vec<Option<u32>> {
    field.region().voxels().map(|voxel| field.squared_voxels(voxel)).collect()
}

fn occupied(at: &[[i32; 3]]) -> Vec<(Voxel, State)> {
    at.iter().map(|[x, y, z]| (Voxel::new(*x, *y, *z), State::Occupied)).collect()
}

fn a_box(min: [i32; 3], size: [u32; 3]) -> VoxelBox {
    VoxelBox::new(Voxel::new(min[0], min[1], min[2]), size).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn every_voxel_has_the_distance_that_all_pairs_give(
        voxels in voxels(20, 30),
        region in region(16, 24),
    ) {
        let view = seen(2, &voxels);
        for obstacles in [Obstacles::Occupied, Obstacles::NotFree] {
            let field = DistanceField::new(&view, region, &config(obstacles)).unwrap();
            prop_assert_eq!(squares(&field), all_pairs(&view, &region, obstacles));
        }
    }

    /// Lines of more than a few obstacles far away, which take lower envelopes, and boxes that take larger numbers.
    #[test]
    fn long_boxes_are_as_exact(
        voxels in voxels(10, 3),
        length in 180u32..400,
        axis in 0..3usize,
        others in (1u32..9, 1u32..9),
    ) {
        let mut view = empty();
        write(&mut view, &voxels);
        let mut size = [length, others.0, others.1];
        size.rotate_right(axis);
        let region = a_box([-9, -8, -7], size);
        let field = DistanceField::new(&view, region, &FieldConfig::default()).unwrap();
        prop_assert_eq!(squares(&field), all_pairs(&view, &region, Obstacles::Occupied));
    }

    #[test]
    fn a_field_that_is_kept_up_to_date_is_one_made_anew(
        first in voxels(20, 40),
        steps in prop::collection::vec(voxels(20, 6), 1..5),
        region in region(16, 40),
        obstacles in prop_oneof![Just(Obstacles::Occupied), Just(Obstacles::NotFree)],
    ) {
        let mut map = seen(2, &first);
        let mut field = DistanceField::new(&map, region, &config(obstacles)).unwrap();
        for step in steps {
            write(&mut map, &step);
            field.update(&map);
            let anew = DistanceField::new(&map, region, &config(obstacles)).unwrap();
            prop_assert_eq!(squares(&field), squares(&anew));
            prop_assert_eq!(field.version(), map.version());
        }
    }

    #[test]
    fn a_field_that_moves_is_one_made_anew(
        voxels in voxels(20, 40),
        a in region(16, 24),
        b in region(16, 24),
    ) {
        let map = seen(2, &voxels);
        let mut field = DistanceField::new(&map, a, &FieldConfig::default()).unwrap();
        field.move_to(&map, b).unwrap();
        let anew = DistanceField::new(&map, b, &FieldConfig::default()).unwrap();
        prop_assert_eq!(field.region(), b);
        prop_assert_eq!(squares(&field), squares(&anew));
    }

    /// Against differences of the distance itself, which know nothing of its gradient.
    #[test]
    fn the_gradient_is_that_of_the_distance(
        voxels in voxels(7, 12),
        point in prop::array::uniform3(-1.9f64..1.9),
    ) {
        let mut map = empty();
        write(&mut map, &voxels);
        let field = DistanceField::new(&map, a_box([-8; 3], [16; 3]), &FieldConfig::default()).unwrap();
        let side = 0.25;
        // Not within the step of a place where the gradient jumps.
        let step = 1e-6;
        prop_assume!(point.iter().all(|p| (p / side - 0.5).rem_euclid(1.0).min(0.999) > 1e-4));
        prop_assume!(point.iter().all(|p| (p / side - 0.5).rem_euclid(1.0) < 1.0 - 1e-4));
        let found = field.at(point).unwrap();
        for axis in 0..3 {
            let moved = |by: f64| {
                let mut point = point;
                point[axis] += by;
                field.at(point).unwrap().distance_m
            };
            let slope = if found.distance_m.is_finite() { (moved(step) - moved(-step)) / (2.0 * step) } else { 0.0 };
            prop_assert!((slope - found.gradient[axis]).abs() < 1e-6, "{slope} {found:?}");
        }
    }

    /// At a centre the distance is the voxel's; between centres it is between theirs.
    #[test]
    fn the_interpolation_goes_through_the_centres(voxels in voxels(7, 12), at in prop::array::uniform3(-8i32..8)) {
        let mut map = empty();
        write(&mut map, &voxels);
        let field = DistanceField::new(&map, a_box([-8; 3], [16; 3]), &FieldConfig::default()).unwrap();
        let voxel = Voxel::new(at[0], at[1], at[2]);
        let (there, here) = (field.distance(voxel).unwrap(), field.at(map.resolution().centre(voxel)).unwrap());
        prop_assert!(there == here.distance_m || (there - here.distance_m).abs() < 1e-9);
    }
}

#[test]
fn an_empty_box_is_infinitely_far_from_everything() {
    let field = DistanceField::new(&empty(), a_box([0; 3], [20; 3]), &FieldConfig::default()).unwrap();
    assert_eq!(field.squared_voxels(Voxel::new(1, 2, 3)), None);
    assert_eq!(field.distance(Voxel::new(1, 2, 3)), Some(f64::INFINITY));
    let found = field.at([1.0; 3]).unwrap();
    assert_eq!((found.distance_m, found.gradient), (f64::INFINITY, [0.0; 3]));
}

#[test]
fn obstacles_outside_of_the_box_do_not_count() {
    let mut map = empty();
    write(&mut map, &occupied(&[[-1, 3, 3], [9, 3, 3], [3, 3, 12]]));
    let inner = a_box([0; 3], [8; 3]);
    let field = DistanceField::new(&map, inner, &FieldConfig::default()).unwrap();
    assert_eq!(field.squared_voxels(Voxel::new(0, 3, 3)), None);
    let field = DistanceField::new(&map, grown(inner, 2), &FieldConfig::default()).unwrap();
    assert_eq!(field.squared_voxels(Voxel::new(0, 3, 3)), Some(1));
    assert_eq!(field.squared_voxels(Voxel::new(7, 3, 3)), Some(4));
}

#[test]
fn outside_of_the_box_and_for_what_is_no_number_there_is_no_answer() {
    let mut map = empty();
    write(&mut map, &occupied(&[[3, 3, 3]]));
    let field = DistanceField::new(&map, a_box([0; 3], [8; 3]), &FieldConfig::default()).unwrap();
    assert_eq!(field.distance(Voxel::new(8, 0, 0)), None);
    for point in
        [[f64::NAN, 1.0, 1.0], [2.001, 1.0, 1.0], [1.0, -0.001, 1.0], [1.0, 1.0, f64::INFINITY], [1e300; 3]]
    {
        assert_eq!(field.at(point), None, "{point:?}");
        let (mut distance, mut gradient) = ([0.0], [[0.0; 3]]);
        field.clearances(&[point], &mut distance, &mut gradient);
        assert!(distance[0].is_nan() && gradient[0].iter().all(|g| g.is_nan()));
    }
}

#[test]
fn across_a_face_of_the_box_the_gradient_is_zero() {
    let mut map = empty();
    write(&mut map, &occupied(&[[3, 3, 3]]));
    let field = DistanceField::new(&map, a_box([0; 3], [8; 3]), &FieldConfig::default()).unwrap();
    let corner = field.at([0.0001; 3]).unwrap();
    assert_eq!(corner.gradient, [0.0; 3]);
    assert_eq!(Some(corner.distance_m), field.distance(Voxel::new(0, 0, 0)));
}

#[test]
fn a_box_that_is_too_large_is_refused_before_anything_is_allocated() {
    let huge = a_box([-(1 << 28); 3], [1 << 29; 3]);
    let error = DistanceField::new(&empty(), huge, &FieldConfig::default()).unwrap_err();
    assert_eq!(error, FieldError::TooLong { region: huge });
    let large = a_box([0; 3], [1000, 1000, 1000]);
    let error = DistanceField::new(&empty(), large, &FieldConfig::default()).unwrap_err();
    assert!(matches!(error, FieldError::TooLarge { bytes, .. } if bytes >= 12_000_000_000), "{error}");
    let thin = a_box([7, 0, 0], [2, 100, 100]);
    assert_eq!(DistanceField::bytes_of(&thin), 100 * 100 * 16 * 6);
}

#[test]
fn an_update_does_what_is_needed_and_no_more() {
    let mut map = empty();
    write(&mut map, &occupied(&[[3, 3, 3]]));
    let mut field = DistanceField::new(&map, a_box([0; 3], [80; 3]), &FieldConfig::default()).unwrap();
    assert_eq!(field.update(&map), Updated::Unchanged);
    write(&mut map, &occupied(&[[-100, 3, 3]]));
    assert_eq!(field.update(&map), Updated::Unchanged);
    write(&mut map, &occupied(&[[50, 50, 50]]));
    assert_eq!(field.update(&map), Updated::Partly);
    assert_eq!(field.squared_voxels(Voxel::new(50, 50, 52)), Some(4));
    // An older view of the map, and one of another resolution: nothing is known of what changed.
    assert_eq!(field.update(&empty()), Updated::Anew);
    assert_eq!(field.squared_voxels(Voxel::new(50, 50, 52)), None);
    let mut coarse = MapView::new(Resolution::from_metres(1.0).unwrap());
    write(&mut coarse, &occupied(&[[3, 3, 3], [5, 5, 5]]));
    assert_eq!(field.update(&coarse), Updated::Anew);
    assert_eq!(field.distance(Voxel::new(5, 5, 7)), Some(2.0));
}
