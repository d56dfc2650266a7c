//! The file of one simulated robot while it is written.

use std::borrow::Borrow;
use std::path::{Path, PathBuf};

use anyhow::Context;
use flockmap::grid::{BlockIndex, StateBlock, set_bits};
use flockmap::{Pose, Resolution, Scan, Stamp, Voxel};
use flockmap_io::RecordWriter;
use serde::Serialize;

use crate::document::DataTable;
use crate::numbers::thousands;

/// A record that is being written, and what it holds so far.
pub struct RobotRecord {
    writer: RecordWriter,
    facts: RecordFacts,
    first: Option<Stamp>,
    last: Option<(Stamp, [f64; 3])>,
}

/// What a finished record holds.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RecordFacts {
    pub robot: String,
    pub file: PathBuf,
    pub scans: u64,
    /// Returns of all scans.
    pub points: u64,
    /// Rays without a return that were delivered.
    pub no_returns: u64,
    /// From the first to the last scan.
    pub seconds: f64,
    /// Length of the path from scan to scan.
    pub path_m: f64,
    /// Pictures of the map.
    pub views: u64,
    /// Size of the file.
    pub file_bytes: u64,
}

impl RobotRecord {
    /// Makes `DIR/NAME.mcap`, or overwrites it.
    pub fn create(folder: &Path, robot: &str) -> anyhow::Result<Self> {
        let path = folder.join(format!("{robot}.mcap"));
        let writer = RecordWriter::create(&path, robot)?;
        let facts = RecordFacts { robot: robot.to_owned(), file: path, ..RecordFacts::default() };
        Ok(Self { writer, facts, first: None, last: None })
    }

    /// Writes a scan taken at `T_map_sensor`.
    pub fn scan(&mut self, scan: &Scan, t_map_sensor: &Pose) -> anyhow::Result<()> {
        self.writer.write(scan, t_map_sensor)?;
        let place = t_map_sensor.translation();
        if let Some((_, last)) = self.last {
            self.facts.path_m += last.iter().zip(place).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
        }
        let first = *self.first.get_or_insert(scan.stamp);
        self.last = Some((scan.stamp, place));
        self.facts.scans += 1;
        self.facts.points += scan.points.len() as u64;
        self.facts.no_returns += scan.no_returns.len() as u64;
        self.facts.seconds = scan.stamp.micros_since(first) as f64 / 1e6;
        Ok(())
    }

    /// Whether it is time for a picture of the map.
    pub fn is_view_due(&self) -> bool {
        self.last.is_some_and(|(now, _)| self.writer.is_view_due(now))
    }

    /// Writes a picture of the map as it is at the last scan.
    pub fn view(
        &mut self,
        resolution: Resolution,
        occupied: impl Iterator<Item = Voxel>,
    ) -> anyhow::Result<()> {
        if let Some((now, _)) = self.last {
            self.writer.write_view(now, resolution, occupied)?;
            self.facts.views += 1;
        }
        Ok(())
    }

    /// Ends the file.
    pub fn finish(self) -> anyhow::Result<RecordFacts> {
        self.writer.finish()?;
        Ok(RecordFacts { file_bytes: file_bytes(&self.facts.file)?, ..self.facts })
    }
}

/// Size of a file.
pub fn file_bytes(file: &Path) -> anyhow::Result<u64> {
    Ok(std::fs::metadata(file).with_context(|| format!("cannot read {}", file.display()))?.len())
}

/// The occupied voxels of blocks, in no particular order.
pub fn occupied(
    blocks: impl Iterator<Item = (BlockIndex, impl Borrow<StateBlock>)>,
) -> impl Iterator<Item = Voxel> {
    blocks.flat_map(|(index, block)| set_bits(block.borrow().occupied()).map(move |bit| index.voxel(bit)))
}

/// Makes the folder for records, and warns of files in it that belong to an earlier flight with more robots.
pub fn prepare_folder(folder: &Path, robots: usize) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let next = folder.join(format!("robot{}.mcap", robots + 1));
    if next.exists() {
        eprintln!("warning: {} is left from an earlier flight with more robots", next.display());
    }
    Ok(())
}

/// Prints what records hold.
pub fn print_table(records: &[RecordFacts]) {
    let table = DataTable::of_text(
        records,
        &[
            ("robot", &|r| r.robot.clone()),
            ("scans", &|r| thousands(r.scans)),
            ("points", &|r| thousands(r.points)),
            ("seconds", &|r| format!("{:.1}", r.seconds)),
            ("metres", &|r| format!("{:.1}", r.path_m)),
            ("MB", &|r| format!("{:.1}", r.file_bytes as f64 / 1048576.0)),
            ("file", &|r| r.file.display().to_string()),
        ],
    );
    print!("\n{table}");
}
