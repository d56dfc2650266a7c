//! LAS and LAZ point clouds (ASPRS LAS 1.0 to 1.4).
//!
//! The header is read here: coordinates are the first twelve bytes of every point format, so nothing else of
//! a LAS file is needed. Packed points are unpacked by the `laz` crate, once all sizes that it would believe
//! have been checked.

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};

use laz::{LasZipDecompressor, LazItemType, LazVlr};

use crate::bytes::Bytes;
use crate::cloud::CLOUD_POINTS_MAX;
use crate::error::{Fault, Place};

/// Points per byte that a LAZ file may hold. Real ones hold less than one.
const LAZ_POINTS_PER_BYTE_MAX: u64 = 64;
/// Points unpacked at a time.
const BATCH: u64 = 10_000;

struct Header {
    point_bytes: u64,
    points: u64,
    scale: [f64; 3],
    offset: [f64; 3],
    data_at: u64,
    laszip: Option<LazVlr>,
}

/// The points in the coordinates of the file.
pub(crate) fn parse(bytes: &[u8]) -> Result<Vec<[f64; 3]>, Fault> {
    let header = parse_header(bytes)?;
    if header.points > CLOUD_POINTS_MAX {
        let what = "the number of points";
        return Err(Fault::too_large(Place::Byte(0), what, header.points, CLOUD_POINTS_MAX));
    }
    let data = bytes.get(header.data_at as usize..).unwrap_or_default();
    if let Some(laszip) = &header.laszip {
        return unpack(bytes, &header, laszip);
    }
    let needed = header.points * header.point_bytes;
    if needed > data.len() as u64 {
        let expected = format!("{needed} bytes for {} points of {} bytes", header.points, header.point_bytes);
        let found = format!("{} bytes", data.len());
        return Err(Fault::truncated(Place::Byte(header.data_at), expected, found));
    }
    let mut points = Vec::with_capacity(header.points as usize);
    take_points(data.get(..needed as usize).unwrap_or_default(), &header, &mut points);
    Ok(points)
}

fn take_points(records: &[u8], header: &Header, points: &mut Vec<[f64; 3]>) {
    for record in records.chunks_exact(header.point_bytes as usize) {
        let mut point = [0.0; 3];
        for (axis, (v, raw)) in point.iter_mut().zip(record.chunks_exact(4)).enumerate() {
            let raw = raw.first_chunk().map_or(0, |b| i32::from_le_bytes(*b));
            *v = f64::from(raw) * header.scale[axis] + header.offset[axis];
        }
        points.push(point);
    }
}

fn parse_header(bytes: &[u8]) -> Result<Header, Fault> {
    if !bytes.starts_with(b"LASF") {
        let found: Vec<String> = bytes.iter().take(4).map(|b| format!("{b:02x}")).collect();
        return Err(Fault::foreign(Place::Byte(0), "a LAS file (first bytes \"LASF\")", found.join(" ")));
    }
    let mut head = Bytes::new(bytes, 0);
    head.take(24, "the LAS header")?;
    let [major, minor] = head.array("the version")?;
    if major != 1 || minor > 4 {
        return Err(Fault::foreign(Place::Byte(24), "LAS version 1.0 to 1.4", format!("{major}.{minor}")));
    }
    head.take(68, "the LAS header")?;
    let header_bytes = u64::from(head.u16("the size of the header")?);
    let data_at = u64::from(head.u32("the place of the points")?);
    let records = head.u32("the number of variable records")?;
    let [format] = head.array("the point format")?;
    let point_bytes = u64::from(head.u16("the bytes of a point")?);
    let mut points = u64::from(head.u32("the number of points")?);
    head.take(20, "the LAS header")?;
    let mut numbers = [0.0; 6];
    for number in &mut numbers {
        *number = head.f64("scale and offset")?;
    }
    let [sx, sy, sz, ox, oy, oz] = numbers;
    if numbers.iter().any(|v| !v.is_finite()) || sx == 0.0 || sy == 0.0 || sz == 0.0 {
        let expected = "finite scales and offsets, scales other than zero";
        return Err(Fault::damaged(Place::Byte(131), expected, format!("{numbers:?}")));
    }
    head.take(48, "the bounds")?;
    if minor == 4 && points == 0 {
        head.take(8 + 8 + 4, "the LAS 1.4 header")?;
        points = head.u64("the number of points")?;
    }
    // Bit 7 (and in old files 6) of the format says packed by LASzip.
    let compressed = format & 0xc0 != 0;
    if format & 0x3f > 10 {
        return Err(Fault::foreign(Place::Byte(104), "point format 0 to 10", (format & 0x3f).to_string()));
    }
    if point_bytes < 20 {
        return Err(Fault::damaged(Place::Byte(105), "points of at least 20 bytes", point_bytes.to_string()));
    }
    if data_at > bytes.len() as u64 || data_at < header_bytes {
        let expected = format!("points that begin between byte {header_bytes} and {}", bytes.len());
        return Err(Fault::damaged(Place::Byte(96), expected, format!("byte {data_at}")));
    }
    let laszip = if compressed { Some(find_laszip(bytes, header_bytes, data_at, records)?) } else { None };
    Ok(Header { point_bytes, points, scale: [sx, sy, sz], offset: [ox, oy, oz], data_at, laszip })
}

/// The record that says how the points are packed.
fn find_laszip(bytes: &[u8], header_bytes: u64, data_at: u64, records: u32) -> Result<LazVlr, Fault> {
    let from = bytes.get(header_bytes as usize..data_at as usize).unwrap_or_default();
    let mut head = Bytes::new(from, header_bytes);
    for _ in 0..records {
        head.take(2, "a variable record")?;
        let user = head.take(16, "a variable record")?;
        let id = head.u16("a variable record")?;
        let length = head.u16("a variable record")?;
        head.take(32, "a variable record")?;
        let place = head.place();
        let data = head.take(u64::from(length), "a variable record")?;
        if id == LazVlr::RECORD_ID && user.starts_with(LazVlr::USER_ID.as_bytes()) {
            return LazVlr::read_from(data)
                .map_err(|e| Fault::damaged(place, "a LASzip record", e.to_string()));
        }
    }
    let expected = "a LASzip record, since the points are packed";
    Err(Fault::damaged(Place::Byte(header_bytes), expected, format!("{records} other records")))
}

/// Unpacks the points of a LAZ file.
fn unpack(bytes: &[u8], header: &Header, laszip: &LazVlr) -> Result<Vec<[f64; 3]>, Fault> {
    let place = || Place::Byte(header.data_at);
    if laszip.items_size() != header.point_bytes {
        let expected = format!("packed points of {} bytes", header.point_bytes);
        return Err(Fault::damaged(place(), expected, format!("{} bytes", laszip.items_size())));
    }
    let most = bytes.len() as u64 * LAZ_POINTS_PER_BYTE_MAX;
    if header.points > most {
        let expected = format!("at most {LAZ_POINTS_PER_BYTE_MAX} points for each byte of the file");
        return Err(Fault::damaged(Place::Byte(107), expected, format!("{} points", header.points)));
    }
    if header.points == 0 {
        return Ok(Vec::new());
    }
    check_chunks(bytes, header, laszip)?;
    let mut source = Cursor::new(bytes);
    source.set_position(header.data_at);
    // The crate panics on some damaged files. It is given nothing but bytes and a fresh buffer, so nothing is
    // left half done.
    let unpacked = catch_unwind(AssertUnwindSafe(|| {
        let mut unpacker = LasZipDecompressor::new(source, laszip.clone()).map_err(|e| e.to_string())?;
        let mut points = Vec::new();
        let mut records = Vec::new();
        while (points.len() as u64) < header.points {
            let batch = BATCH.min(header.points - points.len() as u64);
            records.resize((batch * header.point_bytes) as usize, 0);
            let done = points.len();
            unpacker
                .decompress_many(&mut records)
                .map_err(|e| format!("{e}, after {done} of {} points", header.points))?;
            take_points(&records, header, &mut points);
        }
        Ok::<_, String>(points)
    }));
    match unpacked {
        Ok(Ok(points)) => Ok(points),
        Ok(Err(found)) => Err(Fault::damaged(place(), format!("{} packed points", header.points), found)),
        Err(_) => Err(Fault::damaged(place(), "packed points", "data that cannot be unpacked")),
    }
}

/// Checks the sizes that the unpacker would make room for: the table of chunks, and in layered chunks (point
/// formats 6 and up) each layer. A chunk there is its first point, its number of points, the size of each
/// layer, and the layers.
fn check_chunks(bytes: &[u8], header: &Header, laszip: &LazVlr) -> Result<(), Fault> {
    let at = |place: u64| bytes.get(usize::try_from(place).ok()?..)?.first_chunk::<8>().copied();
    let mut table = at(header.data_at).map(i64::from_le_bytes).unwrap_or_default();
    if table <= header.data_at as i64 {
        table = (bytes.len() as u64).checked_sub(8).and_then(at).map(i64::from_le_bytes).unwrap_or_default();
    }
    if table > header.data_at as i64
        && let Some([_, _, _, _, count @ ..]) = at(table as u64)
    {
        let count = u64::from(u32::from_le_bytes(count));
        if count > bytes.len() as u64 {
            let expected = format!("at most {} chunks", bytes.len());
            return Err(Fault::damaged(Place::Byte(table as u64 + 4), expected, count.to_string()));
        }
    }
    let mut layers = 0;
    let mut layered = false;
    for item in laszip.items() {
        layers += match item.item_type() {
            LazItemType::Point14 => 9,
            LazItemType::RGB14 | LazItemType::WavePacket14 => 1,
            LazItemType::RGBNIR14 => 2,
            LazItemType::Byte14(count) => u64::from(count),
            _ => continue,
        };
        layered = true;
    }
    if !layered {
        return Ok(());
    }
    let mut chunk = Bytes::new(bytes.get(header.data_at as usize..).unwrap_or_default(), header.data_at);
    chunk.take(8, "the place of the table of chunks")?;
    let mut points = 0;
    while points < header.points {
        let place = chunk.place();
        chunk.take(header.point_bytes, "the first point of a chunk")?;
        let count = u64::from(chunk.u32("the number of points of a chunk")?);
        if count == 0 {
            return Err(Fault::damaged(place, "a chunk with points", "none"));
        }
        let mut size = 0;
        for _ in 0..layers {
            size += u64::from(chunk.u32("the size of a layer")?);
        }
        chunk.take(size, "the layers of a chunk")?;
        points += count;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use laz::{LasZipCompressor, LazItemRecordBuilder, LazVlrBuilder};
    use proptest::prelude::*;

    /// A LAS file with point format 0 (old) or 6 (LAS 1.4), packed or not.
    fn file(points: &[[i32; 3]], format: u8, packed: bool) -> Vec<u8> {
        let (minor, header_bytes, point_bytes) = if format == 0 { (2, 227, 20) } else { (4, 375, 30) };
        let items = LazItemRecordBuilder::default_for_point_format_id(format, 0).unwrap();
        let vlr = LazVlrBuilder::new(items).build();
        let mut record = Vec::new();
        if packed {
            let mut data = Vec::new();
            vlr.write_to(&mut data).unwrap();
            record.extend([0, 0]);
            let mut user = [0u8; 16];
            user[..LazVlr::USER_ID.len()].copy_from_slice(LazVlr::USER_ID.as_bytes());
            record.extend(user);
            record.extend(LazVlr::RECORD_ID.to_le_bytes());
            record.extend((data.len() as u16).to_le_bytes());
            record.extend([0; 32]);
            record.extend(data);
        }
        let mut bytes = b"LASF".to_vec();
        bytes.resize(24, 0);
        bytes.extend([1, minor]);
        bytes.resize(94, 0);
        bytes.extend((header_bytes as u16).to_le_bytes());
        bytes.extend(((header_bytes + record.len()) as u32).to_le_bytes());
        bytes.extend(u32::from(packed).to_le_bytes());
        bytes.push(format | if packed { 0x80 } else { 0 });
        bytes.extend((point_bytes as u16).to_le_bytes());
        bytes.extend((if format == 0 { points.len() as u32 } else { 0 }).to_le_bytes());
        bytes.resize(131, 0);
        for v in [0.01f64, 0.01, 0.5, 500_000.0, 4_000_000.0, 0.0] {
            bytes.extend(v.to_le_bytes());
        }
        bytes.resize(247, 0);
        bytes.extend((points.len() as u64).to_le_bytes());
        bytes.resize(header_bytes, 0);
        bytes.extend(&record);
        let mut raw = Vec::new();
        for p in points {
            let from = raw.len();
            raw.extend(p.iter().flat_map(|v| v.to_le_bytes()));
            raw.resize(from + point_bytes, 0);
        }
        if packed {
            let mut out = Cursor::new(bytes);
            out.set_position(out.get_ref().len() as u64);
            let mut compressor = LasZipCompressor::new(out, vlr).unwrap();
            compressor.compress_many(&raw).unwrap();
            compressor.done().unwrap();
            bytes = compressor.into_inner().into_inner();
        } else {
            bytes.extend(raw);
        }
        bytes
    }

    fn points() -> Vec<[i32; 3]> {
        (0..500).map(|i| [i * 7 % 300, -i, i / 3]).collect()
    }

    const KINDS: [(u8, bool); 4] = [(0, false), (0, true), (6, false), (6, true)];

    #[test]
    fn packed_and_plain_give_the_same_points() {
        let expected: Vec<[f64; 3]> = points()
            .iter()
            .map(|p| {
                let [x, y, z] = p.map(f64::from);
                [x * 0.01 + 500_000.0, y * 0.01 + 4_000_000.0, z * 0.5]
            })
            .collect();
        for (format, packed) in KINDS {
            assert_eq!(parse(&file(&points(), format, packed)).unwrap(), expected, "{format} {packed}");
        }
    }

    #[test]
    fn truncated_files_are_errors_at_every_place() {
        for (format, packed) in KINDS {
            let bytes = file(&points(), format, packed);
            // The table of chunks at the end of a packed file is not needed to read on.
            let needed = if packed { bytes.len() - 40 } else { bytes.len() };
            for cut in (0..needed).step_by(13) {
                assert!(parse(&bytes[..cut]).is_err(), "format {format}, packed {packed}, cut at {cut}");
            }
        }
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(
            kind in 0..4usize, flips in prop::collection::vec((any::<prop::sample::Index>(), 0..8u8), 1..4),
        ) {
            let (format, packed) = KINDS[kind];
            let mut bytes = file(&points(), format, packed);
            for (at, bit) in flips {
                let at = at.index(bytes.len());
                bytes[at] ^= 1 << bit;
            }
            if let Ok(points) = parse(&bytes) {
                prop_assert!(points.len() as u64 <= bytes.len() as u64 * LAZ_POINTS_PER_BYTE_MAX);
            }
        }
    }

    #[test]
    fn sizes_are_checked_before_room_is_made_for_them() {
        let mut bytes = file(&points(), 6, true);
        let data_at = u32::from_le_bytes(bytes[96..100].try_into().unwrap()) as usize;
        let table = i64::from_le_bytes(bytes[data_at..data_at + 8].try_into().unwrap()) as usize;
        let mut many_chunks = bytes.clone();
        many_chunks[table + 4..table + 8].copy_from_slice(&u32::MAX.to_le_bytes());
        let fault = parse(&many_chunks).unwrap_err();
        assert!(fault.problem.to_string().contains("chunks, found 4294967295"), "{}", fault.problem);
        let layers = data_at + 8 + 30 + 4;
        bytes[layers..layers + 4].copy_from_slice(&u32::MAX.to_le_bytes());
        let fault = parse(&bytes).unwrap_err();
        assert!(fault.problem.to_string().contains("the layers of a chunk"), "{}", fault.problem);
    }
}
