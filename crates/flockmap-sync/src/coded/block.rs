//! The layout of a block, its source symbols, and the repair symbols that a holder of all of it makes.

use super::error::MendError;
#[cfg(test)]
use crate::IntervalSet;
use flockmap_codec::{ContentKind, Package};
use flockmap_grid::{RobotId, Stream};

/// Packages of a block at the most.
pub(crate) const PACKAGES_MAX: usize = 64;
/// Source symbols of a block at the most.
pub(crate) const SOURCES_MAX: usize = 1_024;
/// Bytes of a symbol are a multiple of this …
pub(crate) const SYMBOL_UNIT: usize = 16;
/// … and at most so many.
pub(crate) const SYMBOL_BYTES_MAX: usize = 256;
/// Bytes of a package without its stream, with the byte before it, at the most: more never came in a
/// datagram.
pub(crate) const SOURCE_BYTES_MAX: usize = 1_184;
/// Numbers of repair symbols, from 0 on: enough that no two holders of a block come to the same ones, and few
/// enough that a number takes three bytes.
pub(crate) const SYMBOL_NUMBERS: u32 = 1 << 21;

/// The layout of some packages that follow each other in a stream, as source symbols. All who make it of the
/// same packages make the same; two that differ in anything are different blocks. Holds at most 64 bytes
/// beside itself.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Block {
    pub(crate) stream: Stream,
    /// Index of the first package, from 1.
    pub(crate) first: u32,
    /// Source symbols of each package, one after the other: 1 to 64 packages, of at least one symbol each,
    /// and of [`SOURCES_MAX`] together at the most.
    pub(crate) symbols: Vec<u8>,
    /// A multiple of [`SYMBOL_UNIT`], to [`SYMBOL_BYTES_MAX`].
    pub(crate) symbol_bytes: u16,
    /// CRC-32 of all source symbols.
    pub(crate) check: u32,
}

/// The source symbols of a block.
pub(super) struct Sources {
    /// Those that are lacking are zero.
    pub(super) bytes: Vec<u8>,
    /// The numbers of those that are there.
    pub(super) known: Vec<u16>,
    /// And of the others.
    pub(super) lacking: Vec<u16>,
}

impl Block {
    /// A block with this layout, which may come from anywhere; `None` if it is beyond a limit.
    pub(crate) fn new(
        stream: Stream,
        first: u32,
        symbols: Vec<u8>,
        symbol_bytes: u16,
        check: u32,
    ) -> Option<Self> {
        let block = Self { stream, first, symbols, symbol_bytes, check };
        let each = block.symbol_bytes();
        let last = u32::try_from(block.symbols.len()).ok()?.checked_sub(1)?;
        let is_within = first > 0
            && first.checked_add(last).is_some()
            && block.symbols.len() <= PACKAGES_MAX
            && (SYMBOL_UNIT..=SYMBOL_BYTES_MAX).contains(&each)
            && each.is_multiple_of(SYMBOL_UNIT)
            && block.symbols.iter().all(|&count| (1..=symbols_max(each)).contains(&usize::from(count)))
            && block.sources() <= SOURCES_MAX;
        is_within.then_some(block)
    }

    /// The block of these packages, which have the indices from `first` on. Takes the length of a symbol that
    /// costs the fewest bytes on the air. `None` if they are too many or too long, or not changes of this
    /// stream.
    pub(crate) fn of(stream: Stream, first: u32, packages: &[&Package]) -> Option<Self> {
        let is_next = |(index, package): (u32, &&Package)| {
            let header = package.header();
            (header.stream, header.index, header.content) == (stream, index, ContentKind::Changes)
        };
        if packages.len() > PACKAGES_MAX || !(first..).zip(packages).all(is_next) {
            return None;
        }
        let lengths: Vec<usize> = packages.iter().map(|package| source_bytes(package)).collect();
        if lengths.iter().any(|&length| length > SOURCE_BYTES_MAX) {
            return None;
        }
        let layouts = (SYMBOL_UNIT..=SYMBOL_BYTES_MAX).step_by(SYMBOL_UNIT).filter_map(|each| {
            let symbols = lengths.iter().map(|length| u8::try_from(length.div_ceil(each)).ok());
            Self::new(stream, first, symbols.collect::<Option<_>>()?, each as u16, 0)
        });
        // Zeros that fill symbols against bits that say how many symbols there are.
        let mut block = layouts
            .min_by_key(|block| block.sources() * block.symbol_bytes() * (1_200 + block.layout_bytes()))?;
        block.check = crc32fast::hash(&block.sources_of(|i| packages.get(i).copied()).ok()?.bytes);
        Some(block)
    }

    /// Number of packages.
    pub(crate) const fn packages(&self) -> usize {
        self.symbols.len()
    }

    /// Number of source symbols.
    pub(crate) fn sources(&self) -> usize {
        self.symbols.iter().map(|&count| usize::from(count)).sum()
    }

    pub(crate) fn symbol_bytes(&self) -> usize {
        self.symbol_bytes.into()
    }

    /// Indices and numbers of source symbols, of each package.
    pub(crate) fn indices(&self) -> impl Iterator<Item = (u32, usize)> + '_ {
        (self.first..=u32::MAX).zip(self.symbols.iter().map(|&count| usize::from(count)))
    }

    /// How many source symbols the package with this index takes; 0 if it is not of this block.
    pub(crate) fn symbols_of(&self, index: u32) -> usize {
        let at = index.checked_sub(self.first).and_then(|at| self.symbols.get(at as usize));
        at.map_or(0, |&count| count.into())
    }

    /// How many source symbols who has received these indices lacks: as many repair symbols mend it.
    #[cfg(test)]
    pub(crate) fn symbols_lacking(&self, received: &IntervalSet) -> usize {
        self.indices().filter(|(index, _)| !received.contains(*index)).map(|(_, count)| count).sum()
    }

    /// Fewest symbols of a package, and bits that say how many more one has.
    pub(crate) fn symbol_bits(&self) -> (u8, u32) {
        let least = self.symbols.iter().copied().min().unwrap_or(1);
        let most = self.symbols.iter().copied().max().unwrap_or(1);
        (least, u8::BITS - (most - least).leading_zeros())
    }

    /// Bytes that say how many symbols each package has.
    pub(crate) fn layout_bytes(&self) -> usize {
        (self.packages() * self.symbol_bits().1 as usize).div_ceil(8)
    }

    /// All source symbols, given the packages that are there by their numbers in the block, from 0 on.
    pub(super) fn sources_of<'a>(
        &self,
        get: impl Fn(usize) -> Option<&'a Package>,
    ) -> Result<Sources, MendError> {
        let mut bytes = vec![0; self.sources() * self.symbol_bytes()];
        let (mut known, mut lacking) = (Vec::new(), Vec::new());
        let mut number = 0;
        for (at, &count) in self.symbols.iter().enumerate() {
            let numbers = number..number + u16::from(count);
            let place = bytes.get_mut(self.place(&numbers)).unwrap_or_default();
            number = numbers.end;
            match get(at) {
                Some(package) => {
                    put_source(place, package, self.symbol_bytes()).ok_or(MendError::Layout)?;
                    known.extend(numbers);
                }
                None => lacking.extend(numbers),
            }
        }
        Ok(Sources { bytes, known, lacking })
    }

    /// The packages of these source symbols that begin with one of the `lacking`.
    pub(super) fn packages_of(&self, sources: &[u8], lacking: &[u16]) -> Result<Vec<Package>, MendError> {
        let mut packages = Vec::new();
        let mut number = 0;
        for (index, count) in self.indices() {
            let numbers = number..number + count as u16;
            number = numbers.end;
            if lacking.binary_search(&numbers.start).is_ok() {
                let place = sources.get(self.place(&numbers)).unwrap_or_default();
                let bytes = unpadded(place);
                if bytes.len() >= SOURCE_BYTES_MAX {
                    return Err(MendError::Another);
                }
                let package = Package::parse_without_stream(self.stream, bytes);
                let package = package.map_err(MendError::Package)?;
                let header = package.header();
                if (header.index, header.content) != (index, ContentKind::Changes) {
                    return Err(MendError::Another);
                }
                packages.push(package);
            }
        }
        Ok(packages)
    }

    fn place(&self, numbers: &core::ops::Range<u16>) -> core::ops::Range<usize> {
        usize::from(numbers.start) * self.symbol_bytes()..usize::from(numbers.end) * self.symbol_bytes()
    }
}

/// Symbols of the longest package.
const fn symbols_max(symbol_bytes: usize) -> usize {
    SOURCE_BYTES_MAX.div_ceil(symbol_bytes)
}

/// Bytes of a package as it goes into symbols: one that says how much is filled up, and the package without
/// its stream, which the block states.
fn source_bytes(package: &Package) -> usize {
    let [front, back] = package.without_stream();
    1 + front.len() + back.len()
}

/// Writes a package into its source symbols, which are zero; `None` if it takes another number of them.
fn put_source(place: &mut [u8], package: &Package, symbol_bytes: usize) -> Option<()> {
    let [front, back] = package.without_stream();
    let filled = place.len().checked_sub(source_bytes(package)).filter(|&filled| filled < symbol_bytes)?;
    let (first, rest) = place.split_first_mut()?;
    *first = u8::try_from(filled).ok()?;
    let (front_place, rest) = rest.split_at_mut_checked(front.len())?;
    front_place.copy_from_slice(front);
    rest.get_mut(..back.len())?.copy_from_slice(back);
    Some(())
}

/// What was written into source symbols, without what they were filled up with.
fn unpadded(place: &[u8]) -> &[u8] {
    let Some((&filled, rest)) = place.split_first() else { return &[] };
    rest.get(..rest.len().saturating_sub(filled.into())).unwrap_or_default()
}

/// The numbers of so many repair symbols that follow each other: after the last comes 0. No number twice.
pub(super) fn numbers(from: u32, count: usize) -> impl Iterator<Item = u32> {
    (from % SYMBOL_NUMBERS..SYMBOL_NUMBERS).chain(0..from % SYMBOL_NUMBERS).take(count)
}

/// The number of the n-th repair symbol (from 0) that a robot makes of a block. Where robots begin is spread
/// by the golden ratio, so that those with neighbouring ids do not make the same symbols.
pub(crate) const fn symbol_number(holder: RobotId, nth: u32) -> u32 {
    let start = (holder.0 as u32).wrapping_mul(0x9e37_79b9) / (u32::MAX / SYMBOL_NUMBERS + 1);
    (start + nth % SYMBOL_NUMBERS) % SYMBOL_NUMBERS
}
