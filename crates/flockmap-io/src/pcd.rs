//! Point Cloud Data files (PCL's `.pcd`, versions .5 to .7): ascii, binary and binary_compressed.

use std::borrow::Cow;

use flockmap_grid::Pose;

use crate::bytes::Bytes;
use crate::cloud::{STATE, StoredPoints, noted_voxels};
use crate::error::{Fault, Place, excerpt};
use crate::header_lines::HeaderLines;
use crate::lzf;
use crate::number::Number;

/// Most fields of a point.
const FIELDS_MAX: usize = 256;

/// A parsed file; `viewpoint` is the pose in the header.
#[derive(Debug, Default)]
pub(crate) struct Parsed {
    pub(crate) points: StoredPoints,
    pub(crate) viewpoint: Pose,
    pub(crate) viewpoint_line: u64,
}

/// A field of each point: `count` numbers of `size` bytes of the type F, I or U.
struct Field {
    name: String,
    size: u64,
    kind: char,
    count: u64,
}

impl Field {
    const fn bytes(&self) -> u64 {
        self.size * self.count
    }

    /// The type of its numbers; `None` for floats of one or two bytes.
    const fn number(&self) -> Option<Number> {
        Some(match (self.kind, self.size) {
            ('F', 4) => Number::F32,
            ('F', 8) => Number::F64,
            ('I', 1) => Number::I8,
            ('I', 2) => Number::I16,
            ('I', 4) => Number::I32,
            ('I', 8) => Number::I64,
            ('U', 1) => Number::U8,
            ('U', 2) => Number::U16,
            ('U', 4) => Number::U32,
            ('U', 8) => Number::U64,
            _ => return None,
        })
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Data {
    Ascii,
    Binary,
    Compressed,
}

/// What the header says of the data.
struct Layout {
    data: Data,
    points: u64,
    /// Bytes and numbers of a point.
    point_bytes: u64,
    words: u64,
    axes: [Axis; 3],
    state: Option<Axis>,
}

/// One coordinate, or the state: which number of a point (text), where in the point (binary), where its
/// column begins (compressed).
#[derive(Clone, Copy)]
struct Axis {
    word: u64,
    offset: u64,
    size: u64,
    number: Option<Number>,
}

pub(crate) fn parse(bytes: &[u8], points_max: u64) -> Result<Parsed, Fault> {
    let mut lines = HeaderLines::new(bytes);
    let mut parsed = Parsed::default();
    let layout = parse_header(&mut lines, &mut parsed)?;
    let place = Place::Byte(lines.at() as u64);
    if layout.points > points_max {
        return Err(Fault::too_large(place, "the number of points", layout.points, points_max));
    }
    let data = lines.rest();
    if layout.data == Data::Ascii {
        parse_ascii(data, lines.line() + 1, &layout, &mut parsed)?;
        return Ok(parsed);
    }
    let needed = layout.points.saturating_mul(layout.point_bytes);
    let points_of = || format!("{needed} bytes for {} points of {} bytes", layout.points, layout.point_bytes);
    let is_columns = layout.data == Data::Compressed;
    let data = if is_columns {
        Cow::Owned(unpack(data, lines.at() as u64, needed, points_of)?)
    } else if needed > data.len() as u64 {
        return Err(Fault::truncated(place, points_of(), format!("{} bytes", data.len())));
    } else {
        Cow::Borrowed(data)
    };
    parsed.points.solid.reserve(layout.points as usize);
    for i in 0..layout.points {
        let number = |axis: Axis| {
            // A column holds one field of all points; those before it are as long for each point as its offset.
            let at = if is_columns {
                axis.offset * layout.points + i * axis.size
            } else {
                i * layout.point_bytes + axis.offset
            };
            let number = data.get(at as usize..).unwrap_or_default();
            axis.number.map_or(f64::NAN, |n| n.read(number, false))
        };
        parsed.points.push(layout.axes.map(number), layout.state.map(number), || place.clone())?;
    }
    Ok(parsed)
}

fn parse_header(lines: &mut HeaderLines<'_>, parsed: &mut Parsed) -> Result<Layout, Fault> {
    let mut fields: Vec<Field> = Vec::new();
    let (mut width, mut height, mut points) = (None, None, None);
    loop {
        let text = lines.next("the header of a PCD file up to the line \"DATA …\"")?;
        let as_text = String::from_utf8_lossy(text);
        let mut words = as_text.split_ascii_whitespace();
        let Some(key) = words.next() else { continue };
        let words: Vec<&str> = words.take(FIELDS_MAX + 1).collect();
        let single = |into: &mut Option<u64>, what: &str| {
            *into = words.first().and_then(|w| whole(w));
            into.map(drop).ok_or_else(|| format!("{what} as a whole number"))
        };
        let read = match key {
            _ if key.starts_with('#') => {
                let comment = as_text.trim_start().strip_prefix('#').unwrap_or_default();
                parsed.points.voxels = noted_voxels(comment, &lines.place())?.or(parsed.points.voxels);
                Ok(())
            }
            "VERSION" => Ok(()),
            "FIELDS" | "COLUMNS" => {
                fields = words
                    .iter()
                    .map(|&name| Field { name: name.to_owned(), size: 0, kind: ' ', count: 1 })
                    .collect();
                let fits = (1..=FIELDS_MAX).contains(&fields.len());
                fits.then_some(()).ok_or_else(|| format!("1 to {FIELDS_MAX} fields"))
            }
            "SIZE" => {
                let size = |w: &str| whole(w).filter(|s| [1, 2, 4, 8].contains(s));
                set(&mut fields, &words, size, |f, size| f.size = size, "a size of 1, 2, 4 or 8")
            }
            "TYPE" => {
                let kind = |w: &str| {
                    Some(w.to_ascii_uppercase()).filter(|w| ["F", "I", "U"].contains(&w.as_str()))?.pop()
                };
                set(&mut fields, &words, kind, |f, kind| f.kind = kind, "a type F, I or U")
            }
            "COUNT" => {
                let count = |w: &str| whole(w).filter(|&n| n <= 65_536);
                set(&mut fields, &words, count, |f, count| f.count = count, "a count up to 65,536")
            }
            "WIDTH" => single(&mut width, "the width"),
            "HEIGHT" => single(&mut height, "the height"),
            "POINTS" => single(&mut points, "the number of points"),
            "VIEWPOINT" => {
                parsed.viewpoint_line = lines.line();
                let pose = viewpoint(&words).map(|pose| parsed.viewpoint = pose);
                pose.ok_or_else(|| "VIEWPOINT x y z qw qx qy qz, a pose".to_owned())
            }
            "DATA" => {
                let data = match words.as_slice() {
                    ["ascii"] => Data::Ascii,
                    ["binary"] => Data::Binary,
                    ["binary_compressed"] => Data::Compressed,
                    _ => {
                        let expected = "DATA ascii, binary or binary_compressed";
                        return Err(Fault::foreign(lines.place(), expected, excerpt(text)));
                    }
                };
                let points = points.or_else(|| width?.checked_mul(height.unwrap_or(1)));
                let is_whole = fields.first().is_some_and(|f| f.size > 0 && f.kind != ' ');
                let Some(points) = points.filter(|_| is_whole) else {
                    let expected = "FIELDS, SIZE, TYPE and POINTS (or WIDTH and HEIGHT) before DATA";
                    return Err(Fault::damaged(lines.place(), expected, "a header without one of them"));
                };
                let state = fields.iter().any(|f| f.name == STATE && f.count == 1);
                parsed.points.has_states = state;
                return Ok(Layout {
                    data,
                    points,
                    point_bytes: fields.iter().map(Field::bytes).sum(),
                    words: fields.iter().map(|f| f.count).sum(),
                    axes: [axis(&fields, "x")?, axis(&fields, "y")?, axis(&fields, "z")?],
                    state: if state { Some(axis(&fields, STATE)?) } else { None },
                });
            }
            _ => {
                let fault = if fields.is_empty() { Fault::foreign } else { Fault::damaged };
                let expected = "a line of a PCD header (VERSION, FIELDS, SIZE, TYPE, COUNT, WIDTH, HEIGHT, VIEWPOINT, POINTS, DATA)";
                return Err(fault(lines.place(), expected, excerpt(text)));
            }
        };
        read.map_err(|expected| Fault::damaged(lines.place(), expected, excerpt(text)))?;
    }
}

fn whole(word: &str) -> Option<u64> {
    word.parse().ok().filter(|&n| n <= 1 << 40)
}

/// Sets something of each field. The words up to the first that says nothing must be as many as the fields.
fn set<T>(
    fields: &mut [Field],
    words: &[&str],
    parse: impl Fn(&str) -> Option<T>,
    set: impl Fn(&mut Field, T),
    expected: &str,
) -> Result<(), String> {
    let values: Vec<T> = words.iter().map_while(|w| parse(w)).collect();
    if values.len() != fields.len() {
        return Err(format!("{expected} for each of {} fields", fields.len()));
    }
    fields.iter_mut().zip(values).for_each(|(field, value)| set(field, value));
    Ok(())
}

fn viewpoint(words: &[&str]) -> Option<Pose> {
    let numbers: Vec<f64> = words.iter().map_while(|w| w.parse().ok()).collect();
    // The quaternion is written w first.
    let &[x, y, z, qw, qx, qy, qz] = numbers.as_slice() else { return None };
    Pose::new([x, y, z], [qx, qy, qz, qw])
}

fn axis(fields: &[Field], name: &str) -> Result<Axis, Fault> {
    if let Some(at) = fields.iter().position(|f| f.name == name && f.count == 1) {
        let (before, from) = fields.split_at(at);
        let (size, number) = from.first().map_or((0, None), |f| (f.size, f.number()));
        let word = before.iter().map(|f| f.count).sum();
        return Ok(Axis { word, offset: before.iter().map(Field::bytes).sum(), size, number });
    }
    let found: Vec<String> = fields.iter().take(16).map(|f| format!("{} ({})", f.name, f.count)).collect();
    let expected = "fields x, y and z with one number each";
    Err(Fault::foreign(Place::Byte(0), expected, format!("fields {}", found.join(", "))))
}

fn parse_ascii(data: &[u8], first: u64, layout: &Layout, parsed: &mut Parsed) -> Result<(), Fault> {
    let mut lines = data.split(|&b| b == b'\n').zip(first..);
    let (mut read, mut last) = (0, first);
    while read < layout.points {
        let Some((text, line)) = lines.next() else {
            let expected = format!("{} points", layout.points);
            return Err(Fault::truncated(Place::Line(last), expected, format!("{read} points")));
        };
        last = line + 1;
        let text = text.trim_ascii();
        if text.is_empty() {
            continue;
        }
        let words = || text.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty());
        let number = |word| core::str::from_utf8(word).ok()?.parse::<f64>().ok();
        let value = |axis: Axis| words().nth(axis.word as usize).and_then(number);
        let (point, words) = (layout.axes.map(value), words().count());
        let found = match point {
            [Some(x), Some(y), Some(z)] if words as u64 == layout.words => {
                // A word that is no number is no state either.
                let state = layout.state.map(|axis| value(axis).unwrap_or(f64::NAN));
                parsed.points.push([x, y, z], state, || Place::Line(line))?;
                read += 1;
                continue;
            }
            [Some(_), Some(_), Some(_)] => format!("{words} numbers"),
            _ => excerpt(text),
        };
        let expected = format!("a point of {} numbers", layout.words);
        return Err(Fault::damaged(Place::Line(line), expected, found));
    }
    Ok(())
}

/// The columns of a compressed file: all x, then all y … as they lie in memory.
fn unpack(data: &[u8], at: u64, needed: u64, points_of: impl Fn() -> String) -> Result<Vec<u8>, Fault> {
    let mut data = Bytes::new(data, at);
    let place = data.place();
    let packed = data.u32("the packed size")?;
    let unpacked = u64::from(data.u32("the unpacked size")?);
    if unpacked != needed {
        return Err(Fault::damaged(place, points_of(), format!("{unpacked} bytes unpacked")));
    }
    let base = at + data.at() as u64;
    lzf::decompress(data.take(packed.into(), "packed points")?, unpacked, base)
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
                prop_assert_eq!(&parsed.points.solid, &expected);
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
                prop_assert!(parsed.points.solid.len() <= 1000);
            }
        }
    }

    #[test]
    fn points_that_are_no_numbers_are_read_as_such() {
        let text = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA ascii\nnan 1 2\n1 2 3\n";
        let [first, second] = parse(text.as_bytes(), 10).unwrap().points.solid[..] else {
            panic!("two points")
        };
        assert!(first[0].is_nan() && first[1..] == [1.0, 2.0] && second == [1.0, 2.0, 3.0], "{first:?}");
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
