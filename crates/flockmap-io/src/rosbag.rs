//! rosbag2 folders, as `ros2 bag record` makes them: `metadata.yaml` and the files with the messages.
//!
//! Only five things in the metadata matter here: the kind of storage, the two that tell how it is packed, and
//! the list of files. What the messages are is read from the files.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use saphyr_parser::{Event, Parser};

use crate::error::{Fault, Place, ReadError, check_room, excerpt};
use crate::file::read_whole;
use crate::mcap_parts::McapParts;

/// The file that makes a folder a bag.
const METADATA: &str = "metadata.yaml";
/// Largest metadata in bytes.
const METADATA_BYTES_MAX: u64 = 16 << 20;
/// Most files of a bag.
const FILES_MAX: usize = 65_536;
/// Deepest nesting of the metadata.
const DEPTH_MAX: usize = 64;
/// The key under which all of it stands.
const ROOT: &str = "rosbag2_bagfile_information";

/// How to make a bag of another kind readable.
pub(crate) const CONVERT: &str = "MCAP storage: `rosbags-convert --src BAG --dst BAG_mcap --dst-storage mcap` (pip install rosbags) or \
    `ros2 bag convert` makes it";

/// Whether the name is that of an MCAP file, packed as a whole or not.
pub(crate) fn is_mcap(path: &Path) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    name.ends_with(".mcap") || name.ends_with(".mcap.zstd")
}

/// Whether the folder is a bag, or has files that may be parts of one.
pub(crate) fn is_bag(folder: &Path) -> bool {
    let is_part = |path: &Path| is_mcap(path) || is_database(path);
    folder.join(METADATA).is_file()
        || std::fs::read_dir(folder).is_ok_and(|entries| entries.flatten().any(|e| is_part(&e.path())))
}

/// The files of a bag, in the order in which they were recorded.
///
/// A folder without metadata, left by a recorder that was switched off, is read where there is no doubt about
/// its files: if there is one, or if they are numbered and named for the folder as the recorder does it.
pub(crate) fn parts(folder: &Path) -> Result<McapParts, ReadError> {
    let path = folder.join(METADATA);
    if !path.is_file() {
        return unlisted(folder).map_err(|fault| fault.in_file(folder));
    }
    let bytes = read_whole(&path, METADATA_BYTES_MAX)?;
    let metadata = parse(&bytes).and_then(|metadata| metadata.parts(folder));
    metadata.map_err(|fault| fault.in_file(&path))
}

/// SQLite, the other storage of rosbag2.
fn is_database(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("db3"))
}

/// What the metadata says.
#[derive(Debug, Default, PartialEq)]
struct Metadata {
    storage: String,
    compression_format: String,
    compression_mode: String,
    files: Vec<String>,
    has_root: bool,
}

/// A mapping with the key whose value comes next, or a sequence.
enum Level {
    Mapping(Option<String>),
    Sequence,
}

fn parse(bytes: &[u8]) -> Result<Metadata, Fault> {
    let Ok(text) = core::str::from_utf8(bytes) else {
        return Err(Fault::damaged(Place::Whole, "YAML in UTF-8", "bytes that are no UTF-8"));
    };
    let mut metadata = Metadata::default();
    let mut levels: Vec<Level> = Vec::new();
    for event in Parser::new_from_str(text) {
        let (event, span) = event.map_err(|error| {
            let line = Place::Line(error.marker().line() as u64);
            Fault::damaged(line, "YAML, as ros2 bag writes it", excerpt(error.info().as_bytes()))
        })?;
        let place = Place::Line(span.start.line() as u64);
        match event {
            Event::Scalar(value, ..) => match levels.last_mut() {
                Some(Level::Mapping(key @ None)) => *key = Some(value.into_owned()),
                _ => {
                    metadata.take(&levels, &value).map_err(|fault| Fault { place, ..fault })?;
                    finish_value(&mut levels);
                }
            },
            // Not followed: nothing that is read here has one, and what they make of a text has no limit.
            Event::Alias(_) => match levels.last_mut() {
                Some(Level::Mapping(key @ None)) => *key = Some(String::new()),
                _ => finish_value(&mut levels),
            },
            Event::MappingStart(..) | Event::SequenceStart(..) if levels.len() >= DEPTH_MAX => {
                let (what, found) = ("the depth of the metadata", levels.len() as u64 + 1);
                return Err(Fault::too_large(place, what, found, DEPTH_MAX as u64));
            }
            Event::MappingStart(..) => levels.push(Level::Mapping(None)),
            Event::SequenceStart(..) => levels.push(Level::Sequence),
            Event::MappingEnd | Event::SequenceEnd => {
                levels.pop();
                match levels.last_mut() {
                    // It was a key that is no text.
                    Some(Level::Mapping(key @ None)) => *key = Some(String::new()),
                    _ => finish_value(&mut levels),
                }
            }
            _ => {}
        }
    }
    Ok(metadata)
}

/// A value is complete: in a mapping the next key follows.
fn finish_value(levels: &mut [Level]) {
    if let Some(Level::Mapping(key)) = levels.last_mut() {
        *key = None;
    }
}

impl Metadata {
    /// Takes over a value at this place of the metadata.
    fn take(&mut self, levels: &[Level], value: &str) -> Result<(), Fault> {
        let [Level::Mapping(Some(root)), Level::Mapping(Some(key)), below @ ..] = levels else {
            return Ok(());
        };
        if root != ROOT {
            return Ok(());
        }
        self.has_root = true;
        match (key.as_str(), below) {
            ("storage_identifier", []) => self.storage = value.to_owned(),
            ("compression_format", []) => self.compression_format = value.to_ascii_lowercase(),
            ("compression_mode", []) => self.compression_mode = value.to_ascii_lowercase(),
            ("relative_file_paths", [Level::Sequence]) => {
                check_room("the number of files of a bag", self.files.len(), FILES_MAX)?;
                check_path(value)?;
                self.files.push(value.to_owned());
            }
            _ => {}
        }
        Ok(())
    }

    fn parts(self, folder: &Path) -> Result<McapParts, Fault> {
        let foreign = |expected: &str, found: String| Err(Fault::foreign(Place::Whole, expected, found));
        if !self.has_root {
            return foreign(&format!("the metadata of a bag, below \"{ROOT}:\""), "no such key".to_owned());
        }
        if self.files.is_empty() {
            return foreign("files of a bag in relative_file_paths", "none".to_owned());
        }
        let mut seen = BTreeSet::new();
        if let Some(twice) = self.files.iter().find(|file| !seen.insert(*file)) {
            return foreign("each file once in relative_file_paths", excerpt(twice.as_bytes()));
        }
        let not_mcap = self.files.iter().find(|file| !is_mcap(Path::new(file)));
        if !self.storage.is_empty() && self.storage != "mcap" {
            return foreign(CONVERT, format!("the storage {}", excerpt(self.storage.as_bytes())));
        }
        if let Some(file) = not_mcap {
            return foreign(CONVERT, format!("the file {}", excerpt(file.as_bytes())));
        }
        let has_packed_messages = match (self.compression_mode.as_str(), self.compression_format.as_str()) {
            ("" | "none", _) | ("file", "zstd") => false,
            ("message", "zstd") => true,
            (mode, format) => {
                let found = excerpt(format!("{format}, {mode}").as_bytes());
                return foreign("files or messages packed with zstd, or not at all", found);
            }
        };
        let files = self.files.iter().map(|file| folder.join(file)).collect();
        Ok(McapParts { files, has_packed_messages })
    }
}

/// A bag names files in its own folder, and no others.
fn check_path(path: &str) -> Result<(), Fault> {
    let is_inside = Path::new(path).components().all(|part| matches!(part, Component::Normal(_)));
    if path.is_empty() || !is_inside || path.contains(['\\', '\0']) {
        let expected = "the path of a file within the folder of the bag";
        return Err(Fault::foreign(Place::Whole, expected, excerpt(path.as_bytes())));
    }
    Ok(())
}

/// The files of a folder without metadata.
fn unlisted(folder: &Path) -> Result<McapParts, Fault> {
    let (mut files, mut databases) = (BTreeSet::new(), 0);
    for entry in std::fs::read_dir(folder).map_err(|e| Fault::io(&e))? {
        let path = entry.map_err(|e| Fault::io(&e))?.path();
        databases += usize::from(is_database(&path));
        if is_mcap(&path) {
            check_room("the number of files of a bag", files.len(), FILES_MAX)?;
            files.insert(path);
        }
    }
    if files.is_empty() && databases > 0 {
        return Err(Fault::foreign(Place::Whole, CONVERT, "files *.db3"));
    }
    if files.len() > 1 {
        let name = folder.canonicalize().map_err(|e| Fault::io(&e))?;
        let name = name.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let number = |path: &PathBuf| {
            let file = path.file_name()?.to_str()?;
            let number = file.strip_prefix(&name)?.strip_prefix('_')?.split_once('.')?.0;
            number.parse::<u32>().ok()
        };
        let numbered: BTreeMap<u32, &PathBuf> =
            files.iter().filter_map(|path| Some((number(path)?, path))).collect();
        if numbered.len() < files.len() {
            let expected = format!(
                "{METADATA}, which tells what belongs together: `ros2 bag reindex -s mcap {}` makes it for one recording; \
                 if they are several, name the files one by one",
                folder.display()
            );
            let found = format!("{} files .mcap without it", files.len());
            return Err(Fault::foreign(Place::Whole, expected, found));
        }
        let files = numbered.into_values().cloned().collect();
        return Ok(McapParts { files, ..McapParts::default() });
    }
    Ok(McapParts { files: files.into_iter().collect(), ..McapParts::default() })
}
