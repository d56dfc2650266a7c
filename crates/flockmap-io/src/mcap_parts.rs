//! The files that make one MCAP record, read as one: a recorder may begin a new file every so often.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::error::{Fault, Place, ReadError};
use crate::mcap_file::{Channel, McapReader};

/// One message. Its data is only lent: it lies in the chunk that is open.
pub(crate) struct Message<'a> {
    pub(crate) channel: Arc<Channel>,
    pub(crate) data: &'a [u8],
}

/// The files of a record, in their order.
#[derive(Clone, Debug, Default)]
pub(crate) struct McapParts {
    pub(crate) files: Vec<PathBuf>,
    /// Whether each message is packed with zstd by itself (rosbag2's message compression).
    pub(crate) has_packed_messages: bool,
}

impl McapParts {
    /// A record in one file.
    pub(crate) fn single(path: &Path) -> Self {
        Self { files: vec![path.to_owned()], has_packed_messages: false }
    }

    /// Size of all files in bytes; one that is not there counts as empty.
    pub(crate) fn bytes(&self) -> u64 {
        self.files.iter().filter_map(|file| std::fs::metadata(file).ok()).map(|file| file.len()).sum()
    }
}

/// Reads the files of a record from the first to the last. Memory: that of [`McapReader`], and one message
/// unpacked.
pub(crate) struct PartsReader {
    parts: McapParts,
    /// The file that is open, or was tried last.
    at: usize,
    /// Whether that file is done with.
    is_done: bool,
    reader: Option<McapReader>,
    chunk_bytes_max: u64,
    unpacked: Vec<u8>,
}

impl PartsReader {
    pub(crate) const fn new(parts: McapParts, chunk_bytes_max: u64) -> Self {
        Self { parts, at: 0, is_done: false, reader: None, chunk_bytes_max, unpacked: Vec::new() }
    }

    /// Whether a file is open. After an error: whether that file could be opened.
    pub(crate) const fn is_open(&self) -> bool {
        self.reader.is_some()
    }

    /// The file that the last message, or the last error, came from.
    pub(crate) fn path(&self) -> &Path {
        self.parts.files.get(self.at).map_or_else(|| Path::new(""), PathBuf::as_path)
    }

    /// The next message, or what is wrong with the part that is left out; `None` at the end. After an error
    /// the next call goes on behind the damage: in the same file where there is anything, else in the next.
    pub(crate) fn next_message(&mut self) -> Option<Result<Message<'_>, ReadError>> {
        let found = loop {
            self.at += usize::from(core::mem::take(&mut self.is_done));
            let path = self.parts.files.get(self.at)?;
            let Some(reader) = &mut self.reader else {
                match McapReader::open(path, self.chunk_bytes_max) {
                    Ok(reader) => self.reader = Some(reader),
                    Err(fault) => {
                        self.is_done = true;
                        return Some(Err(fault.in_file(path)));
                    }
                }
                continue;
            };
            match reader.next_message() {
                Some(Ok(found)) => break found,
                Some(Err(fault)) => return Some(Err(fault.in_file(path))),
                None => {
                    self.reader = None;
                    self.is_done = true;
                }
            }
        };
        let (channel, range) = found;
        let data = self.reader.as_ref()?.data(range);
        if !self.parts.has_packed_messages {
            return Some(Ok(Message { channel, data }));
        }
        self.unpacked.clear();
        if let Err(fault) = unpack(data, &mut self.unpacked, self.chunk_bytes_max) {
            return Some(Err(fault.in_file(self.path())));
        }
        Some(Ok(Message { channel, data: &self.unpacked }))
    }
}

fn unpack(data: &[u8], into: &mut Vec<u8>, bytes_max: u64) -> Result<(), Fault> {
    let unpacked = zstd::Decoder::with_buffer(data)
        .and_then(|packed| packed.take(bytes_max.saturating_add(1)).read_to_end(into));
    if let Err(error) = unpacked {
        return Err(Fault::damaged(Place::Whole, "messages packed with zstd", error.to_string()));
    }
    if into.len() as u64 > bytes_max {
        let what = "an unpacked message in bytes, at least";
        return Err(Fault::too_large(Place::Whole, what, into.len() as u64, bytes_max));
    }
    Ok(())
}
