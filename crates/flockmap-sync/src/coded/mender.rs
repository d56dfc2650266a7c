//! What a receiver keeps of repair symbols until they suffice.

use super::block::{Block, numbers};
use super::code::solve;
use super::error::{BEYOND_MAX, MendError};
use crate::wire::Coded;
use flockmap_codec::Package;
use flockmap_grid::Stream;
use std::collections::VecDeque;

/// Blocks of which symbols are kept.
const REPAIRS_MAX: usize = 32;
/// Bytes of all of them.
const BYTES_MAX: usize = 256 << 10;

/// Keeps the repair symbols of blocks until packages can be found from them. Holds at most 32 blocks and 256
/// KiB; the block of which a symbol came longest ago goes first. While it mends it holds 3.5 MB more, and 30
/// MB where the numbers of symbols were chosen to that end.
#[derive(Debug, Default)]
pub(crate) struct Mender {
    /// The one that was touched longest ago first.
    repairs: VecDeque<Repair>,
    bytes: usize,
    failed: u64,
}

/// A block of which something is lacking, and its repair symbols so far.
#[derive(Debug)]
struct Repair {
    block: Block,
    /// No number twice, and at most [`BEYOND_MAX`] more numbers than source symbols.
    numbers: Vec<u32>,
    symbols: Vec<u8>,
    /// Symbols that were there, and how many were lacking, when last they did not suffice.
    tried: Option<(usize, usize)>,
}

/// What repair symbols came to.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) enum Mended {
    /// So many more are needed.
    Needs(usize),
    /// The packages of the block that were not stored, ascending; none if all were.
    Packages(Vec<Package>),
}

impl Mender {
    /// Takes repair symbols; `stored` gives the packages of their stream that are there. What is held and not
    /// stored any more counts as lacking, and comes back with the rest.
    ///
    /// Work: once as many symbols are there as are lacking, all source symbols are solved for; so with each
    /// call that brings a further one, up to [`BEYOND_MAX`].
    pub(crate) fn take<'a>(
        &mut self,
        coded: Coded,
        stored: impl Fn(u32) -> Option<&'a Package>,
    ) -> Result<Mended, MendError> {
        let at = self.repairs.iter().position(|repair| repair.block == coded.block);
        let mut repair = at.and_then(|at| self.remove(at)).unwrap_or_else(|| Repair {
            block: coded.block,
            numbers: Vec::new(),
            symbols: Vec::new(),
            tried: None,
        });
        repair.add(coded.first_symbol, &coded.symbols);
        let mended = repair.mend(stored);
        match mended {
            Ok(Mended::Needs(_)) => self.keep(repair),
            Ok(Mended::Packages(_)) => {}
            Err(_) => self.failed += 1,
        }
        mended
    }

    /// Looks again at all blocks that have this package, which came otherwise: what can be found with it.
    pub(crate) fn retry<'a>(
        &mut self,
        stream: Stream,
        index: u32,
        stored: impl Fn(u32) -> Option<&'a Package>,
    ) -> Vec<Package> {
        let mut packages = Vec::new();
        let mut at = 0;
        while let Some(Repair { block, .. }) = self.repairs.get(at) {
            let mended = if block.stream == stream && block.symbols_of(index) > 0 {
                self.repairs[at].mend(&stored)
            } else {
                Ok(Mended::Needs(1))
            };
            match mended {
                Ok(Mended::Needs(_)) => at += 1,
                Ok(Mended::Packages(mended)) => {
                    packages.extend(mended);
                    self.remove(at);
                }
                Err(_) => {
                    self.failed += 1;
                    self.remove(at);
                }
            }
        }
        packages
    }

    /// Drops all blocks of a stream.
    pub(crate) fn forget(&mut self, stream: Stream) {
        self.repairs.retain(|repair| repair.block.stream != stream);
        self.bytes = self.repairs.iter().map(Repair::bytes).sum();
    }

    /// Blocks that were dropped since they are false.
    pub(crate) const fn failed(&self) -> u64 {
        self.failed
    }

    /// Bytes that are held.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        self.bytes + self.repairs.capacity() * size_of::<Repair>()
    }

    /// Blocks that something is kept of.
    #[cfg(test)]
    pub(super) fn repairs_kept(&self) -> usize {
        self.repairs.len()
    }

    fn keep(&mut self, repair: Repair) {
        let room = BYTES_MAX.saturating_sub(repair.bytes() + REPAIRS_MAX * size_of::<Repair>());
        while (self.repairs.len() >= REPAIRS_MAX || self.bytes > room) && self.remove(0).is_some() {}
        self.bytes += repair.bytes();
        self.repairs.push_back(repair);
    }

    fn remove(&mut self, at: usize) -> Option<Repair> {
        let repair = self.repairs.remove(at)?;
        self.bytes -= repair.bytes();
        Some(repair)
    }
}

impl Repair {
    /// Bytes beside the struct itself.
    fn bytes(&self) -> usize {
        self.block.symbols.capacity() + 4 * self.numbers.capacity() + self.symbols.capacity()
    }

    /// Adds symbols with the numbers from `first` on, as far as they are new and there can be use for them.
    fn add(&mut self, first: u32, symbols: &[u8]) {
        let (each, most) = (self.block.symbol_bytes(), self.block.sources() + BEYOND_MAX);
        let symbols = symbols.chunks_exact(each);
        for (number, symbol) in numbers(first, symbols.len()).zip(symbols) {
            if self.numbers.len() < most && !self.numbers.contains(&number) {
                self.numbers.push(number);
                self.symbols.extend_from_slice(symbol);
            }
        }
    }

    fn mend<'a>(&mut self, stored: impl Fn(u32) -> Option<&'a Package>) -> Result<Mended, MendError> {
        let block = &self.block;
        let lacks =
            block.indices().filter(|(index, _)| stored(*index).is_none()).map(|(_, count)| count).sum();
        if lacks == 0 {
            return Ok(Mended::Packages(Vec::new()));
        }
        let kept = self.numbers.len();
        if let Some(more @ 1..) = usize::checked_sub(lacks, kept) {
            return Ok(Mended::Needs(more));
        }
        if self.tried == Some((kept, lacks)) {
            return Ok(Mended::Needs(1));
        }
        let sources = block.sources_of(|at| stored(block.first + at as u32))?;
        let most = lacks + BEYOND_MAX;
        let numbers = self.numbers.get(..most).unwrap_or(&self.numbers);
        match solve(block, &sources, numbers, &self.symbols) {
            Some(bytes) if crc32fast::hash(&bytes) != block.check => Err(MendError::Check),
            Some(bytes) => block.packages_of(&bytes, &sources.lacking).map(Mended::Packages),
            None if kept >= most => Err(MendError::Dependent),
            None => {
                self.tried = Some((kept, lacks));
                Ok(Mended::Needs(1))
            }
        }
    }
}
