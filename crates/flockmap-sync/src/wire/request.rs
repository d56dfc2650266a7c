//! REQUEST datagrams: what the sender holds, whom it hears, how far its present-state transfers are.

use super::datagram::{DATAGRAM_BYTES_MAX, Datagram, DatagramError, DatagramHeader, Kind, put_record, seal};
use super::newest::{Heard, NewestWriter, ReceivedNewest, put_heard};
use super::received::{Received, put_list, put_stream, read_intervals, read_stream};
use crate::IntervalSet;
use flockmap_codec::bytes::{Reader, put_varint, put_zigzag};
use flockmap_grid::{RobotId, Stamp, Stream};

const ECHOES: u8 = 1;
const TRANSFER: u8 = 3;
const ORIGINS: u8 = 4;
const CLOCKS: u8 = 5;
const SNAPSHOT_REQUEST: u8 = 6;
const NEXT_WITHIN: u8 = 9;
const RECEIVED_NEWEST: u8 = 10;
const HEARD: u8 = 11;

const ALL_ORIGINS: u8 = 1;
const ALL_ECHOES: u8 = 2;

const NO_NEW_STREAMS: u8 = 4;
const IS_SHORT: u8 = 8;

/// Record with a range of origins.
const ORIGINS_BYTES_MAX: usize = 8;

/// A peer that the sender of a request hears directly. From the echo of an own stamp a robot measures the round
/// trip and the offset between the clocks; from everybody's echoes it knows who hears whom.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Echo {
    /// The peer that is heard.
    pub robot: RobotId,
    /// The low 16 bits of its epoch.
    pub epoch_low: u16,
    /// The low 32 bits of the newest send stamp heard from it.
    pub stamp_low: u32,
    /// Microseconds between hearing that stamp and sending this request; saturated.
    pub age_micros: u32,
}

impl Echo {
    const BYTES_MAX: usize = 8 + 5;

    /// The full stamp, taken as the newest one with these low bits that is not after `now`, the clock of the
    /// robot that sent the stamp. Stamps come back within 71 minutes or not at all.
    pub fn stamp(&self, now: Stamp) -> Stamp {
        now.plus_micros(-i64::from((now.0 as u32).wrapping_sub(self.stamp_low)))
    }
}

/// Origins of which a request names every run that the sender holds something of: what it does not name of
/// them, it does not hold. From `first` on, upwards, and from 65,535 on to 0, to `last`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct OriginRange {
    /// The first of them.
    pub first: RobotId,
    /// The last of them.
    pub last: RobotId,
}

impl OriginRange {
    /// All origins, beginning with this one.
    pub const fn all_from(first: RobotId) -> Self {
        Self { first, last: RobotId(first.0.wrapping_sub(1)) }
    }

    /// Whether an origin is among them.
    pub const fn contains(self, origin: RobotId) -> bool {
        origin.0.wrapping_sub(self.first.0) <= self.last.0.wrapping_sub(self.first.0)
    }

    /// Whether all are.
    pub const fn is_all(self) -> bool {
        self.last.0.wrapping_add(1) == self.first.0
    }
}

/// A snapshot that is wanted in place of packages that cannot be decoded any more, since what they build on
/// is gone.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct SnapshotRequest {
    /// The stream.
    pub stream: Stream,
    /// The sender holds packages 1 to this one: a state since there, or since an earlier one, will do.
    pub since: u32,
    /// Nothing is said of indices below this one; 1 if the list is whole.
    pub from: u32,
    /// The packages: a state that contains one of them is welcome. The sender states them as held, so that
    /// nobody sends them.
    pub undecodable: IntervalSet,
}

/// How far the receipt of a snapshot is.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct TransferProgress {
    /// The robot that sends the chunks: robots may cut the same state differently.
    pub source: RobotId,
    /// The stream whose state is transferred.
    pub stream: Stream,
    /// The state is what packages after this one made; 0: the whole.
    pub since: u32,
    /// The state is the one after packages 1 to this one.
    pub upto: u32,
    /// Which snapshot.
    pub snapshot_id: u32,
    /// Number of chunks of the snapshot.
    pub chunks: u32,
    /// Nothing is said of chunks whose number + 1 is below this; 1 if the list is whole.
    pub from: u32,
    /// Number + 1 of each chunk accepted.
    pub accepted: IntervalSet,
}

impl TransferProgress {
    /// Whether no chunk is asked for: all are accepted, or nobody shall send them just now.
    pub fn is_complete(&self) -> bool {
        self.accepted.contains_range(self.from, self.chunks)
    }
}

/// What the sender of a request knows of another robot's clock, for those who cannot hear that robot.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct ClockReport {
    /// The robot whose clock it is.
    pub robot: RobotId,
    /// The low 16 bits of its epoch.
    pub epoch_low: u16,
    /// Its clock minus the clock of the sender of the request, in microseconds.
    pub offset_micros: i64,
}

/// All that a request says. Parsed from at most [`DATAGRAM_BYTES_MAX`] bytes; holds at most 80 times as many.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Request {
    /// The origins of which `received` names every run that the sender holds something of. A request that has
    /// to be cut says nothing of others that it does not name. `None`: of no origin.
    pub origins: Option<OriginRange>,
    /// Whether `echoes` and `hears` name every peer that the sender hears.
    pub all_echoes: bool,
    /// The sender has no room for streams that it does not name.
    pub no_new_streams: bool,
    /// It says no more than what has changed or is missing: whom the sender hears beside those in `echoes`, and what
    /// it knows of clocks, stands in the request before.
    pub is_short: bool,
    /// Milliseconds within which the sender will be heard again, where that is longer than usual: its radio is
    /// thin. 0: as usual.
    pub next_within_ms: u32,
    /// The peers that the sender hears.
    pub echoes: Vec<Echo>,
    /// What the sender holds. To be written: what matters most first, then all runs by their origins, in the
    /// order of `origins`.
    pub received: Vec<Received>,
    /// Runs that the sender knows as the newest ones of their robots, in ascending order: lists of these are written by a
    /// digest of the epochs. Empty: all are named in full.
    pub newest_runs: Vec<Stream>,
    /// The runs of peers that the sender hears, beside those in `echoes`, in ascending order.
    pub hears: Vec<Stream>,
    /// What was read by digests, and is still to be [given its runs](Self::find_runs).
    pub received_newest: Vec<ReceivedNewest>,
    /// The same of whom the sender hears.
    pub heard: Vec<Heard>,
    /// The snapshots that it is receiving.
    pub transfers: Vec<TransferProgress>,
    /// What it knows of others' clocks.
    pub clocks: Vec<ClockReport>,
    /// The snapshots that it wants.
    pub snapshot_requests: Vec<SnapshotRequest>,
}

impl Request {
    /// Whether it names every run of this origin that its sender holds something of.
    pub fn covers(&self, origin: RobotId) -> bool {
        self.origins.is_some_and(|origins| origins.contains(origin))
    }

    /// Whether it says nothing but which packages of its own run the sender has made.
    pub(crate) fn is_probe(&self, sender: RobotId) -> bool {
        let is_own = |received: &Received| received.stream.origin == sender;
        self.is_short && self.echoes.is_empty() && self.received.iter().all(is_own)
    }

    /// Reads the records of a request; unknown ones are skipped. Lists of more than `intervals_max` intervals
    /// keep their newest ones.
    pub fn parse(datagram: &Datagram<'_>, intervals_max: usize) -> Result<Self, DatagramError> {
        let mut request = Self {
            origins: (datagram.flags & ALL_ORIGINS != 0).then_some(OriginRange::all_from(RobotId(0))),
            all_echoes: datagram.flags & ALL_ECHOES != 0,
            no_new_streams: datagram.flags & NO_NEW_STREAMS != 0,
            is_short: datagram.flags & IS_SHORT != 0,
            ..Self::default()
        };
        for (id, content) in datagram.records() {
            let mut reader = Reader::new(content);
            let (read, what) = match id {
                ECHOES => (request.read_echoes(&mut reader), "echo"),
                _ if Received::is_of(id) => {
                    let read = Received::read(&mut reader, id, intervals_max);
                    (read.map(|list| request.received.push(list)), "list of held indices")
                }
                RECEIVED_NEWEST => {
                    let read = ReceivedNewest::read(&mut reader);
                    (read.map(|lists| request.received_newest.push(lists)), "lists of newest runs")
                }
                HEARD => (Heard::read(&mut reader).map(|heard| request.heard.push(heard)), "robots heard"),
                TRANSFER => (request.read_transfer(&mut reader, intervals_max), "transfer"),
                ORIGINS => (request.read_origins(&mut reader), "range of origins"),
                NEXT_WITHIN => (request.read_next_within(&mut reader), "time to the next request"),
                CLOCKS => (request.read_clocks(&mut reader), "clock"),
                SNAPSHOT_REQUEST => {
                    (request.read_snapshot_request(&mut reader, intervals_max), "snapshot request")
                }
                _ => continue,
            };
            read.ok_or_else(|| datagram.malformed(what))?;
        }
        Ok(request)
    }

    fn read_echoes(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        while !reader.is_empty() {
            self.echoes.push(Echo {
                robot: RobotId(reader.u16()?),
                epoch_low: reader.u16()?,
                stamp_low: reader.u32()?,
                age_micros: reader.varint_u32()?,
            });
        }
        Some(())
    }

    /// Gives what was read by digests the runs that are meant: the newest ones that the reader knows, or for lists the
    /// newest ones that have lists, since the sender may not hear that a robot flies a later one. Where neither are the
    /// sender's, nothing of it is taken in, and the request says nothing of what it does not name.
    pub fn find_runs(
        &mut self,
        newest: impl Fn(RobotId) -> Option<Stream>,
        newest_listed: impl Fn(RobotId) -> Option<Stream>,
        intervals_max: usize,
    ) {
        for lists in core::mem::take(&mut self.received_newest) {
            let found = lists.find_runs(&newest, intervals_max);
            match found.or_else(|| lists.find_runs(&newest_listed, intervals_max)) {
                Some(received) => self.received.extend(received),
                None => self.origins = None,
            }
        }
        for heard in core::mem::take(&mut self.heard) {
            // In the order in which they are written, so that nobody is named twice.
            match heard.find_runs(&newest).filter(|runs| self.hears.last() < runs.first()) {
                Some(runs) => {
                    self.hears.reserve_exact(runs.len());
                    self.hears.extend(runs);
                }
                None => self.all_echoes = false,
            }
        }
    }

    fn read_transfer(&mut self, reader: &mut Reader<'_>, intervals_max: usize) -> Option<()> {
        let source = RobotId(reader.varint_u16()?);
        let stream = read_stream(reader)?;
        let (since, upto) = (reader.varint_u32()?, reader.varint_u32()?);
        let (snapshot_id, chunks) = (reader.u32()?, reader.varint_u32()?);
        let (from, accepted) = read_intervals(reader, intervals_max)?;
        self.transfers.push(TransferProgress {
            source,
            stream,
            since,
            upto,
            snapshot_id,
            chunks,
            from,
            accepted,
        });
        Some(())
    }

    fn read_origins(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        let (first, last) = (RobotId(reader.varint_u16()?), RobotId(reader.varint_u16()?));
        self.origins = Some(OriginRange { first, last });
        reader.is_empty().then_some(())
    }

    fn read_next_within(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        self.next_within_ms = reader.varint_u32()?;
        reader.is_empty().then_some(())
    }

    fn read_clocks(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        while !reader.is_empty() {
            self.clocks.push(ClockReport {
                robot: RobotId(reader.varint_u16()?),
                epoch_low: reader.u16()?,
                offset_micros: reader.zigzag()?,
            });
        }
        Some(())
    }

    fn read_snapshot_request(&mut self, reader: &mut Reader<'_>, intervals_max: usize) -> Option<()> {
        let (stream, since) = (read_stream(reader)?, reader.varint_u32()?);
        let (from, undecodable) = read_intervals(reader, intervals_max)?;
        if undecodable.first().is_none_or(|first| first <= since) {
            return None;
        }
        self.snapshot_requests.push(SnapshotRequest { stream, since, from, undecodable });
        Some(())
    }

    /// Writes the request into at most `bytes_max` bytes, with nothing that is urgent: [`Self::emit_in_order`].
    pub fn emit(&self, header: DatagramHeader, bytes_max: usize) -> Vec<u8> {
        self.emit_in_order(header, bytes_max, 0).0
    }

    /// Writes the request into at most `bytes_max` bytes (200 to [`DATAGRAM_BYTES_MAX`]); also returns which
    /// origins it covers.
    ///
    /// What does not fit is cut: echoes get at most a quarter of the room, clocks and snapshot requests an
    /// eighth each. Of the rest half is for transfers that need it, since one that is not named would be sent
    /// for ever. The first `urgent` lists of held indices get half of what remains; then come the origins in
    /// their order, each with all of its runs, as many as fit. `origins` of `self` is what is covered if all
    /// fit. A list that does not fit loses its lowest intervals. However small the room, a run is named.
    pub fn emit_in_order(
        &self,
        header: DatagramHeader,
        bytes_max: usize,
        urgent: usize,
    ) -> (Vec<u8>, Option<OriginRange>) {
        let bytes_max = bytes_max.clamp(200, DATAGRAM_BYTES_MAX);
        let mut out = DatagramHeader { kind: Kind::Request, ..header }.emit();
        let flags_at = out.len();
        out.push(0);
        let list_max = (bytes_max - out.len()) / 4;
        let flag = |is_set, flag| if is_set { flag } else { 0 };
        let mut flags = flag(self.no_new_streams, NO_NEW_STREAMS) | flag(self.is_short, IS_SHORT);

        let mut content = Vec::new();
        if self.next_within_ms > 0 {
            put_varint(&mut content, u64::from(self.next_within_ms));
        }
        put_unless_empty(&mut out, NEXT_WITHIN, &mut content);
        let heard_at = out.len();
        let all_heard = put_heard(&mut out, HEARD, &self.hears, heard_at + list_max);
        let list_max = list_max - (out.len() - heard_at);
        let echoes_fit = self.echoes.len().min(list_max / Echo::BYTES_MAX);
        for echo in &self.echoes[..echoes_fit] {
            content.extend(echo.robot.0.to_le_bytes());
            content.extend(echo.epoch_low.to_le_bytes());
            content.extend(echo.stamp_low.to_le_bytes());
            put_varint(&mut content, u64::from(echo.age_micros));
        }
        put_unless_empty(&mut out, ECHOES, &mut content);
        if self.all_echoes && all_heard && echoes_fit == self.echoes.len() {
            flags |= ALL_ECHOES;
        }

        for clock in &self.clocks {
            if content.len() + 15 <= list_max / 2 {
                put_varint(&mut content, u64::from(clock.robot.0));
                content.extend(clock.epoch_low.to_le_bytes());
                put_zigzag(&mut content, clock.offset_micros);
            }
        }
        put_unless_empty(&mut out, CLOCKS, &mut content);

        let requests_end = out.len() + list_max / 2;
        for wanted in &self.snapshot_requests {
            put_stream(&mut content, wanted.stream);
            put_varint(&mut content, u64::from(wanted.since));
            put_list(
                &mut out,
                SNAPSHOT_REQUEST,
                &mut content,
                wanted.from,
                &wanted.undecodable,
                requests_end,
            );
        }

        let mut trial = out.clone();
        self.put_transfers(&mut trial, out.len() + (bytes_max - out.len()) / 2);
        // Each `from` is reckoned with the 5 bytes that it may take, and the range of origins with its 8.
        let transfer_bytes = trial.len() - out.len() + 5 * self.transfers.len();
        let received_end = bytes_max.saturating_sub(transfer_bytes + ORIGINS_BYTES_MAX);
        let origins = self.put_received(&mut out, received_end, urgent);
        match origins {
            Some(origins) if origins.is_all() => flags |= ALL_ORIGINS,
            Some(OriginRange { first, last }) => {
                put_varint(&mut content, u64::from(first.0));
                put_varint(&mut content, u64::from(last.0));
                put_unless_empty(&mut out, ORIGINS, &mut content);
            }
            None => {}
        }
        self.put_transfers(&mut out, bytes_max);
        out[flags_at] = flags;
        (seal(out), origins)
    }

    /// Appends the lists of held indices that fit before `end`; the origins of which all are there.
    fn put_received(&self, out: &mut Vec<u8>, end: usize, urgent: usize) -> Option<OriginRange> {
        let (urgent, rest) = self.received.split_at(urgent.min(self.received.len()));
        // Half of the room is for the origins in their order, if they need it.
        let half = end.saturating_sub(out.len()) / 2;
        let mut trial = Vec::new();
        let is_urgent = |received: &Received| urgent.iter().any(|urgent| urgent.stream == received.stream);
        let mut newest = NewestWriter::default();
        let fits = rest
            .iter()
            .filter(|received| !is_urgent(received))
            .all(|received| self.put_list(&mut trial, &mut newest, received, half));
        let urgent_end = end.saturating_sub(if fits { trial.len() + newest.bytes() } else { half });
        let mut newest = NewestWriter::default();
        let mut named = Vec::with_capacity(urgent.len());
        for received in urgent {
            if self.put_list(out, &mut newest, received, urgent_end) {
                named.push(received.stream);
            }
        }
        newest.finish(out, RECEIVED_NEWEST);
        let OriginRange { first, .. } = self.origins.unwrap_or(OriginRange::all_from(RobotId(0)));
        let mut next = first;
        // Only of lists that are in order can be said how far they go.
        let is_in_order = rest.is_sorted_by_key(|received| received.stream.origin.0.wrapping_sub(first.0));
        for runs in rest.chunk_by(|a, b| a.stream.origin == b.stream.origin) {
            let origin = runs[0].stream.origin;
            if newest.is_full() {
                newest.finish(out, RECEIVED_NEWEST);
            }
            let before = (out.len(), newest.mark());
            let mut all_fit = true;
            for received in runs.iter().filter(|received| !named.contains(&received.stream)) {
                all_fit &= self.put_list(out, &mut newest, received, end);
            }
            if !all_fit {
                if next != first {
                    // It is the first one next time.
                    out.truncate(before.0);
                    newest.take_back(before.1);
                }
                newest.finish(out, RECEIVED_NEWEST);
                let last = RobotId(origin.0.wrapping_sub(1));
                return self
                    .origins
                    .filter(|_| origin != first && is_in_order)
                    .map(|_| OriginRange { first, last });
            }
            next = RobotId(origin.0.wrapping_add(1));
        }
        newest.finish(out, RECEIVED_NEWEST);
        self.origins
    }

    /// Appends a list of held indices, or adds it to those of newest runs, if it fits before `end`; whether it did.
    fn put_list(
        &self,
        out: &mut Vec<u8>,
        newest: &mut NewestWriter,
        received: &Received,
        end: usize,
    ) -> bool {
        if self.newest_runs.binary_search(&received.stream).is_err() || !NewestWriter::takes(received) {
            return received.put(out, end.saturating_sub(newest.bytes()));
        }
        if newest.is_full() {
            newest.finish(out, RECEIVED_NEWEST);
        }
        newest.push(received, end.saturating_sub(out.len()))
    }

    /// Appends the transfers that fit before `end_max`.
    fn put_transfers(&self, out: &mut Vec<u8>, end_max: usize) {
        let mut content = Vec::new();
        for transfer in &self.transfers {
            put_varint(&mut content, u64::from(transfer.source.0));
            put_stream(&mut content, transfer.stream);
            put_varint(&mut content, u64::from(transfer.since));
            put_varint(&mut content, u64::from(transfer.upto));
            content.extend(transfer.snapshot_id.to_le_bytes());
            put_varint(&mut content, u64::from(transfer.chunks));
            put_list(out, TRANSFER, &mut content, transfer.from, &transfer.accepted, end_max);
        }
    }
}

fn put_unless_empty(out: &mut Vec<u8>, id: u8, content: &mut Vec<u8>) {
    if !content.is_empty() {
        put_record(out, id, content);
        content.clear();
    }
}
