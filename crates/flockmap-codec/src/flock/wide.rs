//! The contexts of an Unknown voxel beyond the nearest cells and its ray. Each has a trained table, and the
//! values of all add up.

use super::cells::{Row, STATES, new, occupied};
use super::neighbourhood::Neighbourhood;
use super::planes::swapped_in_words;
use super::tables::{NEAR_CONTEXTS, RAY_CONTEXTS};

/// Contexts of a voxel, with the nearest cells and the ray.
pub(crate) const VOXEL_PLACES: usize = 8;

// Where in the sums each table begins.
const RAY: usize = NEAR_CONTEXTS;
const CHANGED: usize = RAY + RAY_CONTEXTS;
const OBSTACLES: usize = CHANGED + 4_096;
const ASKEW: usize = OBSTACLES + 4_096;
const DISTANT: usize = ASKEW + 4_096;
const COUNTS: usize = DISTANT + 4_096;
const SLOPES: usize = COUNTS + 2_048;
/// Values of all tables of a voxel.
pub(crate) const VOXEL_SUMS: usize = SLOPES + 16_384;

/// What is round the voxels of a row, as the row began.
pub(crate) struct Wide {
    /// Eight bits of contexts by voxel.
    words: [[u8; 8]; 6],
    /// How many cells round the row are Occupied, new and known, in eight classes each.
    counts: usize,
    /// The slopes of the rays along x and along y, in eight steps each.
    slopes: usize,
    is_by_rows: bool,
}

impl Wide {
    /// Of the row at a place. b is the axis of a slice along which the sensor is farther away, c the other.
    #[inline]
    pub(crate) fn of(cells: &Neighbourhood, at: usize, is_by_rows: bool, slopes: [usize; 2]) -> Self {
        let words = if is_by_rows { words::<true>(cells, at) } else { words::<false>(cells, at) };
        let words = swapped_in_words(words).map(u64::to_le_bytes);
        let [slope_x, slope_y] = slopes.map(|slope| (slope >> 1).min(7));
        Self { words, counts: counts(cells, at), slopes: slope_x | slope_y << 3, is_by_rows }
    }

    /// Takes in that a voxel of the row was found: the next two know it.
    #[inline(always)]
    pub(crate) fn note(&mut self, x: usize, is_occupied: bool) {
        let mut set = |word: usize, x: usize, bits: u8| {
            if let Some(byte) = self.words[word].get_mut(x) {
                *byte |= bits;
            }
        };
        // The two bits of a state stand two apart.
        let occupied = u8::from(is_occupied);
        if self.is_by_rows {
            set(4, x + 2, 0b10 | occupied << 3);
            set(5, x + 1, occupied << 3);
        } else {
            set(0, x + 1, 0b100);
            set(4, x + 2, 0b01 | occupied << 2);
            set(5, x + 1, occupied << 2);
        }
    }

    /// Where the values of a voxel are in the sums.
    #[inline(always)]
    pub(crate) fn places(&self, [near, ray]: [u16; 2], x: usize) -> [usize; VOXEL_PLACES] {
        let byte = |word: usize| usize::from(self.words[word][x & 7]);
        let (near, ray) = (usize::from(near), usize::from(ray));
        [
            near,
            RAY + ray % RAY_CONTEXTS,
            CHANGED + (byte(0) | (byte(1) & 15) << 8),
            OBSTACLES + (byte(5) | byte(1) >> 4 << 8),
            ASKEW + (byte(2) | (byte(3) & 15) << 8),
            DISTANT + (byte(4) | byte(3) >> 4 << 8),
            COUNTS + (self.counts << 2 | near & 1 | near >> 1 & 2) % 2_048,
            SLOPES + (self.slopes << 8 | near >> 4 & 0xf0 | near & 15) % 16_384,
        ]
    }
}

/// Eight cells of each voxel of a row in each word, one in each byte.
#[inline(always)]
fn words<const BY_ROWS: bool>(cells: &Neighbourhood, at: usize) -> [u64; 6] {
    // So many steps back along b and along c, and on along z.
    let cell = |b: isize, c: isize, z: isize| {
        let (rows, x) = if BY_ROWS { (b, c) } else { (c, b) };
        cells.shifted(at.wrapping_add_signed(16 * z - rows), -x)
    };
    let state = |b, c, z| cell(b, c, z) & STATES;
    let fresh = |b, c, z| u64::from(new(cell(b, c, z)));
    let known = |b, c, z| u64::from(occupied(cell(b, c, z)) & !new(cell(b, c, z)));
    let found = |b, c, z| u64::from(occupied(cell(b, c, z)) & new(cell(b, c, z)));
    // The two bits of a state stand two bytes apart.
    let states = |[one, two, three, four]: [Row; 4]| one | two << 8 | three << 32 | four << 40;
    let bits = |bits: [u64; 8]| bits.into_iter().rev().fold(0, |all, byte| all << 8 | byte);
    let over = state(0, 0, -1);
    [
        bits([
            fresh(1, -2, 0),
            fresh(1, -1, 0),
            fresh(1, 0, 0),
            fresh(1, 1, 0),
            fresh(1, 2, 0),
            fresh(-2, 0, -1),
            fresh(-1, 0, -1),
            fresh(0, 0, -1),
        ]),
        bits([
            fresh(1, 0, -1),
            fresh(2, 0, -1),
            fresh(0, 1, -1),
            fresh(0, -1, -1),
            known(0, 0, 1),
            known(-1, 0, 1),
            known(0, -1, 1),
            known(1, 0, 1),
        ]),
        states([state(-1, 0, -1), state(0, -1, -1), state(1, -1, -1), state(-1, 1, -1)]),
        states([state(1, -1, 0), over, state(0, 1, -2), over]),
        states([state(2, 0, 0), state(0, 2, 0), state(0, 0, -2), state(1, 0, -2)]),
        bits([
            known(0, 1, 1),
            known(0, 0, 2),
            found(1, 0, 0),
            found(0, 1, 0),
            found(0, 0, -1),
            found(1, 1, 0),
            found(1, 0, -1),
            found(0, 1, -1),
        ]),
    ]
}

/// How many of the ten columns round a row have an Occupied, a new, and a known cell and no new one.
#[inline(always)]
fn counts(cells: &Neighbourhood, at: usize) -> usize {
    let mut all = 0;
    for slice in [at.wrapping_sub(16), at, at + 16] {
        all |= cells.row(slice.wrapping_sub(1)) | cells.row(slice) | cells.row(slice + 1);
    }
    let ten = |lanes: Row| (lanes >> 2 & 1_023) as usize;
    let fresh = ten(all >> 32);
    let class = |which: usize, columns: usize| usize::from(CLASSES[which][columns]);
    class(0, ten(all >> 48)) | class(1, fresh) << 3 | class(1, ten(all | all >> 16) & !fresh) << 6
}

/// Classes by ten bits: how many are set.
static CLASSES: [[u8; 1_024]; 2] = {
    const BOUNDS: [[u32; 7]; 2] = [[1, 2, 3, 4, 6, 8, 9], [1, 2, 3, 5, 7, 9, 10]];
    let mut table = [[0; 1_024]; 2];
    let mut at = 0;
    while at < 2 * 1_024 * 7 {
        let (which, columns, bound) = (at / 7 / 1_024, at / 7 % 1_024, at % 7);
        table[which][columns] += ((columns as u32).count_ones() >= BOUNDS[which][bound]) as u8;
        at += 1;
    }
    table
};
