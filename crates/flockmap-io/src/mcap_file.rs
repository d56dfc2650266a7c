//! The messages of an MCAP file, one after another (<https://mcap.dev/spec>).
//!
//! Reads from start to end and needs no summary, so files of recorders that were switched off are read as far
//! as they go. A damaged chunk is left out and reported; what follows it is read. The framing is read here
//! rather than by the `mcap` crate so that each error has its byte, and sizes are checked before anything is
//! held.
//!
//! A file that is packed as a whole (`.mcap.zstd`, rosbag2's file compression) is unpacked as it is read.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use mcap::MAGIC;
use mcap::records::op;

use crate::bytes::Bytes;
use crate::error::{Fault, Place};
use crate::file::ending;

/// Opcode and length in front of each record.
const RECORD_HEADER_BYTES: u64 = 9;
/// Longest name of a topic, type or encoding.
const NAME_BYTES_MAX: u32 = 4096;

/// What is said about the messages of one topic.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) struct Channel {
    pub(crate) topic: String,
    pub(crate) schema: String,
    pub(crate) encoding: String,
}

/// The channel of a message, and where its data lies in the chunk.
pub(crate) type Found = (Arc<Channel>, Range<usize>);

/// The largest window of a packed file that is unpacked, as a power of two: 128 MiB.
const WINDOW_LOG_MAX: u32 = 27;

/// A file, or what is packed in it.
enum Input {
    Plain(BufReader<File>),
    Packed(Box<zstd::Decoder<'static, BufReader<File>>>),
}

impl Input {
    /// Puts the next bytes behind those in `into`. What is packed may promise more than it holds.
    fn read(&mut self, bytes: u64, into: &mut Vec<u8>) -> io::Result<()> {
        match self {
            Self::Plain(file) => {
                let kept = into.len();
                into.resize(kept + bytes as usize, 0);
                file.read_exact(into.get_mut(kept..).unwrap_or_default())
            }
            Self::Packed(file) => match file.take(bytes).read_to_end(into)? as u64 {
                read if read == bytes => Ok(()),
                _ => Err(io::ErrorKind::UnexpectedEof.into()),
            },
        }
    }

    fn skip(&mut self, bytes: u64) -> io::Result<()> {
        match self {
            Self::Plain(file) => file.seek_relative(bytes as i64),
            Self::Packed(file) => match io::copy(&mut file.take(bytes), &mut io::sink())? {
                skipped if skipped == bytes => Ok(()),
                _ => Err(io::ErrorKind::UnexpectedEof.into()),
            },
        }
    }
}

/// Reads an MCAP file. Memory: the records that are held at one time, that is one chunk packed and unpacked,
/// each at most `chunk_bytes_max`, and the names of at most 65,536 channels; for a file that is packed as a
/// whole up to 128 MiB more, as its packer asked for.
pub(crate) struct McapReader {
    file: Input,
    /// Bytes of the file; of a packed one the most that there can be, since its own size is not known.
    length: u64,
    at: u64,
    chunk_bytes_max: u64,
    channels: HashMap<u16, Arc<Channel>>,
    schemas: HashMap<u16, String>,
    /// The record being read, as it lies in the file.
    record: Vec<u8>,
    /// The records of the chunk that is open. One that lies in the file by itself is taken for a chunk of one
    /// record.
    chunk: Vec<u8>,
    chunk_at: usize,
    /// Where the open chunk begins in the file.
    chunk_place: Place,
    /// When the last message was recorded, in nanoseconds.
    log_time: u64,
    ended: bool,
}

impl McapReader {
    pub(crate) fn open(path: &Path, chunk_bytes_max: u64) -> Result<Self, Fault> {
        let file = File::open(path).map_err(|e| Fault::io(&e))?;
        let mut length = file.metadata().map_err(|e| Fault::io(&e))?.len();
        let mut file = Input::Plain(BufReader::with_capacity(1 << 16, file));
        if ending(path) == "zstd"
            && let Input::Plain(packed) = file
        {
            let mut unpacker = zstd::Decoder::with_buffer(packed).map_err(|e| Fault::io(&e))?;
            unpacker.window_log_max(WINDOW_LOG_MAX).map_err(|e| Fault::io(&e))?;
            file = Input::Packed(Box::new(unpacker));
            length = i64::MAX as u64;
        }
        let mut reader = Self {
            file,
            length,
            at: 0,
            chunk_bytes_max,
            channels: HashMap::new(),
            schemas: HashMap::new(),
            record: Vec::new(),
            chunk: Vec::new(),
            chunk_at: 0,
            chunk_place: Place::Whole,
            log_time: 0,
            ended: false,
        };
        reader.read(0, length.min(MAGIC.len() as u64))?;
        if reader.record != MAGIC {
            let expected = "an MCAP file (first bytes 89 4d 43 41 50 30 0d 0a)";
            let found: Vec<String> = reader.record.iter().map(|b| format!("{b:02x}")).collect();
            return Err(Fault::foreign(Place::Byte(0), expected, found.join(" ")));
        }
        Ok(reader)
    }

    /// The next message, or what is wrong with the part that is left out; `None` at the end. After an error
    /// the next call goes on behind the damage, where there is anything.
    pub(crate) fn next_message(&mut self) -> Option<Result<Found, Fault>> {
        loop {
            if self.chunk_at < self.chunk.len() {
                match self.next_in_chunk() {
                    Ok(None) => {}
                    Ok(Some(found)) => return Some(Ok(found)),
                    Err(fault) => {
                        // Where the next record of this chunk begins is not known any more.
                        self.chunk.clear();
                        return Some(Err(Fault { place: self.chunk_place.clone(), ..fault }));
                    }
                }
            } else if self.ended {
                return None;
            } else if let Err(fault) = self.open_next() {
                return Some(Err(fault));
            }
        }
    }

    /// The data of the message that was found last.
    pub(crate) fn data(&self, found: Range<usize>) -> &[u8] {
        self.chunk.get(found).unwrap_or_default()
    }

    /// When the message that was found last was recorded, in nanoseconds.
    pub(crate) const fn log_time(&self) -> u64 {
        self.log_time
    }

    /// Takes the next record of the chunk, which may be a message.
    fn next_in_chunk(&mut self) -> Result<Option<Found>, Fault> {
        let mut bytes = Bytes::new(self.chunk.get(self.chunk_at..).unwrap_or_default(), 0);
        let [opcode] = bytes.array("a record in the chunk")?;
        let length = bytes.u64("a record in the chunk")?;
        let mut body = Bytes::new(bytes.take(length, "a record in the chunk")?, 0);
        self.chunk_at += bytes.at();
        match opcode {
            op::MESSAGE => {
                // Channel, sequence, log time, publish time, data.
                let id = body.u16("a message")?;
                body.u32("a message")?;
                self.log_time = body.u64("a message")?;
                body.u64("a message")?;
                let channel = self.channels.get(&id).cloned().ok_or_else(|| {
                    let expected = "messages of channels that were announced before";
                    Fault::damaged(Place::Whole, expected, format!("channel {id}"))
                })?;
                return Ok(Some((channel, self.chunk_at - body.rest().len()..self.chunk_at)));
            }
            op::SCHEMA => {
                let id = body.u16("a schema")?;
                self.schemas.insert(id, name(&mut body, "the name of a schema")?);
            }
            op::CHANNEL => {
                let id = body.u16("a channel")?;
                let schema = self.schemas.get(&body.u16("a channel")?).cloned().unwrap_or_default();
                let topic = name(&mut body, "a topic")?;
                let encoding = name(&mut body, "a message encoding")?;
                self.channels.insert(id, Arc::new(Channel { topic, schema, encoding }));
            }
            _ => {}
        }
        Ok(None)
    }

    /// Reads one record of the file, and opens it where it may hold a message.
    fn open_next(&mut self) -> Result<(), Fault> {
        let place = Place::Byte(self.at);
        let left = self.length.saturating_sub(self.at);
        let Some(left) = left.checked_sub(RECORD_HEADER_BYTES) else {
            self.ended = true;
            return Err(Fault::truncated(place, "more records up to a footer", format!("{left} bytes")));
        };
        self.read(0, RECORD_HEADER_BYTES)?;
        let mut header = Bytes::new(&self.record, 0);
        let [opcode] = header.array("a record")?;
        let length = header.u64("a record")?;
        if length > left {
            self.ended = true;
            let expected = format!("a record of {length} bytes (type {opcode:#04x})");
            return Err(Fault::truncated(place, expected, format!("{left} bytes")));
        }
        match opcode {
            // What follows the data is an index to it, which is not needed here.
            op::DATA_END | op::FOOTER => self.ended = true,
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK if length > self.chunk_bytes_max => {
                self.skip(length)?;
                return Err(Fault::too_large(place, "a record in bytes", length, self.chunk_bytes_max));
            }
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK => {
                self.read(RECORD_HEADER_BYTES as usize, length)?;
                (self.chunk_at, self.chunk_place) = (0, place.clone());
                if opcode == op::CHUNK {
                    self.chunk.clear();
                    self.open_chunk().map_err(|fault| {
                        self.chunk.clear();
                        Fault { place, ..fault }
                    })?;
                } else {
                    core::mem::swap(&mut self.record, &mut self.chunk);
                }
            }
            _ => self.skip(length)?,
        }
        Ok(())
    }

    /// Unpacks the records of a chunk and checks them.
    fn open_chunk(&mut self) -> Result<(), Fault> {
        let mut bytes = Bytes::new(&self.record, 0);
        bytes.take(RECORD_HEADER_BYTES + 16, "the times of a chunk")?;
        let size = bytes.u64("the size of a chunk")?;
        let check = bytes.u32("the check of a chunk")?;
        let compression = name(&mut bytes, "a compression")?;
        let packed_size = bytes.u64("the packed size of a chunk")?;
        let packed = bytes.take(packed_size, "the records of a chunk")?;
        if size > self.chunk_bytes_max {
            let what = "an unpacked chunk in bytes";
            return Err(Fault::too_large(Place::Whole, what, size, self.chunk_bytes_max));
        }
        let into = &mut self.chunk;
        let unpacked = match compression.as_str() {
            "" => into.write_all(packed),
            "zstd" => {
                into.reserve(size as usize);
                let unpacker = zstd::bulk::Decompressor::new();
                unpacker.and_then(|mut unpacker| unpacker.decompress_to_buffer(packed, into)).map(drop)
            }
            "lz4" => {
                let unpacker = lz4_flex::frame::FrameDecoder::new(packed);
                unpacker.take(size.saturating_add(1)).read_to_end(into).map(drop)
            }
            other => {
                let expected = "a chunk packed with zstd, lz4 or nothing";
                return Err(Fault::foreign(Place::Whole, expected, format!("\"{other}\"")));
            }
        };
        let damaged = |expected: String, found: String| Err(Fault::damaged(Place::Whole, expected, found));
        if let Err(error) = unpacked {
            return damaged(format!("a chunk packed with {compression}"), error.to_string());
        }
        if into.len() as u64 != size {
            return damaged(format!("a chunk of {size} bytes"), format!("{} bytes", into.len()));
        }
        // Zero means that the writer did not compute it.
        let computed = if check == 0 { 0 } else { crc32fast::hash(into) };
        if computed != check {
            return damaged(format!("a chunk with the check {check:08x}"), format!("{computed:08x}"));
        }
        Ok(())
    }

    /// Reads that many bytes into `record`, behind the first `kept` that it holds.
    fn read(&mut self, kept: usize, bytes: u64) -> Result<(), Fault> {
        self.at += bytes;
        self.record.truncate(kept);
        let read = self.file.read(bytes, &mut self.record);
        read.map_err(|error| self.broken(&error))
    }

    fn skip(&mut self, bytes: u64) -> Result<(), Fault> {
        self.at += bytes;
        self.file.skip(bytes).map_err(|error| self.broken(&error))
    }

    fn broken(&mut self, error: &io::Error) -> Fault {
        self.ended = true;
        let place = Place::Byte(self.at);
        match (error.kind(), &self.file) {
            // What is read is checked against the length, so it is the packed bytes that end.
            (io::ErrorKind::UnexpectedEof, _) => {
                Fault::truncated(place, "more records up to a footer", "the end of the file")
            }
            (io::ErrorKind::Other, Input::Packed(_)) => {
                Fault::damaged(place, "a file packed with zstd", error.to_string())
            }
            _ => Fault::io(error),
        }
    }
}

fn name(bytes: &mut Bytes<'_>, what: &str) -> Result<String, Fault> {
    let length = bytes.u32(what)?;
    if length > NAME_BYTES_MAX {
        let expected = format!("{what} of at most {NAME_BYTES_MAX} bytes");
        return Err(Fault::damaged(bytes.place(), expected, format!("{length} bytes")));
    }
    Ok(String::from_utf8_lossy(bytes.take(u64::from(length), what)?).into_owned())
}
