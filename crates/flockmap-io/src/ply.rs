//! Polygon files (`.ply`): the vertices, from ascii, binary_little_endian and binary_big_endian.

use crate::bytes::Bytes;
use crate::cloud::{CLOUD_POINTS_MAX, STATE, StoredPoints, noted_voxels};
use crate::error::{Fault, Place, excerpt};
use crate::header_lines::HeaderLines;
use crate::number::Number;

#[derive(Clone, Copy, PartialEq)]
enum Format {
    Ascii,
    Binary { big_endian: bool },
}

struct Property {
    name: String,
    number: Number,
    /// The number in front of a list that says how long it is.
    length: Option<Number>,
}

struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

/// The vertices of a file.
pub(crate) fn parse(bytes: &[u8]) -> Result<StoredPoints, Fault> {
    let mut header = HeaderLines::new(bytes);
    let mut points = StoredPoints::default();
    let (format, elements) = parse_header(&mut header, &mut points)?;
    let mut source = match format {
        Format::Ascii => Source::Text {
            lines: header.rest().split(|&b| b == b'\n'),
            line: header.line() + 1,
            words: Vec::new(),
        },
        Format::Binary { big_endian } => {
            Source::Binary { bytes: Bytes::new(header.rest(), header.at() as u64), big_endian }
        }
    };
    for element in &elements {
        let is_vertex = element.name == "vertex";
        let axis = |name: &str| element.properties.iter().position(|p| p.name == name && p.length.is_none());
        let axes = [axis("x"), axis("y"), axis("z")];
        let state_at = axis(STATE).filter(|_| is_vertex);
        points.has_states |= state_at.is_some();
        if is_vertex && axes.contains(&None) {
            let names: Vec<&str> = element.properties.iter().take(16).map(|p| p.name.as_str()).collect();
            let found = format!("vertices with {}", names.join(", "));
            return Err(Fault::foreign(Place::Byte(0), "vertices with x, y and z", found));
        }
        if is_vertex && element.count > CLOUD_POINTS_MAX {
            let what = "the number of vertices";
            return Err(Fault::too_large(Place::Byte(0), what, element.count, CLOUD_POINTS_MAX));
        }
        // Without properties its rows take no bytes, so their number is bounded by nothing.
        let rows = if element.properties.is_empty() { 0 } else { element.count };
        for _ in 0..rows {
            source.start_row()?;
            let (mut point, mut state) = ([f64::NAN; 3], None);
            for (i, property) in element.properties.iter().enumerate() {
                let value = source.property(property)?;
                for (v, _) in point.iter_mut().zip(axes).filter(|(_, axis)| *axis == Some(i)) {
                    *v = value;
                }
                if state_at == Some(i) {
                    state = Some(value);
                }
            }
            if is_vertex {
                points.push(point, state, || source.place())?;
            }
        }
        if is_vertex {
            return Ok(points);
        }
    }
    Err(Fault::foreign(Place::Byte(0), "an element \"vertex\"", "none"))
}

enum Source<'a, P: FnMut(&u8) -> bool> {
    Text { lines: core::slice::Split<'a, u8, P>, line: u64, words: Vec<&'a [u8]> },
    Binary { bytes: Bytes<'a>, big_endian: bool },
}

impl<P: FnMut(&u8) -> bool> Source<'_, P> {
    fn start_row(&mut self) -> Result<(), Fault> {
        let Self::Text { lines, line, words } = self else { return Ok(()) };
        words.clear();
        while words.is_empty() {
            let place = Place::Line(*line);
            let text = lines.next().ok_or_else(|| Fault::truncated(place, "another row", "the end"))?;
            words.extend(text.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty()).take(1 << 16));
            // Taken from the end, one by one.
            words.reverse();
            *line += 1;
        }
        Ok(())
    }

    /// The number of a property; a list is gone past.
    fn property(&mut self, property: &Property) -> Result<f64, Fault> {
        let Some(length) = property.length else { return self.number(property.number, &property.name) };
        let length = self.number(length, &property.name)?;
        let place = self.place();
        if !(0.0..=65_535.0).contains(&length) {
            let expected = "a list of at most 65,535 numbers";
            return Err(Fault::damaged(place, expected, length.to_string()));
        }
        for _ in 0..length as u32 {
            self.number(property.number, &property.name)?;
        }
        Ok(f64::NAN)
    }

    fn place(&self) -> Place {
        match self {
            Self::Text { line, .. } => Place::Line(line.saturating_sub(1)),
            Self::Binary { bytes, .. } => bytes.place(),
        }
    }

    fn number(&mut self, number: Number, name: &str) -> Result<f64, Fault> {
        let place = self.place();
        match self {
            Self::Text { words, .. } => {
                let word = words.pop().unwrap_or_default();
                core::str::from_utf8(word)
                    .ok()
                    .and_then(|w| w.parse().ok())
                    .ok_or_else(|| Fault::damaged(place, format!("a number for {name}"), excerpt(word)))
            }
            Self::Binary { bytes, big_endian } => {
                bytes.take(number.size(), name).map(|taken| number.read(taken, *big_endian))
            }
        }
    }
}

fn parse_header(
    lines: &mut HeaderLines<'_>,
    points: &mut StoredPoints,
) -> Result<(Format, Vec<Element>), Fault> {
    let mut format = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let text = lines.next("the header of a PLY file up to \"end_header\"")?;
        let as_text = String::from_utf8_lossy(text);
        let words: Vec<&str> = as_text.split_ascii_whitespace().take(8).collect();
        let damaged = |expected: &str| Fault::damaged(lines.place(), expected, excerpt(text));
        match words.as_slice() {
            ["ply"] if lines.line() == 1 => {}
            _ if lines.line() == 1 => {
                return Err(Fault::foreign(lines.place(), "\"ply\"", excerpt(text)));
            }
            ["comment", ..] => {
                let comment = as_text.trim_start().strip_prefix("comment").unwrap_or_default();
                points.voxels = noted_voxels(comment, &lines.place())?.or(points.voxels);
            }
            [] | ["obj_info", ..] => {}
            ["format", name, "1.0"] => {
                format = Some(match *name {
                    "ascii" => Format::Ascii,
                    "binary_little_endian" => Format::Binary { big_endian: false },
                    "binary_big_endian" => Format::Binary { big_endian: true },
                    _ => return Err(damaged("format ascii, binary_little_endian or binary_big_endian")),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| damaged("element NAME COUNT"))?;
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
            }
            ["property", kinds @ .., name] => {
                let known = |name: &str| number(name).ok_or_else(|| damaged("a type such as float"));
                let (number, length) = match kinds {
                    [number] => (known(number)?, None),
                    ["list", length, number] => (known(number)?, Some(known(length)?)),
                    _ => return Err(damaged("property TYPE NAME or property list TYPE TYPE NAME")),
                };
                let element =
                    elements.last_mut().ok_or_else(|| damaged("an element before its properties"))?;
                element.properties.push(Property { name: (*name).to_owned(), number, length });
            }
            ["end_header"] => {
                let format =
                    format.ok_or_else(|| damaged("a line \"format …\" before the end of the header"))?;
                return Ok((format, elements));
            }
            _ => return Err(damaged("a line of a PLY header")),
        }
    }
}

fn number(name: &str) -> Option<Number> {
    Some(match name {
        "char" | "int8" => Number::I8,
        "uchar" | "uint8" => Number::U8,
        "short" | "int16" => Number::I16,
        "ushort" | "uint16" => Number::U16,
        "int" | "int32" => Number::I32,
        "uint" | "uint32" => Number::U32,
        "float" | "float32" => Number::F32,
        "double" | "float64" => Number::F64,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ELEMENTS: &str = "comment made by a test\nelement part 2\nproperty list uchar short members\n\
        element vertex 3\nproperty uchar red\nproperty double z\nproperty float x\nproperty list uint8 int32 faces\n\
        property int y\nelement face 9\nproperty list uchar int vertex_indices\nend_header\n";

    fn forms() -> [Vec<u8>; 3] {
        let head = |format: &str| format!("ply\nformat {format} 1.0\n{ELEMENTS}").into_bytes();
        let mut ascii = head("ascii");
        ascii.extend(b"2 5 6\n0\n\n9 3 1 2 7 7 2\n9 6 4 0 5\n9 -9 -7.5 1 7 -8\n");
        let binary = |big: bool| {
            let mut bytes = head(if big { "binary_big_endian" } else { "binary_little_endian" });
            let mut put = |b: &[u8]| {
                let mut b = b.to_vec();
                if big {
                    b.reverse();
                }
                bytes.extend(b);
            };
            put(&[2]);
            put(&5i16.to_le_bytes());
            put(&6i16.to_le_bytes());
            put(&[0]);
            for (x, y, z, faces) in [(1.0f32, 2i32, 3.0f64, 2), (4.0, 5, 6.0, 0), (-7.5, -8, -9.0, 1)] {
                put(&[9]);
                put(&z.to_le_bytes());
                put(&x.to_le_bytes());
                put(&[faces]);
                for _ in 0..faces {
                    put(&7i32.to_le_bytes());
                }
                put(&y.to_le_bytes());
            }
            bytes
        };
        [ascii, binary(false), binary(true)]
    }

    #[test]
    fn all_forms_give_the_same_vertices() {
        for bytes in forms() {
            assert_eq!(parse(&bytes).unwrap().solid, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [-7.5, -8.0, -9.0]]);
        }
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(
            form in 0..3usize, cut in any::<prop::sample::Index>(),
            flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
        ) {
            let mut bytes = forms()[form].clone();
            for (at, value) in flips {
                let at = at.index(bytes.len());
                bytes[at] = value;
            }
            bytes.truncate(cut.index(bytes.len() + 1));
            if let Ok(points) = parse(&bytes) {
                prop_assert!(points.solid.len() <= bytes.len());
            }
        }
    }

    #[test]
    fn errors_name_the_place() {
        let error = |bytes: &[u8]| {
            let fault = parse(bytes).unwrap_err();
            format!("{}{}", fault.place, fault.problem)
        };
        assert!(error(b"solid\n").starts_with("line 1: cannot be used: expected \"ply\""));
        assert!(error(b"ply\nformat ascii 1.0\nelement vertex x\n").starts_with("line 3: damaged"));
        assert!(error(b"ply\nformat ascii 1.0\nend_header\n").contains("an element \"vertex\""));
        let [ascii, binary, _] = forms();
        assert!(
            error(&ascii[..ascii.len() - 6]).contains("line 20: damaged: expected a number for faces"),
            "{}",
            error(&ascii[..ascii.len() - 6])
        );
        assert!(error(&binary[..binary.len() - 1]).contains("expected 4 bytes of y, found 3 bytes"));
    }
}
