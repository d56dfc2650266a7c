//! The model by which a cube is packed: what the voxels before say of the next one.

use flockmap_coder::{CodeBit, Probability};

use super::cube::CUBE_SIDE;
use crate::{BLOCK_VOXELS, Plane, State, StateBlock};

/// A block as it is packed.
#[derive(Clone)]
pub(super) struct Voxels {
    pub(super) states: StateBlock,
    /// The number of the stamp of each known voxel among all stamps of the cube, the oldest first.
    pub(super) ranks: [u16; BLOCK_VOXELS],
    /// The same of the newest stamp.
    pub(super) newest: u16,
    pub(super) before: Option<StateBlock>,
}

impl Default for Voxels {
    fn default() -> Self {
        Self { states: StateBlock::default(), ranks: [0; BLOCK_VOXELS], newest: 0, before: None }
    }
}

/// Voxels along a side of a cube, and a border on both sides of which nothing is known.
const SIDE: usize = 8 * CUBE_SIDE + 2;
/// Steps from a voxel to the one before it along each axis.
const STEPS: [usize; 3] = [1, SIDE, SIDE * SIDE];

/// The voxels of a row along x, by z and y, a bit each.
type Rows = [[u64; SIDE]; SIDE];

/// How fast probabilities follow: a step of one in 2ⁿ.
const RATE: u32 = 4;
const EVEN: Probability = 1 << 15;

/// Blocks to bits, or bits to blocks: one piece of code, so that both learn alike. Each voxel is coded with what is known of those around it
/// that came before: whether it is known, whether it is Occupied, whether its stamp is that of a neighbour.
pub(super) struct Packing<B> {
    bits: B,
    model: Box<Model>,
    known: Box<Rows>,
    occupied: Box<Rows>,
    ranks: Vec<u16>,
    /// Of the voxel before.
    last: u16,
}

struct Model {
    known: [Probability; 1024],
    occupied: [Probability; 1024],
    first: [Probability; 64],
    second: [Probability; 64],
    is_later: Probability,
    length: [Probability; 16],
    digits: [[Probability; 16]; 16],
    is_newest_used: Probability,
    is_before_known: Probability,
    is_regular: Probability,
    before_known: [Probability; 3],
    before_occupied: [Probability; 3],
}

impl<B: CodeBit> Packing<B> {
    pub(super) fn new(bits: B) -> Self {
        let model = Model {
            known: [EVEN; 1024],
            occupied: [EVEN; 1024],
            first: [EVEN; 64],
            second: [EVEN; 64],
            is_later: EVEN,
            length: [EVEN; 16],
            digits: [[EVEN; 16]; 16],
            is_newest_used: EVEN,
            is_before_known: EVEN,
            is_regular: EVEN,
            before_known: [EVEN; 3],
            before_occupied: [EVEN; 3],
        };
        let rows = || Box::new([[0; SIDE]; SIDE]);
        let ranks = vec![0; SIDE * SIDE * SIDE];
        Self { bits, model: Box::new(model), known: rows(), occupied: rows(), ranks, last: 0 }
    }

    pub(super) fn into_bits(self) -> B {
        self.bits
    }

    /// Passes the block at a place of the cube. A reader does not look at `truth`. Returns the block.
    pub(super) fn block(&mut self, place: u32, truth: &Voxels) -> Voxels {
        let [cx, cy, cz] = [place & 3, place >> 2 & 3, place >> 4].map(|at| 8 * at as usize + 1);
        let (mut free, mut occupied): (Plane, Plane) = ([0; 8], [0; 8]);
        let mut ranks = [0; BLOCK_VOXELS];
        let mut highest = 0;
        for (row, ranks) in ranks.as_chunks_mut::<8>().0.iter_mut().enumerate() {
            let (z, y) = (row >> 3, row & 7);
            let of_row = |plane: &Plane| (plane[z] >> (8 * y)) as u8;
            let is = [truth.states.free(), truth.states.occupied()].map(of_row);
            let [free_row, occupied_row] = self.row([cx, cy + y, cz + z], is, ranks, &truth.ranks[8 * row..]);
            free[z] |= u64::from(free_row) << (8 * y);
            occupied[z] |= u64::from(occupied_row) << (8 * y);
            highest = ranks.iter().fold(highest, |highest: u16, rank| highest.max(*rank));
        }
        let states = StateBlock::new(free, occupied);
        let newest = self.newest(highest, truth.newest);
        let before = self.before(&states, &ranks, newest, truth.before);
        Voxels { states, ranks, newest, before }
    }

    /// Passes eight voxels along x from a place on: the Free and the Occupied ones, and the numbers of their stamps.
    #[inline(always)]
    fn row(&mut self, at: [usize; 3], is: [u8; 2], ranks: &mut [u16; 8], truth: &[u16]) -> [u8; 2] {
        let [x, y, z] = at;
        // From the voxel before the first one on: of the row itself, the one before it along y, along z, and both.
        let around = |rows: &Rows| {
            [rows[z][y], rows[z][y - 1], rows[z - 1][y], rows[z - 1][y - 1]].map(|row| row >> (x - 1))
        };
        let ([mut known, ky, kz, kyz], [mut occupied, oy, oz, _]) =
            (around(&self.known), around(&self.occupied));
        let mut found = [0u8; 2];
        for (n, to) in ranks.iter_mut().enumerate() {
            // What is known, and what is Occupied, of the voxels before it along x; y; z; y and z: of the middle two also
            // their neighbours along x.
            let near = [known >> n & 1, ky >> n & 7, kz >> n & 7, kyz >> (n + 1) & 1];
            let hard = [occupied >> n & 1, oy >> n & 7, oz >> n & 7];
            let context = near[0]
                | near[1] << 1
                | near[2] << 4
                | near[3] << 7
                | hard[0] << 8
                | ((hard[1] | hard[2]) & 2) << 8;
            let [is_free, is_occupied] = is.map(|row| row >> n & 1 == 1);
            let probability = &mut self.model.known[context as usize & 1023];
            if !self.bits.code(probability, is_free || is_occupied, RATE) {
                continue;
            }
            // The same, but for the voxels that are before it along two axes.
            let context = near[0]
                | near[1] >> 1 << 1
                | near[2] >> 1 << 3
                | hard[0] << 5
                | hard[1] >> 1 << 6
                | hard[2] >> 1 << 8;
            let is_occupied =
                self.bits.code(&mut self.model.occupied[context as usize & 1023], is_occupied, RATE);
            let flags = [near[0] == 1, near[1] >> 1 & 1 == 1, near[2] >> 1 & 1 == 1];
            let cell = z * STEPS[2] + y * STEPS[1] + x + n;
            let rank = self.rank(cell, flags, truth.get(n).copied().unwrap_or(0));
            self.ranks[cell] = rank;
            self.last = rank;
            *to = rank;
            known |= 2 << n;
            occupied |= u64::from(is_occupied) << (n + 1);
            found[usize::from(is_occupied)] |= 1 << n;
        }
        self.known[z][y] |= known << (x - 1);
        self.occupied[z][y] |= occupied << (x - 1);
        found
    }

    /// The number of a stamp: that of a neighbour, as a rule, or so much earlier or later.
    #[inline(always)]
    fn rank(&mut self, at: usize, known: [bool; 3], truth: u16) -> u16 {
        let Self { bits, model, ranks, last, .. } = self;
        let [x, y, z] = STEPS.map(|step| ranks[at - step]);
        let agree =
            [known[0] && known[1] && x == y, known[0] && known[2] && x == z, known[1] && known[2] && y == z];
        let among = [(known[0], x), (known[2], z), (known[1], y)];
        let mut others = among.into_iter().filter_map(|(is_known, rank)| is_known.then_some(rank));
        let first = if agree[2] && !agree[0] { Some(y) } else { others.next() }.unwrap_or(*last);
        let second = among.into_iter().find(|(is_known, rank)| *is_known && *rank != first);
        let flags = agree.into_iter().chain(known);
        let context = flags.enumerate().map(|(n, flag)| usize::from(flag) << n).sum::<usize>();
        if bits.code(&mut model.first[context], truth == first, RATE) {
            return first;
        }
        if let Some((_, second)) = second
            && bits.code(&mut model.second[context], truth == second, RATE)
        {
            return second;
        }
        // As far away: the number of binary digits, then these.
        let is_later = bits.code(&mut model.is_later, truth > first, RATE);
        let distance = u32::from(truth.abs_diff(first)).max(1);
        let mut length = 0;
        while length < 15 && bits.code(&mut model.length[length], distance >> (length + 1) != 0, RATE) {
            length += 1;
        }
        let mut coded = 1u16;
        for digit in (0..length).rev() {
            let probability = &mut model.digits[length][digit];
            coded = coded << 1 | u16::from(bits.code(probability, distance >> digit & 1 == 1, RATE));
        }
        if is_later { first.wrapping_add(coded) } else { first.wrapping_sub(coded) }
    }

    /// The number of the newest stamp: as a rule a voxel has it.
    fn newest(&mut self, highest: u16, truth: u16) -> u16 {
        let Self { bits, model, .. } = self;
        if bits.code(&mut model.is_newest_used, truth == highest, RATE) {
            return highest;
        }
        let mut even = EVEN;
        // A probability that does not learn: the rate is beyond its bits.
        (0..16).fold(0, |coded, digit| {
            coded | u16::from(bits.code(&mut even, truth >> digit & 1 == 1, 16)) << digit
        })
    }

    /// The states before the newest stamp: as a rule those of voxels with another stamp are as they are now.
    fn before(
        &mut self,
        states: &StateBlock,
        ranks: &[u16; BLOCK_VOXELS],
        newest: u16,
        truth: Option<StateBlock>,
    ) -> Option<StateBlock> {
        let Self { bits, model, .. } = self;
        if !bits.code(&mut model.is_before_known, truth.is_some(), RATE) {
            return None;
        }
        let truth = truth.unwrap_or_default();
        let is_of_newest = |bit: usize| states.get(bit) != State::Unknown && ranks[bit] == newest;
        let is_regular =
            B::KNOWS && (0..BLOCK_VOXELS).all(|bit| is_of_newest(bit) || truth.get(bit) == states.get(bit));
        let is_regular = bits.code(&mut model.is_regular, is_regular, RATE);
        let mut before = *states;
        for bit in (0..BLOCK_VOXELS).filter(|bit| !is_regular || is_of_newest(*bit)) {
            let (context, truth) = (states.get(bit) as usize, truth.get(bit));
            let state = if !bits.code(&mut model.before_known[context], truth != State::Unknown, RATE) {
                State::Unknown
            } else if bits.code(&mut model.before_occupied[context], truth == State::Occupied, RATE) {
                State::Occupied
            } else {
                State::Free
            };
            before.set(bit, state);
        }
        Some(before)
    }
}
