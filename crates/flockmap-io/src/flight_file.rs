//! The file of a flight while it is written: it grows by whole chunks, up to a limit, and is never one that was there.

use std::fs::{File, OpenOptions};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use flockmap_grid::Stamp;
use mcap::records::MessageHeader;

use crate::error::WriteError;
use crate::flight_view::ViewSink;

/// A chunk is closed when it holds so much, before it is packed.
const CHUNK_BYTES: u64 = 1 << 20;
/// Most numbers that a name is given before there is taken to be no room for it.
const NUMBER_MAX: u32 = 9_999;
/// What is kept free for schemas and channels, which stand at the end of the file once more.
const SUMMARY_BYTES: u64 = 1 << 16;
/// And for each chunk: its index, and those of its messages' channels.
const CHUNK_INDEX_BYTES: u64 = 1 << 10;
/// What a message takes beside its data: its header, and its place in the index.
const MESSAGE_BYTES: u64 = 64;

/// An MCAP file that is being written.
pub(crate) struct FlightFile {
    path: PathBuf,
    /// To cut it; the writer has its own.
    file: File,
    mcap: mcap::Writer<BufWriter<File>>,
    bytes_max: u64,
    /// Bytes in whole chunks.
    whole: u64,
    chunks: u64,
    /// Bytes of messages that are not in whole chunks yet, before they are packed.
    waiting: u64,
    sequence: u32,
}

/// A channel of the file.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ChannelId(u16);

impl FlightFile {
    /// Makes a file. If there is one of that name, the new one gets a number: `flight-2.mcap`.
    pub(crate) fn create(path: &Path, bytes_max: u64) -> Result<Self, WriteError> {
        let (path, file) = create_new(path).map_err(WriteError::io(path))?;
        let options = mcap::WriteOptions::new()
            .library("flockmap")
            .compression(Some(mcap::Compression::Zstd))
            // The thread that writes is the one that packs.
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            // A chunk is written when it is whole, and not begun and mended later.
            .disable_seeking(true);
        let written = file.try_clone().map_err(WriteError::io(&path))?;
        let mcap = options.create(BufWriter::new(written)).map_err(WriteError::mcap(&path))?;
        Ok(Self { path, file, mcap, bytes_max, whole: 0, chunks: 0, waiting: 0, sequence: 0 })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Writes what waits as a whole chunk: from here on it survives the end of the program, and of the power.
    pub(crate) fn flush(&mut self) -> Result<(), WriteError> {
        if self.waiting > 0 {
            self.mcap.flush().map_err(WriteError::mcap(&self.path))?;
            // A flight that ends with the battery is the one that will be looked at.
            self.file.sync_data().map_err(WriteError::io(&self.path))?;
            self.chunks += 1 + self.waiting / CHUNK_BYTES;
            self.waiting = 0;
            self.whole = self.file.metadata().map_err(WriteError::io(&self.path))?.len();
        }
        Ok(())
    }

    /// Bytes in whole chunks.
    pub(crate) const fn bytes(&self) -> u64 {
        self.whole
    }

    /// Writes the index and ends the file. Where that fails, it ends behind its last whole chunk.
    pub(crate) fn finish(self) -> Result<(), WriteError> {
        let Self { path, file, mut mcap, whole, .. } = self;
        let done = mcap.finish().map_err(WriteError::mcap(&path));
        let done = done.and_then(|_| mcap.into_inner().flush().map_err(WriteError::io(&path)));
        if done.is_err() {
            cut(&file, whole);
        }
        done
    }

    /// Ends the file behind its last whole chunk, after an error.
    pub(crate) fn abandon(self) {
        let Self { file, mcap, whole, .. } = self;
        // It tries to write the rest once more.
        drop(mcap);
        cut(&file, whole);
    }

    fn has_room(&self, bytes: u64) -> bool {
        let summary = SUMMARY_BYTES + (self.chunks + 2) * CHUNK_INDEX_BYTES;
        self.whole + self.waiting + bytes + summary <= self.bytes_max
    }
}

impl ViewSink for FlightFile {
    type Channel = ChannelId;
    type Error = WriteError;

    /// A channel, which is made when it is asked for the first time.
    fn channel(
        &mut self,
        topic: &str,
        encoding: &str,
        (schema, schema_encoding, data): (&str, &str, &[u8]),
    ) -> Result<ChannelId, WriteError> {
        let schema = self.mcap.add_schema(schema, schema_encoding, data);
        let channel = schema
            .and_then(|schema| self.mcap.add_channel(schema, topic, encoding, &Default::default()))
            .map_err(WriteError::mcap(&self.path))?;
        Ok(ChannelId(channel))
    }

    /// Writes a message.
    ///
    /// # Errors
    /// [`WriteError::Full`] where it might have no room: it is left out then.
    fn message(&mut self, channel: ChannelId, stamp: Stamp, data: &[u8]) -> Result<(), WriteError> {
        let bytes = data.len() as u64 + MESSAGE_BYTES;
        if !self.has_room(bytes) {
            // What waits may be a tenth of that when it is packed.
            self.flush()?;
            if !self.has_room(bytes) {
                return Err(WriteError::Full { path: self.path.clone(), bytes_max: self.bytes_max });
            }
        }
        self.sequence = self.sequence.wrapping_add(1);
        let time = stamp.0.max(0).unsigned_abs().saturating_mul(1_000);
        let sequence = self.sequence;
        let header = MessageHeader { channel_id: channel.0, sequence, log_time: time, publish_time: time };
        self.mcap.write_to_known_channel(&header, data).map_err(WriteError::mcap(&self.path))?;
        self.waiting += bytes;
        Ok(())
    }
}

fn cut(file: &File, bytes: u64) {
    // Where the disk does not even do this, readers stop at the half chunk.
    let _ = file.set_len(bytes);
}

/// Makes a file of this name, or the first of `name-2`, `name-3` … that is not there.
fn create_new(path: &Path) -> io::Result<(PathBuf, File)> {
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let end = path.extension().map(|end| format!(".{}", end.to_string_lossy())).unwrap_or_default();
    let mut number = 1;
    let mut tried = path.to_owned();
    loop {
        match OpenOptions::new().write(true).create_new(true).open(&tried) {
            Ok(file) => return Ok((tried, file)),
            Err(error) if error.kind() == ErrorKind::AlreadyExists && number < NUMBER_MAX => {}
            Err(error) => return Err(error),
        }
        number += 1;
        tried = path.with_file_name(format!("{name}-{number}{end}"));
    }
}
