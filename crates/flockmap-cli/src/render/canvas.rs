//! Faces of cubes drawn over each other: of each pixel the nearest counts.

/// Pixels, each with what is nearest in it. Takes 8 bytes and an `Option<T>` for each.
#[derive(Clone, Debug)]
pub struct Canvas<T> {
    width: usize,
    pixels: Vec<(f64, Option<T>)>,
}

/// A parallelogram on the canvas: a corner, and the two edges from there. Each is pixels to the right, pixels down,
/// and how near it is.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Face {
    /// The corner.
    pub corner: [f64; 3],
    /// The edges.
    pub edges: [[f64; 3]; 2],
}

impl<T: Copy> Canvas<T> {
    /// An empty one.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, pixels: vec![(f64::NEG_INFINITY, None); width * height] }
    }

    /// Draws a face in every pixel whose centre is in it. One that is smaller than a pixel is drawn in the pixel of its
    /// own centre, so that it is not lost.
    pub fn draw(&mut self, face: &Face, what: T) {
        let Face { corner, edges: [a, b] } = face;
        let area = a[0] * b[1] - a[1] * b[0];
        let height = self.pixels.len() / self.width.max(1);
        let is_small = (0..2).all(|axis| a[axis].abs() + b[axis].abs() < 1.0);
        if is_small {
            let [x, y, near] = core::array::from_fn(|axis| corner[axis] + (a[axis] + b[axis]) / 2.0);
            if (0.0..self.width as f64).contains(&x) && (0.0..height as f64).contains(&y) {
                self.put(x as usize, y as usize, near, what);
            }
        } else if area.abs() > 1e-12 {
            let range = |axis: usize, size: usize| {
                let (low, high) = (a[axis].min(0.0) + b[axis].min(0.0), a[axis].max(0.0) + b[axis].max(0.0));
                let first = (corner[axis] + low - 0.5).ceil().clamp(0.0, size as f64) as usize;
                let end = ((corner[axis] + high - 0.5).floor() + 1.0).clamp(0.0, size as f64) as usize;
                first..end.max(first)
            };
            for y in range(1, height) {
                for x in range(0, self.width) {
                    let (dx, dy) = (x as f64 + 0.5 - corner[0], y as f64 + 0.5 - corner[1]);
                    let s = (dx * b[1] - dy * b[0]) / area;
                    let t = (dy * a[0] - dx * a[1]) / area;
                    // A hair more, so that no gap opens between two faces.
                    if (-1e-9..=1.0 + 1e-9).contains(&s) && (-1e-9..=1.0 + 1e-9).contains(&t) {
                        self.put(x, y, corner[2] + s * a[2] + t * b[2], what);
                    }
                }
            }
        }
    }

    /// What is nearest in each pixel, row by row from the top; `None`: nothing.
    pub fn pixels(&self) -> impl Iterator<Item = Option<T>> {
        self.pixels.iter().map(|(_, what)| *what)
    }

    fn put(&mut self, x: usize, y: usize, near: f64, what: T) {
        let pixel = &mut self.pixels[y * self.width + x];
        if near > pixel.0 {
            *pixel = (near, Some(what));
        }
    }
}
