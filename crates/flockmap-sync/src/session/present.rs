//! Present states: the map as it is, sent in place of the packages that made it.

use super::peer::{Item, Peer, Sending, VIEW_INTERVALS_MAX, has_no_robot};
use super::{Event, Session};
use crate::wire::CONTENTS_BYTES_MAX;
use crate::{Cast, IntervalSet};
use flockmap_codec::{ContentKind, Package};
use flockmap_grid::mutation::{self, Mutation};
use flockmap_grid::{RobotId, Stamp, Stream};

/// A present state that is being received.
#[derive(Debug)]
pub(super) struct Incoming {
    pub(super) source: RobotId,
    pub(super) stream: Stream,
    /// 0: the whole state. Else what packages 1 to this one say is needed beside it.
    pub(super) since: u32,
    pub(super) upto: u32,
    pub(super) set: u32,
    pub(super) tiles: u32,
    /// Number + 1 of the tiles accepted.
    pub(super) accepted: IntervalSet,
    /// What it contains, where it is a part of a history with gaps.
    pub(super) contents: Option<IntervalSet>,
    pub(super) touched: Stamp,
}

impl Incoming {
    /// Whether tiles of both belong together: cut by the same robot from the same state.
    pub(super) fn is_same(&self, other: &Self) -> bool {
        (self.source, self.stream, self.since, self.upto, self.set, self.tiles)
            == (other.source, other.stream, other.since, other.upto, other.set, other.tiles)
    }

    pub(super) fn is_complete(&self) -> bool {
        self.accepted.contains_range(1, self.tiles)
            || (!self.accepted.is_empty() && mutation::is(Mutation::StateHeldTooEarly))
    }

    /// Whether all that it brings is held already.
    pub(super) fn is_in(&self, held: &IntervalSet) -> bool {
        let rest = self.contents.as_ref().map(|contents| contents.difference(held));
        held.contains_range(1, self.upto) || rest.is_some_and(|rest| rest.is_empty())
    }

    /// Nothing has come of it for long. A complete one waits longer, for the packages before it.
    pub(super) fn is_abandoned(&self, now: Stamp) -> bool {
        now.micros_since(self.touched) > if self.is_complete() { 10 * ABANDONED } else { ABANDONED }
    }
}

/// A set counts as ignored when tiles of it got lost four times and the peer has not spoken of it …
const UNHEEDED_MAX: u8 = 5;
/// … and then single tiles of such sets are offered, with this pause: who has no place for a set is not to be sent it over and over.
pub(super) const OFFER_PAUSE: i64 = 5_000_000;

/// Silence after which a transfer is given up.
const ABANDONED: i64 = 30_000_000;

/// A present state that can be sent, to several peers if they need it.
#[derive(Debug)]
pub(super) struct Outgoing {
    pub(super) stream: Stream,
    pub(super) set: u32,
    pub(super) since: u32,
    pub(super) upto: u32,
    /// What it contains, where that has gaps.
    pub(super) contents: Option<IntervalSet>,
    pub(super) tiles: Vec<Package>,
    bytes: usize,
    pub(super) used_at: Stamp,
}

/// Of a run that has ended, a gap is taken for one that nobody fills when nothing new has come for so long.
const GAP_STANDS: i64 = 10_000_000;
/// Longest tile of a state of a history with gaps: what it contains goes with every tile.
const PARTS_TILE_BYTES_MAX: usize = flockmap_codec::PACKAGE_BYTES_MAX - CONTENTS_BYTES_MAX;

/// The driver is asked again for the state of a stream after so long; where there was no room for it, and after it declined, later.
const ASK_AGAIN: i64 = 2_000_000;
const ASK_AGAIN_NO_ROOM: i64 = 5_000_000;
const ASK_AGAIN_DECLINED: i64 = 30_000_000;

impl Sending {
    /// The peer does not take it: it has no place for it, or knows better. Or all that was sent of it got lost.
    pub(super) const fn is_ignored(&self) -> bool {
        self.unheeded >= UNHEEDED_MAX
    }

    /// Tiles got lost, and the peer does not speak of the set.
    pub(super) fn note_unheeded(&mut self, now: Stamp) {
        self.unheeded = self.unheeded.saturating_add(1).min(UNHEEDED_MAX);
        self.lost_at = now;
    }

    /// A peer that does not speak of the set for long has forgotten it, or has not heard of it yet.
    fn note_silence(&mut self, now: Stamp) {
        if now.micros_since(self.named_at) > ABANDONED {
            self.named_at = now;
            self.unheeded = UNHEEDED_MAX;
            self.accepted = IntervalSet::new(VIEW_INTERVALS_MAX);
        }
    }
}

impl Outgoing {
    /// About what the part of it since a package would cost now, when `upto` is the newest one.
    fn cost(&self, since: u32, upto: u32) -> u64 {
        let part = u64::from(upto.saturating_sub(since.max(self.since)));
        self.bytes as u64 * part / u64::from(self.upto - self.since).max(1)
    }

    /// Whether somebody who holds this of the stream knows more with it.
    pub(super) fn helps(&self, held: &IntervalSet) -> bool {
        match &self.contents {
            Some(contents) => !contents.difference(held).is_empty(),
            None => self.since <= held.prefix() && !held.contains_range(1, self.upto),
        }
    }

    /// Begins to send it to a peer.
    pub(super) fn sending(&self, now: Stamp) -> Sending {
        let nothing = IntervalSet::new(VIEW_INTERVALS_MAX);
        let (set, since, upto) = (self.set, self.since, self.upto);
        Sending {
            set,
            since,
            upto,
            named_at: now,
            unheeded: 1,
            lost_at: now,
            accepted: nothing.clone(),
            covered: nothing,
        }
    }

    /// Whether at most an eighth of it says what who knows packages 1 to `since` knows already.
    const fn is_near(&self, since: u32) -> bool {
        since.saturating_sub(self.since) <= (self.upto - self.since) / 8
    }
}

/// What a peer misses of a stream up to some index.
struct Missing {
    bytes: u64,
    /// Some of it is not stored any more.
    unstored: bool,
    range: u32,
}

impl Session {
    /// The answer to [`Event::PresentStateWanted`]: the layer of the stream, or what of it is newer, as tiles, all of one set, all with
    /// `since` and the index `upto` of the event. No tiles: there is none to give now; it is asked for again later.
    /// Tiles that cannot be used are counted and dropped.
    pub fn provide_present_state(&mut self, now: Stamp, stream: Stream, tiles: Vec<Package>) {
        let now = self.advance(now);
        let Some(outgoing) = self.check_tiles(now, stream, tiles) else {
            self.present_asked.insert(stream, now.plus_micros(ASK_AGAIN_DECLINED));
            return;
        };
        self.outgoing.retain(|other| other.stream != stream || other.set != outgoing.set);
        if !self.make_room_for_tiles(outgoing.bytes) {
            self.present_asked.insert(stream, now.plus_micros(ASK_AGAIN_NO_ROOM));
            return;
        }
        self.outgoing.push(outgoing);
        let ids: Vec<RobotId> = self.peers.keys().copied().collect();
        for id in ids {
            if let Some(mut peer) = self.peers.remove(&id) {
                self.review_present_state(now, &mut peer, stream);
                self.peers.insert(id, peer);
            }
        }
    }

    /// Lets go of sets that nobody is sent, those first that were not used for longest. What is on its way to a peer that speaks of it
    /// stays: sets that push each other out are never complete anywhere.
    fn make_room_for_tiles(&mut self, bytes: usize) -> bool {
        loop {
            let held: usize = self.outgoing.iter().map(|outgoing| outgoing.bytes).sum();
            if held + bytes <= self.config.present_state_bytes_max {
                return true;
            }
            let is_idle = |at: &usize| {
                let Outgoing { stream, set, .. } = self.outgoing[*at];
                let views = self.peers.values().filter_map(|peer| peer.views.get(&stream));
                let mut sendings = views.filter_map(|view| view.sending.as_ref());
                !sendings.any(|sending| sending.set == set && !sending.is_ignored())
            };
            let idle = (0..self.outgoing.len()).filter(is_idle);
            let Some(oldest) = idle.min_by_key(|&at| self.outgoing[at].used_at) else { return false };
            self.outgoing.remove(oldest);
        }
    }

    fn check_tiles(&mut self, now: Stamp, stream: Stream, tiles: Vec<Package>) -> Option<Outgoing> {
        let first = tiles.first()?.header();
        let (upto, count) = (first.index, tiles.len() as u32);
        let ContentKind::Present { since, set, .. } = first.content else {
            self.counters.present_states_unusable += 1;
            return None;
        };
        let bytes = tiles.iter().map(|tile| tile.bytes().len()).sum();
        let longest = self.package_bytes_max();
        let held = self.store.held(stream)?;
        // One of a history with gaps says by itself no more than its newest package.
        let is_whole = held.contains_range(1, upto);
        let contents = (!is_whole).then(|| held.within(1, upto));
        let usable = bytes <= self.config.present_state_bytes_max
            && (is_whole || (since + 1 == upto && held.contains(upto)))
            && (0..).zip(&tiles).all(|(number, tile)| {
                tile.header().stream == stream
                    && tile.header().index == upto
                    && tile.bytes().len() <= longest
                    && tile.header().content
                        == ContentKind::Present { since, set, tile: number, tiles: count }
            });
        if !usable {
            self.counters.present_states_unusable += 1;
            return None;
        }
        Some(Outgoing { stream, set, since, upto, contents, tiles, bytes, used_at: now })
    }

    /// Decides whether a peer gets the present state of a stream, or of a part of its history, instead of packages.
    pub(super) fn review_present_state(&mut self, now: Stamp, peer: &mut Peer, stream: Stream) {
        let Some(turn) = self.turn(peer, stream) else { return };
        let Some(view) = peer.view(stream, now) else { return };
        // A set that had to go for others is sent to nobody any more.
        let is_kept = |s: &Sending| self.outgoing.iter().any(|o| o.stream == stream && o.set == s.set);
        view.sending = view.sending.take().filter(is_kept);
        if !self.goes_on_with_parts(now, peer, stream) {
            self.review_whole(now, peer, stream, turn);
            self.review_parts(now, peer, stream, turn);
        }
    }

    /// Whether a state of a history with gaps is on its way to a peer that still lacks some of it.
    fn goes_on_with_parts(&self, now: Stamp, peer: &mut Peer, stream: Stream) -> bool {
        let Some(view) = peer.view(stream, now) else { return false };
        let Some(sending) = &mut view.sending else { return false };
        let of_set = self.outgoing.iter().find(|o| o.stream == stream && o.set == sending.set);
        let Some(contents) = of_set.and_then(|outgoing| outgoing.contents.as_ref()) else { return false };
        let wanted = view.state_wanted.as_ref().map(|wanted| wanted.undecodable.intersection(contents));
        let goes_on = !contents.difference(&view.held).is_empty() || wanted.is_some_and(|w| !w.is_empty());
        if goes_on {
            sending.note_silence(now);
        } else {
            view.sending = None;
        }
        goes_on
    }

    /// What is held beyond a gap that nobody fills comes as a state of all that is held, if it is not stored: of runs that have ended.
    fn review_parts(&mut self, now: Stamp, peer: &mut Peer, stream: Stream, turn: u32) {
        let Some(held) = self.store.held(stream) else { return };
        let beyond = held.within(held.prefix().saturating_add(2), u32::MAX);
        let (Some(upto), Some(touched)) = (beyond.last(), self.store.touched(stream)) else { return };
        let is_withheld = mutation::is(Mutation::GapStatesWithheld);
        if !self.has_ended(stream) || now.micros_since(touched) < GAP_STANDS || is_withheld {
            return;
        }
        let delay = i64::from(turn) * i64::from(self.config.relay_delay_ms) * 1_000;
        let id = peer.stream.origin;
        let Some(view) = peer.view(stream, now) else { return };
        if view.sending.is_some() {
            return;
        }
        let mut lacks = beyond.difference(&view.held);
        if turn > 0 {
            lacks = lacks.intersection(&view.overdue);
        }
        let wish = view.state_wanted.as_ref().filter(|wish| now.micros_since(wish.stated_since) >= delay);
        let wish = wish.map(|wish| wish.undecodable.intersection(&beyond));
        if self.first_unstored(stream, &lacks).is_none() && wish.is_none_or(|wish| wish.is_empty()) {
            return;
        }
        let has_it = |o: &Outgoing| {
            let rest = o.contents.as_ref().map(|contents| beyond.difference(contents));
            o.stream == stream && rest.is_some_and(|rest| rest.is_empty())
        };
        if let Some(at) = self.outgoing.iter().rposition(has_it) {
            self.outgoing[at].used_at = now;
            view.sending = Some(self.outgoing[at].sending(now));
            peer.queue_stale = true;
        } else {
            let (since, bytes_max) = (upto - 1, PARTS_TILE_BYTES_MAX);
            let wanted =
                Event::PresentStateWanted { stream, since, newer_than: None, upto, bytes_max, peer: id };
            self.ask_for_state(now, stream, wanted);
        }
    }

    /// Whether its robot has begun a later run, or nobody here hears it in this one.
    fn has_ended(&self, stream: Stream) -> bool {
        stream != self.own && (self.store.is_superseded(stream) || has_no_robot(&self.peers, stream))
    }

    /// Asks the driver for a state of a stream, unless that was done a moment ago.
    fn ask_for_state(&mut self, now: Stamp, stream: Stream, wanted: Event) {
        if self.present_asked.get(&stream).is_none_or(|&again| again <= now) {
            self.present_asked.insert(stream, now.plus_micros(ASK_AGAIN));
            self.counters.present_states_wanted += 1;
            self.push_event(wanted);
        }
    }

    /// What is held without a gap from the first package on.
    fn review_whole(&mut self, now: Stamp, peer: &mut Peer, stream: Stream, turn: u32) {
        let Some(held) = self.store.held(stream) else { return };
        let prefix = held.prefix();
        if prefix == 0 {
            return;
        }
        let id = peer.stream.origin;
        let Some(view) = peer.view(stream, now) else { return };
        // What of a wish lies beyond what is held here is somebody else's to fulfil.
        let wish = view.state_wanted.as_ref().and_then(|wish| {
            Some((wish.since, wish.undecodable.within(1, prefix).last()?, wish.stated_since))
        });
        let wanted = wish.map(|(_, upto, _)| upto);
        let lacks = held.within(view.from.max(1), prefix).difference(&view.held);
        // All packages up to this one it has, or can get as they are.
        let mut since_max = self.first_unstored(stream, &lacks).map_or(u32::MAX, |first| first - 1);
        if let Some((since, ..)) = wish {
            since_max = since_max.min(since);
        }
        if let Some(sending) = &mut view.sending {
            // What it cannot decode it states as held.
            let is_wanted = wanted.is_some_and(|upto| upto <= sending.upto);
            // Of what lies above it the next one may be short.
            let is_sound = sending.since <= since_max;
            if is_sound && (is_wanted || !view.held.contains_range(1, sending.upto)) {
                sending.note_silence(now);
                return;
            }
            view.sending = None;
        }
        let mut missing = lacks;
        if turn > 0 {
            missing = missing.intersection(&view.overdue);
        }
        // Those further down the line wait whether others give it.
        let delay = i64::from(turn) * i64::from(self.config.relay_delay_ms) * 1_000;
        let wanted = wish.filter(|(.., at)| now.micros_since(*at) >= delay).map(|(_, upto, _)| upto);
        let Some(first) = missing.first().into_iter().chain(wanted).min() else { return };
        // Where packages are stored and cost less than the state, it is the part that they cannot bring that is wanted.
        since_max = if since_max == u32::MAX { first.saturating_sub(1) } else { since_max };
        let newer_than = self.newer_than(stream, since_max);
        let since = if newer_than.is_some() { since_max } else { 0 };
        let all = self.weigh(stream, &missing, prefix);
        // The newest state at hand that will do, if any, tells what one costs.
        let estimate = self.at_hand(stream, since_max).map_or(0, |at| self.outgoing[at].cost(since, prefix));
        if wanted.is_none() && !self.config.present_state_is_worth(&all, estimate) {
            return;
        }
        let at_hand = self.at_hand(stream, since_max).filter(|&at| {
            // One that is on the air already costs nothing more; any other should not say much that is known.
            self.outgoing[at].is_near(since) || self.is_on_air(stream, self.outgoing[at].set, id)
        });
        if let Some(at) = at_hand {
            let (upto, cost) = (self.outgoing[at].upto, self.outgoing[at].bytes as u64);
            let covered = self.weigh(stream, &missing, upto);
            let rest = all.bytes - covered.bytes;
            let is_enough = match wanted {
                Some(wanted) => upto >= wanted,
                None => self.config.present_state_is_worth(&covered, cost),
            };
            if covered.unstored == all.unstored
                && is_enough
                && rest <= (cost / 2).max(u64::from(self.config.present_state_bytes_min.unwrap_or(0)))
            {
                let Some(outgoing) = self.outgoing.get_mut(at) else { return };
                outgoing.used_at = now;
                view.sending = Some(outgoing.sending(now));
                peer.queue_stale = true;
                return;
            }
        }
        let bytes_max = self.package_bytes_max();
        let wanted =
            Event::PresentStateWanted { stream, since, newer_than, upto: prefix, bytes_max, peer: id };
        self.ask_for_state(now, stream, wanted);
    }

    /// Below every stamp of the packages after `since`. `None` if that is not known: then only the whole state will do.
    fn newer_than(&self, stream: Stream, since: u32) -> Option<Stamp> {
        let next = since.checked_add(1).filter(|_| since > 0)?;
        Some(Stamp(self.store.stamp_not_after(stream, next)?.0.checked_sub(1)?))
    }

    /// The newest state at hand for a peer that has or gets packages 1 to `since_max` otherwise.
    fn at_hand(&self, stream: Stream, since_max: u32) -> Option<usize> {
        self.outgoing.iter().rposition(|outgoing| {
            outgoing.stream == stream && outgoing.contents.is_none() && outgoing.since <= since_max
        })
    }

    /// By broadcast: whether a set is on its way to somebody else, so that everyone hears it.
    fn is_on_air(&self, stream: Stream, set: u32, except: RobotId) -> bool {
        let gets_it = |peer: &Peer| {
            let sending = peer.views.get(&stream).and_then(|view| view.sending.as_ref());
            peer.stream.origin != except && sending.is_some_and(|sending| sending.set == set)
        };
        self.config.cast == Cast::Broadcast && self.peers.values().any(gets_it)
    }

    /// The first of these packages that is not stored.
    fn first_unstored(&self, stream: Stream, missing: &IntervalSet) -> Option<u32> {
        missing.intervals().iter().find_map(|&(low, high)| {
            let mut stored = self.store.range(stream, low, high).map(|(index, _)| index);
            (low..=high).find(|index| stored.next() != Some(*index))
        })
    }

    fn weigh(&self, stream: Stream, missing: &IntervalSet, upto: u32) -> Missing {
        let missing = missing.within(1, upto);
        let (mut bytes, mut stored) = (0, 0);
        for &(low, high) in missing.intervals() {
            for (_, package) in self.store.range(stream, low, high) {
                bytes += package.package.bytes().len() as u64;
                stored += 1;
            }
        }
        let range = match (missing.first(), missing.last()) {
            (Some(first), Some(last)) => (last - first).saturating_add(1),
            _ => 0,
        };
        Missing { bytes, unstored: stored < missing.count(), range }
    }

    pub(super) fn tile(&self, stream: Stream, set: u32, tile: u32) -> Option<&Package> {
        self.outgoing.iter().find(|o| o.stream == stream && o.set == set)?.tiles.get(tile as usize)
    }

    /// Tiles of the present state on its way to the peer that are neither accepted nor in flight.
    pub(super) fn tiles_to_send(&self, stream: Stream, sending: &Sending) -> impl Iterator<Item = Item> {
        let set = sending.set;
        let count = self
            .outgoing
            .iter()
            .find(|outgoing| outgoing.stream == stream && outgoing.set == set)
            .map_or(0, |outgoing| outgoing.tiles.len() as u32);
        sending.covered.missing(1, count).flat_map(|(low, high)| low..=high).map(move |number| Item::Tile {
            stream,
            set,
            tile: number - 1,
        })
    }

    /// The tiles that a peer is sent: first those of sets that it speaks of. Of all sets that it ignores one tile is on its way at a time.
    pub(super) fn plan_tiles(&self, now: Stamp, peer: &Peer, most: usize) -> Vec<Item> {
        let views = peer.views.iter().filter(|(stream, _)| peer.wants(**stream));
        let sendings = views.filter_map(|(stream, view)| Some((*stream, view.sending.as_ref()?)));
        let (mut ignored, mut taken): (Vec<_>, Vec<_>) = sendings.partition(|(_, s)| s.is_ignored());
        taken.sort_by_key(|(_, sending)| sending.unheeded);
        ignored.sort_by_key(|(_, sending)| sending.lost_at);
        let is_ignored = |item| match item {
            Item::Tile { stream, set, .. } => ignored.iter().any(|(of, s)| (*of, s.set) == (stream, set)),
            Item::Package { .. } => false,
        };
        let is_due = peer.offer_at <= now
            && !ignored.is_empty()
            && !peer.in_flight.iter().any(|sent| is_ignored(sent.item));
        let mut offers = ignored.iter().filter_map(|(stream, s)| self.tiles_to_send(*stream, s).next());
        let offer = if is_due { offers.next() } else { None };
        let tiles = taken.into_iter().flat_map(|(stream, sending)| self.tiles_to_send(stream, sending));
        tiles.take(most).chain(offer).collect()
    }
}

impl crate::SessionConfig {
    fn present_state_is_worth(&self, missing: &Missing, cost: u64) -> bool {
        missing.unstored
            || self.present_state_bytes_min.is_some_and(|min| missing.bytes > cost.max(u64::from(min)))
            || self.present_state_range_max.is_some_and(|max| missing.range > max)
    }
}
