//! OctoMap's half, in C++.

use super::mapped::Mapped;
use anyhow::{Context, anyhow, bail, ensure};
use flockmap::codec::bytes::Reader;
use flockmap::{Changes, State, Voxel};
use flockmap_cli::measure::Times;
use flockmap_cli::progress::Progress;
use flockmap_cli::sources::Frame;
use flockmap_cli::stop;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const SOURCE: &str = include_str!("octomap_bench.cpp");

/// Its program, and the scans as it reads them.
pub(super) struct Octomap {
    folder: tempfile::TempDir,
    scans: u64,
}

impl Octomap {
    /// Compiles it. An error is the reason why it cannot take part.
    pub(super) fn new(frames: &[Frame]) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let octomap = Self { folder, scans: frames.len() as u64 };
        std::fs::write(octomap.path("octomap_bench.cpp"), SOURCE)?;
        let compiled = Command::new("c++")
            .args(["-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-o"])
            .arg(octomap.path("octomap_bench"))
            .arg(octomap.path("octomap_bench.cpp"))
            .args(["-loctomap", "-loctomath"])
            .output();
        let compiled = compiled.map_err(|error| anyhow!("there is no C++ compiler `c++` ({error})"))?;
        if !compiled.status.success() {
            let text = String::from_utf8_lossy(&compiled.stderr);
            if text.contains("octomap/octomap.h") || text.contains("-loctomap") {
                bail!("liboctomap-dev is not installed");
            }
            bail!("its program does not compile: {}", text.lines().next().unwrap_or_default());
        }
        write_scans(&octomap.path("scans.bin"), frames)?;
        Ok(octomap)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Maps the scans.
    pub(super) fn run(&self, resolution_m: f64, range_m: f64) -> anyhow::Result<Mapped> {
        let mut running = Command::new(self.path("octomap_bench"))
            .args([self.path("scans.bin"), self.path("map.bin")])
            .args([resolution_m.to_string(), range_m.to_string()])
            .stdout(Stdio::piped())
            .spawn()
            .context("OctoMap's program does not run")?;
        let progress = Progress::new("OctoMap: scans", self.scans);
        let (mut times, mut memory_bytes) = (Times::default(), 0);
        for line in BufReader::new(running.stdout.take().context("its output is gone")?).lines() {
            let line = line?;
            match line.split_once(' ') {
                Some(("scan", ms)) => {
                    times.0.push(ms.parse()?);
                    progress.step();
                }
                Some(("memory", bytes)) => memory_bytes = bytes.parse()?,
                _ => bail!("OctoMap's program says \"{line}\""),
            }
            if stop::requested() {
                running.kill()?;
                running.wait()?;
                bail!("ended by Ctrl-C");
            }
        }
        ensure!(running.wait()?.success(), "OctoMap's program failed");
        let dump = std::fs::read(self.path("map.bin"))?;
        let mut reader = Reader::new(&dump);
        let voxels = std::iter::from_fn(|| {
            let [x, y, z] = [reader.u32()?, reader.u32()?, reader.u32()?].map(|index| index as i32);
            Some((Voxel::new(x, y, z), if reader.u8()? == 1 { State::Occupied } else { State::Free }))
        });
        Ok(Mapped { times, map: Changes::from_voxels(voxels), memory_bytes })
    }
}

/// Scans as OctoMap takes them: points in the map's frame, as `f32`.
fn write_scans(path: &Path, frames: &[Frame]) -> anyhow::Result<()> {
    let mut out = std::io::BufWriter::new(std::fs::File::create(path)?);
    out.write_all(&(frames.len() as u32).to_le_bytes())?;
    for frame in frames {
        let bytes = |point: [f64; 3]| point.map(|v| (v as f32).to_le_bytes()).concat();
        out.write_all(&bytes(frame.pose.translation()))?;
        out.write_all(&((frame.scan.points.len() + frame.scan.no_returns.len()) as u32).to_le_bytes())?;
        // OctoMap cuts what lies beyond the range by itself.
        for point in frame.scan.points.iter().chain(&frame.scan.no_returns) {
            out.write_all(&bytes(frame.pose.transform(point.map(f64::from))))?;
        }
    }
    out.flush()?;
    Ok(())
}
