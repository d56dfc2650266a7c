//! The newest runs of robots, named by the ids of the robots and a digest of the epochs. An epoch takes nine bytes, and in
//! a crowd nearly everybody knows the newest run of nearly everybody.

use super::datagram::{put_record, record_len};
use super::received::{Received, put_gaps};
use crate::IntervalSet;
use flockmap_codec::bytes::{Reader, put_varint, put_zigzag};
use flockmap_grid::{RobotId, Stream};

/// Runs that share a digest: who does not know one of them learns nothing of the others.
const RUNS_MAX: usize = 32;
/// Lists of more intervals are named in full, so that they can be cut.
const INTERVALS_MAX: usize = 16;

/// CRC-32 of runs in their order. A reader reckons it with the runs that it knows as the newest.
fn digest(runs: impl Iterator<Item = Stream>) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    for Stream { origin, epoch } in runs {
        hasher.update(&origin.0.to_le_bytes());
        hasher.update(&epoch.to_le_bytes());
    }
    hasher.finalize()
}

/// Lists of held indices of newest runs, as they are read. Holds the bytes of its record.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ReceivedNewest {
    digest: u32,
    lists: Vec<u8>,
}

impl ReceivedNewest {
    pub(super) fn read(reader: &mut Reader<'_>) -> Option<Self> {
        let (digest, lists) = (reader.u32()?, reader.rest());
        let mut robots = 0;
        for list in Lists::new(lists) {
            list?;
            robots += 1;
        }
        (1..=RUNS_MAX).contains(&robots).then(|| Self { digest, lists: lists.to_vec() })
    }

    /// The lists, with the runs that are meant; `None` if the sender knows others as the newest ones than the reader.
    pub(super) fn find_runs(
        &self,
        newest: impl Fn(RobotId) -> Option<Stream>,
        intervals_max: usize,
    ) -> Option<Vec<Received>> {
        let mut received = Vec::with_capacity(Lists::new(&self.lists).count());
        for (robot, intervals) in Lists::new(&self.lists).flatten() {
            let mut held = IntervalSet::from_intervals(intervals_max, intervals);
            let from = held.keep_newest(intervals_max).max(1);
            let stream = newest(robot)?;
            received.push(Received { stream, is_oldest_wanted: false, in_part: None, from, received: held });
        }
        (digest(received.iter().map(|received| received.stream)) == self.digest).then_some(received)
    }
}

/// Reads lists one by one; `None` where one is malformed, after which nothing comes.
struct Lists<'a> {
    reader: Reader<'a>,
    next: u16,
}

impl<'a> Lists<'a> {
    const fn new(bytes: &'a [u8]) -> Self {
        Self { reader: Reader::new(bytes), next: 0 }
    }

    fn read(&mut self) -> Option<(RobotId, Vec<(u32, u32)>)> {
        let robot = i64::from(self.next).checked_add(self.reader.zigzag()?)?;
        let robot = u16::try_from(robot).ok()?;
        self.next = robot.wrapping_add(1);
        let head = self.reader.varint_u32()?;
        if head & 1 == 0 {
            let newest = head >> 1;
            return Some((RobotId(robot), if newest > 0 { vec![(1, newest)] } else { Vec::new() }));
        }
        let count = (head >> 1) as usize;
        if count > INTERVALS_MAX {
            return None;
        }
        let (mut intervals, mut lowest) = (Vec::with_capacity(count), 1_u32);
        for at in 0..count {
            let low = lowest.checked_add(self.reader.varint_u32()?)?;
            let high = low.checked_add(self.reader.varint_u32()?)?;
            intervals.push((low, high));
            lowest = if at + 1 < count { high.checked_add(2)? } else { high };
        }
        Some((RobotId(robot), intervals))
    }
}

impl Iterator for Lists<'_> {
    type Item = Option<(RobotId, Vec<(u32, u32)>)>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.reader.is_empty() {
            return None;
        }
        let list = self.read();
        if list.is_none() {
            self.reader = Reader::new(&[]);
        }
        Some(list)
    }
}

/// Writes lists of newest runs into shared records.
#[derive(Clone, Debug, Default)]
pub(super) struct NewestWriter {
    runs: Vec<Stream>,
    lists: Vec<u8>,
}

impl NewestWriter {
    /// Whether a list can be named like that.
    pub(super) fn takes(received: &Received) -> bool {
        received.in_part.is_none()
            && !received.is_oldest_wanted
            && received.from == 1
            && received.received.first() != Some(0)
            && received.received.last() <= Some(u32::MAX >> 1)
            && received.received.intervals().len() <= INTERVALS_MAX
    }

    /// Bytes of the record so far.
    pub(super) fn bytes(&self) -> usize {
        if self.runs.is_empty() { 0 } else { record_len(4 + self.lists.len()) }
    }

    /// What [`Self::take_back`] takes back to.
    pub(super) fn mark(&self) -> (usize, usize) {
        (self.runs.len(), self.lists.len())
    }

    pub(super) fn take_back(&mut self, (runs, lists): (usize, usize)) {
        self.runs.truncate(runs);
        self.lists.truncate(lists);
    }

    /// Adds a list if the record takes at most `room` bytes then; whether it did.
    pub(super) fn push(&mut self, received: &Received, room: usize) -> bool {
        let mark = self.mark();
        let next = self.runs.last().map_or(0, |run| run.origin.0.wrapping_add(1));
        put_zigzag(&mut self.lists, i64::from(received.stream.origin.0) - i64::from(next));
        match received.received.intervals() {
            [] => put_varint(&mut self.lists, 0),
            &[(1, newest)] => put_varint(&mut self.lists, u64::from(newest) << 1),
            intervals => {
                put_varint(&mut self.lists, ((intervals.len() as u64) << 1) | 1);
                put_gaps(&mut self.lists, 1, intervals);
            }
        }
        self.runs.push(received.stream);
        let fits = self.bytes() <= room;
        if !fits {
            self.take_back(mark);
        }
        fits
    }

    pub(super) fn is_full(&self) -> bool {
        self.runs.len() >= RUNS_MAX
    }

    /// Ends the record, if there is anything in it.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>, id: u8) {
        if !self.runs.is_empty() {
            let mut content = digest(self.runs.iter().copied()).to_le_bytes().to_vec();
            content.append(&mut self.lists);
            put_record(out, id, &content);
            self.runs.clear();
        }
    }
}

/// Robots that the sender hears, as they are read.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Heard {
    digest: u32,
    /// First and last id.
    robots: Vec<(u16, u16)>,
}

impl Heard {
    pub(super) fn read(reader: &mut Reader<'_>) -> Option<Self> {
        let (digest, mut robots, mut lowest, mut count) = (reader.u32()?, Vec::new(), 0_u16, 0_usize);
        while !reader.is_empty() {
            let first = lowest.checked_add(reader.varint_u16()?)?;
            let last = first.checked_add(reader.varint_u16()?)?;
            count += usize::from(last - first) + 1;
            robots.push((first, last));
            lowest = if reader.is_empty() { last } else { last.checked_add(2)? };
        }
        (1..=RUNS_MAX).contains(&count).then_some(Self { digest, robots })
    }

    /// The runs of these robots; `None` if the sender hears others than the reader knows.
    pub(super) fn find_runs(&self, newest: impl Fn(RobotId) -> Option<Stream>) -> Option<Vec<Stream>> {
        let robots = self.robots.iter().flat_map(|&(first, last)| first..=last);
        let runs: Vec<Stream> = robots.map(|robot| newest(RobotId(robot))).collect::<Option<_>>()?;
        (digest(runs.iter().copied()) == self.digest).then_some(runs)
    }
}

/// Appends records that name these runs, in the order of their robots, as many as fit before `end`; whether all did.
pub(super) fn put_heard(out: &mut Vec<u8>, id: u8, runs: &[Stream], end: usize) -> bool {
    for group in runs.chunks(RUNS_MAX) {
        let mut content = digest(group.iter().copied()).to_le_bytes().to_vec();
        let mut lowest = 0;
        for robots in group.chunk_by(|a, b| a.origin.0.checked_add(1) == Some(b.origin.0)) {
            let (first, last) = (robots[0].origin.0, robots[0].origin.0 + (robots.len() - 1) as u16);
            put_varint(&mut content, u64::from(first - lowest));
            put_varint(&mut content, u64::from(last - first));
            lowest = last.saturating_add(2);
        }
        if out.len() + record_len(content.len()) > end {
            return false;
        }
        put_record(out, id, &content);
    }
    true
}
