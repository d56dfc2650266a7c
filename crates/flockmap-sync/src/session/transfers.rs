//! Snapshots that come in, chunk by chunk.

use super::Session;
use super::rest::Complete;
use crate::IntervalSet;
use crate::event::Event;
use crate::inbox::{ABANDONED, Transfer};
use crate::item::Item;
use crate::peer::Peer;
use core::time::Duration;
use flockmap_codec::Package;
use flockmap_grid::{RobotId, Stamp, Stream};

impl Session {
    pub(super) fn receive_chunk(&mut self, now: Stamp, mut chunk_of: Transfer, chunk: u32, package: Package) {
        let (stream, upto) = (chunk_of.stream, chunk_of.upto);
        self.store.note_newest(stream, upto, now);
        let is_held = self.store.received(stream).is_some_and(|received| received.contains_range(1, upto));
        chunk_of.is_rest = is_held && self.takes_rest(&chunk_of);
        if is_held && !chunk_of.is_rest {
            self.report.counters.duplicates += 1;
            return;
        }
        let from = chunk_of.source;
        let at = match self.inbox.transfers.iter().position(|transfer| transfer.is_same(&chunk_of)) {
            Some(at) => at,
            None => {
                // Sets of one robot are kept side by side: by broadcast, one that it sends to somebody else is
                // heard among the chunks of the one for us.
                if self.inbox.transfers.len() >= self.config.transfers_max {
                    self.finish_transfers(now);
                }
                if self.inbox.transfers.len() >= self.config.transfers_max {
                    self.report.counters.transfers_dropped += u64::from(self.inbox.make_room(
                        &chunk_of,
                        self.identity.own.origin,
                        self.config.cast,
                        &self.store,
                    ));
                }
                if self.inbox.transfers.len() >= self.config.transfers_max {
                    self.report.counters.too_many_transfers += 1;
                    return;
                }
                self.begin_anew_where_dropped(&mut chunk_of);
                self.inbox.transfers.push(chunk_of);
                self.inbox.transfers.len() - 1
            }
        };
        let transfer = &mut self.inbox.transfers[at];
        let item = Item::Chunk { stream, snapshot_id: transfer.snapshot_id, chunk };
        let received = transfer.accepted.contains(chunk + 1);
        if !received {
            // One of which nothing new comes keeps its place from others no longer than one of which nothing
            // comes.
            transfer.touched = now;
        }
        self.deliver(now, from, item, received, package);
        // If the rest gets lost, say soon which chunks are missing.
        self.note_gap(now, false);
    }

    pub(super) fn accept_chunk(
        &mut self,
        now: Stamp,
        from: RobotId,
        (stream, snapshot_id): (Stream, u32),
        chunk: u32,
        newest: Stamp,
    ) {
        let found = self
            .inbox
            .transfers
            .iter()
            .position(|t| (t.source, t.stream, t.snapshot_id) == (from, stream, snapshot_id));
        let Some(at) = found else { return };
        let transfer = &mut self.inbox.transfers[at];
        transfer.newest = transfer.newest.max(newest);
        match self.inbox.transfers[at].accepted.insert(chunk + 1) {
            Ok(is_new) => self.report.counters.chunks_accepted += u64::from(is_new),
            Err(_) => {
                self.report.counters.too_fragmented += 1;
                return;
            }
        }
        self.finish_transfers(now);
    }

    /// The driver has let go of what the chunks of a snapshot said, and needs all of them again to go on:
    /// those merged or waiting count no more. Rejected ones stay so for their time.
    pub fn restart_snapshot(&mut self, now: Stamp, stream: Stream, snapshot_id: u32) {
        let now = self.advance(now);
        self.inbox.restart(stream, snapshot_id);
        self.report.counters.snapshots_restarted += 1;
        self.note_gap(now, true);
    }

    /// Counts as held what completely received snapshots contain; lets go of transfers that are done,
    /// superseded or abandoned.
    pub(super) fn finish_transfers(&mut self, now: Stamp) {
        let complete = self.inbox.transfers.iter().filter(|transfer| transfer.is_complete());
        let mut complete: Vec<_> = complete
            .map(|t| (Complete::of(t), t.contents.clone().map(|contents| (t.snapshot_id, contents))))
            .collect();
        // One may be what the next one waits for.
        complete.sort_unstable_by_key(|(of, _)| (of.stream, of.since, of.upto));
        for (of, contents) in complete {
            let Complete { stream, since, upto, .. } = of;
            let Some(received) = self.store.received(stream) else { continue };
            // What is wanting before it comes as packages, or by another snapshot.
            let prefix = received.prefix();
            let by_prefix = (prefix >= since && prefix < upto)
                .then(|| IntervalSet::from_intervals(1, vec![(since + 1, upto)]));
            let (news, contents) = match (by_prefix, contents) {
                (Some(news), _) => (news, None),
                (None, Some((snapshot_id, contents))) => {
                    (contents.difference(received), Some((snapshot_id, contents)))
                }
                (None, None) => {
                    // Its packages are held already: if it is anything, the rest of what was lacking.
                    if prefix >= upto {
                        self.note_complete(now, &of);
                    }
                    continue;
                }
            };
            if news.is_empty() {
                continue;
            }
            let is_whole = contents.is_none();
            let mut is_received = true;
            for &(low, high) in news.intervals() {
                is_received &= self.store.hold(stream, low, high, now).is_ok();
            }
            self.inbox.settle(stream, &news);
            if is_received {
                self.report.counters.caught_up += 1;
                if is_whole {
                    self.note_complete(now, &of);
                    if let Some(newest) = of.newest_of_piece {
                        self.store.note_stamp(stream, upto, newest);
                    }
                }
                let upto = self.store.received(stream).map_or(0, IntervalSet::prefix);
                if let Some((snapshot_id, received)) = contents {
                    self.push_event(Event::SnapshotContains { stream, snapshot_id, received });
                }
                self.push_event(Event::CaughtUp { stream, upto });
                self.mark_queues_stale();
                // The sender should learn soon that it can stop, and what came after.
                self.greet(now);
            } else {
                // Stays complete, and counts once some gaps are filled.
                self.report.counters.too_fragmented += 1;
            }
        }
        let Self { inbox, store, peers, .. } = self;
        let patience = |source| peers.get(&source).map_or(ABANDONED, Peer::transfer_patience);
        inbox.transfers.iter_mut().for_each(|transfer| transfer.is_rest &= !transfer.is_complete());
        self.report.counters.transfers_dropped += inbox.drop_done(now, store, patience);
    }

    /// A snapshot from or to a robot of which nothing comes for so long is given up.
    pub(super) fn transfer_patience(&self, robot: RobotId) -> Duration {
        self.peers.get(&robot).map_or(ABANDONED, Peer::transfer_patience)
    }

    /// What was read is let go of of snapshots with no packages beyond these; those that bring the rest of a stream
    /// begin again.
    pub(super) fn restart_rests(&mut self, stream: Stream, upto: u32) {
        let rests = self.inbox.transfers.iter().filter(|t| t.is_rest && t.stream == stream && t.upto <= upto);
        let rests: Vec<u32> = rests.map(|transfer| transfer.snapshot_id).collect();
        for snapshot_id in rests {
            self.restart_snapshot(self.clocks.now(), stream, snapshot_id);
        }
    }
}
