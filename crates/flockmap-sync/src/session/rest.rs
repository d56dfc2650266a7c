//! Streams of which something is lacking here, since it was dropped for want of room: who says so, and how it comes
//! back when there is room again.
//!
//! What was dropped counts as held: nobody sends it unasked. A robot that has room asks one robot after the other for a
//! snapshot of all that it has, those first of which nothing is lacking.

use super::Session;
use crate::event::Event;
use crate::inbox::Transfer;
use crate::lacks::{Lack, Rest, note};
use crate::outbox::Outgoing;
use crate::peer::{Peer, brings_rest};
use crate::wire::{InPart, RestRequest};
use flockmap_codec::{ContentKind, Header};
use flockmap_grid::{RobotId, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};

impl Session {
    /// Something of a stream was dropped from its layer for want of room, or is lacking there since it came late:
    /// nothing newer than `upto`. `is_anywhere`: of hardly any place it can be said that nothing was dropped there.
    pub fn note_dropped(&mut self, stream: Stream, upto: Stamp, is_anywhere: bool) {
        if self.store.received(stream).is_none() {
            return;
        }
        let lack = self.lacks.lack(stream, upto);
        lack.is_anywhere |= is_anywhere;
        self.spoil_transfers(stream);
    }

    /// Before a chunk is merged of a snapshot that lacks something ([`Header::lost_upto`]): whether what is known of the
    /// stream that is as old has to be taken out first, since the snapshot may make it outdated without saying so. Then that
    /// counts as lacking.
    pub fn begin_part(&mut self, header: &Header) -> bool {
        let &Header { stream, index, changed_upto, lost_upto: Some(lost_upto), .. } = header else {
            return false;
        };
        let is_held = self.store.received(stream).is_some_and(|received| received.contains_range(1, index));
        // All pieces of a state are made of the same one, which lacked the same.
        let upto = changed_upto.map_or(index, |changed| changed.max(index));
        let begun = self.lacks.streams.get(&stream).and_then(|lack| lack.begun);
        if is_held || begun.is_some_and(|(index, stamp)| index >= upto && stamp >= lost_upto) {
            return false;
        }
        let (index, stamp) = begun.unwrap_or((upto, lost_upto));
        let lack = self.lacks.lack(stream, lost_upto);
        (lack.begun, lack.is_anywhere) = (Some((index.max(upto), stamp.max(lost_upto))), true);
        self.spoil_transfers(stream);
        true
    }

    /// Whether what a chunk of a snapshot says may come back where something was dropped: it is of a state that has all
    /// packages of which something is lacking here.
    pub fn brings_back(&self, header: &Header) -> bool {
        let &Header { stream, content: ContentKind::Snapshot { id, .. }, .. } = header else {
            return false;
        };
        // A state of a history with gaps has not.
        let has_gaps = |t: &Transfer| (t.stream, t.snapshot_id) == (stream, id) && t.contents.is_some();
        self.has_lacking(stream, header.newest_of()) && !self.inbox.transfers.iter().any(has_gaps)
    }

    /// Whether a state that says the newest of packages 1 to `upto` has all packages of which something is lacking here.
    fn has_lacking(&self, stream: Stream, upto: u32) -> bool {
        // Of packages that another snapshot brings when it is complete something may be gone as well.
        let is_beyond = |t: &Transfer| t.stream == stream && t.is_spoiled && t.upto > upto;
        self.lacking_upto(stream).is_some_and(|lacking| upto >= lacking)
            && !self.inbox.transfers.iter().any(is_beyond)
    }

    /// Of a stream of which something is lacking here: that is nothing newer than this. `None`: nothing is lacking.
    pub fn lost_upto(&self, stream: Stream) -> Option<Stamp> {
        self.lacks.streams.get(&stream).map(|lack| lack.upto)
    }

    /// Whether there is room for what is lacking, so that it can be asked for.
    pub fn set_has_room(&mut self, has_room: bool) {
        if has_room && !self.lacks.has_room {
            self.lacks.streams.values_mut().for_each(|lack| lack.done.clear());
        }
        self.lacks.has_room = has_room;
    }

    /// Streams of which nothing is lacking any more, since all of it has come. To be asked for with each event, before
    /// the event is dealt with.
    pub fn take_complete(&mut self) -> Vec<Stream> {
        core::mem::take(&mut self.lacks.ended)
    }

    /// Whether some robot here can decode hardly anything of the own stream that is not independent.
    pub fn is_independent_wanted(&self) -> bool {
        let own = self.identity.own;
        let wants = |peer: &Peer| peer.streams.get(&own).and_then(|theirs| theirs.in_part) == Some(true);
        self.peers.values().any(wants)
    }

    /// The streams for whose rest somebody is asked, or will be. O(streams that lack something · peers).
    pub fn rests_wanted(&self) -> impl Iterator<Item = Stream> + '_ {
        let streams = self.lacks.streams.iter();
        let wanted =
            streams.filter(|(stream, lack)| lack.asked.is_some() || self.who_has_rest(**stream).is_some());
        wanted.map(|(stream, _)| *stream)
    }

    /// All packages of which something is lacking are up to this one.
    fn lacking_upto(&self, stream: Stream) -> Option<u32> {
        let lack = self.lacks.streams.get(&stream)?;
        let by_stamp = self.store.index_upto(stream, lack.upto);
        let holds =
            |index| self.store.received(stream).is_some_and(|received| received.contains_range(1, index));
        Some(match lack.begun {
            // Until its packages are held nothing is known of the stamps of those: they may count later without coming
            // again.
            Some((index, _)) if !holds(index) => by_stamp.max(index),
            _ => by_stamp,
        })
    }

    /// A snapshot begins to come. The same may have come before, from anybody, and may be gone again: the rest of a
    /// stream is read anew then, and any other does not count as all.
    pub(super) fn begin_anew_where_dropped(&mut self, transfer: &mut Transfer) {
        let (stream, snapshot_id) = (transfer.stream, transfer.snapshot_id);
        let is_lacking = self.lacks.streams.contains_key(&stream) && self.inbox.has_read(stream, snapshot_id);
        if (is_lacking && transfer.is_rest) || self.inbox.is_spoiled(stream, snapshot_id) {
            self.inbox.restart(stream, snapshot_id);
            self.push_event(Event::SnapshotDropped { stream, snapshot_id });
        } else {
            transfer.is_spoiled = is_lacking;
        }
    }

    /// What snapshots that are coming brought may be gone again.
    fn spoil_transfers(&mut self, stream: Stream) {
        self.inbox.spoil(stream);
        if let Some(lack) = self.lacks.streams.get_mut(&stream) {
            lack.rest = Rest::default();
        }
    }

    /// Whether a snapshot that is coming, whose packages are all held, is the rest of its stream.
    pub(super) fn takes_rest(&self, transfer: &Transfer) -> bool {
        let Some(lack) = self.lacks.streams.get(&transfer.stream) else { return false };
        let is_asked = lack.asked.is_some_and(|(robot, _)| robot == transfer.source);
        // What was stored on the own disk is given unasked.
        (is_asked || transfer.source == self.identity.own.origin)
            && transfer.since <= lack.rest.upto
            && transfer.upto > lack.rest.upto
            && self.has_lacking(transfer.stream, transfer.newest_of)
    }

    /// All chunks of a snapshot were merged.
    pub(super) fn note_complete(&mut self, now: Stamp, transfer: &Complete) {
        let &Complete { source, stream, since, upto, newest_of, lacks_too, .. } = transfer;
        // Nor may anything be gone again of packages that another one brings when it is complete.
        let is_any_spoiled = self.inbox.transfers.iter().any(|t| t.stream == stream && t.is_spoiled);
        let is_of_rest = !is_any_spoiled && self.has_lacking(stream, newest_of);
        let Some(lacking) = self.lacking_upto(stream) else { return };
        let is_next = |lack: &&mut Lack| since <= lack.rest.upto && !transfer.has_gaps;
        let Some(lack) = self.lacks.streams.get_mut(&stream).filter(is_next) else { return };
        let rest = &mut lack.rest;
        if is_of_rest {
            *rest = Rest { upto: rest.upto.max(upto), lacks_too: rest.lacks_too || lacks_too };
            if rest.upto < lacking {
                // Further pieces are to come.
                lack.asked = lack.asked.map(|(robot, _)| (robot, now));
                self.greet(now);
                return;
            }
        }
        let Rest { lacks_too, .. } = core::mem::take(rest);
        if is_of_rest && !lacks_too {
            self.lacks.forget(stream);
            self.lacks.ended.push(stream);
            // A better one can be given now.
            self.outbox.snapshots.retain(|outgoing| outgoing.stream != stream || !outgoing.is_in_part);
        } else {
            // One that lacks nothing can give it once more.
            if lacks_too || transfer.lacks_too {
                note(&mut lack.done, source);
            }
            lack.asked = lack.asked.filter(|(robot, _)| *robot != source);
        }
    }

    /// Chooses who is asked for the rest of each stream. O(streams that lack something · peers).
    pub(super) fn choose_who_is_asked(&mut self, now: Stamp) {
        let lacking: Vec<Stream> =
            self.lacks.streams.keys().copied().filter(|s| *s != self.identity.own).collect();
        for stream in lacking {
            let comes_since = |source: RobotId| {
                let is_of = |t: &&Transfer| (t.source, t.stream) == (source, stream);
                self.inbox.transfers.iter().filter(is_of).map(|transfer| transfer.touched).max()
            };
            let Some(lack) = self.lacks.streams.get(&stream) else { continue };
            let (mut asked, mut given_up) = (lack.asked, None);
            if let Some((robot, since)) = asked {
                let since = comes_since(robot).map_or(since, |touched| touched.max(since));
                let is_late = now.since(since) > self.transfer_patience(robot);
                if is_late || !self.peers.contains_key(&robot) || !self.lacks.has_room {
                    given_up = Some(robot).filter(|_| is_late);
                    asked = None;
                }
            }
            if let Some(lack) = self.lacks.streams.get_mut(&stream) {
                given_up.into_iter().for_each(|robot| note(&mut lack.late, robot));
            }
            let asked = asked.or_else(|| Some((self.who_has_rest(stream)?, now)));
            if let Some(lack) = self.lacks.streams.get_mut(&stream) {
                lack.asked = asked;
                if asked.is_none() {
                    lack.late.clear();
                }
            }
        }
    }

    /// Who may have what is lacking of a stream and was not asked yet, if there is room for it.
    fn who_has_rest(&self, stream: Stream) -> Option<RobotId> {
        let (lack, upto) = (self.lacks.streams.get(&stream)?, self.lacking_upto(stream)?);
        let lacks_too =
            |peer: &Peer| peer.streams.get(&stream).is_some_and(|theirs| theirs.in_part.is_some());
        let has_all = |peer: &&Peer| {
            let theirs = peer.streams.get(&stream);
            theirs.is_some_and(|theirs| theirs.received.contains_range(1, upto))
                // It may have got the rest itself meanwhile.
                && !(lacks_too(peer) && lack.done.contains(&peer.stream.origin))
                && !lack.late.contains(&peer.stream.origin)
        };
        // Of a state that comes in pieces there is more to come.
        let prefix = self.store.received(stream).map_or(0, |received| received.prefix());
        let is_possible = self.lacks.has_room
            && stream != self.identity.own
            && self.store.changed_upto(stream) <= prefix
            && !mutation::is(Mutation::RestUnasked);
        let peers = self.peers.values().filter(|_| is_possible).filter(has_all);
        peers.min_by_key(|peer| (lacks_too(peer), peer.stream)).map(|peer| peer.stream.origin)
    }

    /// What a request says of it.
    pub(super) fn in_part(&self, stream: Stream) -> Option<InPart> {
        let lack = self.lacks.streams.get(&stream)?;
        let upto = self.lacking_upto(stream).unwrap_or(0);
        let since = lack.rest.upto;
        let rest = lack.asked.map(|(holder, _)| RestRequest { holder, upto, since });
        Some(InPart { wants_independent: lack.is_anywhere, rest })
    }

    /// Decides whether a peer that asked for it is given the rest of a stream. `is_relay`: it is given what it lacks
    /// unasked as well.
    pub(super) fn review_rest(&mut self, now: Stamp, id: RobotId, stream: Stream, is_relay: bool) {
        let patience = self.transfer_patience(id);
        let Some(theirs) = self.peers.get_mut(&id).and_then(|peer| peer.theirs(stream, now)) else { return };
        let Some(wanted) = theirs.rest_wanted else {
            if !is_relay {
                theirs.sending = None;
            }
            return;
        };
        if let Some(sending) = &mut theirs.sending {
            // What it lacks beside the rest comes first.
            if is_relay || sending.brings_rest(&wanted) {
                sending.note_silence(now, patience);
                return;
            }
            theirs.sending = None;
        }
        let prefix = self.store.received(stream).map_or(0, |received| received.prefix());
        if prefix < wanted.upto.max(1) {
            return;
        }
        let is_in_part = self.lost_upto(stream).is_some();
        let is_it = |o: &Outgoing| {
            o.stream == stream
                && brings_rest([o.since, o.upto, o.newest_of], &wanted)
                && o.contents.is_none()
                && (is_in_part || !o.is_in_part)
        };
        if let Some(at) = self.outbox.snapshots.iter().rposition(is_it) {
            self.begin_to_send(now, id, at);
        } else {
            let (upto, bytes_max) = (prefix, self.package_bytes_max());
            let newer_than = self.store.newer_than(stream, wanted.since);
            let since = if newer_than.is_some() { wanted.since } else { 0 };
            let in_pieces = self.cuts(stream, upto).has_all;
            let wanted =
                Event::SnapshotWanted { stream, since, newer_than, upto, bytes_max, in_pieces, peer: id };
            self.request_snapshot(now, stream, wanted, None);
        }
    }

    /// Whether a snapshot of packages up to one can be made here: else it would lack something of later ones.
    pub(super) fn can_give(&self, stream: Stream, upto: u32) -> bool {
        let lost = self.lacks.streams.get(&stream);
        lost.is_none_or(|lack| self.store.index_upto(stream, lack.upto) <= upto)
    }
}

/// A snapshot of which all chunks were merged.
pub(super) struct Complete {
    pub(super) source: RobotId,
    pub(super) stream: Stream,
    pub(super) since: u32,
    pub(super) upto: u32,
    newest_of: u32,
    /// Of a piece that says nothing newer than its packages: its newest stamp.
    pub(super) newest_of_piece: Option<Stamp>,
    /// It lacks something itself.
    lacks_too: bool,
    /// It is a state of a history with gaps.
    has_gaps: bool,
}

impl Complete {
    pub(super) fn of(transfer: &Transfer) -> Self {
        let &Transfer { source, stream, since, upto, newest_of, lost_upto, is_cut, newest, .. } = transfer;
        let newest_of_piece = is_cut.then_some(newest);
        let (lacks_too, has_gaps) = (lost_upto.is_some(), transfer.contents.is_some());
        Self { source, stream, since, upto, newest_of, newest_of_piece, lacks_too, has_gaps }
    }
}
