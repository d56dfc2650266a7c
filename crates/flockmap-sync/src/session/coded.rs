//! Coded repair, by broadcast: where several peers lack different packages of a stream, one datagram that mends what
//! each of them lacks.

use super::Session;
use crate::coded::{Block, BlockEncoder, Mended, PACKAGES_MAX, symbol_number};
use crate::inbox::Inbox;
use crate::item::Item;
use crate::wire::{Coded, Kind, PackagesWriter};
use crate::{Cast, Store};
use flockmap_codec::Package;
use flockmap_grid::{RobotId, Stamp, Stream};
use std::collections::BTreeSet;

/// Plain packages have to cost at least so many quarters of what repair symbols do.
const WORTH_QUARTERS: usize = 5;
/// Of a datagram so many records of repair symbols are read at the most: to solve for one takes up to 2.4 ms, and up to
/// 56 ms where somebody chose the symbols to that end (docs/coded-repair.md).
const CODED_RECORDS_MAX: usize = 1;

/// What a datagram of repair symbols mends.
pub(super) struct Mending {
    pub(super) writer: PackagesWriter,
    /// Who has all of these then.
    pub(super) mended: Vec<(RobotId, Vec<u32>)>,
    pub(super) stream: Stream,
}

impl Session {
    /// Repair symbols in place of a package that was sent before, if that costs fewer bytes. O(peers × packages).
    pub(super) fn mending(&mut self, now: Stamp, item: Item) -> Option<Mending> {
        let Item::Package { stream, index } = item else { return None };
        if self.config.cast != Cast::Broadcast || !self.outbox.broadcasts.was_sent(item) {
            return None;
        }
        let lacking = self.lacking_of_many(now, stream, index)?;
        let all: BTreeSet<u32> = lacking.iter().flat_map(|(_, indices)| indices.iter().copied()).collect();
        let first = *all.first()?;
        let bytes_of =
            |index: u32| self.store.get(stream, index).map_or(0, |stored| stored.package.bytes().len());
        // As many as one datagram mends.
        let header = self.header(now, Kind::Packages);
        let mut writer = PackagesWriter::new(header, self.plain_bytes_max(Kind::Packages));
        let room = self.plain_bytes_max(Kind::Packages).saturating_sub(2 * PACKAGES_MAX);
        let fits = |last: &u32| {
            let lacks = |(_, indices): &(RobotId, Vec<u32>)| {
                indices.iter().filter(|&index| index <= last).map(|&index| bytes_of(index)).sum::<usize>()
            };
            lacking.iter().map(lacks).max().unwrap_or(0) <= room
        };
        let last = all.iter().copied().take_while(fits).last()?;
        let packages: Vec<&Package> =
            self.store.range(stream, first, last).map(|(_, stored)| &stored.package).collect();
        let block = Block::of(stream, first, &packages)?;
        let room = writer.room_for_coded(&block);
        let needs = |indices: &[u32]| indices.iter().map(|&index| block.symbols_of(index)).sum::<usize>();
        let within = lacking.into_iter().map(|(id, mut indices)| {
            indices.retain(|index| *index <= last);
            (id, needs(&indices), indices)
        });
        let mended: Vec<_> = within.filter(|(_, needs, _)| (1..=room).contains(needs)).collect();
        let count = best_count(mended.iter().map(|(_, needs, _)| *needs))?;
        let mended: Vec<_> = mended.into_iter().filter(|(_, needs, _)| *needs <= count).collect();
        let plain: BTreeSet<u32> =
            mended.iter().flat_map(|(_, _, indices)| indices.iter().copied()).collect();
        let plain: usize = plain.into_iter().map(bytes_of).sum();
        if 4 * plain < WORTH_QUARTERS * (count * block.symbol_bytes() + block.layout_bytes() + 16) {
            return None;
        }
        if self.outbox.encoder.as_ref().is_none_or(|encoder| *encoder.block() != block) {
            self.outbox.encoder = BlockEncoder::new(&block, &packages);
        }
        let first_symbol = symbol_number(self.identity.own.origin, self.outbox.symbols_made);
        let symbols = self.outbox.encoder.as_ref()?.symbols(first_symbol, count);
        let sent = writer.push_coded(&Coded { block, first_symbol, symbols });
        self.outbox.symbols_made = self.outbox.symbols_made.wrapping_add(sent as u32);
        let mended = mended.into_iter().filter(|(_, needs, _)| *needs <= sent);
        Some(Mending { writer, mended: mended.map(|(id, _, indices)| (id, indices)).collect(), stream })
    }

    /// What each peer lacks that was sent before, from this package on and near it: where at least two lack
    /// something, and of what is stored without a gap.
    fn lacking_of_many(&self, now: Stamp, stream: Stream, index: u32) -> Option<Vec<(RobotId, Vec<u32>)>> {
        let sent = self.outbox.broadcasts.sent(stream)?;
        let mut low = index;
        while low > 1 && index - low < PACKAGES_MAX as u32 / 2 && self.store.get(stream, low - 1).is_some() {
            low -= 1;
        }
        let stored = (low..=u32::MAX).zip(self.store.range(stream, low, u32::MAX));
        let high = stored.take(PACKAGES_MAX).take_while(|(at, (index, _))| at == index).last()?.0;
        let own = self.identity.own.origin;
        let listens = |peer: &&crate::peer::Peer| {
            peer.hears(own) && !peer.is_silent(now) && self.relay_rank(peer, stream) == Some(0)
        };
        let lacking = self.peers.values().filter(listens).filter_map(|peer| {
            let theirs = peer.streams.get(&stream)?;
            let missing = theirs.received_or_in_flight.missing(low.max(theirs.from), high);
            let indices: Vec<u32> =
                missing.flat_map(|(low, high)| low..=high).filter(|index| sent.contains(*index)).collect();
            (!indices.is_empty()).then_some((peer.stream.origin, indices))
        });
        let lacking: Vec<_> = lacking.collect();
        (lacking.len() > 1).then_some(lacking)
    }

    /// Repair symbols that were received.
    pub(super) fn receive_coded(&mut self, now: Stamp, sender: Stream, coded: Vec<Coded>) {
        for coded in coded.into_iter().take(CODED_RECORDS_MAX) {
            let stream = coded.block.stream;
            self.note_own_id(now, stream);
            if stream == self.identity.own || !self.open_stream(stream) {
                continue;
            }
            let newest = self.store.newest_known(stream);
            let last = coded.block.indices().last().map_or(0, |(index, _)| index);
            if self.store.note_newest(stream, last, now) && last > newest {
                self.note_gap(now, true);
            }
            self.note_mended(now, sender.origin, &coded);
            match self.mender.take(coded, there(&self.store, &self.inbox, stream)) {
                Ok(Mended::Packages(packages)) => self.receive_mended(now, sender.origin, packages),
                // What was false is counted there.
                Ok(Mended::Needs(_)) | Err(_) => {}
            }
            self.report.counters.mending_failed = self.mender.failed();
        }
    }

    /// A package has come: with it repair symbols may suffice.
    pub(super) fn mend_with(&mut self, now: Stamp, stream: Stream, index: u32) {
        let packages = self.mender.retry(stream, index, there(&self.store, &self.inbox, stream));
        self.report.counters.mending_failed = self.mender.failed();
        self.receive_mended(now, stream.origin, packages);
    }

    fn receive_mended(&mut self, now: Stamp, from: RobotId, packages: Vec<Package>) {
        for package in packages {
            let (stream, index) = (package.header().stream, package.header().index);
            // What is held and not stored comes back with the rest.
            if self.store.received(stream).is_some_and(|received| !received.contains(index)) {
                self.report.counters.mended += 1;
                self.receive_changes(now, from, package);
            }
        }
    }

    /// Others who heard the same symbols, and lack no more than they mend, need it from nobody.
    fn note_mended(&mut self, now: Stamp, from: RobotId, coded: &Coded) {
        let block = &coded.block;
        let count = coded.symbols.len() / block.symbol_bytes();
        for peer in self.peers.values_mut() {
            if peer.stream.origin == from || !peer.hears(from) {
                continue;
            }
            let Some(theirs) = peer.streams.get(&block.stream) else { continue };
            let lacks = |(index, _): &(u32, usize)| !theirs.received_or_in_flight.contains(*index);
            let lacking: Vec<(u32, usize)> = block.indices().filter(lacks).collect();
            if lacking.is_empty() || lacking.iter().map(|(_, symbols)| symbols).sum::<usize>() > count {
                continue;
            }
            for (index, _) in lacking {
                let item = Item::Package { stream: block.stream, index };
                if peer.cover_heard(item, now, 2 * self.config.in_flight_max) {
                    self.report.counters.suppressed += 1;
                }
            }
        }
    }
}

/// Of so many symbols that peers need, each of them others: how many to send, so that most is mended for each symbol on
/// the air. Who needs more is served when more is lacking.
fn best_count(needs: impl Iterator<Item = usize>) -> Option<usize> {
    let mut needs: Vec<usize> = needs.collect();
    needs.sort_unstable();
    let mut mended = 0;
    let counts = needs.iter().map(|&count| {
        mended += count;
        (count, mended)
    });
    let counts: Vec<(usize, usize)> = counts.collect();
    // The most that are served at a price not far from the best.
    let best = counts.iter().copied().max_by(|a, b| (a.1 * b.0).cmp(&(b.1 * a.0)))?;
    let is_near = |(count, mended): &&(usize, usize)| 10 * mended * best.0 >= 6 * best.1 * count;
    counts.iter().rfind(is_near).map(|(count, _)| *count)
}

/// The packages of a stream that are here, also those that wait for others.
fn there<'a>(store: &'a Store, inbox: &'a Inbox, stream: Stream) -> impl Fn(u32) -> Option<&'a Package> {
    move |index| {
        let stored = store.get(stream, index).map(|stored| &stored.package);
        stored.or_else(|| inbox.waiting_package(stream, index))
    }
}
