//! Morton order: the bits of three numbers in turn.

/// The lowest 21 bits of three numbers; from the top, bits of x, y, z, x, y, z …
pub(crate) fn interleave([x, y, z]: [u64; 3]) -> u64 {
    spread(x) << 2 | spread(y) << 1 | spread(z)
}

/// The inverse of [`interleave`].
pub(crate) fn separate(code: u64) -> [u64; 3] {
    [code >> 2, code >> 1, code].map(gather)
}

/// Two zero bits before each of the lowest 21 bits.
fn spread(v: u64) -> u64 {
    let mut v = v & 0x1f_ffff;
    for (shift, mask) in [
        (32, 0x001f_0000_0000_ffff),
        (16, 0x001f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        v = (v | v << shift) & mask;
    }
    v
}

/// Every third bit.
fn gather(v: u64) -> u64 {
    let mut v = v & 0x1249_2492_4924_9249;
    for (shift, mask) in [
        (2, 0x10c3_0c30_c30c_30c3),
        (4, 0x100f_00f0_0f00_f00f),
        (8, 0x001f_0000_ff00_00ff),
        (16, 0x001f_0000_0000_ffff),
        (32, 0x1f_ffff),
    ] {
        v = (v | v >> shift) & mask;
    }
    v
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn bits_come_in_turn_and_go_back(v in prop::array::uniform3(0..1u64 << 21)) {
            let slow = (0..21).fold(0, |code, bit| {
                let at = |axis: usize| v[axis] >> bit & 1;
                code | (at(0) << 2 | at(1) << 1 | at(2)) << (3 * bit)
            });
            prop_assert_eq!(interleave(v), slow);
            prop_assert_eq!(separate(slow), v);
        }
    }
}
