//! Pictures as files: PGM and PNG.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use png::{BitDepth, ColorType, Compression, Encoder, EncodingError};

use crate::error::WriteError;

/// Rows of pixels from the top, as PNG and PGM have them.
pub(crate) enum Pixels {
    /// A byte a pixel.
    Grey(Vec<u8>),
    /// Two bytes a pixel.
    Deep(Vec<u16>),
    /// Red, green, blue.
    Colour(Vec<[u8; 3]>),
}

/// Writes a grey picture as binary PGM (`P5`), with one line of comment.
pub(crate) fn write_pgm(
    path: &Path,
    [width, height]: [usize; 2],
    grey: &[u8],
    note: &str,
) -> Result<(), WriteError> {
    let write = || {
        let mut out = BufWriter::new(File::create(path)?);
        write!(out, "P5\n# {note}\n{width} {height}\n255\n")?;
        out.write_all(grey)?;
        out.flush()
    };
    write().map_err(WriteError::io(path))
}

/// Writes a PNG; the note stands in it as its `Description`.
pub(crate) fn write_png(
    path: &Path,
    [width, height]: [usize; 2],
    pixels: &Pixels,
    note: &str,
) -> Result<(), WriteError> {
    let (colour, depth, bytes) = match pixels {
        Pixels::Grey(grey) => (ColorType::Grayscale, BitDepth::Eight, grey.clone()),
        Pixels::Deep(deep) => {
            (ColorType::Grayscale, BitDepth::Sixteen, deep.iter().flat_map(|v| v.to_be_bytes()).collect())
        }
        Pixels::Colour(colour) => (ColorType::Rgb, BitDepth::Eight, colour.concat()),
    };
    let write = || -> Result<(), EncodingError> {
        let out = BufWriter::new(File::create(path)?);
        let mut encoder = Encoder::new(out, width as u32, height as u32);
        encoder.set_color(colour);
        encoder.set_depth(depth);
        encoder.set_compression(Compression::High);
        encoder.add_text_chunk("Description".to_owned(), note.to_owned())?;
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&bytes)?;
        writer.finish()
    };
    write().map_err(|error| match error {
        EncodingError::IoError(error) => WriteError::io(path)(error),
        error => WriteError::unfit(path, "a PNG", error.to_string()),
    })
}

/// The same rows in the other order: maps count from the bottom, pictures from the top.
pub(crate) fn upside_down<T: Copy>(cells: &[T], width: usize) -> Vec<T> {
    cells.chunks(width.max(1)).rev().flatten().copied().collect()
}
