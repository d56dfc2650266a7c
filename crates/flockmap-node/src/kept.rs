//! What a node finds of its former runs when it starts, and the epoch that it takes after them.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use flockmap::RobotConfig;
use flockmap_store::{EpochFile, Folder, Identity, Store, StoreOptions, next_epoch};

use crate::{Log, NodeConfig};

/// 2026-01-01: a machine that shows an earlier time has lost it.
const EARLIEST_SECONDS: u64 = 1_767_225_600;

/// What is on disk, and the epoch of this run, which is safe there as far as a disk takes it.
pub(crate) struct Kept {
    pub(crate) epoch: u64,
    pub(crate) epoch_file: Option<EpochFile>,
    pub(crate) store: Option<Store>,
}

impl Kept {
    /// A disk that fails is logged, and no reason not to fly.
    pub(crate) fn open(config: &NodeConfig, robot: &RobotConfig, random: u32, log: &Log) -> Result<Self> {
        let store = open_store(config, robot)?;
        let folder = config.state_folder(|name| std::env::var_os(name));
        if folder.is_none() && store.is_none() {
            log.warn("there is no home folder, so that the epoch of this run is kept nowhere and the next one relies on the clock: give [state] path");
        }
        let mut epoch_file = folder.as_ref().and_then(|folder| open_epoch_file(folder, robot, log));

        let last =
            epoch_file.as_ref().and_then(EpochFile::last).max(store.as_ref().and_then(Store::last_epoch));
        let seconds = config.epoch.map_or_else(seconds_since_1970, u64::from);
        if last.is_none() && config.epoch.is_none() && seconds < EARLIEST_SECONDS {
            log.warn(
                "the clock of this machine is years behind, and no former run is known here: if team-mates know one, this robot begins anew when it hears of it",
            );
        }
        let epoch = next_epoch(last, seconds, random)
            .with_context(|| exhausted(config, folder, epoch_file.as_ref()))?;
        if let Some(Err(fault)) = epoch_file.as_mut().map(|file| file.keep(epoch)) {
            log.warn(format!("{fault}. The next run relies on the store, if there is one, and on the clock"));
        }
        Ok(Self { epoch, epoch_file, store })
    }
}

fn open_store(config: &NodeConfig, robot: &RobotConfig) -> Result<Option<Store>> {
    let section = &config.store;
    let Some(path) = &section.path else { return Ok(None) };
    let identity =
        Identity { swarm: robot.session.swarm, robot: robot.id, resolution: robot.mapper.resolution };
    let options = StoreOptions {
        bytes_max: section.bytes_max,
        sync_period: Duration::from_millis(section.sync_ms.into()),
    };
    Ok(Some(Store::open_folder(path, identity, options)?))
}

fn open_epoch_file(path: &PathBuf, robot: &RobotConfig, log: &Log) -> Option<EpochFile> {
    let cannot = |error: &io::Error| {
        let path = path.display();
        log.warn(format!(
            "cannot make the folder {path} for the epoch: {error}. The next run relies on the store, if there is one, and on the clock; [state] path names another folder"
        ));
    };
    let folder = Folder::shared(path).inspect_err(cannot).ok()?;
    let (file, fault) = EpochFile::open(Arc::new(folder), robot.session.swarm, robot.id);
    if let Some(fault) = fault {
        log.warn(format!("in {}: {fault}", path.display()));
    }
    Some(file)
}

/// What to do where there is no higher epoch.
fn exhausted(config: &NodeConfig, folder: Option<PathBuf>, file: Option<&EpochFile>) -> String {
    let file = folder.zip(file).map(|(folder, file)| folder.join(file.name()));
    let places = file.iter().chain(&config.store.path);
    let places: Vec<String> = places.map(|path| path.display().to_string()).collect();
    format!(
        "robot {} has no epoch left: remove {}, with what it has on disk of former maps. Who has heard the last run takes the next one for an older one: give the robot \
         another id, or start the whole swarm again",
        config.id,
        places.join(" and ")
    )
}

fn seconds_since_1970() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}
