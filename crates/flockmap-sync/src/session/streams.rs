//! Streams that get a place, and those that lose it.

use super::Session;
use crate::event::Event;
use crate::peer::{Peer, is_heard};
use crate::store::Opened;
use flockmap_grid::Stream;

impl Session {
    /// Opens a place for a stream and reports it to the driver; whether there is one.
    pub(super) fn open_stream(&mut self, stream: Stream) -> bool {
        match self.store.open(stream, self.clocks.now(), |robot| is_heard(&self.peers, robot)) {
            Ok(Opened { is_new, forgotten }) => {
                if let Some(forgotten) = forgotten {
                    self.report.counters.streams_forgotten += 1;
                    self.forget_stream(forgotten);
                }
                if is_new {
                    self.peers.values_mut().for_each(Peer::plan_anew);
                    self.push_event(Event::StreamSeen(stream));
                }
                true
            }
            Err(_) => {
                self.report.counters.too_many_streams += 1;
                false
            }
        }
    }

    pub(super) fn forget_stream(&mut self, stream: Stream) {
        for peer in self.peers.values_mut() {
            if peer.streams.remove(&stream).is_some_and(|theirs| !theirs.received.is_empty()) {
                peer.note_unplaced(stream);
            }
            peer.in_flight.retain(|sent| sent.item.stream() != stream);
            peer.plan_anew();
        }
        self.inbox.forget(stream);
        // What of it was not polled yet must not be taken for what comes of it from now on.
        self.inbox.drop_upto(stream, u32::MAX);
        self.mender.forget(stream);
        self.outbox.broadcasts.forget(stream);
        self.report
            .events
            .retain(|event| !matches!(event, Event::Received(package) if package.header().stream == stream));
        self.outbox.snapshots.retain(|outgoing| outgoing.stream != stream);
        self.outbox.asked.remove(&stream);
        self.outbox.held_when_asked.remove(&stream);
        self.outbox.coming.remove(&stream);
        self.lacks.forget(stream);
        self.clocks.forget(stream);
        self.push_event(Event::StreamForgotten(stream));
    }
}
