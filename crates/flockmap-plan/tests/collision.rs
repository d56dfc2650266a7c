//! Collision, batches and inflation beside what looks at every voxel.

mod common;

use common::{empty, region, seen, voxels};
use flockmap_grid::{MapView, Pose, RayEnd, State, Voxel, VoxelBox};
use flockmap_plan::{Collision, DistanceField, FieldConfig, Obstacles, QuestionError, cast_rays, states};
use proptest::prelude::*;

/// What surely holds every body of these tests.
fn everywhere() -> VoxelBox {
    VoxelBox::new(Voxel::new(-24, -24, -24), [48; 3]).unwrap()
}

fn obstacles_of(view: &MapView, obstacles: Obstacles) -> Vec<Voxel> {
    everywhere().voxels().filter(|voxel| obstacles.contain(view.state(*voxel))).collect()
}

const SIDE: f64 = 0.25;

fn nearest_of_cube(voxel: Voxel, point: [f64; 3]) -> [f64; 3] {
    let low = [voxel.x, voxel.y, voxel.z].map(|at| f64::from(at) * SIDE);
    core::array::from_fn(|axis| point[axis].clamp(low[axis], low[axis] + SIDE))
}

fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum::<f64>().sqrt()
}

fn to_cube(voxel: Voxel, point: [f64; 3]) -> f64 {
    apart(point, nearest_of_cube(voxel, point))
}

/// Where on a way the distance to a cube is least (by halving: it is convex), and where it first is the radius.
fn way_to_cube(voxel: Voxel, from: [f64; 3], to: [f64; 3], radius: f64) -> (f64, f64) {
    let at = |t: f64| -> f64 {
        to_cube(voxel, core::array::from_fn(|axis| from[axis] + (to[axis] - from[axis]) * t))
    };
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..100 {
        let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if at(a) <= at(b) { high = b } else { low = a }
    }
    let nearest = at(low);
    let (mut out, mut within) = (0.0, low);
    for _ in 0..60 {
        let middle = (out + within) / 2.0;
        if at(middle) <= radius { within = middle } else { out = middle }
    }
    (nearest, within)
}

/// The part of a way within a cube, as metres along it: where it comes in and where it leaves.
fn part_in_cube(voxel: Voxel, from: [f64; 3], to: [f64; 3]) -> Option<[f64; 2]> {
    let (low, length) = ([voxel.x, voxel.y, voxel.z].map(|at| f64::from(at) * SIDE), apart(from, to));
    let mut part = [0.0, length];
    for axis in 0..3 {
        let slope = (to[axis] - from[axis]) / length;
        let ends = [low[axis], low[axis] + SIDE].map(|face| (face - from[axis]) / slope);
        part = [part[0].max(ends[0].min(ends[1])), part[1].min(ends[0].max(ends[1]))];
    }
    (part[0] <= part[1]).then_some(part)
}

fn point() -> impl Strategy<Value = [f64; 3]> {
    prop::array::uniform3(-2.9f64..2.9)
}

/// Closer to the limit than this, rounding decides.
const ROUNDING: f64 = 1e-6;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    #[test]
    fn a_sweep_meets_first_what_is_nearest_along_it(
        voxels in voxels(13, 25),
        from in point(),
        to in point(),
        radius in 0.0f64..1.0,
        obstacles in prop_oneof![3 => Just(Obstacles::Occupied), 1 => Just(Obstacles::NotFree)],
    ) {
        let view = seen(2, &voxels);
        let found = obstacles_of(&view, obstacles);
        let ways: Vec<(f64, f64)> = found.iter().map(|voxel| way_to_cube(*voxel, from, to, radius)).collect();
        prop_assume!(ways.iter().all(|(nearest, _)| (nearest - radius).abs() > ROUNDING || *nearest == 0.0 && radius > 0.0));
        let first = ways.iter().filter(|way| way.0 <= radius).map(|way| way.1).min_by(f64::total_cmp);
        let hit = Collision::new(&view, obstacles).swept_sphere(from, to, radius).unwrap();
        prop_assert_eq!(hit.is_some(), first.is_some());
        if let (Some(hit), Some(first)) = (hit, first) {
            prop_assert!((hit.along_m - first * apart(from, to)).abs() < 1e-4, "{hit:?} {first}");
            prop_assert!(obstacles.contain(view.state(hit.voxel)));
            let (nearest, at) = way_to_cube(hit.voxel, from, to, radius);
            prop_assert!(nearest <= radius && (at - first).abs() * apart(from, to) < 1e-4);
        }
    }

    #[test]
    fn a_sphere_meets_the_cubes_within_its_radius(voxels in voxels(13, 25), centre in point(), radius in 0.0f64..2.0) {
        let view = seen(2, &voxels);
        let found = obstacles_of(&view, Obstacles::Occupied);
        let nearest = found.iter().map(|voxel| to_cube(*voxel, centre)).min_by(f64::total_cmp).unwrap_or(f64::INFINITY);
        prop_assume!((nearest - radius).abs() > ROUNDING);
        let met = Collision::new(&view, Obstacles::Occupied).sphere(centre, radius).unwrap();
        prop_assert_eq!(met.is_some(), nearest < radius);
        prop_assert!(met.is_none_or(|voxel| to_cube(voxel, centre) < radius));
        // What the field calls clear is.
        let field = DistanceField::new(&view, everywhere(), &FieldConfig::default()).unwrap();
        let mut is_clear = [false];
        field.are_clear(&[centre], radius, &mut is_clear);
        prop_assert!(!(is_clear[0] && met.is_some()));
        prop_assert!(is_clear[0] || nearest < radius + 4.0 * SIDE);
    }

    #[test]
    fn a_path_is_its_parts_one_after_the_other(
        voxels in voxels(13, 12),
        points in prop::collection::vec(point(), 0..5),
        radius in 0.0f64..0.5,
    ) {
        let view = seen(2, &voxels);
        let collision = Collision::new(&view, Obstacles::Occupied);
        let mut expected = None;
        let mut gone = 0.0;
        for (at, ends) in points.windows(2).enumerate() {
            if let Some(hit) = collision.swept_sphere(ends[0], ends[1], radius).unwrap() {
                expected = Some((at, hit.voxel, gone + hit.along_m));
                break;
            }
            gone += apart(ends[0], ends[1]);
        }
        if let [only] = points[..] {
            expected = collision.sphere(only, radius).unwrap().map(|voxel| (0, voxel, 0.0));
        }
        let found = collision.path(&points, radius).unwrap();
        prop_assert_eq!(found.map(|(at, hit)| (at, hit.voxel, hit.along_m)), expected);
    }

    #[test]
    fn an_aligned_box_meets_the_cubes_that_it_overlaps(voxels in voxels(13, 25), a in point(), b in point()) {
        let view = seen(2, &voxels);
        let meets = |voxel: &Voxel| {
            let low = [voxel.x, voxel.y, voxel.z].map(|at| f64::from(at) * SIDE);
            (0..3).all(|axis| a[axis].min(b[axis]) <= low[axis] + SIDE && a[axis].max(b[axis]) >= low[axis])
        };
        let expected = obstacles_of(&view, Obstacles::Occupied).iter().any(meets);
        let met = Collision::new(&view, Obstacles::Occupied).aligned_box(a, b).unwrap();
        prop_assert_eq!(met.is_some(), expected);
        prop_assert!(met.is_none_or(|voxel| meets(&voxel)));
    }

    /// Beside projections on the box and on the cube in turn, which come to where both are nearest.
    #[test]
    fn an_oriented_box_meets_the_cubes_that_it_overlaps(
        voxels in voxels(10, 25),
        centre in prop::array::uniform3(-1.5f64..1.5),
        turn in prop::array::uniform4(-1.0f64..1.0),
        half in prop::array::uniform3(0.01f64..1.2),
    ) {
        let pose = Pose::new(centre, turn);
        prop_assume!(pose.is_some());
        let (pose, view) = (pose.unwrap(), seen(2, &voxels));
        let distance = |voxel: &Voxel| {
            let mut point = centre;
            for _ in 0..2000 {
                let own = pose.inverse().transform(nearest_of_cube(*voxel, point));
                point = pose.transform(core::array::from_fn(|axis| own[axis].clamp(-half[axis], half[axis])));
            }
            to_cube(*voxel, point)
        };
        let all: Vec<f64> = obstacles_of(&view, Obstacles::Occupied).iter().map(distance).collect();
        prop_assume!(all.iter().all(|distance| *distance < 1e-9 || *distance > 1e-3));
        let met = Collision::new(&view, Obstacles::Occupied).oriented_box(&pose, half).unwrap();
        prop_assert_eq!(met.is_some(), all.iter().any(|distance| *distance < 1e-9));
        prop_assert!(met.is_none_or(|voxel| distance(&voxel) < 1e-9));
    }

    #[test]
    fn inflation_takes_what_is_within_the_radius(voxels in voxels(15, 20), region in region(12, 24), radius in 0.0f64..1.5) {
        let view = seen(2, &voxels);
        let field = DistanceField::new(&view, region, &FieldConfig::default()).unwrap();
        let inflated = field.inflated(&view, radius);
        for voxel in everywhere().voxels() {
            let near = field.distance(voxel).is_some_and(|distance| distance <= radius + 1e-9);
            let expected = if near { State::Occupied } else { view.state(voxel) };
            prop_assert_eq!(inflated.state(voxel), expected);
        }
    }

    #[test]
    fn a_ray_ends_in_the_first_cube_on_its_way(
        voxels in voxels(13, 40), from in point(), to in point(), through_unknown in any::<bool>(),
    ) {
        let view = seen(1, &voxels);
        let stops = |voxel| match view.state(voxel) {
            State::Occupied => true,
            State::Unknown => !through_unknown,
            State::Free => false,
        };
        let crossed = || everywhere().voxels().filter_map(|voxel| Some((voxel, part_in_cube(voxel, from, to)?)));
        // What it does not just touch.
        let first = crossed().filter(|(voxel, part)| stops(*voxel) && part[1] - part[0] > ROUNDING);
        let first = first.map(|(_, part)| part[0]).fold(f64::INFINITY, f64::min);
        let (voxel, distance_m, state) = match view.cast_ray(from, to, through_unknown) {
            RayEnd::Clear => {
                prop_assert!(first.is_infinite(), "{first}");
                return Ok(());
            }
            RayEnd::Occupied { voxel, distance_m } => (voxel, distance_m, State::Occupied),
            RayEnd::Unknown { voxel, distance_m } => (voxel, distance_m, State::Unknown),
        };
        prop_assert!(stops(voxel) && view.state(voxel) == state);
        prop_assert!(distance_m <= first + ROUNDING, "{distance_m} {first}");
        let there = core::array::from_fn(|axis| from[axis] + (to[axis] - from[axis]) * distance_m / apart(from, to));
        prop_assert!(to_cube(voxel, there) < ROUNDING, "{voxel:?} {distance_m}");
    }

    #[test]
    fn a_batch_answers_as_one_by_one(voxels in voxels(13, 40), points in prop::collection::vec(point(), 1..20)) {
        let view = seen(1, &voxels);
        let mut found = vec![State::Free; points.len()];
        states(&view, &points, &mut found).unwrap();
        prop_assert_eq!(found, points.iter().map(|point| view.state_at(*point)).collect::<Vec<_>>());
        let to: Vec<[f64; 3]> = points.iter().rev().copied().collect();
        let mut ends = vec![RayEnd::Clear; points.len()];
        cast_rays(&view, &points, &to, false, &mut ends).unwrap();
        for ((from, to), end) in points.iter().zip(&to).zip(&ends) {
            prop_assert_eq!(*end, view.cast_ray(*from, *to, false));
        }
        let mut collides = vec![false; points.len()];
        let collision = Collision::new(&view, Obstacles::Occupied);
        collision.spheres(&points, 0.3, &mut collides).unwrap();
        for (point, collides) in points.iter().zip(collides) {
            prop_assert_eq!(collides, collision.sphere(*point, 0.3).unwrap().is_some());
        }
    }
}

#[test]
fn what_is_no_number_is_answered() {
    let view = empty();
    let collision = Collision::new(&view, Obstacles::NotFree);
    let (nan, far) = ([0.0, f64::NAN, 0.0], [1e300, 0.0, 0.0]);
    for wrong in [nan, far, [f64::INFINITY; 3]] {
        for answer in [
            collision.sphere(wrong, 1.0),
            collision.aligned_box([0.0; 3], wrong),
            collision.oriented_box(&Pose::from_translation(wrong), [1.0; 3]),
            collision.swept_sphere([0.0; 3], wrong, 1.0).map(|hit| hit.map(|hit| hit.voxel)),
        ] {
            assert!(matches!(answer, Err(QuestionError::NotInGrid(_))), "{answer:?}");
        }
    }
    for wrong in [f64::NAN, -1.0, f64::INFINITY] {
        assert!(matches!(collision.sphere([0.0; 3], wrong), Err(QuestionError::NotInGrid(_))));
        assert!(matches!(
            collision.oriented_box(&Pose::IDENTITY, [wrong; 3]),
            Err(QuestionError::NotInGrid(_))
        ));
    }
    let field = DistanceField::new(&view, everywhere(), &FieldConfig::default()).unwrap();
    assert!(field.within(f64::NAN).is_empty());
    let mut is_clear = [true];
    field.are_clear(&[nan], 0.1, &mut is_clear);
    assert!(!is_clear[0]);
    field.are_clear(&[[0.0; 3]], f64::NAN, &mut is_clear);
    assert!(!is_clear[0]);
}

#[test]
fn what_is_too_large_is_refused() {
    let view = empty();
    let collision = Collision::new(&view, Obstacles::NotFree);
    let far = [1e7, 1e7, 1e7];
    assert!(matches!(collision.sphere([0.0; 3], 1e9), Err(QuestionError::TooLarge { .. })));
    assert!(matches!(collision.aligned_box([0.0; 3], far), Err(QuestionError::TooLarge { .. })));
    assert!(matches!(collision.swept_sphere([0.0; 3], far, 0.1), Err(QuestionError::TooLarge { .. })));
    assert!(matches!(collision.path(&[[0.0; 3], [5.0; 3], far], 0.1), Err(QuestionError::TooLarge { .. })));
    let error = cast_rays(&view, &[[0.0; 3]], &[far], true, &mut [RayEnd::Clear]);
    assert!(matches!(error, Err(QuestionError::TooLarge { .. })));
    assert_eq!(states(&view, &[far], &mut []), Err(QuestionError::Lengths(1, 0)));
}
