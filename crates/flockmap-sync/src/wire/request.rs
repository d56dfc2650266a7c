//! REQUEST datagrams: what the sender holds, whom it hears, how far its present-state transfers are.

use super::{
    DATAGRAM_BYTES_MAX, Datagram, DatagramError, DatagramHeader, Kind, put_record, record_len, seal,
};
use crate::IntervalSet;
use crate::bytes::{Reader, put_varint, put_zigzag, varint_len};
use flockmap_grid::{RobotId, Stamp, Stream};

const ECHOES: u8 = 1;
const HELD: u8 = 2;
const TRANSFER: u8 = 3;
const FLOORS: u8 = 4;
const CLOCKS: u8 = 5;
const STATES_WANTED: u8 = 6;

const ALL_STREAMS: u8 = 1;
const ALL_ECHOES: u8 = 2;
const NO_NEW_STREAMS: u8 = 4;

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

/// The indices that are held of one stream.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Held {
    /// The stream.
    pub stream: Stream,
    /// Nothing is said of indices below this one; 1 if the list is whole.
    pub from: u32,
    /// The indices held, none of them below `from`.
    pub held: IntervalSet,
}

/// How far the receipt of a present state is.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct TransferProgress {
    /// The robot that sends the tiles: robots may cut the same state differently.
    pub source: RobotId,
    /// The stream whose state is transferred.
    pub stream: Stream,
    /// The state is what packages after this one made; 0: the whole.
    pub since: u32,
    /// The state is the one after packages 1 to this one.
    pub upto: u32,
    /// Which set of tiles.
    pub set: u32,
    /// Number of tiles of the set.
    pub tiles: u32,
    /// Nothing is said of tiles whose number + 1 is below this; 1 if the list is whole.
    pub from: u32,
    /// Number + 1 of each tile accepted.
    pub accepted: IntervalSet,
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

/// All that a request says. Parsed from at most [`DATAGRAM_BYTES_MAX`] bytes; holds at most 24 times as many.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Request {
    /// Whether `held` names every stream of which the sender holds something. If not, it had to be cut, and says
    /// nothing of the streams that it does not name.
    pub all_streams: bool,
    /// Whether `echoes` names every peer that the sender hears.
    pub all_echoes: bool,
    /// The sender has no room for streams that it does not name.
    pub no_new_streams: bool,
    /// The peers that the sender hears.
    pub echoes: Vec<Echo>,
    /// What the sender holds.
    pub held: Vec<Held>,
    /// The present states that it is receiving.
    pub transfers: Vec<TransferProgress>,
    /// Streams of this origin with an epoch below this one are not wanted.
    pub floors: Vec<(RobotId, u64)>,
    /// What it knows of others' clocks.
    pub clocks: Vec<ClockReport>,
    /// Streams with packages that it cannot decode any more, the last package before the first that it states and does not hold, and the newest of them: it wants
    /// a present state since the one, or an earlier one, that contains the other. It states these packages as held, so that nobody sends them.
    pub states_wanted: Vec<(Stream, u32, u32)>,
}

impl Request {
    /// Reads the records of a request; unknown ones are skipped. Lists of more than `intervals_max` intervals
    /// keep their newest ones.
    pub fn parse(datagram: &Datagram<'_>, intervals_max: usize) -> Result<Self, DatagramError> {
        let mut request = Self {
            all_streams: datagram.flags & ALL_STREAMS != 0,
            all_echoes: datagram.flags & ALL_ECHOES != 0,
            no_new_streams: datagram.flags & NO_NEW_STREAMS != 0,
            ..Self::default()
        };
        for (id, content) in datagram.records() {
            let mut reader = Reader::new(content);
            let (read, what) = match id {
                ECHOES => (request.read_echoes(&mut reader), "echo"),
                HELD => (request.read_held(&mut reader, intervals_max), "list of held indices"),
                TRANSFER => (request.read_transfer(&mut reader, intervals_max), "transfer"),
                FLOORS => (request.read_floors(&mut reader), "floor"),
                CLOCKS => (request.read_clocks(&mut reader), "clock"),
                STATES_WANTED => (request.read_states_wanted(&mut reader), "wish for a present state"),
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

    fn read_held(&mut self, reader: &mut Reader<'_>, intervals_max: usize) -> Option<()> {
        let stream = read_stream(reader)?;
        let (from, held) = read_intervals(reader, intervals_max)?;
        self.held.push(Held { stream, from, held });
        Some(())
    }

    fn read_transfer(&mut self, reader: &mut Reader<'_>, intervals_max: usize) -> Option<()> {
        let source = RobotId(reader.varint_u16()?);
        let stream = read_stream(reader)?;
        let (since, upto) = (reader.varint_u32()?, reader.varint_u32()?);
        let (set, tiles) = (reader.u32()?, reader.varint_u32()?);
        let (from, accepted) = read_intervals(reader, intervals_max)?;
        self.transfers.push(TransferProgress { source, stream, since, upto, set, tiles, from, accepted });
        Some(())
    }

    fn read_floors(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        while !reader.is_empty() {
            self.floors.push((RobotId(reader.varint_u16()?), reader.varint()?));
        }
        Some(())
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

    fn read_states_wanted(&mut self, reader: &mut Reader<'_>) -> Option<()> {
        while !reader.is_empty() {
            let stream = read_stream(reader)?;
            let (since, upto) = (reader.varint_u32()?, reader.varint_u32()?);
            if since >= upto {
                return None;
            }
            self.states_wanted.push((stream, since, upto));
        }
        Some(())
    }

    /// Writes the request into at most `bytes_max` bytes (200 to [`DATAGRAM_BYTES_MAX`]). What does not fit is
    /// cut: echoes, floors and clocks get at most a quarter of the room, wishes for present states an eighth, held lists lose their oldest part, then
    /// whole streams are left out, of transfers what is more than half of the room; the request says so. `all_streams` and `all_echoes` of `self` are what they
    /// are to be if nothing is cut. Put what matters most first in each list.
    pub fn emit(&self, header: DatagramHeader, bytes_max: usize) -> Vec<u8> {
        let bytes_max = bytes_max.clamp(200, DATAGRAM_BYTES_MAX);
        let mut out = DatagramHeader { kind: Kind::Request, ..header }.emit();
        let flags_at = out.len();
        out.push(0);
        let list_max = (bytes_max - out.len()) / 4;
        let mut flags = u8::from(self.no_new_streams) * NO_NEW_STREAMS;

        let mut content = Vec::new();
        let echoes_fit = self.echoes.len().min(list_max / Echo::BYTES_MAX);
        for echo in &self.echoes[..echoes_fit] {
            content.extend(echo.robot.0.to_le_bytes());
            content.extend(echo.epoch_low.to_le_bytes());
            content.extend(echo.stamp_low.to_le_bytes());
            put_varint(&mut content, u64::from(echo.age_micros));
        }
        put_unless_empty(&mut out, ECHOES, &mut content);
        if self.all_echoes && echoes_fit == self.echoes.len() {
            flags |= ALL_ECHOES;
        }

        for (robot, epoch) in &self.floors {
            if content.len() + 8 <= list_max {
                put_varint(&mut content, u64::from(robot.0));
                put_varint(&mut content, *epoch);
            }
        }
        put_unless_empty(&mut out, FLOORS, &mut content);

        for clock in &self.clocks {
            if content.len() + 15 <= list_max {
                put_varint(&mut content, u64::from(clock.robot.0));
                content.extend(clock.epoch_low.to_le_bytes());
                put_zigzag(&mut content, clock.offset_micros);
            }
        }
        put_unless_empty(&mut out, CLOCKS, &mut content);

        for (stream, since, upto) in &self.states_wanted {
            if content.len() + 18 <= list_max / 2 {
                put_stream(&mut content, *stream);
                put_varint(&mut content, u64::from(*since));
                put_varint(&mut content, u64::from(*upto));
            }
        }
        put_unless_empty(&mut out, STATES_WANTED, &mut content);

        // Lists of held indices leave half of the room to transfers that need it: a transfer that is not named
        // would be sent for ever.
        let mut trial = out.clone();
        self.put_transfers(&mut trial, out.len() + (bytes_max - out.len()) / 2);
        // Each `from` is reckoned with the 5 bytes that it may take.
        let transfer_bytes = trial.len() - out.len() + 5 * self.transfers.len();
        let held_end_max = bytes_max.saturating_sub(transfer_bytes);

        let mut all_fit = true;
        for held in &self.held {
            put_stream(&mut content, held.stream);
            let room = held_end_max.saturating_sub(out.len() + record_len(content.len()) + 2);
            if put_intervals(&mut content, held.from, &held.held, room) {
                put_unless_empty(&mut out, HELD, &mut content);
            } else {
                content.clear();
                all_fit = false;
            }
        }
        if self.all_streams && all_fit {
            flags |= ALL_STREAMS;
        }

        self.put_transfers(&mut out, bytes_max);
        out[flags_at] = flags;
        seal(out)
    }

    /// Appends the transfers that fit before `end_max`.
    fn put_transfers(&self, out: &mut Vec<u8>, end_max: usize) {
        let mut content = Vec::new();
        for transfer in &self.transfers {
            put_varint(&mut content, u64::from(transfer.source.0));
            put_stream(&mut content, transfer.stream);
            put_varint(&mut content, u64::from(transfer.since));
            put_varint(&mut content, u64::from(transfer.upto));
            content.extend(transfer.set.to_le_bytes());
            put_varint(&mut content, u64::from(transfer.tiles));
            let room = end_max.saturating_sub(out.len() + record_len(content.len()) + 2);
            if put_intervals(&mut content, transfer.from, &transfer.accepted, room) {
                put_unless_empty(out, TRANSFER, &mut content);
            }
            content.clear();
        }
    }
}

fn put_unless_empty(out: &mut Vec<u8>, id: u8, content: &mut Vec<u8>) {
    if !content.is_empty() {
        put_record(out, id, content);
        content.clear();
    }
}

fn read_stream(reader: &mut Reader<'_>) -> Option<Stream> {
    Some(Stream { origin: RobotId(reader.varint_u16()?), epoch: reader.varint()? })
}

fn put_stream(out: &mut Vec<u8>, stream: Stream) {
    put_varint(out, u64::from(stream.origin.0));
    put_varint(out, stream.epoch);
}

/// Reads `from` and the intervals after it, to the end of the record.
fn read_intervals(reader: &mut Reader<'_>, intervals_max: usize) -> Option<(u32, IntervalSet)> {
    let mut from = reader.varint_u32()?;
    let mut intervals = Vec::new();
    let mut lowest = from;
    while !reader.is_empty() {
        let low = lowest.checked_add(reader.varint_u32()?)?;
        let high = low.checked_add(reader.varint_u32()?)?;
        intervals.push((low, high));
        if reader.is_empty() {
            break;
        }
        lowest = high.checked_add(2)?;
    }
    let mut set = IntervalSet::from_intervals(intervals_max, intervals);
    from = from.max(set.keep_newest(intervals_max));
    Some((from, set))
}

/// Writes `from` and the intervals into at most `room` bytes, raising `from` if only the newest intervals fit.
/// `false` if not even the newest interval fits of a set that has one.
fn put_intervals(out: &mut Vec<u8>, from: u32, set: &IntervalSet, room: usize) -> bool {
    let intervals = set.intervals();
    // From the newest down: how many fit. Each is counted with its real gap; the first one's gap is counted from
    // `from`, which raising `from` can only make smaller.
    let mut used = 5;
    let mut first = intervals.len();
    while first > 0 {
        let (low, high) = intervals[first - 1];
        let lowest = if first == 1 { from } else { intervals[first - 2].1 + 2 };
        let cost = varint_len(u64::from(low.saturating_sub(lowest))) + varint_len(u64::from(high - low));
        if used + cost > room {
            break;
        }
        used += cost;
        first -= 1;
    }
    if room < 5 || (first == intervals.len() && first > 0) {
        return false;
    }
    let from = if first == 0 { from } else { intervals[first - 1].1 + 1 };
    put_varint(out, u64::from(from));
    let mut lowest = from;
    for &(low, high) in &intervals[first..] {
        put_varint(out, u64::from(low.saturating_sub(lowest)));
        put_varint(out, u64::from(high - low));
        lowest = high.saturating_add(2);
    }
    true
}
