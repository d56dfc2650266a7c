//! What a node finds of its former runs when it starts, and the epoch that it takes after them.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, anyhow, bail};
use flockmap::RobotConfig;
use flockmap_store::{EpochFault, EpochFile, Folder, Identity, Store, StoreError, StoreOptions, next_epoch};

use crate::config::value;
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
        let is_wanted = config.state.path.is_some();
        let opened = folder.as_ref().map(|folder| open_epoch_file(folder, is_wanted, robot, log));
        let mut epoch_file = opened.transpose()?.flatten();

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
            if let (EpochFault::Disk { error, .. }, Some(path)) = (&fault, &config.state.path) {
                refuse_mistake("[state] path", path, error)?;
            }
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
    if let Err(StoreError::Disk { error, .. }) = Folder::open(path) {
        refuse_mistake("[store] path", path, &error)?;
    }
    Store::open_folder(path, identity, options).map(Some).map_err(|error| anyhow!("[store] path: {error}"))
}

/// A disk that fails is no reason not to fly; a path at which nothing can ever be written is a mistake.
fn refuse_mistake(key: &str, path: &Path, error: &io::Error) -> Result<()> {
    use io::ErrorKind::{AlreadyExists, InvalidFilename, InvalidInput, NotADirectory, PermissionDenied};
    let kinds = [AlreadyExists, InvalidFilename, InvalidInput, NotADirectory, PermissionDenied];
    if kinds.contains(&error.kind()) {
        let expected = "a folder that this user may make and write to";
        bail!(value(key, format!("{} ({error})", path.display()), expected));
    }
    Ok(())
}

/// `is_wanted`: the configuration names the folder.
fn open_epoch_file(
    path: &Path,
    is_wanted: bool,
    robot: &RobotConfig,
    log: &Log,
) -> Result<Option<EpochFile>> {
    let cannot = |error: &io::Error| {
        let path = path.display();
        log.warn(format!(
            "cannot make the folder {path} for the epoch: {error}. The next run relies on the store, if there is one, and on the clock; [state] path names another folder"
        ));
    };
    let folder = match Folder::shared(path) {
        Ok(folder) => folder,
        Err(error) => {
            if is_wanted {
                refuse_mistake("[state] path", path, &error)?;
            }
            cannot(&error);
            return Ok(None);
        }
    };
    let (file, fault) = EpochFile::open(Arc::new(folder), robot.session.swarm, robot.id);
    if let Some(fault) = fault {
        log.warn(format!("in {}: {fault}", path.display()));
    }
    Ok(Some(file))
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
