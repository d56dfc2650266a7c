//! Programs of others, which do a box whenever they are asked.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, anyhow, bail, ensure};

const EDT: &str = include_str!("edt_bench.py");
const DYNAMIC_EDT: &str = include_str!("dynamic_edt_bench.cpp");

/// Whose program.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Edt,
    DynamicEdt,
}

/// A program that runs.
pub(super) struct Rival {
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    folder: tempfile::TempDir,
}

impl Rival {
    /// Gives it a box before and after a scan. An error is the reason why it cannot take part.
    pub(super) fn start(
        kind: Kind,
        python: &Path,
        size: [u32; 3],
        cells: &[Vec<u8>; 2],
    ) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let path = |name: &str| folder.path().join(name);
        let mut bytes = size.map(u32::to_le_bytes).concat();
        cells.iter().for_each(|half| bytes.extend(half));
        fs::write(path("box.bin"), bytes)?;
        let mut command = match kind {
            Kind::Edt => {
                fs::write(path("edt_bench.py"), EDT)?;
                let has = Command::new(python).args(["-c", "import edt, numpy"]).output();
                let has = has.map_err(|error| anyhow!("{} does not run ({error})", python.display()))?;
                ensure!(
                    has.status.success(),
                    "{} has no edt, or no numpy: pip install edt",
                    python.display()
                );
                let mut command = Command::new(python);
                command.arg(path("edt_bench.py"));
                command
            }
            Kind::DynamicEdt => {
                compile(&path("bench"))?;
                Command::new(path("bench"))
            }
        };
        let command = command.arg(path("box.bin")).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().context("its program does not run")?;
        let input = child.stdin.take().context("its input is gone")?;
        let output = BufReader::new(child.stdout.take().context("its output is gone")?);
        Ok(Self { child, input, output, folder })
    }

    /// Milliseconds that it took.
    pub(super) fn ask(&mut self, what: &str) -> anyhow::Result<f64> {
        writeln!(self.input, "{what}")?;
        self.input.flush()?;
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        line.trim().parse().with_context(|| format!("its program says {line:?}"))
    }

    /// Squared distances of the box after the scan.
    pub(super) fn squared(&mut self) -> anyhow::Result<Vec<f32>> {
        let path: PathBuf = self.folder.path().join("squared.bin");
        self.ask(&format!("write {}", path.display()))?;
        let bytes = fs::read(path)?;
        Ok(bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }
}

impl Drop for Rival {
    fn drop(&mut self) {
        // What cannot be ended has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn compile(program: &Path) -> anyhow::Result<()> {
    let source = program.with_extension("cpp");
    fs::write(&source, DYNAMIC_EDT)?;
    let compiled = Command::new("c++")
        .args(["-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-o"])
        .args([program, &source])
        .arg("-ldynamicedt3d")
        .output()
        .map_err(|error| anyhow!("there is no C++ compiler `c++` ({error})"))?;
    if !compiled.status.success() {
        let text = String::from_utf8_lossy(&compiled.stderr);
        if text.contains("dynamicEDT3D.h") || text.contains("-ldynamicedt3d") {
            bail!("libdynamicedt3d-dev is not installed");
        }
        bail!("its program does not compile: {}", text.lines().next().unwrap_or_default());
    }
    Ok(())
}
