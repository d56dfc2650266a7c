//! Repair symbols of a block of packages, in PACKAGES datagrams.

use super::datagram::{DATAGRAM_BYTES_MAX, Datagram, DatagramError, put_record, record_len};
use super::packages::PackagesWriter;
use super::received::{put_stream, read_stream};
use crate::coded::{Block, PACKAGES_MAX, SYMBOL_NUMBERS, SYMBOL_UNIT};
use flockmap_codec::bytes::{Reader, put_varint};
use flockmap_grid::Stream;

const CODED: u8 = 20;
/// Of the sender's own run: its stream is that of the header.
const OWN_CODED: u8 = 21;

/// Bits of a byte of the record: symbol length, then bits of a count.
const COUNT_BITS_SHIFT: u32 = 4;
const COUNT_BITS_MAX: u32 = 7;

/// Bytes of the number of a symbol at the most.
const NUMBER_BYTES_MAX: usize = 3;

const _: () = assert!(SYMBOL_NUMBERS <= 1 << (7 * NUMBER_BYTES_MAX));

/// Repair symbols of one block that follow each other.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Coded {
    /// What they are of.
    pub(crate) block: Block,
    /// Number of the first of them, below [`SYMBOL_NUMBERS`]; after the last one comes 0.
    pub(crate) first_symbol: u32,
    /// The symbols, at least one.
    pub(crate) symbols: Vec<u8>,
}

/// All repair symbols of a datagram; records of other types are skipped. Holds at most 12 times as many bytes
/// as the datagram has.
pub(crate) fn parse_coded(datagram: &Datagram<'_>) -> Result<Vec<Coded>, DatagramError> {
    let sender = datagram.header().sender;
    let read = |(id, content)| {
        let mut reader = Reader::new(content);
        let stream = if id == OWN_CODED { sender } else { read_stream(&mut reader)? };
        read_coded(stream, &mut reader)
    };
    let records = datagram.records().filter(|(id, _)| [CODED, OWN_CODED].contains(id));
    records.map(|record| read(record).ok_or_else(|| datagram.malformed("repair symbols"))).collect()
}

fn read_coded(stream: Stream, reader: &mut Reader<'_>) -> Option<Coded> {
    let (first, packages) = (reader.varint_u32()?, usize::from(reader.u8()?));
    let (form, least) = (reader.u8()?, reader.u8()?);
    let symbol_bytes = (usize::from(form & 15) + 1) * SYMBOL_UNIT;
    let bits = u32::from(form) >> COUNT_BITS_SHIFT;
    if packages > PACKAGES_MAX || bits > COUNT_BITS_MAX {
        return None;
    }
    let packed = reader.bytes((packages * bits as usize).div_ceil(8))?;
    let symbols =
        unpack(packed, packages, bits).map(|more| least.checked_add(more)).collect::<Option<_>>()?;
    let block = Block::new(stream, first, symbols, symbol_bytes as u16, reader.u32()?)?;
    let first_symbol = reader.varint_u32()?;
    let symbols = reader.rest();
    let is_whole = !symbols.is_empty() && symbols.len().is_multiple_of(symbol_bytes);
    let coded = (is_whole && first_symbol < SYMBOL_NUMBERS).then(|| Coded {
        block,
        first_symbol,
        symbols: symbols.to_vec(),
    })?;
    // One form for each: bits after the last count are zero, and there are not more of them than needed.
    let (mut again, length) = (Vec::new(), packed.len());
    put_layout(&mut again, &coded.block);
    (again.get(again.len().checked_sub(length)?..)? == packed
        && again.first()? == &form
        && again.get(1)? == &least)
        .then_some(coded)
}

/// Numbers of so many bits each, the lowest bit first.
fn unpack(packed: &[u8], count: usize, bits: u32) -> impl Iterator<Item = u8> {
    let bit = |at: usize| packed.get(at / 8).map_or(0, |byte| byte >> (at % 8) & 1);
    (0..count).map(move |number| (0..bits).fold(0, |v, b| v | bit(number * bits as usize + b as usize) << b))
}

/// Length of a symbol, and how many symbols each package takes.
fn put_layout(out: &mut Vec<u8>, block: &Block) {
    let (least, bits) = block.symbol_bits();
    out.push((block.symbol_bytes() / SYMBOL_UNIT - 1) as u8 | (bits << COUNT_BITS_SHIFT) as u8);
    out.push(least);
    let start = out.len();
    out.resize(start + block.layout_bytes(), 0);
    for (number, &count) in block.symbols.iter().enumerate() {
        for b in 0..bits as usize {
            let at = number * bits as usize + b;
            out[start + at / 8] |= ((count - least) >> b & 1) << (at % 8);
        }
    }
}

/// All of a record but its symbols, and their number.
fn put_head(block: &Block, sender: Stream) -> (u8, Vec<u8>) {
    let mut out = Vec::with_capacity(96);
    let is_own = block.stream == sender;
    if !is_own {
        put_stream(&mut out, block.stream);
    }
    put_varint(&mut out, block.first.into());
    out.push(block.packages() as u8);
    put_layout(&mut out, block);
    out.extend(block.check.to_le_bytes());
    (if is_own { OWN_CODED } else { CODED }, out)
}

impl PackagesWriter {
    /// How many symbols of a block there is room for, whatever their numbers.
    pub(crate) fn room_for_coded(&self, block: &Block) -> usize {
        let (_, head) = put_head(block, self.sender);
        let room = self.bytes_max.saturating_sub(self.bytes.len());
        let frame = record_len(DATAGRAM_BYTES_MAX) - DATAGRAM_BYTES_MAX;
        room.saturating_sub(frame + head.len() + NUMBER_BYTES_MAX) / block.symbol_bytes()
    }

    /// Adds repair symbols, as many of them as there is room for; how many that are.
    pub(crate) fn push_coded(&mut self, coded: &Coded) -> usize {
        let each = coded.block.symbol_bytes();
        let count = self.room_for_coded(&coded.block).min(coded.symbols.len() / each);
        if count > 0 {
            let (id, mut content) = put_head(&coded.block, self.sender);
            put_varint(&mut content, coded.first_symbol.into());
            content.extend(coded.symbols.iter().take(count * each));
            put_record(&mut self.bytes, id, &content);
        }
        count
    }
}

#[cfg(test)]
mod tests;
