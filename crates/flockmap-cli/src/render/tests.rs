use super::*;

use flockmap::grid::Changes;
use proptest::prelude::*;

fn view(voxels: &[Voxel]) -> MapView {
    let mut view = MapView::new(Resolution::from_metres(0.5).unwrap());
    let changes = Changes::from_voxels(voxels.iter().map(|voxel| (*voxel, State::Occupied)));
    changes.blocks().iter().for_each(|(index, block)| view.set_block(*index, block));
    view
}

fn style(azimuth: f64, elevation: f64) -> Style {
    let camera = Camera::new(azimuth, elevation);
    Style { size: [48, 40], camera, heights_m: [f64::NEG_INFINITY, f64::INFINITY], is_dark: false }
}

/// The nearest cube on a ray through everything, by the planes of each; `None` where the ray passes so near to an
/// edge that rounding decides.
fn nearest(voxels: &[Voxel], from: [f64; 3], along: [f64; 3]) -> Option<Option<(Voxel, f64)>> {
    const HAIR: f64 = 1e-3;
    let mut best: Option<(Voxel, f64)> = None;
    for voxel in voxels {
        let low = [voxel.x, voxel.y, voxel.z].map(f64::from);
        let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
        for axis in 0..3 {
            let [a, b] = [low[axis], low[axis] + 1.0].map(|plane| (plane - from[axis]) / along[axis]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        if (enter - leave).abs() < HAIR {
            return None;
        }
        if enter < leave && best.is_none_or(|(_, other)| enter < other) {
            best = Some((*voxel, enter));
        }
    }
    Some(best)
}

proptest! {
    #[test]
    fn each_pixel_shows_the_first_cube_on_its_ray(
        voxels in prop::collection::btree_set((-4i32..4, -4i32..4, -4i32..4), 1..40),
        azimuth in 1.0..89.0f64, turns in 0..4i32, elevation in prop_oneof![-80.0..-5.0f64, 5.0..80.0f64],
    ) {
        let voxels: Vec<Voxel> = voxels.into_iter().map(|(x, y, z)| Voxel::new(x, y, z)).collect();
        let style = style(azimuth + 90.0 * f64::from(turns), elevation);
        let view = view(&voxels);
        let scene = Scene::of(&view, &style).unwrap();
        let mut canvas = Canvas::new(48 * OVERSAMPLING, 40 * OVERSAMPLING);
        scene.voxels.iter().for_each(|voxel| scene.draw(*voxel, &mut canvas));
        // From the directions of the camera, not from its code: right, up and towards are a frame.
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| style.camera.project(axis));
        let world = |p: [f64; 3]| axes.map(|axis| axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2]);
        let mut looked = 0;
        for (at, pixel) in canvas.pixels().enumerate() {
            let (x, y) = ((at % 96) as f64 + 0.5, (at / 96) as f64 + 0.5);
            let right = (x - scene.canvas[0] / 2.0) / scene.scale + scene.middle[0];
            let up = scene.middle[1] - (y - scene.canvas[1] / 2.0) / scene.scale;
            let Some(expected) = nearest(&voxels, world([right, up, 100.0]), world([0.0, 0.0, -1.0])) else { continue };
            looked += 1;
            let heights = pixel.map(|colour| {
                voxels.iter().filter(|voxel| (0..3).any(|axis| (0..=8u32).any(|near| {
                    scene.colour(voxel.z, LIGHT[axis] * (1.0 - SHADE * f64::from(near))) == colour
                }))).map(|voxel| voxel.z).collect::<Vec<_>>()
            });
            match (expected, heights) {
                (None, None) => {}
                (Some((voxel, _)), Some(heights)) => prop_assert!(heights.contains(&voxel.z), "{at}: {voxel:?} {heights:?}"),
                (expected, got) => prop_assert!(false, "{at}: {expected:?}, drawn {got:?}"),
            }
        }
        prop_assert!(looked > 96 * 80 / 2);
    }
}

#[test]
fn the_whole_map_is_in_the_picture_and_nothing_else() {
    let wall: Vec<Voxel> = (0..20).flat_map(|y| (0..5).map(move |z| Voxel::new(100, y, z))).collect();
    for (azimuth, elevation) in [(0.0, 0.0), (-60.0, 40.0), (-90.0, 90.0), (200.0, -30.0)] {
        let picture = render(&view(&wall), &style(azimuth, elevation)).unwrap();
        let drawn = |at: usize| picture.pixels[at] != [255; 3];
        assert!((0..48 * 40).any(drawn), "{azimuth} {elevation}");
        let edge = (0..48).flat_map(|x| [x, 48 * 39 + x]).chain((0..40).flat_map(|y| [48 * y, 48 * y + 47]));
        assert!(!edge.into_iter().any(drawn), "{azimuth} {elevation}");
        assert_eq!(picture.voxels, 100);
    }
}

#[test]
fn a_pixel_is_as_long_as_it_says() {
    // Seen from +x a wall of 20 by 5 voxels of 0.5 m is 10 m by 2.5 m.
    let wall: Vec<Voxel> = (0..20).flat_map(|y| (0..5).map(move |z| Voxel::new(100, y, z))).collect();
    let picture = render(&view(&wall), &style(0.0, 0.0)).unwrap();
    let row = &picture.pixels[20 * 48..21 * 48];
    let length = row.iter().filter(|colour| **colour != [255; 3]).count() as f64 * picture.metres_per_pixel;
    assert!((length - 10.0).abs() <= 2.0 * picture.metres_per_pixel, "{length}");
}

#[test]
fn heights_cut_a_map_open_and_what_is_not_there_is_an_error() {
    let room: Vec<Voxel> =
        (0..10).flat_map(|x| (0..10).flat_map(move |y| [0, 6].map(|z| Voxel::new(x, y, z)))).collect();
    let view = view(&room);
    let floor = render(&view, &Style { heights_m: [0.0, 2.9], ..style(-60.0, 40.0) }).unwrap();
    assert_eq!(floor.voxels, 100);
    let error =
        render(&view, &Style { heights_m: [10.0, 20.0], ..style(-60.0, 40.0) }).unwrap_err().to_string();
    assert_eq!(error, "nothing to draw: no voxel between 10 and 20 m is occupied");
    let error = render(&view, &Style { size: [8, 10_000], ..style(0.0, 0.0) }).unwrap_err().to_string();
    assert!(error.contains("8 × 10000 pixels, expected 16 to 4096"), "{error}");
}
