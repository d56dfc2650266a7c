//! The messages of an MCAP file, one after another (<https://mcap.dev/spec>).
//!
//! Reads from start to end and needs no summary, so files of recorders that were switched off are read as far as
//! they go. A damaged chunk is left out and told; what follows it is read. The framing is read here rather than by the
//! `mcap` crate so that each error has its byte, and sizes are checked before anything is held.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Arc;

use crate::bytes::Bytes;
use crate::error::{Fault, Place};

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Opcode and length in front of each record.
const RECORD_HEADER_BYTES: u64 = 9;
/// Longest name of a topic, type or encoding.
const NAME_BYTES_MAX: u32 = 4096;

mod op {
    pub(super) const FOOTER: u8 = 0x02;
    pub(super) const SCHEMA: u8 = 0x03;
    pub(super) const CHANNEL: u8 = 0x04;
    pub(super) const MESSAGE: u8 = 0x05;
    pub(super) const CHUNK: u8 = 0x06;
    pub(super) const DATA_END: u8 = 0x0f;
}

/// What is said about the messages of one topic.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) struct Channel {
    pub(crate) topic: String,
    pub(crate) schema: String,
    pub(crate) encoding: String,
}

/// One message. Its data is only lent: it lies in the chunk that is open.
pub(crate) struct Message<'a> {
    pub(crate) channel: Arc<Channel>,
    pub(crate) data: &'a [u8],
}

/// Reads an MCAP file. Memory: the records that are held at one time, that is one chunk packed and unpacked, each at most
/// `chunk_bytes_max`, and the names of at most 65,536 channels.
pub(crate) struct McapReader {
    file: BufReader<File>,
    length: u64,
    at: u64,
    chunk_bytes_max: u64,
    channels: HashMap<u16, Arc<Channel>>,
    schemas: HashMap<u16, String>,
    /// The body of the record being read, as it lies in the file.
    record: Vec<u8>,
    /// The records of the chunk that is open.
    chunk: Vec<u8>,
    chunk_at: usize,
    /// Where the open chunk begins in the file.
    chunk_place: u64,
    ended: bool,
}

/// Where the data of a message lies.
enum Found {
    InRecord(Arc<Channel>, usize),
    InChunk(Arc<Channel>, usize, usize),
}

impl McapReader {
    pub(crate) fn open(path: &Path, chunk_bytes_max: u64) -> Result<Self, Fault> {
        let file = File::open(path).map_err(|e| Fault::io(&e))?;
        let length = file.metadata().map_err(|e| Fault::io(&e))?.len();
        let mut reader = Self {
            file: BufReader::with_capacity(1 << 16, file),
            length,
            at: 0,
            chunk_bytes_max,
            channels: HashMap::new(),
            schemas: HashMap::new(),
            record: Vec::new(),
            chunk: Vec::new(),
            chunk_at: 0,
            chunk_place: 0,
            ended: false,
        };
        let mut magic = [0; 8];
        let there = length.min(8) as usize;
        reader.read_exact(magic.get_mut(..there).unwrap_or_default())?;
        if magic != *MAGIC {
            let expected = "an MCAP file (first bytes 89 4d 43 41 50 30 0d 0a)";
            let found: Vec<String> = magic.iter().take(there).map(|b| format!("{b:02x}")).collect();
            return Err(Fault::foreign(Place::Byte(0), expected, found.join(" ")));
        }
        Ok(reader)
    }

    /// The next message, or what is wrong with the part that is left out; `None` at the end. After an error the next
    /// call goes on behind the damage, where there is anything.
    pub(crate) fn next_message(&mut self) -> Option<Result<Message<'_>, Fault>> {
        match self.find()? {
            Ok(Found::InRecord(channel, from)) => {
                Some(Ok(Message { channel, data: self.record.get(from..).unwrap_or_default() }))
            }
            Ok(Found::InChunk(channel, from, to)) => {
                Some(Ok(Message { channel, data: self.chunk.get(from..to).unwrap_or_default() }))
            }
            Err(fault) => Some(Err(fault)),
        }
    }

    fn find(&mut self) -> Option<Result<Found, Fault>> {
        loop {
            if self.chunk_at < self.chunk.len() {
                match self.find_in_chunk() {
                    Ok(Some(found)) => return Some(Ok(found)),
                    Ok(None) => continue,
                    Err(mut fault) => {
                        // What follows in this chunk cannot be told apart any more.
                        self.chunk.clear();
                        fault.place = Place::Byte(self.chunk_place);
                        return Some(Err(fault));
                    }
                }
            }
            if self.ended {
                return None;
            }
            match self.find_in_file() {
                Ok(Some(found)) => return Some(Ok(found)),
                Ok(None) => {}
                Err(fault) => return Some(Err(fault)),
            }
        }
    }

    fn find_in_chunk(&mut self) -> Result<Option<Found>, Fault> {
        let start = self.chunk_at;
        let mut bytes = Bytes::new(self.chunk.get(start..).unwrap_or_default(), 0);
        let opcode = bytes.array::<1>("a record in the chunk")?[0];
        let length = bytes.u64("a record in the chunk")?;
        let body = bytes.take(length, "a record in the chunk")?;
        let end = start + bytes.at();
        self.chunk_at = end;
        match opcode {
            op::MESSAGE => {
                let channel = message_channel(&self.channels, body)?;
                Ok(Some(Found::InChunk(channel, end - body.len() + MESSAGE_HEADER_BYTES, end)))
            }
            op::SCHEMA => schema(&mut self.schemas, body).map(|()| None),
            op::CHANNEL => channel(&mut self.channels, &self.schemas, body).map(|()| None),
            _ => Ok(None),
        }
    }

    /// Reads one record of the file; a chunk is opened.
    fn find_in_file(&mut self) -> Result<Option<Found>, Fault> {
        let start = self.at;
        let left = self.length.saturating_sub(start);
        if left < RECORD_HEADER_BYTES {
            self.ended = true;
            return Err(Fault::truncated(
                Place::Byte(start),
                "more records up to a footer",
                format!("{left} bytes"),
            ));
        }
        let mut header = [0; RECORD_HEADER_BYTES as usize];
        self.read_exact(&mut header)?;
        let [opcode, length @ ..] = header;
        let length = u64::from_le_bytes(length);
        let left = left - RECORD_HEADER_BYTES;
        if length > left {
            self.ended = true;
            return Err(Fault::truncated(
                Place::Byte(start),
                format!("a record of {length} bytes (type {opcode:#04x})"),
                format!("{left} bytes"),
            ));
        }
        match opcode {
            // What follows the data is an index to it, which is not needed here.
            op::DATA_END | op::FOOTER => {
                self.ended = true;
                return Ok(None);
            }
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK => {}
            _ => {
                self.skip(length)?;
                return Ok(None);
            }
        }
        if length > self.chunk_bytes_max {
            self.skip(length)?;
            let what = "a record in bytes";
            return Err(Fault::too_large(Place::Byte(start), what, length, self.chunk_bytes_max));
        }
        let mut record = core::mem::take(&mut self.record);
        record.resize(length as usize, 0);
        let read = self.read_exact(&mut record);
        self.record = record;
        read?;
        let at = |mut fault: Fault| {
            fault.place = Place::Byte(start);
            fault
        };
        match opcode {
            op::SCHEMA => schema(&mut self.schemas, &self.record).map(|()| None).map_err(at),
            op::CHANNEL => {
                channel(&mut self.channels, &self.schemas, &self.record).map(|()| None).map_err(at)
            }
            op::MESSAGE => {
                let channel = message_channel(&self.channels, &self.record).map_err(at)?;
                Ok(Some(Found::InRecord(channel, MESSAGE_HEADER_BYTES)))
            }
            _ => {
                self.chunk_at = 0;
                self.chunk_place = start;
                self.chunk.clear();
                if let Err(fault) = open_chunk(&self.record, self.chunk_bytes_max, &mut self.chunk) {
                    self.chunk.clear();
                    return Err(at(fault));
                }
                Ok(None)
            }
        }
    }

    fn read_exact(&mut self, into: &mut [u8]) -> Result<(), Fault> {
        self.at += into.len() as u64;
        self.file.read_exact(into).map_err(|error| {
            self.ended = true;
            Fault::io(&error)
        })
    }

    fn skip(&mut self, bytes: u64) -> Result<(), Fault> {
        self.at += bytes;
        self.file.seek(SeekFrom::Start(self.at)).map(|_| ()).map_err(|error| {
            self.ended = true;
            Fault::io(&error)
        })
    }
}

/// Channel, sequence, log time and publish time come before the data.
const MESSAGE_HEADER_BYTES: usize = 2 + 4 + 8 + 8;

fn message_channel(channels: &HashMap<u16, Arc<Channel>>, body: &[u8]) -> Result<Arc<Channel>, Fault> {
    let mut bytes = Bytes::new(body, 0);
    let id = bytes.u16("a message")?;
    bytes.take(MESSAGE_HEADER_BYTES as u64 - 2, "a message")?;
    channels.get(&id).cloned().ok_or_else(|| {
        Fault::damaged(Place::Whole, "messages of channels that were told before", format!("channel {id}"))
    })
}

fn name(bytes: &mut Bytes<'_>, what: &str) -> Result<String, Fault> {
    let length = bytes.u32(what)?;
    if length > NAME_BYTES_MAX {
        return Err(Fault::damaged(
            bytes.place(),
            format!("{what} of at most {NAME_BYTES_MAX} bytes"),
            format!("{length} bytes"),
        ));
    }
    Ok(String::from_utf8_lossy(bytes.take(u64::from(length), what)?).into_owned())
}

fn schema(schemas: &mut HashMap<u16, String>, body: &[u8]) -> Result<(), Fault> {
    let mut bytes = Bytes::new(body, 0);
    let id = bytes.u16("a schema")?;
    schemas.insert(id, name(&mut bytes, "the name of a schema")?);
    Ok(())
}

fn channel(
    channels: &mut HashMap<u16, Arc<Channel>>,
    schemas: &HashMap<u16, String>,
    body: &[u8],
) -> Result<(), Fault> {
    let mut bytes = Bytes::new(body, 0);
    let id = bytes.u16("a channel")?;
    let schema = schemas.get(&bytes.u16("a channel")?).cloned().unwrap_or_default();
    let topic = name(&mut bytes, "a topic")?;
    let encoding = name(&mut bytes, "a message encoding")?;
    channels.insert(id, Arc::new(Channel { topic, schema, encoding }));
    Ok(())
}

/// Unpacks the records of a chunk and checks them.
fn open_chunk(body: &[u8], bytes_max: u64, into: &mut Vec<u8>) -> Result<(), Fault> {
    let mut bytes = Bytes::new(body, 0);
    bytes.take(16, "the times of a chunk")?;
    let size = bytes.u64("the size of a chunk")?;
    let check = bytes.u32("the check of a chunk")?;
    let compression = name(&mut bytes, "a compression")?;
    let packed_size = bytes.u64("the packed size of a chunk")?;
    let packed = bytes.take(packed_size, "the records of a chunk")?;
    if size > bytes_max {
        return Err(Fault::too_large(Place::Whole, "an unpacked chunk in bytes", size, bytes_max));
    }
    let broken = |error: &std::io::Error| {
        Fault::damaged(Place::Whole, format!("a chunk packed with {compression}"), error.to_string())
    };
    match compression.as_str() {
        "" => into.extend_from_slice(packed),
        "zstd" => {
            into.reserve(size as usize);
            let mut unpacker = zstd::bulk::Decompressor::new().map_err(|e| broken(&e))?;
            unpacker.decompress_to_buffer(packed, into).map_err(|e| broken(&e))?;
        }
        "lz4" => {
            let unpacker = lz4_flex::frame::FrameDecoder::new(packed);
            unpacker.take(size.saturating_add(1)).read_to_end(into).map_err(|e| broken(&e))?;
        }
        other => {
            return Err(Fault::foreign(
                Place::Whole,
                "a chunk packed with zstd, lz4 or nothing",
                format!("\"{other}\""),
            ));
        }
    }
    if into.len() as u64 != size {
        let found = format!("{} bytes", into.len());
        return Err(Fault::damaged(Place::Whole, format!("a chunk of {size} bytes"), found));
    }
    // Zero means that the writer did not compute it.
    if check != 0 && crc32fast::hash(into) != check {
        return Err(Fault::damaged(
            Place::Whole,
            format!("a chunk with the check {check:08x}"),
            format!("{:08x}", crc32fast::hash(into)),
        ));
    }
    Ok(())
}
