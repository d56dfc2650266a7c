//! Point Cloud Data files (PCL's `.pcd`, versions .5 to .7): ascii, binary and binary_compressed.

use flockmap_grid::Pose;

use crate::error::{Fault, Place, excerpt};

/// Longest header.
const HEADER_BYTES_MAX: usize = 64 * 1024;
/// Most fields of a point.
const FIELDS_MAX: usize = 256;

/// A parsed file. Points are as stored; `viewpoint` is the pose that the header tells.
#[derive(Debug, Default)]
pub(crate) struct Parsed {
    pub(crate) points: Vec<[f64; 3]>,
    pub(crate) dropped: u64,
    pub(crate) viewpoint: Pose,
    pub(crate) viewpoint_line: u64,
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Kind {
    Float,
    Signed,
    Unsigned,
}

#[derive(Clone, Debug)]
struct Field {
    name: String,
    size: u64,
    kind: Kind,
    count: u64,
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Data {
    Ascii,
    Binary,
    Compressed,
}

#[derive(Debug)]
struct Header {
    fields: Vec<Field>,
    points: u64,
    viewpoint: Pose,
    viewpoint_line: u64,
    data: Data,
    /// Where the data begins, and in which line.
    at: usize,
    line: u64,
}

impl Header {
    fn point_bytes(&self) -> u64 {
        self.fields.iter().map(|f| f.size * f.count).sum()
    }

    fn words(&self) -> u64 {
        self.fields.iter().map(|f| f.count).sum()
    }
}

/// One coordinate: which number of a point (text), where in the point (binary), where its column begins (compressed).
#[derive(Clone, Copy)]
struct Axis {
    word: u64,
    offset: u64,
    size: u64,
    kind: Kind,
}

pub(crate) fn parse(bytes: &[u8], points_max: u64) -> Result<Parsed, Fault> {
    let header = parse_header(bytes)?;
    if header.points > points_max {
        let what = "the number of points";
        return Err(Fault::too_large(Place::Byte(header.at as u64), what, header.points, points_max));
    }
    let axes = axes(&header)?;
    let data = bytes.get(header.at..).unwrap_or_default();
    let mut parsed =
        Parsed { viewpoint: header.viewpoint, viewpoint_line: header.viewpoint_line, ..Default::default() };
    match header.data {
        Data::Ascii => parse_ascii(data, &header, axes, &mut parsed)?,
        Data::Binary => {
            let needed = header.points.saturating_mul(header.point_bytes());
            if needed > data.len() as u64 {
                return Err(Fault::truncated(
                    Place::Byte(header.at as u64),
                    format!("{needed} bytes for {} points of {} bytes", header.points, header.point_bytes()),
                    format!("{} bytes", data.len()),
                ));
            }
            parsed.points.reserve(header.points as usize);
            for point in data.chunks_exact(header.point_bytes() as usize).take(header.points as usize) {
                parsed.push(axes.map(|axis| number(point, axis.offset, axis)));
            }
        }
        Data::Compressed => {
            let columns = decompress(data, &header)?;
            parsed.points.reserve(header.points as usize);
            for i in 0..header.points {
                let mut point = [0.0; 3];
                for (v, axis) in point.iter_mut().zip(axes) {
                    // A column holds this field of all points; those before it are as long for each point as its offset.
                    *v = number(&columns, axis.offset * header.points + i * axis.size, axis);
                }
                parsed.push(point);
            }
        }
    }
    Ok(parsed)
}

impl Parsed {
    fn push(&mut self, point: [f64; 3]) {
        if point.iter().all(|v| v.is_finite()) {
            self.points.push(point);
        } else {
            self.dropped += 1;
        }
    }
}

fn parse_header(bytes: &[u8]) -> Result<Header, Fault> {
    let mut names: Vec<String> = Vec::new();
    let (mut sizes, mut kinds, mut counts) = (Vec::new(), Vec::new(), None);
    let (mut width, mut height, mut points) = (None, None, None);
    let (mut viewpoint, mut viewpoint_line) = (Pose::IDENTITY, 0);
    let mut at = 0;
    for line in 1.. {
        let place = Place::Line(line);
        let rest = bytes.get(at..).unwrap_or_default();
        let window = rest.get(..HEADER_BYTES_MAX.saturating_sub(at)).unwrap_or(rest);
        let Some(end) = window.iter().position(|&b| b == b'\n') else {
            let fault = if names.is_empty() { Fault::foreign } else { Fault::truncated };
            return Err(fault(place, "the header of a PCD file up to the line \"DATA …\"", excerpt(window)));
        };
        let text = window.get(..end).unwrap_or_default();
        at += end + 1;
        let as_text = String::from_utf8_lossy(text);
        let mut words = as_text.split_ascii_whitespace();
        let Some(key) = words.next() else { continue };
        let words: Vec<&str> = words.take(FIELDS_MAX + 1).collect();
        let found = || excerpt(text);
        let of_fields = |expected: &str| {
            Fault::damaged(place.clone(), format!("{expected} for each of {} fields", names.len()), found())
        };
        let whole = |word: &&str| word.parse::<u64>().ok().filter(|&n| n <= 1 << 40);
        let single = |what: &str| {
            words
                .first()
                .and_then(whole)
                .ok_or_else(|| Fault::damaged(place.clone(), format!("{what} as a whole number"), found()))
        };
        match key {
            _ if key.starts_with('#') => {}
            "VERSION" => {}
            "FIELDS" | "COLUMNS" => {
                if words.is_empty() || words.len() > FIELDS_MAX {
                    return Err(Fault::damaged(place, format!("1 to {FIELDS_MAX} fields"), found()));
                }
                names = words.iter().map(|&w| w.to_owned()).collect();
            }
            "SIZE" => {
                sizes = words.iter().map_while(whole).filter(|s| [1, 2, 4, 8].contains(s)).collect();
                if sizes.len() != names.len() {
                    return Err(of_fields("a size of 1, 2, 4 or 8"));
                }
            }
            "TYPE" => {
                let kind = |w: &&str| match *w {
                    "F" | "f" => Some(Kind::Float),
                    "I" | "i" => Some(Kind::Signed),
                    "U" | "u" => Some(Kind::Unsigned),
                    _ => None,
                };
                kinds = words.iter().map_while(kind).collect();
                if kinds.len() != names.len() {
                    return Err(of_fields("a type F, I or U"));
                }
            }
            "COUNT" => {
                let values: Vec<u64> = words.iter().map_while(whole).filter(|&n| n <= 65_536).collect();
                if values.len() != names.len() {
                    return Err(of_fields("a count up to 65,536"));
                }
                counts = Some(values);
            }
            "WIDTH" => width = Some(single("the width")?),
            "HEIGHT" => height = Some(single("the height")?),
            "POINTS" => points = Some(single("the number of points")?),
            "VIEWPOINT" => {
                let v: Vec<f64> = words.iter().map_while(|w| w.parse().ok()).collect();
                let pose = match v.as_slice() {
                    // The quaternion is written w first.
                    &[x, y, z, qw, qx, qy, qz] => Pose::new([x, y, z], [qx, qy, qz, qw]),
                    _ => None,
                };
                viewpoint_line = line;
                viewpoint = pose.ok_or_else(|| {
                    Fault::damaged(place.clone(), "VIEWPOINT x y z qw qx qy qz, a pose", found())
                })?;
            }
            "DATA" => {
                let data = match words.as_slice() {
                    ["ascii"] => Data::Ascii,
                    ["binary"] => Data::Binary,
                    ["binary_compressed"] => Data::Compressed,
                    _ => {
                        let expected = "DATA ascii, binary or binary_compressed";
                        return Err(Fault::foreign(place, expected, found()));
                    }
                };
                let points = points.or_else(|| width?.checked_mul(height.unwrap_or(1)));
                let Some(points) =
                    points.filter(|_| !names.is_empty() && !sizes.is_empty() && !kinds.is_empty())
                else {
                    return Err(Fault::damaged(
                        place,
                        "FIELDS, SIZE, TYPE and POINTS (or WIDTH and HEIGHT) before DATA",
                        "a header without one of them",
                    ));
                };
                let counts = counts.unwrap_or_else(|| vec![1; names.len()]);
                let fields = names
                    .into_iter()
                    .zip(sizes)
                    .zip(kinds)
                    .zip(counts)
                    .map(|(((name, size), kind), count)| Field { name, size, kind, count })
                    .collect();
                return Ok(Header { fields, points, viewpoint, viewpoint_line, data, at, line: line + 1 });
            }
            _ => {
                let fault = if names.is_empty() { Fault::foreign } else { Fault::damaged };
                return Err(fault(
                    place,
                    "a line of a PCD header (VERSION, FIELDS, SIZE, TYPE, COUNT, WIDTH, HEIGHT, VIEWPOINT, POINTS, DATA)",
                    found(),
                ));
            }
        }
    }
    Err(Fault::truncated(Place::Byte(at as u64), "a header", "its end"))
}

fn axes(header: &Header) -> Result<[Axis; 3], Fault> {
    let find = |name: &str| {
        let (mut word, mut offset) = (0, 0);
        for field in &header.fields {
            if field.name == name && field.count == 1 {
                return Ok(Axis { word, offset, size: field.size, kind: field.kind });
            }
            word += field.count;
            offset += field.size * field.count;
        }
        let fields: Vec<String> =
            header.fields.iter().take(16).map(|f| format!("{} ({})", f.name, f.count)).collect();
        Err(Fault::foreign(
            Place::Byte(0),
            "fields x, y and z with one number each",
            format!("fields {}", fields.join(", ")),
        ))
    };
    Ok([find("x")?, find("y")?, find("z")?])
}

fn parse_ascii(data: &[u8], header: &Header, axes: [Axis; 3], parsed: &mut Parsed) -> Result<(), Fault> {
    let mut lines = data.split(|&b| b == b'\n');
    let mut line = header.line;
    let mut read = 0;
    while read < header.points {
        let Some(text) = lines.next() else {
            return Err(Fault::truncated(
                Place::Line(line),
                format!("{} points", header.points),
                format!("{read} points"),
            ));
        };
        let text = text.trim_ascii();
        if !text.is_empty() {
            let mut point = [None; 3];
            let mut words = 0;
            for word in text.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty()) {
                for (v, _) in point.iter_mut().zip(axes).filter(|(_, axis)| axis.word == words) {
                    *v = core::str::from_utf8(word).ok().and_then(|w| w.parse::<f64>().ok());
                }
                words += 1;
            }
            let [Some(x), Some(y), Some(z)] = point else {
                let expected = format!("a point of {} numbers", header.words());
                return Err(Fault::damaged(Place::Line(line), expected, excerpt(text)));
            };
            if words != header.words() {
                return Err(Fault::damaged(
                    Place::Line(line),
                    format!("a point of {} numbers", header.words()),
                    format!("{words} numbers"),
                ));
            }
            parsed.push([x, y, z]);
            read += 1;
        }
        line += 1;
    }
    Ok(())
}

/// The number of this axis at a place; not a number if it lies beyond the end.
fn number(bytes: &[u8], at: u64, axis: Axis) -> f64 {
    let Some(rest) = usize::try_from(at).ok().and_then(|at| bytes.get(at..)) else { return f64::NAN };
    macro_rules! read {
        ($number:ty) => {
            rest.first_chunk().map_or(f64::NAN, |b| <$number>::from_le_bytes(*b) as f64)
        };
    }
    match (axis.kind, axis.size) {
        (Kind::Float, 4) => read!(f32),
        (Kind::Float, 8) => read!(f64),
        (Kind::Signed, 1) => read!(i8),
        (Kind::Signed, 2) => read!(i16),
        (Kind::Signed, 4) => read!(i32),
        (Kind::Signed, 8) => read!(i64),
        (Kind::Unsigned, 1) => read!(u8),
        (Kind::Unsigned, 2) => read!(u16),
        (Kind::Unsigned, 4) => read!(u32),
        (Kind::Unsigned, 8) => read!(u64),
        _ => f64::NAN,
    }
}

/// The columns of a compressed file: all x, then all y … as they lie in memory.
fn decompress(data: &[u8], header: &Header) -> Result<Vec<u8>, Fault> {
    let place = Place::Byte(header.at as u64);
    let size = |at: usize| {
        data.get(at..).and_then(|d| d.first_chunk()).map(|b| u64::from(u32::from_le_bytes(*b))).ok_or_else(
            || {
                let found = format!("{} bytes", data.len());
                Fault::truncated(place.clone(), "8 bytes: the packed and the unpacked size", found)
            },
        )
    };
    let (packed, unpacked) = (size(0)?, size(4)?);
    let needed = header.points.saturating_mul(header.point_bytes());
    if unpacked != needed {
        return Err(Fault::damaged(
            place,
            format!("{needed} bytes for {} points of {} bytes", header.points, header.point_bytes()),
            format!("{unpacked} bytes unpacked"),
        ));
    }
    let rest = data.get(8..).unwrap_or_default();
    let Some(rest) = usize::try_from(packed).ok().and_then(|n| rest.get(..n)) else {
        let found = format!("{} bytes", rest.len());
        return Err(Fault::truncated(place, format!("{packed} packed bytes"), found));
    };
    lzf_decompress(rest, unpacked, header.at as u64 + 8)
}

/// LibLZF's form: a control byte below 32 is followed by that many bytes + 1 as they are; otherwise its upper three bits
/// (7: plus the next byte) are a length − 2, and its lower five with the next byte a distance − 1 back.
fn lzf_decompress(packed: &[u8], size: u64, base: u64) -> Result<Vec<u8>, Fault> {
    // A byte unpacks to at most 264 / 3: a header cannot ask for more than the data can fill.
    if size > packed.len() as u64 * 88 + 64 {
        return Err(Fault::damaged(
            Place::Byte(base),
            format!("packed data for {size} bytes"),
            format!("{} bytes of it", packed.len()),
        ));
    }
    let mut out: Vec<u8> = Vec::with_capacity(size as usize);
    let mut at = 0;
    let broken = |at: usize, found: &str| {
        Fault::damaged(Place::Byte(base + at as u64), "LZF data as PCL packs it", found)
    };
    while let Some(&control) = packed.get(at) {
        let start = at;
        at += 1;
        if control < 32 {
            let end = at + usize::from(control) + 1;
            out.extend_from_slice(packed.get(at..end).ok_or_else(|| broken(start, "the end of the data"))?);
            at = end;
        } else {
            let mut next = || {
                let byte = packed.get(at).copied().ok_or_else(|| broken(start, "the end of the data"));
                at += 1;
                byte.map(usize::from)
            };
            let mut length = usize::from(control >> 5) + 2;
            if control >> 5 == 7 {
                length += next()?;
            }
            let distance = (usize::from(control & 31) << 8 | next()?) + 1;
            let from =
                out.len().checked_sub(distance).ok_or_else(|| broken(start, "a copy from before it"))?;
            for i in from..from + length {
                let byte = out.get(i).copied().unwrap_or_default();
                out.push(byte);
            }
        }
        if out.len() as u64 > size {
            return Err(broken(start, "more than the unpacked size"));
        }
    }
    if out.len() as u64 != size {
        return Err(broken(at, &format!("{} of {size} bytes", out.len())));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn file(data: &str, body: &[u8], points: usize) -> Vec<u8> {
        let mut bytes = format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS label z x rgb y\nSIZE 2 8 4 1 4\nTYPE U F F U I\nCOUNT 1 1 1 3 1\n\
             WIDTH {points}\nHEIGHT 1\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
        .into_bytes();
        bytes.extend_from_slice(body);
        bytes
    }

    fn row(p: [i32; 3]) -> [Vec<u8>; 5] {
        [
            vec![9, 9],
            f64::from(p[2]).to_le_bytes().to_vec(),
            (p[0] as f32).to_le_bytes().to_vec(),
            vec![1, 2, 3],
            p[1].to_le_bytes().to_vec(),
        ]
    }

    /// Packs without looking for repeats, and one byte run to have a copy.
    fn lzf(data: &[u8]) -> Vec<u8> {
        data.chunks(32).flat_map(|c| [&[c.len() as u8 - 1], c].concat()).collect()
    }

    fn three_forms(points: &[[i32; 3]]) -> [Vec<u8>; 3] {
        let text: String = points.iter().map(|p| format!("9 {} {} 1 2 3 {}\n", p[2], p[0], p[1])).collect();
        let binary: Vec<u8> = points.iter().flat_map(|&p| row(p).concat()).collect();
        let columns: Vec<u8> =
            (0..5).flat_map(|f| points.iter().flat_map(move |&p| row(p)[f].clone())).collect();
        let packed = lzf(&columns);
        let mut compressed = (packed.len() as u32).to_le_bytes().to_vec();
        compressed.extend((columns.len() as u32).to_le_bytes());
        compressed.extend(packed);
        [
            file("ascii", text.as_bytes(), points.len()),
            file("binary", &binary, points.len()),
            file("binary_compressed", &compressed, points.len()),
        ]
    }

    proptest! {
        #[test]
        fn all_forms_give_the_same_points(points in prop::collection::vec([-1000i32..1000, -1000..1000, -1000..1000], 0..50)) {
            let expected: Vec<[f64; 3]> = points.iter().map(|p| p.map(f64::from)).collect();
            for bytes in three_forms(&points) {
                let parsed = parse(&bytes, 100).unwrap();
                prop_assert_eq!(&parsed.points, &expected);
                prop_assert_eq!(parsed.viewpoint.translation(), [1.0, 2.0, 3.0]);
            }
        }

        #[test]
        fn damaged_files_never_panic(
            form in 0..3usize, cut in any::<prop::sample::Index>(),
            flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
        ) {
            let points: Vec<[i32; 3]> = (0..40).map(|i| [i, 2 * i, -i]).collect();
            let mut bytes = three_forms(&points)[form].clone();
            for (at, value) in flips {
                let at = at.index(bytes.len());
                bytes[at] = value;
            }
            bytes.truncate(cut.index(bytes.len() + 1));
            if let Ok(parsed) = parse(&bytes, 1000) {
                prop_assert!(parsed.points.len() <= 1000);
            }
        }

        #[test]
        fn lzf_takes_random_bytes(data in prop::collection::vec(any::<u8>(), 0..300), size in 0..5000u64) {
            if let Ok(out) = lzf_decompress(&data, size, 0) {
                prop_assert_eq!(out.len() as u64, size);
            }
        }
    }

    #[test]
    fn lzf_copies_may_overlap_themselves() {
        // "ab", then 2 + 7 + 3 bytes from 2 back.
        let out = lzf_decompress(&[1, b'a', b'b', 7 << 5, 3, 1], 14, 0).unwrap();
        assert_eq!(out, b"ababababababab");
    }

    #[test]
    fn points_that_are_no_numbers_are_dropped_and_counted() {
        let text = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA ascii\nnan 1 2\n1 2 3\n";
        let parsed = parse(text.as_bytes(), 10).unwrap();
        assert_eq!((parsed.points, parsed.dropped), (vec![[1.0, 2.0, 3.0]], 1));
    }

    #[test]
    fn errors_name_the_line() {
        let error = |text: &str| {
            let fault = parse(text.as_bytes(), 10).unwrap_err();
            format!("{}{}", fault.place, fault.problem)
        };
        assert!(error("ply\nformat ascii 1.0\n").starts_with("line 1: cannot be used"));
        assert!(error("FIELDS x y\nSIZE 4\n").starts_with("line 2: damaged: expected a size"));
        let head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\n";
        assert!(error(&format!("{head}DATA zip\n")).starts_with("line 5"));
        assert!(error(&format!("{head}DATA ascii\n1 2 3\n4 5\n")).starts_with("line 7: damaged"));
        assert!(error(&format!("{head}DATA ascii\n1 2 3\n")).contains("2 points, found 1 points"));
        assert!(error(&format!("{head}DATA binary\nabc")).contains("expected 24 bytes"));
        assert!(error(&head.replace("POINTS 2", "POINTS 11\nDATA ascii")).contains("is 11, the limit is 10"));
        assert!(error("FIELDS x y w\nSIZE 4 4 4\nTYPE F F F\nPOINTS 0\nDATA ascii\n").contains("w (1)"));
    }
}
