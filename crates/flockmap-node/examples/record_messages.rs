//! Writes the scans of a record to stdout as messages of kind 1 of `docs/sensor-input.md`, with stamp 0: what a
//! program of any language can read scans and poses from, or `nc` can feed to a node. With the topic of the poses of
//! its submaps (`docs/submaps.md`) also messages of kind 6 and 7, before the scans that they count for.
//!
//! usage: `record_messages RECORD [SUBMAPS_TOPIC] > scans.bin`

use std::io::{Write, stdout};

use anyhow::{Context, Result};
use flockmap::{Stamp, SubmapId};
use flockmap_io::{RecordOptions, SubmapPose, open_record};
use flockmap_node::{SensorMessage, SubmapPoses};

fn main() -> Result<()> {
    let mut words = std::env::args().skip(1);
    let path = words.next().context("usage: record_messages RECORD [SUBMAPS_TOPIC] > scans.bin")?;
    let options = RecordOptions { submaps_topic: words.next(), ..RecordOptions::default() };
    let record = open_record(&path, &options)?;
    let (mut submaps, mut newest) = (record.submaps, SubmapId::FIRST);
    let mut out = std::io::BufWriter::new(stdout().lock());
    for frame in record.frames {
        let mut frame = frame?;
        say_submaps(&mut submaps, frame.scan.stamp, &mut newest, &mut out)?;
        frame.scan.stamp = Stamp(0);
        out.write_all(&SensorMessage::Scan(frame).emit())?;
    }
    say_submaps(&mut submaps, Stamp(i64::MAX), &mut newest, &mut out)?;
    Ok(out.flush()?)
}

/// Writes what is due of submaps. `newest`: the one that began last.
fn say_submaps(
    submaps: &mut SubmapPoses,
    until: Stamp,
    newest: &mut SubmapId,
    out: &mut impl Write,
) -> Result<()> {
    while let Some(SubmapPose { submap, t_map_submap, .. }) = submaps.take_due(until) {
        if submap > *newest {
            *newest = submap;
            out.write_all(&SensorMessage::BeginSubmap.emit())?;
        }
        out.write_all(&SensorMessage::SubmapPose(Some(submap.number()), t_map_submap).emit())?;
    }
    Ok(())
}
