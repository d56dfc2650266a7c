//! Writes the scans of a record to stdout as messages of kind 1 of `docs/sensor-input.md`, with stamp 0: what a
//! program of any language can read scans and poses from, or `nc` can feed to a node.
//!
//! usage: `record_messages RECORD > scans.bin`

use std::io::{Write, stdout};

use anyhow::{Context, Result};
use flockmap::Stamp;
use flockmap_io::{RecordOptions, open_record};
use flockmap_node::SensorMessage;

fn main() -> Result<()> {
    let path = std::env::args().nth(1).context("usage: record_messages RECORD > scans.bin")?;
    let record = open_record(&path, &RecordOptions::default())?;
    let mut out = std::io::BufWriter::new(stdout().lock());
    for frame in record.frames {
        let mut frame = frame?;
        frame.scan.stamp = Stamp(0);
        out.write_all(&SensorMessage::Scan(frame).emit())?;
    }
    Ok(out.flush()?)
}
