//! What somebody holds, as text: intervals of indices, and all of it as JSON.

use std::fmt::Write as _;

use flockmap::sync::{IntervalSet, RECEIVED_INTERVALS_MAX};
use flockmap::{Resolution, Robot, RobotId, Stamp, Stream};
use serde::{Deserialize, Serialize};

/// Answers with more bytes than this, all together, are left out: of some ten thousand streams.
pub(crate) const HELD_BYTES_MAX: usize = 16 << 20;

/// What a holder holds, and how its clock and those of the robots differ.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
pub(crate) struct Held {
    /// Changes with what follows, but not with clocks. Who knows it already is told no more than this and the time.
    pub(crate) digest: String,
    /// On its clock, in microseconds.
    pub(crate) now_us: i64,
    /// Whether it hears the robots itself, so that it has measured their clocks.
    #[serde(default)]
    pub(crate) on_radio: bool,
    /// Side of a voxel in micrometres.
    #[serde(default)]
    pub(crate) resolution_um: u32,
    /// Its streams; none where the digest was known.
    #[serde(default)]
    pub(crate) streams: Vec<HeldStream>,
}

/// What is held of a stream.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
pub(crate) struct HeldStream {
    pub(crate) origin: u16,
    pub(crate) epoch: u64,
    /// As [`intervals_text`] writes it.
    pub(crate) held: String,
    /// The robot's clock minus the holder's, in microseconds, where it is known.
    #[serde(default)]
    pub(crate) clock_us: Option<i64>,
}

impl HeldStream {
    pub(crate) fn stream(&self) -> Stream {
        Stream { origin: RobotId(self.origin), epoch: self.epoch }
    }
}

impl Held {
    /// What a robot holds now.
    pub(crate) fn of(robot: &Robot, now: Stamp, on_radio: bool) -> Self {
        let session = robot.session();
        let streams: Vec<HeldStream> = session
            .streams()
            .filter_map(|stream| {
                let held = session.received(stream).filter(|held| !held.is_empty())?;
                let clock_us =
                    if stream == robot.own_stream() { Some(0) } else { session.clock_offset_micros(stream) };
                let Stream { origin, epoch } = stream;
                Some(HeldStream { origin: origin.0, epoch, held: intervals_text(held.intervals()), clock_us })
            })
            .collect();
        let resolution_um = robot.config().mapper.resolution.micrometres();
        Self { now_us: now.0, on_radio, ..Self::new(resolution_um, streams) }
    }

    /// These streams, with their digest.
    pub(crate) fn new(resolution_um: u32, streams: Vec<HeldStream>) -> Self {
        let digest = digest(resolution_um, &streams);
        Self { digest, now_us: 0, on_radio: false, resolution_um, streams }
    }

    /// Whether the digest is that of the streams.
    pub(crate) fn has_true_digest(&self) -> bool {
        self.digest == digest(self.resolution_um, &self.streams)
    }

    /// The same for who knows it already.
    pub(crate) fn unless_known(self, known: &str) -> Self {
        if known.split(',').any(|digest| digest == self.digest) {
            return Self { streams: Vec::new(), ..self };
        }
        self
    }

    pub(crate) fn resolution(&self) -> Option<Resolution> {
        Resolution::from_micrometres(self.resolution_um)
    }
}

/// 64 bits in hex: the same for the same streams, as far as anybody is concerned who does not mean harm.
fn digest(resolution_um: u32, streams: &[HeldStream]) -> String {
    // FNV-1a.
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut take = |bytes: &[u8]| {
        for byte in bytes {
            hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    };
    take(&resolution_um.to_le_bytes());
    for HeldStream { origin, epoch, held, .. } in streams {
        take(&origin.to_le_bytes());
        take(&epoch.to_le_bytes());
        take(held.as_bytes());
        take(b";");
    }
    format!("{hash:016x}")
}

/// `1-120,130-200`.
pub(crate) fn intervals_text(intervals: &[(u32, u32)]) -> String {
    let mut text = String::new();
    for (low, high) in intervals {
        let comma = if text.is_empty() { "" } else { "," };
        // Writing to a text does not fail.
        let _ = write!(text, "{comma}{low}-{high}");
    }
    text
}

/// Reads them: each from 1 on and ascending, at most as many as a list may have. `None` if it is something else.
pub(crate) fn parse_intervals(text: &str) -> Option<IntervalSet> {
    let mut intervals = Vec::new();
    let mut last = 0u32;
    for part in text.split(',').filter(|_| !text.is_empty()) {
        let (low, high) = part.split_once('-').unwrap_or((part, part));
        let (low, high): (u32, u32) = (low.parse().ok()?, high.parse().ok()?);
        if low <= last || low > high || intervals.len() >= RECEIVED_INTERVALS_MAX {
            return None;
        }
        last = high;
        intervals.push((low, high));
    }
    Some(IntervalSet::from_intervals(RECEIVED_INTERVALS_MAX, intervals))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn intervals_come_back_as_they_were(steps in proptest::collection::vec((2u32..1_000, 0u32..1_000), 0..40)) {
            let mut set = IntervalSet::new(RECEIVED_INTERVALS_MAX);
            let mut at = 0;
            for (gap, length) in steps {
                set.insert_range(at + gap, at + gap + length).unwrap();
                at += gap + length;
            }
            let text = intervals_text(set.intervals());
            prop_assert_eq!(parse_intervals(&text), Some(set));
        }

        #[test]
        fn no_text_makes_it_panic(text in "[0-9,-]{0,60}|\\PC*") {
            if let Some(set) = parse_intervals(&text) {
                prop_assert!(set.intervals().iter().all(|(low, high)| 0 < *low && low <= high));
            }
        }
    }

    #[test]
    fn what_is_no_list_of_intervals_is_refused() {
        assert!(parse_intervals("").is_some_and(|set| set.is_empty()));
        assert!(parse_intervals("5").is_some_and(|set| set.intervals() == [(5, 5)]));
        for bad in ["0-5", "5-4", "1-5,5-6", "1-5,", "a", "1-4294967296", "7-8,1-2"] {
            assert_eq!(parse_intervals(bad), None, "{bad}");
        }
        let long = intervals_text(&(0..1_025).map(|i| (3 * i + 1, 3 * i + 2)).collect::<Vec<_>>());
        assert_eq!(parse_intervals(&long), None);
    }
}
