//! A folder for a test's files, removed at its end; and MCAP files made of messages.
#![allow(dead_code, reason = "each test file uses its own part")]

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

pub(crate) struct Folder(PathBuf);

impl Folder {
    pub(crate) fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let name = format!("flockmap-io-{}-{}", std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(name);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub(crate) fn join(&self, name: impl AsRef<Path>) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Topic, type, and content of a message.
pub(crate) type Message = (String, String, Vec<u8>);

/// The messages of an MCAP file.
pub(crate) fn messages_of(bytes: &[u8]) -> Vec<Message> {
    let read = |m: mcap::Message<'_>| {
        (m.channel.topic.clone(), m.channel.schema.as_ref().unwrap().name.clone(), m.data.to_vec())
    };
    mcap::MessageStream::new(bytes).unwrap().map(|m| read(m.unwrap())).collect()
}

/// An MCAP file with these messages, in their order.
pub(crate) fn mcap_of(messages: &[Message], options: mcap::WriteOptions, encoding: &str) -> Vec<u8> {
    let mut out = Vec::new();
    let mut writer = options.create(Cursor::new(&mut out)).unwrap();
    let mut channels = BTreeMap::new();
    for (number, (topic, schema, data)) in messages.iter().enumerate() {
        let channel_id = *channels.entry(topic).or_insert_with(|| {
            let schema = writer.add_schema(schema, "ros2msg", b"").unwrap();
            writer.add_channel(schema, topic, encoding, &BTreeMap::new()).unwrap()
        });
        let (sequence, time) = (number as u32, number as u64);
        let header =
            mcap::records::MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, data).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    out
}
