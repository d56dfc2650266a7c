//! The model by which a cube is packed: states, and the stamps of what is known.

use flockmap_coder::{CodeBit, Probability};

use super::cube::CUBE_SIDE;
use crate::packing::{EVEN, RATE, StatePacking};
use crate::{BLOCK_VOXELS, State, StateBlock, bit_of};

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

/// Voxels along a side of a cube, and a border before it of which nothing is known.
const SIDE: usize = 8 * CUBE_SIDE + 1;
/// Steps from a voxel to the one before it along each axis.
const STEPS: [usize; 3] = [1, SIDE, SIDE * SIDE];

/// Blocks to bits, or bits to blocks: one piece of code, so that both learn alike. Of each voxel that is known it is
/// coded whether its stamp is that of a neighbour.
pub(super) struct Packing<B> {
    bits: B,
    states: StatePacking<CUBE_SIDE>,
    ranks: Ranks,
    model: Box<Model>,
}

/// Of the stamps of voxels.
struct Ranks {
    model: Box<RankModel>,
    /// Of each voxel of the cube, with the border.
    ranks: Vec<u16>,
    /// Of the voxel before.
    last: u16,
}

struct RankModel {
    first: [Probability; 64],
    second: [Probability; 64],
    is_later: Probability,
    length: [Probability; 16],
    digits: [[Probability; 16]; 16],
}

/// Of the rest of a block.
struct Model {
    is_newest_used: Probability,
    is_before_known: Probability,
    is_regular: Probability,
    before_known: [Probability; 3],
    before_occupied: [Probability; 3],
}

impl<B: CodeBit> Packing<B> {
    pub(super) fn new(bits: B) -> Self {
        let model = Model {
            is_newest_used: EVEN,
            is_before_known: EVEN,
            is_regular: EVEN,
            before_known: [EVEN; 3],
            before_occupied: [EVEN; 3],
        };
        Self { bits, states: StatePacking::new(), ranks: Ranks::new(), model: Box::new(model) }
    }

    pub(super) fn into_bits(self) -> B {
        self.bits
    }

    /// Passes the block at a place of the cube. A reader does not look at `truth`. Returns the block.
    pub(super) fn block(&mut self, place: u32, truth: &Voxels) -> Voxels {
        let at = [place & 3, place >> 2 & 3, place >> 4].map(|at| at as usize);
        let corner = at.iter().zip(STEPS).map(|(at, step)| (8 * at + 1) * step).sum::<usize>();
        let (mut ranks, mut highest) = ([0; BLOCK_VOXELS], 0);
        let Self { bits, states, ranks: all, .. } = self;
        let states = states.block(bits, at, &truth.states, |bits, bit, near| {
            let inside = bit_of(bit).into_iter().zip(STEPS).map(|(at, step)| at as usize * step);
            let rank = all.pass(bits, corner + inside.sum::<usize>(), near, truth.ranks[bit]);
            ranks[bit] = rank;
            highest = rank.max(highest);
        });
        let newest = self.newest(highest, truth.newest);
        let before = self.before(&states, &ranks, newest, truth.before);
        Voxels { states, ranks, newest, before }
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

impl Ranks {
    fn new() -> Self {
        let model = RankModel {
            first: [EVEN; 64],
            second: [EVEN; 64],
            is_later: EVEN,
            length: [EVEN; 16],
            digits: [[EVEN; 16]; 16],
        };
        Self { model: Box::new(model), ranks: vec![0; SIDE * SIDE * SIDE], last: 0 }
    }

    /// The number of a stamp: that of a neighbour, as a rule, or so much earlier or later.
    #[inline(always)]
    fn pass<B: CodeBit>(&mut self, bits: &mut B, at: usize, known: [bool; 3], truth: u16) -> u16 {
        let rank = self.code(bits, at, known, truth);
        self.ranks[at] = rank;
        self.last = rank;
        rank
    }

    #[inline(always)]
    fn code<B: CodeBit>(&mut self, bits: &mut B, at: usize, known: [bool; 3], truth: u16) -> u16 {
        let Self { model, ranks, last } = self;
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
}
