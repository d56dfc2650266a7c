//! Whether any pixel of a set lies near a place in the image, in one look.

/// Pixels in a full turn, which is the width of the image.
pub(super) const WIDTH: usize = 1_800;

/// Words of 64 pixels in a row.
pub(super) const WORDS: usize = WIDTH.div_ceil(64);

/// Pixels in the last word of a row.
const REST: usize = WIDTH % 64;

/// A set of pixels, widened by 1, 2, 4, 8 and 16 pixels to all sides.
#[derive(Clone, Debug, Default)]
pub(super) struct Nearby {
    widened: [Vec<u64>; 5],
    across: Vec<u64>,
}

impl Nearby {
    /// Takes the set: bit `column % 64` of word `row · WORDS + column / 64`. About 0.2 ms for an image of 300
    /// rows.
    pub(super) fn take(&mut self, set: &[u64]) {
        let mut from = set;
        for (level, to) in self.widened.iter_mut().enumerate() {
            widen(from, (1usize << level).div_ceil(2), &mut self.across, to);
            from = to;
        }
    }

    /// Whether the set may have a pixel within `half` rows and columns of this one. Always right where it
    /// says no. The row may lie outside of the image.
    #[inline]
    pub(super) fn any(&self, row: i32, column: i32, half: i32) -> bool {
        let level = (half.max(1) as u32).next_power_of_two().trailing_zeros() as usize;
        let Some(set) = self.widened.get(level) else { return true };
        let row = row.clamp(0, (set.len() / WORDS) as i32 - 1) as usize;
        let column = column.rem_euclid(WIDTH as i32) as usize;
        set.get(row * WORDS + column / 64).is_some_and(|word| word >> (column % 64) & 1 != 0)
    }
}

/// Adds to a set everything `by` pixels up, down, left and right of it (and around corners); columns go
/// around. At most 56 pixels.
fn widen(set: &[u64], by: usize, across: &mut Vec<u64>, to: &mut Vec<u64>) {
    across.clear();
    for row in set.chunks_exact(WORDS) {
        // The row with 56 pixels more at each end, from its other end.
        let mut ring = [0u64; WORDS + 2];
        ring[0] = row[WORDS - 2] >> REST | row[WORDS - 1] << (64 - REST);
        ring[1..=WORDS].copy_from_slice(row);
        ring[WORDS] |= row[0] << REST;
        for w in 1..=WORDS {
            let (before, here, after) = (ring[w - 1], ring[w], ring[w + 1]);
            across.push(here | here << by | before >> (64 - by) | here >> by | after << (64 - by));
        }
        if let Some(last) = across.last_mut() {
            *last &= (1 << REST) - 1;
        }
    }
    to.clear();
    to.extend_from_slice(across);
    let step = by * WORDS;
    for (above, here) in to.iter_mut().skip(step).zip(across.iter()) {
        *above |= here;
    }
    for (below, here) in to.iter_mut().zip(across.iter().skip(step)) {
        *below |= here;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    #[test]
    fn what_is_near_is_found_and_what_is_far_is_not() {
        let rows = 40;
        let mut random = Random::new(1, 1);
        let mut set = vec![0u64; rows * WORDS];
        let mut pixels = vec![(0, 0), (39, 1_799), (20, 1_799), (30, 0)];
        pixels.extend((0..30).map(|_| (random.below(40) as i32, random.below(1_800) as i32)));
        for (row, column) in &pixels {
            set[*row as usize * WORDS + *column as usize / 64] |= 1 << (column % 64);
        }
        let mut nearby = Nearby::default();
        nearby.take(&set);
        for half in [1, 2, 4, 8, 16] {
            for row in 0..rows as i32 {
                for column in 0..WIDTH as i32 {
                    let is_near = pixels.iter().any(|(r, c)| {
                        let across = (c - column).rem_euclid(1_800);
                        (r - row).abs() <= half && across.min(1_800 - across) <= half
                    });
                    assert_eq!(nearby.any(row, column, half), is_near, "{row} {column} {half}");
                }
            }
        }
        assert!(nearby.any(-3, 2, 4) && nearby.any(5, 900, 17), "never no where it does not know");
    }
}
