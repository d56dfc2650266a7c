//! Table IV: the time to pack a batch, and from receiving it to the fused map. Nothing else runs meanwhile,
//! and all of it on one core.

use std::time::{Duration, Instant};

use flockmap::codec::{Codec, Content, Decoder, Encoder, PACKAGE_BYTES_MAX, Package};
use flockmap::{Batch, Changes, Fusion, FusionConfig, Mapper, Packer, RobotId, SessionConfig, Stamp, Stream};
use flockmap_cli::document::{Cell, DataTable, Part, Section};
use flockmap_cli::measure::Times;
use flockmap_cli::progress::Progress;
use flockmap_cli::report::{PAPER_T_INSERT_MS, PAPER_T_PACK_MS};
use flockmap_cli::stop;

use super::flown::{Flown, LIDAR_RANGE_M};
use super::table3;

/// More of the flight says nothing new.
const SECONDS_MAX: f64 = 60.0;

/// The same batches, packed whole and cut to datagrams.
#[derive(Default)]
pub struct Measured {
    pairs: [Pair; 2],
    changes: u64,
    pub batches: u64,
    packages: u64,
    encoder: Encoder,
    decoder: Decoder,
}

#[derive(Default)]
struct Pair {
    t_pack: Times,
    /// All packages of a batch.
    t_recv2insert: Times,
}

/// One robot: what it maps, and how it holds its team-mate's map.
struct Node {
    mapper: Mapper,
    packer: Packer,
    fusions: [Fusion; 2],
}

/// Measures both robots of the forest, one after the other, on this thread.
pub fn measure(flown: &Flown) -> anyhow::Result<Measured> {
    let robot = table3::flight_robot(Codec::Paper, SessionConfig::default(), 0)?;
    let resolution = robot.mapper.resolution;
    let mut sources = flown.sources(LIDAR_RANGE_M)?;
    sources.truncate(2);
    let stream = |number: usize| Stream { origin: RobotId(number as u16 + 1), epoch: 1 };
    let mut nodes = Vec::new();
    for number in 0..sources.len() {
        let fusion = || Fusion::new(stream(number), resolution, FusionConfig::default());
        nodes.push(Node {
            mapper: Mapper::new(robot.mapper.clone())?,
            packer: Packer::new(robot.batch, stream(number), resolution, Stamp(0)),
            fusions: [fusion(), fusion()],
        });
    }
    let mut measured = Measured::default();
    let progress =
        Progress::new("scans", (flown.seconds.min(SECONDS_MAX) * 10.0) as u64 * sources.len() as u64);
    'flight: while !stop::requested() {
        for number in 0..nodes.len() {
            let Some(frame) = sources[number].frames.next() else { break 'flight };
            let now = frame.scan.stamp;
            if now.seconds() > SECONDS_MAX {
                break 'flight;
            }
            let node = &mut nodes[number];
            let report = node.mapper.insert(&frame.scan, &frame.pose, &frame.masks());
            node.packer.note_scan(now, now, &frame.pose);
            node.fusions.iter_mut().for_each(|fusion| fusion.own_scan(&node.mapper, &report));
            loop {
                let started = Instant::now();
                let Node { packer, mapper, .. } = &mut nodes[number];
                let Some((batch, changes)) = packer.close_due(now, mapper) else { break };
                let took = started.elapsed();
                measured.batches += 1;
                measured.changes += changes.len() as u64;
                if let Some(other) = nodes.get_mut(1 - number) {
                    measured.batch(other, took, &batch, &changes)?;
                }
            }
            progress.step();
        }
    }
    Ok(measured)
}

impl Measured {
    /// Packs a batch whole and cut, and merges it at the receiver.
    fn batch(
        &mut self,
        receiver: &mut Node,
        taken: Duration,
        batch: &Batch,
        changes: &Changes,
    ) -> anyhow::Result<()> {
        let index = self.packages as u32 + 1;
        let Node { mapper, fusions, .. } = receiver;
        for (is_whole, (pair, fusion)) in [true, false].into_iter().zip(self.pairs.iter_mut().zip(fusions)) {
            let started = Instant::now();
            let packages = if is_whole {
                vec![self.encoder.encode_whole(Codec::Paper, batch, index, changes)?]
            } else {
                self.encoder.encode_batch(Codec::Paper, batch, index, changes, PACKAGE_BYTES_MAX)?
            };
            pair.t_pack.add(taken + started.elapsed());
            let started = Instant::now();
            for package in &packages {
                let received = Package::parse(package.bytes())?;
                if let Content::Changes(decoded) = self.decoder.decode(&received)? {
                    let (stream, end) = (received.header().stream, received.header().batch_end);
                    fusion.apply(mapper, stream, &decoded, end, end)?;
                }
            }
            pair.t_recv2insert.add(started.elapsed());
            // Those of the second pair, cut to datagrams, count.
            self.packages = u64::from(index) - 1 + packages.len() as u64;
        }
        Ok(())
    }
}

pub fn section(measured: &Measured) -> Section {
    let [whole, datagrams] = &measured.pairs;
    let steps = [
        ("t_pack, one package a batch, as the paper", whole.t_pack.summary(), PAPER_T_PACK_MS),
        ("t_pack, cut to datagrams", datagrams.t_pack.summary(), PAPER_T_PACK_MS),
        ("t_recv2insert, one package", whole.t_recv2insert.summary(), PAPER_T_INSERT_MS),
        ("t_recv2insert, all datagrams of a batch", datagrams.t_recv2insert.summary(), PAPER_T_INSERT_MS),
    ];
    let table = DataTable::of(
        "table4",
        &steps,
        &[
            ("step", "step", &|(name, ..)| Cell::text(*name)),
            ("batches", "batches", &|(_, time, _)| Cell::count(time.count)),
            ("mean_ms", "mean, ms", &|(_, time, _)| Cell::Number(time.mean_ms, 2)),
            ("median_ms", "median, ms", &|(_, time, _)| Cell::Number(time.median_ms, 2)),
            ("p99_ms", "99 %, ms", &|(_, time, _)| Cell::Number(time.p99_ms, 2)),
            ("in_paper_ms", "in the paper, ms", &|(.., paper)| Cell::Number(*paper, 2)),
        ],
    );
    let batches = measured.batches.max(1) as f64;
    let note = format!(
        "Codec `paper`, one core of this machine, nothing else running in this program. {:.0} changed voxels and {:.1} datagrams a batch on average. \
         t_pack: changes taken, boxes found, encoded. t_recv2insert: parsed, checked, decoded, merged, fused.",
        measured.changes as f64 / batches,
        measured.packages as f64 / batches
    );
    let parts = vec![
        Part::Words(format!(
            "The forest with the settings of Table III, first {SECONDS_MAX:.0} s. The paper's times are of the computers on its drones, which it does not \
             name: a scale, not a race."
        )),
        Part::Table(table.with_note(note)),
    ];
    Section::new("table4", "Table IV: time", parts)
}
