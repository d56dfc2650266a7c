//! From where a map is looked at.

/// A camera without perspective: what is parallel stays parallel, and a metre is as long everywhere in the picture.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Camera {
    right: [f64; 3],
    up: [f64; 3],
    toward: [f64; 3],
}

impl Camera {
    /// Stands in this direction as seen from the map: `azimuth_deg` counts from +x towards +y, `elevation_deg` is
    /// above the horizon; 90 is a look straight down, with +y up for an azimuth of −90.
    pub fn new(azimuth_deg: f64, elevation_deg: f64) -> Self {
        let ((s, c), (sin, cos)) = (azimuth_deg.to_radians().sin_cos(), elevation_deg.to_radians().sin_cos());
        Self { right: [-s, c, 0.0], up: [-sin * c, -sin * s, cos], toward: [cos * c, cos * s, sin] }
    }

    /// A point or a direction as right, up, and towards the camera, in the same unit.
    pub fn project(&self, p: [f64; 3]) -> [f64; 3] {
        [self.right, self.up, self.toward].map(|axis| axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2])
    }

    /// For each axis, whether the faces of cubes towards its positive end are seen, those towards its negative end,
    /// or none.
    pub fn seen_faces(&self) -> [Option<i32>; 3] {
        self.toward.map(|along| {
            // Seen from the side a face is a line.
            (along.abs() > 1e-9).then_some(if along > 0.0 { 1 } else { -1 })
        })
    }
}
