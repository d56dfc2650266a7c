//! Polygon files (`.ply`): the vertices, from ascii, binary_little_endian and binary_big_endian.

use crate::bytes::Bytes;
use crate::cloud::CLOUD_POINTS_MAX;
use crate::error::{Fault, Place, excerpt};

/// Longest header.
const HEADER_BYTES_MAX: usize = 64 * 1024;

#[derive(Clone, Copy, PartialEq, Debug)]
enum Format {
    Ascii,
    LittleEndian,
    BigEndian,
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Number {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    const fn size(self) -> u64 {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

#[derive(Debug)]
struct Property {
    name: String,
    number: Number,
    /// The number in front of a list that tells how long it is.
    length: Option<Number>,
}

#[derive(Debug)]
struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

struct Header {
    format: Format,
    elements: Vec<Element>,
    at: usize,
    line: u64,
}

/// The vertices of a file.
pub(crate) fn parse(bytes: &[u8]) -> Result<Vec<[f64; 3]>, Fault> {
    let header = parse_header(bytes)?;
    let mut source = match header.format {
        Format::Ascii => Source::Text {
            lines: bytes.get(header.at..).unwrap_or_default().split(|&b| b == b'\n'),
            line: header.line,
            words: Vec::new(),
        },
        format => Source::Binary {
            bytes: Bytes::new(bytes.get(header.at..).unwrap_or_default(), header.at as u64),
            big_endian: format == Format::BigEndian,
        },
    };
    let mut points = Vec::new();
    for element in &header.elements {
        let is_vertex = element.name == "vertex";
        let axis = |name: &str| element.properties.iter().position(|p| p.name == name && p.length.is_none());
        let axes = [axis("x"), axis("y"), axis("z")];
        let [Some(x), Some(y), Some(z)] = axes else {
            if is_vertex {
                let names: Vec<&str> = element.properties.iter().take(16).map(|p| p.name.as_str()).collect();
                return Err(Fault::foreign(
                    Place::Byte(0),
                    "vertices with x, y and z",
                    format!("vertices with {}", names.join(", ")),
                ));
            }
            skip(&mut source, element)?;
            continue;
        };
        if !is_vertex {
            skip(&mut source, element)?;
            continue;
        }
        if element.count > CLOUD_POINTS_MAX {
            let what = "the number of vertices";
            return Err(Fault::too_large(Place::Byte(0), what, element.count, CLOUD_POINTS_MAX));
        }
        for _ in 0..element.count {
            source.start_row()?;
            let mut point = [f64::NAN; 3];
            for (i, property) in element.properties.iter().enumerate() {
                let value = source.property(property)?;
                for (v, _) in point.iter_mut().zip([x, y, z]).filter(|(_, axis)| *axis == i) {
                    *v = value;
                }
            }
            points.push(point);
        }
        return Ok(points);
    }
    Err(Fault::foreign(Place::Byte(0), "an element \"vertex\"", "none"))
}

/// Goes past an element that comes before the vertices.
fn skip(source: &mut Source<'_, impl FnMut(&u8) -> bool>, element: &Element) -> Result<(), Fault> {
    if element.properties.is_empty() {
        return Ok(());
    }
    for _ in 0..element.count {
        source.start_row()?;
        for property in &element.properties {
            source.property(property)?;
        }
    }
    Ok(())
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
                let taken = bytes.take(number.size(), name)?;
                let mut raw = [0; 8];
                for (to, from) in raw.iter_mut().zip(taken) {
                    *to = *from;
                }
                if *big_endian && let Some(used) = raw.get_mut(..taken.len()) {
                    used.reverse();
                }
                let [a, b, c, d, ..] = raw;
                Ok(match number {
                    Number::I8 => f64::from(a as i8),
                    Number::U8 => f64::from(a),
                    Number::I16 => f64::from(i16::from_le_bytes([a, b])),
                    Number::U16 => f64::from(u16::from_le_bytes([a, b])),
                    Number::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
                    Number::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
                    Number::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
                    Number::F64 => f64::from_le_bytes(raw),
                })
            }
        }
    }
}

fn parse_header(bytes: &[u8]) -> Result<Header, Fault> {
    let mut format = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut at = 0;
    for line in 1.. {
        let place = Place::Line(line);
        let rest = bytes.get(at..).unwrap_or_default();
        let window = rest.get(..HEADER_BYTES_MAX.saturating_sub(at)).unwrap_or(rest);
        let Some(end) = window.iter().position(|&b| b == b'\n') else {
            let fault = if line == 1 { Fault::foreign } else { Fault::truncated };
            return Err(fault(place, "the header of a PLY file up to \"end_header\"", excerpt(window)));
        };
        let text = window.get(..end).unwrap_or_default();
        at += end + 1;
        let as_text = String::from_utf8_lossy(text);
        let words: Vec<&str> = as_text.split_ascii_whitespace().take(8).collect();
        if line == 1 {
            if words != ["ply"] {
                return Err(Fault::foreign(place, "\"ply\"", excerpt(text)));
            }
            continue;
        }
        let damaged = |expected: &str| Fault::damaged(place.clone(), expected, excerpt(text));
        match words.as_slice() {
            [] | ["comment" | "obj_info", ..] => {}
            ["format", name, "1.0"] => {
                format = Some(match *name {
                    "ascii" => Format::Ascii,
                    "binary_little_endian" => Format::LittleEndian,
                    "binary_big_endian" => Format::BigEndian,
                    _ => return Err(damaged("format ascii, binary_little_endian or binary_big_endian")),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| damaged("element NAME COUNT"))?;
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
            }
            ["property", kinds @ .., name] => {
                let known =
                    |name: &str| Number::from_name(name).ok_or_else(|| damaged("a type such as float"));
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
                return Ok(Header { format, elements, at, line: line + 1 });
            }
            _ => return Err(damaged("a line of a PLY header")),
        }
    }
    Err(Fault::truncated(Place::Byte(at as u64), "a header", "its end"))
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
            assert_eq!(parse(&bytes).unwrap(), [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [-7.5, -8.0, -9.0]]);
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
                prop_assert!(points.len() <= bytes.len());
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
