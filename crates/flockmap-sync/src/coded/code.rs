//! The code: RaptorQ (RFC 6330), by the crate `raptorq`.
//!
//! A block here is the one source block of an object there: block number 0, one sub-block. Source symbol k is
//! the encoding symbol k, and repair symbol r the encoding symbol K + r.

use super::block::{Block, SOURCES_MAX, SYMBOL_NUMBERS, Sources};
use flockmap_codec::Package;
#[cfg(test)]
use raptorq::extended_source_block_symbols;
use raptorq::{
    EncodingPacket, ObjectTransmissionInformation, PayloadId, SourceBlockDecoder, SourceBlockEncoder,
};

const BLOCK_NUMBER: u8 = 0;
/// Intermediate symbols beyond K', at the most: S + H there.
#[cfg(test)]
const CONSTRAINTS_MAX: usize = 69;

// Encoding symbols have numbers of 24 bits; the crate panics beyond.
const _: () = assert!(SYMBOL_NUMBERS as usize + SOURCES_MAX <= 1 << 24);

fn object(block: &Block) -> ObjectTransmissionInformation {
    let bytes = block.sources() * block.symbol_bytes();
    ObjectTransmissionInformation::new(bytes as u64, block.symbol_bytes, 1, 1, 1)
}

/// A holder of all packages of a block, who makes repair symbols of it. To make this takes up to 2.5 ms and
/// 3.5 MB meanwhile, each symbol after that less than a microsecond: keep it while symbols of the block are
/// sent. Holds at most 200 KB.
#[derive(Clone, Debug)]
pub(crate) struct BlockEncoder {
    block: Block,
    code: SourceBlockEncoder,
}

impl BlockEncoder {
    /// `None` if the packages are not those of the block.
    pub(crate) fn new(block: &Block, packages: &[&Package]) -> Option<Self> {
        if packages.len() != block.packages() {
            return None;
        }
        let sources = block.sources_of(|at| packages.get(at).copied()).ok()?;
        Some(Self::of_sources(block, &sources.bytes))
    }

    /// Of all source symbols of the block, one after the other.
    pub(super) fn of_sources(block: &Block, sources: &[u8]) -> Self {
        let code = SourceBlockEncoder::new(BLOCK_NUMBER, &object(block), sources);
        Self { block: block.clone(), code }
    }

    pub(crate) const fn block(&self) -> &Block {
        &self.block
    }

    /// Makes `count` repair symbols with the numbers from `from` on (after the last comes 0), one after the
    /// other.
    pub(crate) fn symbols(&self, from: u32, count: usize) -> Vec<u8> {
        let from = from % SYMBOL_NUMBERS;
        let count = u32::try_from(count).unwrap_or(u32::MAX).min(SYMBOL_NUMBERS);
        let before_the_end = count.min(SYMBOL_NUMBERS - from);
        let mut symbols = Vec::with_capacity(count as usize * self.block.symbol_bytes());
        for (from, count) in [(from, before_the_end), (0, count - before_the_end)] {
            for packet in self.code.repair_packets(from, count) {
                symbols.extend_from_slice(packet.data());
            }
        }
        symbols
    }

    /// Bytes that are held, nearly: source symbols one by one, and those that repair symbols are sums of.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        let (sources, each) = (self.block.sources(), self.block.symbol_bytes());
        let intermediate = extended_source_block_symbols(sources as u32) as usize + CONSTRAINTS_MAX;
        self.block.symbols.capacity()
            + sources * (each + size_of::<Vec<u8>>())
            + intermediate * (each + size_of::<usize>())
    }
}

/// All source symbols of a block, of those that are there and of repair symbols with these numbers, no number
/// twice. `None` if they do not suffice.
pub(super) fn solve(block: &Block, sources: &Sources, numbers: &[u32], symbols: &[u8]) -> Option<Vec<u8>> {
    let each = block.symbol_bytes();
    let packet =
        |id: u32, symbol: &[u8]| EncodingPacket::new(PayloadId::new(BLOCK_NUMBER, id), symbol.to_vec());
    let known = sources.known.iter().filter_map(|&number| {
        let at = usize::from(number) * each;
        Some(packet(number.into(), sources.bytes.get(at..at + each)?))
    });
    let repair = numbers.iter().zip(symbols.chunks_exact(each));
    let repair = repair.map(|(number, symbol)| packet(block.sources() as u32 + number, symbol));
    let object = object(block);
    SourceBlockDecoder::new(BLOCK_NUMBER, &object, object.transfer_length()).decode(known.chain(repair))
}

/// Makes `count` repair symbols with the numbers from `from` on (after the last comes 0), one after the
/// other, of all packages of a block. `None` if they are not those of the block. Whoever makes more of them
/// later keeps a [`BlockEncoder`].
#[cfg(test)]
pub(crate) fn repair_symbols(
    block: &Block,
    packages: &[&Package],
    from: u32,
    count: usize,
) -> Option<Vec<u8>> {
    Some(BlockEncoder::new(block, packages)?.symbols(from, count))
}
