//! zlib streams (RFC 1950), with exact limits on what they may become.

use flate2::{Compress, Compression, Decompress, FlushCompress, FlushDecompress, Status};

/// Deflate makes at most 1,032 bytes of one: a longest match of 258 bytes in two bits.
pub(crate) const EXPANSION_MAX: usize = 1032;

/// A compressor with its state, about 300 KB, reused from package to package.
pub(crate) struct Deflater {
    state: Compress,
}

impl Default for Deflater {
    /// Level 6, for packages.
    fn default() -> Self {
        Self { state: Compress::new(Compression::new(6), true) }
    }
}

impl Deflater {
    /// Appends `input` as one zlib stream.
    pub(crate) fn deflate(&mut self, input: &[u8], out: &mut Vec<u8>) {
        self.state.reset();
        let mut consumed = 0;
        loop {
            // The bound of zlib for what it cannot compress; the loop goes on should a back end need more.
            let rest = input.get(consumed..).unwrap_or_default();
            out.reserve(rest.len() + rest.len() / 1000 + 64);
            let before = self.state.total_in();
            let status = self.state.compress_vec(rest, out, FlushCompress::Finish);
            consumed += (self.state.total_in() - before) as usize;
            match status {
                Ok(Status::StreamEnd) => return,
                Ok(Status::Ok | Status::BufError) => {}
                Err(error) => unreachable!("deflate fails only on a wrong state: {error}"),
            }
        }
    }
}

/// Inflates `input`, one whole zlib stream and nothing after it, into `out`.
/// `None` if it is damaged or does not fill `out` exactly.
pub(crate) fn inflate_exact(input: &[u8], out: &mut [u8]) -> Option<()> {
    (inflate_into(input, out)? == out.len()).then_some(())
}

/// Inflates `input`, one whole zlib stream and nothing after it, of at most `max` bytes.
/// Takes no more memory than the smaller of `max` and what `input` could expand to.
pub(crate) fn inflate_up_to(input: &[u8], max: usize) -> Option<Vec<u8>> {
    let mut out = vec![0; max.min(input.len().saturating_mul(EXPANSION_MAX))];
    let len = inflate_into(input, &mut out)?;
    out.truncate(len);
    Some(out)
}

fn inflate_into(input: &[u8], out: &mut [u8]) -> Option<usize> {
    let mut state = Decompress::new(true);
    let status = state.decompress(input, out, FlushDecompress::Finish).ok()?;
    let whole = status == Status::StreamEnd && state.total_in() == input.len() as u64;
    whole.then_some(state.total_out() as usize)
}
