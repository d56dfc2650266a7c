//! Events that wait to be polled.

use std::collections::VecDeque;

use crate::Event;

/// Events kept.
pub(crate) const EVENTS_MAX: usize = 1_024;
/// Bytes that their changes and packages may take: a package of a kilobyte can stand for a megabyte.
pub(crate) const EVENTS_BYTES_MAX: usize = 16 << 20;
/// A block of changes.
const BLOCK_BYTES: usize = 140;
/// An interval of indices.
const INTERVAL_BYTES: usize = 8;
/// A package, beside its bytes.
const PACKAGE_BYTES: usize = 200;

/// A queue within [`EVENTS_MAX`] and [`EVENTS_BYTES_MAX`]: for what comes on top, the oldest go.
#[derive(Default)]
pub(crate) struct Events {
    queue: VecDeque<Event>,
    bytes: usize,
}

impl Events {
    /// Adds an event; how many had to go for it.
    pub(crate) fn push(&mut self, event: Event) -> u64 {
        let bytes = bytes_of(&event);
        let mut dropped = 0;
        while self.queue.len() >= EVENTS_MAX || self.bytes + bytes > EVENTS_BYTES_MAX {
            // One that is larger than all room is kept alone.
            if self.pop().is_none() {
                break;
            }
            dropped += 1;
        }
        self.bytes += bytes;
        self.queue.push_back(event);
        dropped
    }

    /// The oldest event.
    pub(crate) fn pop(&mut self) -> Option<Event> {
        let event = self.queue.pop_front()?;
        self.bytes -= bytes_of(&event);
        Some(event)
    }
}

/// What an event holds beside itself.
fn bytes_of(event: &Event) -> usize {
    match event {
        Event::BatchClosed { changes, packages, .. } => {
            let packages: usize = packages.iter().map(|p| p.bytes().len() + PACKAGE_BYTES).sum();
            changes.blocks().len() * BLOCK_BYTES + packages
        }
        Event::Merged { changes, .. } => changes.blocks().len() * BLOCK_BYTES,
        Event::SnapshotContains { received, .. } => received.intervals().len() * INTERVAL_BYTES,
        _ => 0,
    }
}
