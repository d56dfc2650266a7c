//! `flockmap info`: what is in a file.

use flockmap_cli::outputs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use clap::Args;
use flockmap::State;
use flockmap::codec::{Content, ContentKind, Package};
use flockmap_cli::numbers::thousands;
use flockmap_cli::sources::ending;
use flockmap_cli::{json_file, program, records};
use flockmap_io::describe;
use flockmap_node::store::{inspect, is_store};
use serde_json::{Value, json};

/// Look into a record, a map, a point cloud, or a map package
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  flockmap info robot1.mcap
  flockmap info rosbag2_2026_11_23/ topics of a bag, and how to replay it
  flockmap info fr_079.bt
  flockmap info package.bin         the bytes of one map package
  flockmap info store/              what a robot has on disk for its next run

With --json the facts go to a file as well.")]
pub struct InfoArgs {
    /// A record, map, cloud, map package, or the folder of a store
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Write the facts as JSON
    #[arg(long, value_name = "FILE", value_parser = outputs::file())]
    pub json: Option<PathBuf>,
}

/// Most bytes of a file that is taken for a package.
const PACKAGE_FILE_BYTES_MAX: u64 = 64 << 20;

/// Runs the command.
pub fn run(args: &InfoArgs) -> anyhow::Result<bool> {
    let metadata =
        std::fs::metadata(&args.file).with_context(|| format!("cannot read {}", args.file.display()))?;
    let ending = ending(&args.file);
    let known = matches!(
        ending.as_deref(),
        Some("mcap" | "zstd" | "pcd" | "ply" | "las" | "laz" | "bt" | "db3" | "bag" | "yaml")
    );
    let (text, facts) = if metadata.is_dir() && is_store(&args.file) {
        store(&args.file)?
    } else if known || metadata.is_dir() {
        let description = describe(&args.file)?;
        (description.to_string() + &next_command(&description), facts(&description))
    } else {
        ensure!(
            metadata.len() <= PACKAGE_FILE_BYTES_MAX,
            "{}: no kind of file that flockmap knows: a record (.mcap, rosbag2 folder, folder of scans), the store of a robot (its folder), a map (.bt), a cloud (.pcd .ply .las .laz), or the bytes of one \
             map package, which are at most 64 MiB",
            args.file.display()
        );
        package(args)?
    };
    print!("{text}");
    json_file::write_asked(args.json.as_deref(), &facts)?;
    Ok(true)
}

/// What to do with a record.
fn next_command(description: &flockmap_io::Description) -> String {
    use flockmap_io::Content;
    let record = match &description.content {
        Content::Mcap { record, .. } => record.as_ref().map(drop),
        Content::Folder(_) => Ok(()),
        _ => return String::new(),
    };
    match record {
        Ok(()) => {
            let path = program::quoted(description.path.display().to_string());
            format!("  replay it: flockmap replay {path} --resolution 0.2 --range 30\n")
        }
        Err(error) => records::advice(error).map(|commands| commands + "\n").unwrap_or_default(),
    }
}

fn facts(description: &flockmap_io::Description) -> Value {
    use flockmap_io::Content;
    let record = |r: &flockmap_io::RecordSummary| {
        json!({
            "points_topic": r.points_topic, "scans": r.scans, "frames": r.frames, "scans_without_pose": r.scans_without_pose, "points": r.points,
            "duration_s": r.duration_s(), "path_m": r.path_m, "poses_from": r.poses_from,
            "damages": r.damages.iter().map(ToString::to_string).collect::<Vec<_>>(),
        })
    };
    let content = match &description.content {
        Content::Mcap { files, topics, record: r } => {
            let topics: Vec<Value> = topics
                .iter()
                .map(|t| json!({"name": t.name, "schema": t.schema, "encoding": t.encoding, "messages": t.messages}))
                .collect();
            json!({"kind": "mcap", "files": files, "topics": topics, "record": r.as_ref().map(record).map_err(ToString::to_string).ok(),
                "no_record_because": r.as_ref().err().map(ToString::to_string)})
        }
        Content::Folder(r) => json!({"kind": "folder", "record": record(r)}),
        Content::Cloud { points, free, voxels, dropped, bounds } => json!({
            "kind": "cloud", "points": points, "free": free, "voxels_m": voxels.map(|side| side.metres()),
            "dropped": dropped, "bounds_m": bounds,
        }),
        Content::OctoMap { resolution, nodes, leaves, free, occupied, bounds } => json!({
            "kind": "octomap", "resolution_m": resolution.metres(), "nodes": nodes, "leaves": leaves, "free": free,
            "occupied": occupied, "bounds_m": bounds,
        }),
        _ => json!({"kind": "unknown"}),
    };
    json!({"path": description.path, "bytes": description.bytes, "content": content})
}

fn store(folder: &Path) -> anyhow::Result<(String, Value)> {
    let inspection = inspect(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let bytes: u64 = inspection.segments.iter().map(|segment| segment.bytes).sum();
    let mut text = format!("{}: store of a robot, {} bytes on disk\n", folder.display(), thousands(bytes));
    if let Some(own) = inspection.identity {
        text +=
            &format!("  robot {}, swarm {}, voxels of {} m\n", own.robot, own.swarm, own.resolution.metres());
    }
    text += &format!("  {} segments\n", inspection.segments.len());
    for s in &inspection.segments {
        text += &format!("    {}: {} bytes, {} records", s.name, thousands(s.bytes), thousands(s.records));
        text += if s.is_compacted { ", snapshots that replace all before" } else { "" };
        for (count, what) in [
            (s.unreadable, "records of another version"),
            (s.skipped_bytes, "damaged bytes in between"),
            (s.torn_bytes, "bytes at its end half written"),
        ] {
            if count > 0 {
                text += &format!(", {} {what}", thousands(count));
            }
        }
        if let Some(fault) = &s.fault {
            text += &format!(", NOT USED: {fault}");
        }
        text.push('\n');
    }
    text += &format!("  {} streams\n", inspection.streams.len());
    for (stream, s) in &inspection.streams {
        let held: Vec<String> =
            s.received.intervals().iter().take(8).map(|(low, high)| format!("{low}–{high}")).collect();
        let more = if s.received.intervals().len() > 8 { " …" } else { "" };
        text += &format!(
            "    robot {} epoch {}: holds {}{more}; {} packages of {} bytes, {} chunks of snapshots of {} bytes\n",
            stream.origin,
            stream.epoch,
            if held.is_empty() { "nothing".to_owned() } else { held.join(", ") },
            thousands(s.packages),
            thousands(s.package_bytes),
            thousands(s.chunks),
            thousands(s.chunk_bytes)
        );
    }
    let segments = inspection.segments.iter().map(|s| {
        json!({"name": s.name, "bytes": s.bytes, "fault": s.fault, "is_compacted": s.is_compacted, "records": s.records,
            "unreadable": s.unreadable, "skipped_bytes": s.skipped_bytes, "torn_bytes": s.torn_bytes})
    });
    let streams = inspection.streams.iter().map(|(stream, s)| {
        json!({"origin": stream.origin.0, "epoch": stream.epoch, "held": s.received.intervals(), "packages": s.packages,
            "package_bytes": s.package_bytes, "chunks": s.chunks, "chunk_bytes": s.chunk_bytes})
    });
    let own = inspection.identity.map(
        |own| json!({"robot": own.robot.0, "swarm": own.swarm, "resolution_m": own.resolution.metres()}),
    );
    let content = json!({"kind": "store", "own": own, "segments": segments.collect::<Value>(),
        "streams": streams.collect::<Value>()});
    Ok((text, json!({"path": folder, "bytes": bytes, "content": content})))
}

fn package(args: &InfoArgs) -> anyhow::Result<(String, Value)> {
    let bytes = std::fs::read(&args.file).with_context(|| format!("cannot read {}", args.file.display()))?;
    let file = args.file.display();
    let package = Package::parse(&bytes).map_err(|error| {
        anyhow!("{file}: neither a record, a map, nor a cloud by its ending, and as a map package: {error}")
    })?;
    let content = package.decode().with_context(|| file.to_string())?;
    let h = package.header();
    let (size, min, max) = (h.region.size(), h.region.min(), h.region.max());
    let (kind, parts) = match &content {
        Content::Changes(changes) => ("changes", vec![changes]),
        Content::Snapshot(state) => ("snapshot", state.parts.iter().map(|(_, part)| part).collect()),
    };
    let states = || parts.iter().flat_map(|part| part.voxels()).map(|(_, state)| state);
    let occupied = states().filter(|state| *state == State::Occupied).count();
    let free = states().count() - occupied;
    let mut text = format!(
        "{}: map package, {} bytes, codec {}, {kind}\n  robot {}, epoch {}, index {}, base {}\n  batch {:.6} to {:.6} s, \
         voxels of {} m\n  box {min:?} to {max:?}: {} × {} × {} voxels\n  {} free and {} occupied, {:.2} bits each\n  check: right\n",
        file,
        thousands(bytes.len() as u64),
        h.codec,
        h.stream.origin,
        h.stream.epoch,
        h.index,
        h.base,
        h.batch_start.seconds(),
        h.batch_end.seconds(),
        h.resolution.metres(),
        size[0],
        size[1],
        size[2],
        thousands(free as u64),
        thousands(occupied as u64),
        bytes.len() as f64 * 8.0 / (free + occupied).max(1) as f64,
    );
    let (mut chunk_of, mut since) = (None, None);
    if let ContentKind::Snapshot { since: after, chunk, chunks, .. } = h.content {
        text += &format!("  chunk {chunk} of {chunks}");
        if after > 0 {
            text += &format!(", of what packages after {after} made");
        }
        text.push('\n');
        (chunk_of, since) = (Some([chunk, chunks]), Some(after));
    }
    let facts = json!({
        "path": args.file, "bytes": bytes.len(), "content": {
            "kind": "package", "says": kind, "codec": h.codec.name(), "origin": h.stream.origin.0, "epoch": h.stream.epoch,
            "index": h.index, "reference": h.base, "batch_start_s": h.batch_start.seconds(), "batch_end_s": h.batch_end.seconds(),
            "resolution_m": h.resolution.metres(), "box_min": [min.x, min.y, min.z], "box_size": size, "free": free,
            "occupied": occupied, "chunk_of": chunk_of, "since": since, "priority": format!("{:?}", h.priority),
        }
    });
    Ok((text, facts))
}
