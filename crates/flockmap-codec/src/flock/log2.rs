//! The logarithm of whole numbers, in integers only.

/// The logarithm to base 2 in 2⁻³², rounded down; 0 for 0.
pub(crate) const fn log2(value: u64) -> u64 {
    let Some(whole) = value.checked_ilog2() else { return 0 };
    // 1 ≤ mantissa < 2 in 2⁻⁶³; its square is 2 or more if the next bit of the logarithm is set.
    let mut mantissa = value << (63 - whole);
    let (mut log, mut bits) = (whole as u64, 0);
    while bits < 32 {
        let square = (mantissa as u128 * mantissa as u128) >> 63;
        let bit = (square >> 64) as u64;
        mantissa = (square >> bit) as u64;
        log = log << 1 | bit;
        bits += 1;
    }
    log
}
