//! Which time of a recording is shown.

use flockmap_grid::Stamp;

use super::field;
use crate::FeedError;
use crate::bytes::Fields;

/// Flags.
const PLAYS: u8 = 1;
const GROWS: u8 = 2;

/// How a recording is played.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Playback {
    /// When it begins.
    pub begin: Stamp,
    /// When it ends, so far.
    pub end: Stamp,
    /// The time of which map, poses and counters are.
    pub at: Stamp,
    /// How many times as fast as it was recorded.
    pub speed: f32,
    /// Whether time goes on.
    pub plays: bool,
    /// Whether the recording still grows.
    pub grows: bool,
}

impl Playback {
    pub(super) fn put(&self, bytes: &mut Vec<u8>) {
        for stamp in [self.begin, self.end, self.at] {
            bytes.extend_from_slice(&stamp.0.to_le_bytes());
        }
        bytes.extend_from_slice(&self.speed.to_le_bytes());
        bytes.push(if self.plays { PLAYS } else { 0 } | if self.grows { GROWS } else { 0 });
    }

    pub(super) fn parse(body: &[u8]) -> Result<Self, FeedError> {
        let mut fields = Fields::new("playback", body);
        let [begin, end, at] =
            [Stamp(fields.i64("begin")?), Stamp(fields.i64("end")?), Stamp(fields.i64("time")?)];
        let speed = fields.f32("speed")?;
        if !speed.is_finite() {
            return Err(field("playback", "speed", speed.to_bits().into(), "a finite number"));
        }
        let flags = fields.u8("flags")?;
        Ok(Self { begin, end, at, speed, plays: flags & PLAYS != 0, grows: flags & GROWS != 0 })
    }
}
