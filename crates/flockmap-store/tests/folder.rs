//! Real folders: who can look into them, and what a node does with those that it cannot use.

mod common;

use std::path::PathBuf;
use std::sync::Arc;

use common::{OPTIONS, identity};
use flockmap::{Robot, RobotConfig, RobotId, Stamp};
use flockmap_store::{
    EpochFile, Folder, Identity, Notice, Store, StoreError, StoreOptions, inspect, is_store,
};

/// A folder for one test, gone at its end.
struct Place(PathBuf);

impl Place {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("flockmap-store-{name}-{}", std::process::id()));
        // What a killed test left.
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[cfg(unix)]
mod rights {
    use super::*;
    use flockmap::Event;
    use std::os::unix::fs::PermissionsExt;
    use std::path::Path;

    fn mode(path: &Path) -> u32 {
        std::fs::metadata(path).unwrap().permissions().mode() & 0o777
    }

    /// Something of everything that a store writes: segments, a compacted one, an unfinished one; and the
    /// file of an epoch.
    fn write_all(path: &Path) -> Vec<Notice> {
        for epoch in 1..=65 {
            drop(Store::open_folder(path, identity(), OPTIONS).unwrap().start(epoch).unwrap());
        }
        let mut store = Store::open_folder(path, identity(), OPTIONS).unwrap().start(66).unwrap();
        let robot = Robot::new(RobotConfig { epoch: 66, ..common::swarm::config(1) }, Stamp(0)).unwrap();
        let mut compaction = store.begin_compaction().unwrap();
        let unfinished: Vec<_> = std::fs::read_dir(path)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.extension().is_some_and(|end| end == "unfinished"))
            .collect();
        assert_eq!(unfinished.len(), 1);
        assert_eq!(mode(&unfinished[0]), 0o600);
        while compaction.step(&robot) {}
        store.end_compaction(compaction.finish());
        assert_eq!(store.counters().compactions, 1);
        store.note(Stamp(0), &Event::SameIdentity);
        let folder = Arc::new(Folder::shared(path).unwrap());
        EpochFile::open(folder, 0, RobotId(1)).0.keep(1).unwrap();
        std::iter::from_fn(|| store.poll_notice()).collect()
    }

    fn check_files(path: &Path, expected: usize) {
        let files: Vec<_> = std::fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path()).collect();
        for file in &files {
            assert_eq!(mode(file), 0o600, "{}", file.display());
        }
        assert_eq!(files.len(), expected, "{files:?}");
    }

    #[test]
    fn what_is_made_only_its_owner_can_look_into() {
        let place = Place::new("rights");
        let path = place.0.join("above/store");
        assert_eq!(write_all(&path), []);
        for folder in [&path, &place.0.join("above")] {
            assert_eq!(mode(folder), 0o700, "{}", folder.display());
        }
        // The compacted segment, the one behind it, the lock and the epoch.
        check_files(&path, 4);
    }

    #[test]
    fn a_folder_that_others_can_look_into_is_told_once_and_its_files_are_still_the_owners() {
        let place = Place::new("wide");
        for rights in [0o755, 0o750, 0o711, 0o777] {
            let path = place.0.join(format!("{rights:o}"));
            std::fs::create_dir(&path).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(rights)).unwrap();
            let notices = write_all(&path);
            let [Notice::Warning(text)] = &notices[..] else { panic!("{rights:o}: {notices:?}") };
            assert!(text.contains(&format!("chmod 700 {}", path.display())), "{text}");
            assert_eq!(mode(&path), rights, "it is the user's");
            check_files(&path, 4);
        }
    }
}

/// What a store says that does not work.
fn off(path: PathBuf) -> String {
    let store = Store::open_folder(path, identity(), OPTIONS).unwrap();
    assert_eq!(store.last_epoch(), None);
    let mut store = store.start(7).unwrap();
    assert_eq!(store.counters().failures, 1);
    let notices: Vec<_> = std::iter::from_fn(|| store.poll_notice()).collect();
    let [Notice::Off(text)] = &notices[..] else { panic!("{notices:?}") };
    assert!(text.contains("flies on in memory"), "{text}");
    text.clone()
}

#[test]
fn a_folder_that_cannot_be_made_or_locked_stops_no_robot() {
    let place = Place::new("off");
    let file = place.0.join("file");
    std::fs::write(&file, "no folder").unwrap();
    assert!(off(file.clone()).contains(&file.display().to_string()));
    assert!(off(file.join("below")).contains("file/below"));
    // The lock is no file.
    std::fs::create_dir_all(place.0.join("store/lock")).unwrap();
    assert!(off(place.0.join("store")).contains("cannot open the folder"));
}

#[test]
fn a_store_is_of_one_robot_one_version_and_one_process() {
    let place = Place::new("one");
    let folder = place.0.join("store");
    let disk = Arc::new(Folder::open(&folder).unwrap());
    let error = Store::open_folder(&folder, identity(), OPTIONS).unwrap_err();
    assert!(matches!(error, StoreError::InUse(_)), "{error}");
    let store = Store::open(disk.clone(), identity(), OPTIONS).unwrap();
    assert_eq!(store.last_epoch(), None);
    drop(store.start(7).unwrap());
    let store = Store::open(disk.clone(), identity(), OPTIONS).unwrap();
    let error = store.start(7).unwrap_err().to_string();
    assert_eq!(error, "store: epoch 7 was used before: the last one was 7, give a higher one");

    let other = Identity { robot: RobotId(2), ..identity() };
    let error = Store::open(disk.clone(), other, OPTIONS).unwrap_err();
    assert!(matches!(error, StoreError::Foreign { .. }), "{error}");
    let few = StoreOptions { bytes_max: 1_000, ..OPTIONS };
    let error = Store::open(disk.clone(), identity(), few).unwrap_err().to_string();
    assert_eq!(error, "store: bytes_max is 1000, expected at least 65536");
    assert!(is_store(&folder));
    let inspection = inspect(&folder).unwrap();
    assert_eq!(inspection.identity, Some(identity()));
    assert_eq!((inspection.segments.len(), inspection.segments[0].bytes), (1, 72));

    let path = folder.join(&inspection.segments[0].name);
    let mut bytes = std::fs::read(&path).unwrap();
    for copy in bytes.chunks_mut(36) {
        copy[8] = 9;
        let check = crc32fast::hash(&copy[..32]);
        copy[32..].copy_from_slice(&check.to_le_bytes());
    }
    std::fs::write(&path, bytes).unwrap();
    let error = Store::open(disk.clone(), identity(), OPTIONS).unwrap_err().to_string();
    assert!(error.contains("has version 9, this program knows version 2"), "{error}");
    drop(disk);
    Folder::open(&folder).unwrap();
}

#[test]
fn a_store_of_version_1_is_refused_with_what_to_do_and_shown_for_what_it_is() {
    let place = Place::new("old");
    // The header of version 1: 32 bytes, twice, with an epoch of 32 bits.
    let mut header = b"FLKSTORE\x01\0\0\0\x01\0\0\0\x40\x0d\x03\0\x07\0\0\0\x01\0\0\0".to_vec();
    header.extend_from_slice(&crc32fast::hash(&header).to_le_bytes());
    let name = "00000001-0000000007.log";
    std::fs::write(place.0.join(name), header.repeat(2)).unwrap();
    let error = Store::open_folder(&place.0, identity(), OPTIONS).unwrap_err().to_string();
    assert!(error.contains(name) && error.contains("version 1, this program knows version 2"), "{error}");
    assert!(error.contains("move the folder away"), "{error}");
    assert!(is_store(&place.0));
    let inspection = inspect(&place.0).unwrap();
    let fault = inspection.segments[0].fault.clone();
    assert_eq!(fault.as_deref(), Some("written by another version (1)"));
    assert_eq!(inspection.segments[0].bytes, 64);
}
