//! The model by which states are packed: what the voxels before say of the next one.

use flockmap_coder::{CodeBit, Probability};

use crate::{Plane, StateBlock};

/// How fast probabilities follow: a step of one in 2ⁿ.
pub(crate) const RATE: u32 = 4;
/// At the beginning, of all.
pub(crate) const EVEN: Probability = 1 << 15;

/// What of the blocks of a cube of `BLOCKS`³ went by, and what it says of the next one. Each voxel is coded with what is
/// known of those around it that came before: whether it is known, whether it is Occupied.
///
/// Blocks to bits, or bits to blocks: one piece of code, so that both learn alike.
pub(crate) struct StatePacking<const BLOCKS: usize> {
    of_known: [Probability; 1024],
    of_occupied: [Probability; 1024],
    known: Rows<BLOCKS>,
    occupied: Rows<BLOCKS>,
}

/// The voxels of each row along x, by z and y, a byte for each block, and a border of which nothing is known: a row and
/// a byte before the first ones, two bytes behind the last ones.
struct Rows<const BLOCKS: usize>(Vec<u8>);

impl<const BLOCKS: usize> Rows<BLOCKS> {
    const ROW_BYTES: usize = BLOCKS + 3;
    const SIDE: usize = 8 * BLOCKS + 1;

    fn new() -> Self {
        Self(vec![0; Self::SIDE * Self::SIDE * Self::ROW_BYTES])
    }

    /// The place of a row of a block: `y` and `z` count from the border.
    const fn place(x: usize, y: usize, z: usize) -> usize {
        (z * Self::SIDE + y) * Self::ROW_BYTES + x
    }

    /// From the voxel before the row of a block on: of the row itself, the one before it along y, along z, and both.
    #[inline(always)]
    fn around(&self, x: usize, y: usize, z: usize) -> [u32; 4] {
        [(y, z), (y - 1, z), (y, z - 1), (y - 1, z - 1)].map(|(y, z)| {
            let from = self.0.get(Self::place(x, y, z)..).and_then(|bytes| bytes.first_chunk());
            u32::from_le_bytes(*from.unwrap_or(&[0; 4])) >> 7
        })
    }

    fn set(&mut self, x: usize, y: usize, z: usize, row: u8) {
        self.0[Self::place(x, y, z) + 1] = row;
    }
}

impl<const BLOCKS: usize> StatePacking<BLOCKS> {
    pub(crate) fn new() -> Self {
        Self { of_known: [EVEN; 1024], of_occupied: [EVEN; 1024], known: Rows::new(), occupied: Rows::new() }
    }

    /// Passes the states of the block at a place of the cube, which is later than those before along z, y and x. A
    /// reader does not look at `truth`. With each voxel that is known `found` is called: its bit, and whether the one
    /// before it is known along x, y, z. Returns the states.
    #[inline(always)]
    pub(crate) fn block<B: CodeBit>(
        &mut self,
        bits: &mut B,
        [x, y, z]: [usize; 3],
        truth: &StateBlock,
        mut found: impl FnMut(&mut B, usize, [bool; 3]),
    ) -> StateBlock {
        let (mut free, mut occupied): (Plane, Plane) = ([0; 8], [0; 8]);
        for row in 0..64 {
            let (slice, line) = (row >> 3, row & 7);
            let of_row = |plane: &Plane| (plane[slice] >> (8 * line)) as u8;
            let is = [truth.free(), truth.occupied()].map(of_row);
            let at = [x, 8 * y + line + 1, 8 * z + slice + 1];
            let passed = self.row(bits, at, is, |bits, n, near| found(bits, 8 * row + n, near));
            free[slice] |= u64::from(passed[0]) << (8 * line);
            occupied[slice] |= u64::from(passed[1]) << (8 * line);
        }
        StateBlock::new(free, occupied)
    }

    /// Passes eight voxels along x: the Free and the Occupied ones.
    #[inline(always)]
    fn row<B: CodeBit>(
        &mut self,
        bits: &mut B,
        [x, y, z]: [usize; 3],
        is: [u8; 2],
        mut found: impl FnMut(&mut B, usize, [bool; 3]),
    ) -> [u8; 2] {
        let ([mut known, ky, kz, kyz], [mut occupied, oy, oz, _]) =
            (self.known.around(x, y, z), self.occupied.around(x, y, z));
        let mut passed = [0u8; 2];
        for n in 0..8 {
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
            let probability = &mut self.of_known[context as usize & 1023];
            if !bits.code(probability, is_free || is_occupied, RATE) {
                continue;
            }
            // The same, but for the voxels that are before it along two axes.
            let context = near[0]
                | near[1] >> 1 << 1
                | near[2] >> 1 << 3
                | hard[0] << 5
                | hard[1] >> 1 << 6
                | hard[2] >> 1 << 8;
            let is_occupied = bits.code(&mut self.of_occupied[context as usize & 1023], is_occupied, RATE);
            found(bits, n, [near[0] == 1, near[1] >> 1 & 1 == 1, near[2] >> 1 & 1 == 1]);
            known |= 2 << n;
            occupied |= u32::from(is_occupied) << (n + 1);
            passed[usize::from(is_occupied)] |= 1 << n;
        }
        self.known.set(x, y, z, (known >> 1) as u8);
        self.occupied.set(x, y, z, (occupied >> 1) as u8);
        passed
    }
}
