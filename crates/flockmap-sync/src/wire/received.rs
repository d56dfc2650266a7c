//! The indices that are held of one stream, as a record of a request says them.

use super::datagram::{put_record, record_len};
use crate::IntervalSet;
use flockmap_codec::bytes::{Reader, put_varint, varint_len};
use flockmap_grid::{RobotId, Stream};

const RECEIVED: u8 = 2;
const RECEIVED_FROM_OLDEST: u8 = 7;
const RECEIVED_IN_PART: u8 = 8;

/// Flags of a list of held indices of a stream in part.
const FROM_OLDEST: u8 = 1;
const WANTS_INDEPENDENT: u8 = 2;
const WANTS_REST: u8 = 4;
const WANTS_REST_SINCE: u8 = 8;

/// The indices that are held of one stream; perhaps none.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Received {
    /// The stream.
    pub stream: Stream,
    /// Earlier runs of this origin are not wanted any more.
    pub is_oldest_wanted: bool,
    /// Something of it is lacking.
    pub in_part: Option<InPart>,
    /// Nothing is said of indices below this one; 1 if the list is whole.
    pub from: u32,
    /// The indices held, none of them below `from`.
    pub received: IntervalSet,
}

/// Of a stream something is lacking, since there was no room for it, though its packages are stated as held.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct InPart {
    /// It may be lacking anywhere: of packages that are not independent next to none can be decoded.
    pub wants_independent: bool,
    /// All that a robot holds of the stream is wanted from it.
    pub rest: Option<RestRequest>,
}

/// From whom the rest of a stream is wanted.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct RestRequest {
    /// This robot is to give it.
    pub holder: RobotId,
    /// A snapshot will do that has packages 1 to this one at least, or a piece of such a state.
    pub upto: u32,
    /// What packages 1 to this one say has come already; 0: nothing.
    pub since: u32,
}

impl Received {
    /// Whether a record of this type says it.
    pub(super) const fn is_of(id: u8) -> bool {
        matches!(id, RECEIVED | RECEIVED_FROM_OLDEST | RECEIVED_IN_PART)
    }

    /// Reads it from the record of this type.
    pub(super) fn read(reader: &mut Reader<'_>, id: u8, intervals_max: usize) -> Option<Self> {
        let stream = read_stream(reader)?;
        let mut is_oldest_wanted = id == RECEIVED_FROM_OLDEST;
        let mut in_part = None;
        if id == RECEIVED_IN_PART {
            let flags = reader.u8()?;
            is_oldest_wanted = flags & FROM_OLDEST != 0;
            let rest = if flags & WANTS_REST == 0 {
                None
            } else {
                let (holder, upto) = (RobotId(reader.varint_u16()?), reader.varint_u32()?);
                let since = if flags & WANTS_REST_SINCE == 0 { 0 } else { reader.varint_u32()? };
                Some(RestRequest { holder, upto, since })
            };
            in_part = Some(InPart { wants_independent: flags & WANTS_INDEPENDENT != 0, rest });
        }
        let (from, received) = read_intervals(reader, intervals_max)?;
        Some(Self { stream, is_oldest_wanted, in_part, from, received })
    }

    /// Appends its record, cut if need be, if it fits before `end`; whether it did.
    pub(super) fn put(&self, out: &mut Vec<u8>, end: usize) -> bool {
        let mut content = Vec::new();
        put_stream(&mut content, self.stream);
        let id = match self.in_part {
            Some(InPart { wants_independent, rest }) => {
                let flag = |is_set, flag| if is_set { flag } else { 0 };
                content.push(
                    flag(self.is_oldest_wanted, FROM_OLDEST)
                        | flag(wants_independent, WANTS_INDEPENDENT)
                        | flag(rest.is_some(), WANTS_REST)
                        | flag(rest.is_some_and(|rest| rest.since > 0), WANTS_REST_SINCE),
                );
                if let Some(RestRequest { holder, upto, since }) = rest {
                    put_varint(&mut content, u64::from(holder.0));
                    put_varint(&mut content, u64::from(upto));
                    if since > 0 {
                        put_varint(&mut content, u64::from(since));
                    }
                }
                RECEIVED_IN_PART
            }
            None if self.is_oldest_wanted => RECEIVED_FROM_OLDEST,
            None => RECEIVED,
        };
        put_list(out, id, &mut content, self.from, &self.received, end)
    }
}

/// Ends a record with a list of intervals, as far as it fits before `end`; whether anything of it did.
/// Empties `content`.
pub(super) fn put_list(
    out: &mut Vec<u8>,
    id: u8,
    content: &mut Vec<u8>,
    from: u32,
    set: &IntervalSet,
    end: usize,
) -> bool {
    let room = end.saturating_sub(out.len() + record_len(content.len()) + 2);
    let fits = put_intervals(content, from, set, room);
    if fits {
        put_record(out, id, content);
    }
    content.clear();
    fits
}

pub(super) fn read_stream(reader: &mut Reader<'_>) -> Option<Stream> {
    Some(Stream { origin: RobotId(reader.varint_u16()?), epoch: reader.varint()? })
}

pub(super) fn put_stream(out: &mut Vec<u8>, stream: Stream) {
    put_varint(out, u64::from(stream.origin.0));
    put_varint(out, stream.epoch);
}

/// Reads `from` and the intervals after it, to the end of the record.
pub(super) fn read_intervals(reader: &mut Reader<'_>, intervals_max: usize) -> Option<(u32, IntervalSet)> {
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
    // From the newest down: how many fit. The gap below the first one is counted from `from`, which is raised
    // to the end of the one before; that is one more than between two, and may take a byte more.
    let mut used = 5;
    let mut first = intervals.len();
    while first > 0 {
        let (low, high) = intervals[first - 1];
        let cost = |lowest: u32| {
            varint_len(u64::from(low.saturating_sub(lowest))) + varint_len(u64::from(high - low))
        };
        let before = first.checked_sub(2).map(|before| intervals[before].1);
        if used + cost(before.map_or(from, |high| high + 1)) > room {
            break;
        }
        used += cost(before.map_or(from, |high| high + 2));
        first -= 1;
    }
    if room < 5 || (first == intervals.len() && first > 0) {
        return false;
    }
    let from = if first == 0 { from } else { intervals[first - 1].1 + 1 };
    put_varint(out, u64::from(from));
    put_gaps(out, from, &intervals[first..]);
    true
}

/// Writes gap and length of each interval, none of which begins below `lowest`.
pub(super) fn put_gaps(out: &mut Vec<u8>, mut lowest: u32, intervals: &[(u32, u32)]) {
    for &(low, high) in intervals {
        put_varint(out, u64::from(low.saturating_sub(lowest)));
        put_varint(out, u64::from(high - low));
        lowest = high.saturating_add(2);
    }
}
