//! The second and the third pass: along lines of y or z, a group of them at a time.
//!
//! Each finds for every place i of a line the least `f(j) + (i − j)²`.

use super::cell::{Cell, Group, LANES};

/// Steps after which it is asked whether more of them can find anything.
const STRIDE: usize = 4;
/// Steps for each voxel of a line, on average, after which lower envelopes are faster.
const STEPS_MAX: usize = 64;

/// A group of lines, and room to work on it.
#[derive(Clone, Debug)]
pub(super) struct Lines<T> {
    /// The lines, with as many cells of nothing before and after.
    cells: Vec<Group<T>>,
    length: usize,
    least: Group<T>,
    envelope: Envelope,
}

impl<T: Cell> Lines<T> {
    pub(super) fn new(length: usize) -> Self {
        let cells = vec![[T::NONE; LANES]; length * 3 + 2 * STRIDE];
        Self { cells, length, least: [T::NONE; LANES], envelope: Envelope::default() }
    }

    /// Takes the lines' cells in order, as many as the lines are long.
    #[inline(always)]
    pub(super) fn load(&mut self, from: impl Iterator<Item = Group<T>>) {
        let mut least = [T::NONE; LANES];
        for (cell, group) in self.cells[self.length + STRIDE..].iter_mut().zip(from.take(self.length)) {
            *cell = group;
            least = lesser(least, group);
        }
        self.least = least;
    }

    /// Calls `out` with the least of every place, in order.
    #[inline(always)]
    pub(super) fn each(&mut self, mut out: impl FnMut(usize, Group<T>)) {
        let mut left = self.length * STEPS_MAX;
        for at in 0..self.length {
            if left == 0 {
                return self.envelopes(at, out);
            }
            let (best, steps) = self.at(at);
            left = left.saturating_sub(steps);
            out(at, best);
        }
    }

    /// The least of one place, and the steps that it took.
    #[inline(always)]
    pub(super) fn at(&self, at: usize) -> (Group<T>, usize) {
        // Up to here, what is k voxels before; from here, what is k voxels after.
        let (before, after) = self.cells.split_at(self.length + STRIDE + at);
        let (mut best, after) = (after[0], &after[1..]);
        let mut k = 0;
        for (before, after) in before.rchunks_exact(STRIDE).zip(after.chunks_exact(STRIDE)) {
            // Whatever is left takes at least this.
            let bound = T::square(k as u16 + 1);
            let more =
                (0..LANES).fold(false, |more, lane| more | (best[lane] > self.least[lane].plus(bound)));
            if !more || k >= self.length {
                break;
            }
            for step in 0..STRIDE {
                k += 1;
                let square = T::square(k as u16);
                let (a, b) = (before[STRIDE - 1 - step], after[step]);
                for lane in 0..LANES {
                    best[lane] = best[lane].lesser(a[lane].lesser(b[lane]).plus(square));
                }
            }
        }
        (best, k)
    }

    /// The same from place `first` on, line by line, in time that does not depend on the distances.
    #[cold]
    fn envelopes(&mut self, first: usize, mut out: impl FnMut(usize, Group<T>)) {
        let mut all = vec![[T::NONE; LANES]; self.length];
        let cells = &self.cells[self.length + STRIDE..];
        for lane in 0..LANES {
            let line = cells[..self.length].iter().map(|group| group[lane].whole());
            self.envelope.least(line, |at, least| all[at][lane] = T::from_whole(least));
        }
        for (at, group) in all.into_iter().enumerate().skip(first) {
            out(at, group);
        }
    }
}

#[inline(always)]
fn lesser<T: Cell>(a: Group<T>, b: Group<T>) -> Group<T> {
    core::array::from_fn(|lane| a[lane].lesser(b[lane]))
}

/// The lower envelope of parabolas of P. Felzenszwalb, D. Huttenlocher, "Distance Transforms of Sampled
/// Functions", Theory of Computing 8 (2012), in whole numbers.
#[derive(Clone, Debug, Default)]
struct Envelope {
    /// Of each parabola of the envelope: where it stands, its height, and the first place that it is the lowest at.
    parabolas: Vec<(i64, i64, i64)>,
}

impl Envelope {
    fn least(&mut self, line: impl Iterator<Item = Option<u32>>, mut out: impl FnMut(usize, u32)) {
        self.parabolas.clear();
        let mut length = 0;
        for (at, height) in line.enumerate() {
            length = at + 1;
            let (Some(height), at) = (height, at as i64) else { continue };
            let height = i64::from(height);
            let mut from = 0;
            while let Some(&(p, low, start)) = self.parabolas.last() {
                // The first whole place at which the new one is lower.
                from = ((height + at * at) - (low + p * p)).div_euclid(2 * (at - p)) + 1;
                if from > start {
                    break;
                }
                self.parabolas.pop();
                from = 0;
            }
            self.parabolas.push((at, height, from));
        }
        let mut next = self.parabolas.iter().peekable();
        let Some(mut lowest) = next.next() else { return };
        for at in 0..length as i64 {
            while let Some(parabola) = next.next_if(|parabola| parabola.2 <= at) {
                lowest = parabola;
            }
            out(at as usize, (lowest.1 + (at - lowest.0).pow(2)) as u32);
        }
    }
}
