//! Who listens to what, and who cannot: what discovery says.
//!
//! `ros2_client::Spinner` would do the first, and keeps the second to itself.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ros2_client::dds::rustdds::{DomainParticipantStatusEvent as Event, GUID, QosPolicies};

/// What is known of the other side of each topic. Clones share it.
#[derive(Clone, Default)]
pub(crate) struct Links(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    /// Own readers and writers, by the topic's full name.
    own: BTreeMap<GUID, String>,
    /// Those on the other side.
    matched: BTreeMap<GUID, BTreeSet<GUID>>,
    /// Readers and writers that wanted what cannot be.
    incompatible: u64,
}

impl Links {
    /// An own reader or writer.
    pub(crate) fn add(&self, own: GUID, topic: String) {
        self.lock().own.insert(own, topic);
    }

    /// How many are on the other side.
    pub(crate) fn count(&self, own: GUID) -> usize {
        self.lock().matched.get(&own).map_or(0, BTreeSet::len)
    }

    /// How many could not be matched, since their QoS does not fit.
    pub(crate) fn incompatible(&self) -> u64 {
        self.lock().incompatible
    }

    /// Takes what discovery says. Returns what there is to tell people.
    pub(crate) fn take(&self, event: Event) -> Option<String> {
        let mut state = self.lock();
        match event {
            Event::RemoteReaderMatched { local_writer: own, remote_reader: other }
            | Event::RemoteWriterMatched { local_reader: own, remote_writer: other } => {
                state.matched.entry(own).or_default().insert(other);
                None
            }
            Event::ReaderLost { guid, .. } | Event::WriterLost { guid, .. } => {
                for others in state.matched.values_mut() {
                    others.remove(&guid);
                }
                None
            }
            Event::ParticipantLost { id, .. } => {
                state.matched.values_mut().for_each(|others| others.retain(|other| other.prefix != id));
                None
            }
            Event::RemoteReaderQosIncompatible { local_writer, requested_qos, offered_qos, .. } => {
                let topic = state.own.get(&local_writer)?.clone();
                state.incompatible += 1;
                Some(format!(
                    "a subscriber to {topic} gets nothing: it asks for {}",
                    difference(&requested_qos, &offered_qos)
                ))
            }
            Event::RemoteWriterQosIncompatible { local_reader, requested_qos, offered_qos, .. } => {
                let topic = state.own.get(&local_reader)?.clone();
                state.incompatible += 1;
                Some(format!(
                    "nothing comes from a publisher of {topic}: this node asks for {}",
                    difference(&requested_qos, &offered_qos)
                ))
            }
            _ => None,
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // What a thread that panicked has left behind is whole.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// In words, what is asked for and not offered.
fn difference(requested: &QosPolicies, offered: &QosPolicies) -> String {
    let mut parts = Vec::new();
    if requested.reliability() != offered.reliability() && requested.reliability().is_some() {
        parts.push("reliable delivery, and best effort is offered");
    }
    if requested.durability() != offered.durability() && requested.durability().is_some() {
        parts.push("what was sent before (transient local), and only what is new (volatile) is offered");
    }
    if parts.is_empty() {
        return format!("{requested:?}, and {offered:?} is offered");
    }
    parts.join("; ")
}
