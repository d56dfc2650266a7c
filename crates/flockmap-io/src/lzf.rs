//! LZF, the packing of compressed PCD files.

use crate::bytes::Bytes;
use crate::error::{Fault, Place};

/// LibLZF's form: a control byte below 32 is followed by that many bytes + 1 as they are; otherwise its upper
/// three bits (7: plus the next byte) are a length − 2, and its lower five with the next byte a distance − 1
/// back.
pub(crate) fn decompress(packed: &[u8], size: u64, base: u64) -> Result<Vec<u8>, Fault> {
    // A byte unpacks to at most 264 / 3: a header cannot ask for more than the data can fill.
    if size > packed.len() as u64 * 88 + 64 {
        let expected = format!("packed data for {size} bytes");
        return Err(Fault::damaged(Place::Byte(base), expected, format!("{} bytes of it", packed.len())));
    }
    let mut out: Vec<u8> = Vec::with_capacity(size as usize);
    let mut packed = Bytes::new(packed, base);
    let broken = |place, found: &str| Fault::damaged(place, "LZF data as PCL packs it", found);
    while !packed.rest().is_empty() {
        let place = packed.place();
        let mut next = || packed.array("LZF data").map(|[byte]| usize::from(byte));
        let control = next()?;
        if control < 32 {
            out.extend_from_slice(packed.take(control as u64 + 1, "LZF data")?);
        } else {
            let length = 2 + if control >> 5 == 7 { 7 + next()? } else { control >> 5 };
            let distance = ((control & 31) << 8 | next()?) + 1;
            let from = out.len().checked_sub(distance);
            let from = from.ok_or_else(|| broken(place.clone(), "a copy from before it"))?;
            for i in from..from + length {
                let byte = out.get(i).copied().unwrap_or_default();
                out.push(byte);
            }
        }
        if out.len() as u64 > size {
            return Err(broken(place, "more than the unpacked size"));
        }
    }
    if out.len() as u64 != size {
        return Err(broken(packed.place(), &format!("{} of {size} bytes", out.len())));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn random_bytes_never_panic(data in prop::collection::vec(any::<u8>(), 0..300), size in 0..5000u64) {
            if let Ok(out) = decompress(&data, size, 0) {
                prop_assert_eq!(out.len() as u64, size);
            }
        }
    }

    #[test]
    fn copies_may_overlap_themselves() {
        // "ab", then 2 + 7 + 3 bytes from 2 back.
        let out = decompress(&[1, b'a', b'b', 7 << 5, 3, 1], 14, 0).unwrap();
        assert_eq!(out, b"ababababababab");
    }
}
