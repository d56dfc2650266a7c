//! What a store costs, as `docs/store.md` has it: `cargo run --release -p flockmap-node --example
//! store_cost -- FOLDER`.
//!
//! Two robots fly through a forest for a minute and hear each other; the first one stores. Then it starts
//! again, makes its log shorter, and starts once more.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use flockmap::{Destination, Resolution, Robot, RobotConfig, RobotId, Stamp};
use flockmap_node::store::{Identity, Store, StoreOptions};
use flockmap_node::{Log, StoreWriter};
use flockmap_worlds::{Flight, Lidar, ScanOptions, Trajectory, TrajectoryOptions, World};

const RANGE_M: f64 = 7.0;

fn main() -> anyhow::Result<()> {
    let folder: PathBuf = std::env::args_os().nth(1).context("give a new folder for the store")?.into();
    ensure!(!folder.exists(), "{} exists already", folder.display());
    let resolution = Resolution::from_metres(0.1).context("a resolution")?;
    let robot = |id, epoch| {
        let config = RobotConfig { epoch, ..RobotConfig::new(RobotId(id), resolution, RANGE_M) };
        Robot::new(config, Stamp(0))
    };
    let identity = Identity { swarm: 0, robot: RobotId(1), resolution };
    let open =
        || -> anyhow::Result<Store> { Ok(Store::open_folder(&folder, identity, StoreOptions::default())?) };
    let start = |store: Store, epoch| -> anyhow::Result<StoreWriter> {
        Ok(StoreWriter::start(Some(store.start(epoch)?), None, Log::silent()))
    };

    let mut robots = [robot(1, 1)?, robot(2, 1)?];
    let mut store = start(open()?, 1)?;
    let (noting, packages, bytes) = fly(&mut robots, &mut store)?;
    store.flush();
    let counters = store.counters();
    drop(store);
    println!("{packages} packages of {bytes} B; {} B on disk, {} syncs", counters.disk_bytes, counters.syncs);
    println!("handing them to the store: {:.1} µs a package", noting.as_secs_f64() * 1e6 / packages as f64);

    let digest =
        |robot: &Robot| -> Vec<u64> { robot.fusion().layers().map(|(_, layer)| layer.digest()).collect() };
    let restart = |epoch| -> anyhow::Result<(Robot, StoreWriter)> {
        let mut again = robot(1, epoch)?;
        let mut store = open()?;
        let began = Instant::now();
        let restored = store.restore(&mut again, Stamp(1));
        let took = began.elapsed().as_secs_f64();
        println!(
            "restored {} packages and chunks in {took:.3} s, {:.2} ms each",
            restored.packages,
            took * 1e3 / restored.packages as f64
        );
        ensure!(digest(&again) == digest(&robots[0]), "the layers are others");
        Ok((again, start(store, epoch)?))
    };
    // So many runs in which nothing was seen make it shorten its log.
    for epoch in 2..=66 {
        drop(open()?.start(epoch)?);
    }
    let (again, store) = restart(67)?;
    let (began, mut longest) = (Instant::now(), Duration::ZERO);
    while store.counters().compactions + store.counters().compactions_failed + store.counters().failures == 0
    {
        let step = Instant::now();
        store.step(&again);
        longest = longest.max(step.elapsed());
        std::thread::sleep(Duration::from_millis(1));
    }
    let after = store.counters();
    println!(
        "made shorter in {:.3} s: {} B on disk; the robot waited for {:.1} ms at the longest",
        began.elapsed().as_secs_f64(),
        after.disk_bytes,
        longest.as_secs_f64() * 1e3
    );
    ensure!(after.compactions == 1, "the log was not made shorter: {after:?}");
    drop(store);
    restart(68)?;
    Ok(())
}

/// A minute of flight; the time that storing took of the robot's, and packages and bytes stored.
fn fly(robots: &mut [Robot; 2], store: &mut StoreWriter) -> anyhow::Result<(Duration, usize, usize)> {
    let world = Arc::new(World::forest(1));
    let options = TrajectoryOptions { duration_s: 60.0, ..TrajectoryOptions::default() };
    let trajectories = Trajectory::plan(&world, 2, 1, &options)?;
    let scan = ScanOptions { range_m: RANGE_M, ..ScanOptions::default() };
    let mut flights: Vec<_> = trajectories
        .into_iter()
        .map(|trajectory| Flight::new(Arc::clone(&world), Lidar::Mid360, scan, trajectory))
        .collect();
    let (mut noting, mut packages, mut bytes) = (Duration::ZERO, 0, 0);
    loop {
        let mut now = None;
        for (robot, flight) in robots.iter_mut().zip(&mut flights) {
            let Some(frame) = flight.next() else { continue };
            robot.insert_scan(frame.scan.stamp, &frame.scan, &frame.t_map_sensor)?;
            now = now.max(Some(frame.scan.stamp));
        }
        let Some(now) = now else { return Ok((noting, packages, bytes)) };
        for from in [0, 1] {
            robots[from].handle_timeout(now);
            while let Some(transmit) = robots[from].poll_transmit(now) {
                let to = robots[1 - from].own_stream().origin;
                if matches!(transmit.to, Destination::Everyone) || transmit.to == Destination::Peer(to) {
                    robots[1 - from].handle_datagram(now, &transmit.bytes)?;
                }
            }
        }
        while let Some(event) = robots[0].poll_event() {
            match &event {
                flockmap::Event::BatchClosed { packages: own, .. } => {
                    packages += own.len();
                    bytes += own.iter().map(|package| package.bytes().len()).sum::<usize>();
                }
                flockmap::Event::Merged { package, .. } => {
                    packages += 1;
                    bytes += package.bytes().len();
                }
                _ => {}
            }
            let began = Instant::now();
            store.note(&event);
            noting += began.elapsed();
        }
    }
}
