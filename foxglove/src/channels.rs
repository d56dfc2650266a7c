//! Topics of the app: messages of [`FlightView`](flockmap_io::FlightView) go to those who look at them.

use std::sync::Arc;
use std::time::Duration;

use flockmap_grid::Stamp;
use flockmap_io::ViewSink;
use foxglove::{ChannelBuilder, Context, FoxgloveError, PartialMetadata, RawChannel, Schema};

use crate::apps::Apps;

/// After so many messages at once the server gets time to send them: what waits has a limit, and the oldest are left out.
const BURST_MAX: usize = 16;
const BURST_PAUSE: Duration = Duration::from_millis(2);

/// The topics that the apps are offered.
pub(crate) struct Channels {
    context: Arc<Context>,
    apps: Apps,
    channels: Vec<Arc<RawChannel>>,
    burst: usize,
}

impl Channels {
    pub(crate) const fn new(context: Arc<Context>, apps: Apps) -> Self {
        Self { context, apps, channels: Vec::new(), burst: 0 }
    }

    /// Takes all topics back: another robot has others.
    pub(crate) fn clear(&mut self) {
        self.channels.drain(..).for_each(|channel| channel.close());
    }

    /// Whether an app looks at any of it.
    pub(crate) fn has_watchers(&self) -> bool {
        self.channels.iter().any(|channel| channel.has_sinks())
    }

    /// A pause is over in which the server could send.
    pub(crate) const fn end_burst(&mut self) {
        self.burst = 0;
    }
}

impl ViewSink for Channels {
    type Channel = usize;
    type Error = FoxgloveError;

    fn channel(
        &mut self,
        topic: &str,
        encoding: &str,
        (name, schema_encoding, data): (&str, &str, &[u8]),
    ) -> Result<usize, FoxgloveError> {
        let schema = Schema::new(name, schema_encoding, data.to_vec());
        let known = self.channels.iter().position(|channel| channel.topic() == topic);
        if let Some(known) = known {
            if self.channels[known].schema() == Some(&schema) {
                return Ok(known);
            }
            // The app takes one type for a topic at a time.
            self.channels[known].close();
        }
        let builder = ChannelBuilder::new(topic).message_encoding(encoding).schema(schema);
        let channel = builder.context(&self.context).build_raw()?;
        Ok(match known {
            Some(known) => {
                self.channels[known] = channel;
                known
            }
            None => {
                self.channels.push(channel);
                self.channels.len() - 1
            }
        })
    }

    fn message(&mut self, channel: usize, stamp: Stamp, data: &[u8]) -> Result<(), FoxgloveError> {
        let channel = &self.channels[channel];
        if self.apps.are_too_many() || !channel.has_sinks() {
            return Ok(());
        }
        let nanoseconds = stamp.0.max(0).unsigned_abs().saturating_mul(1_000);
        channel.log_with_meta(data, PartialMetadata::with_log_time(nanoseconds));
        self.burst += 1;
        if self.burst >= BURST_MAX {
            std::thread::sleep(BURST_PAUSE);
            self.burst = 0;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_has_one_channel_which_is_replaced_when_its_type_changes() {
        let mut channels = Channels::new(Context::new(), Apps::default());
        let mut channel =
            |topic, data: &[u8]| channels.channel(topic, "protobuf", ("A", "protobuf", data)).unwrap();
        assert_eq!([channel("/a", b"1"), channel("/b", b"1"), channel("/a", b"1")], [0, 1, 0]);
        assert_eq!(channel("/a", b"2"), 0);
        assert_eq!(channels.channels[0].schema().unwrap().data[..], b"2"[..]);
        assert_eq!(channels.channels.len(), 2);
        channels.message(1, Stamp(-1), b"to nobody").unwrap();
        channels.clear();
        assert!(channels.channels.is_empty());
    }
}
