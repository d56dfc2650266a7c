//! What went out when.

use flockmap_grid::Stamp;
use std::collections::VecDeque;

/// Bytes sent so far, by the time at which they were.
#[derive(Clone, Debug, Default)]
pub(super) struct SentLog {
    pub(super) bytes: u64,
    /// At most [`LOG_MAX`], not nearer to each other than [`LOG_GRAIN`], and the farther apart the older they are: of a
    /// day some 400.
    pub(super) points: VecDeque<(Stamp, u64)>,
}

pub(super) const LOG_MAX: usize = 512;
pub(super) const LOG_GRAIN: i64 = 50_000;
/// Nor than their age by this.
const LOG_PRECISION: i64 = 32;

impl SentLog {
    pub(super) fn add(&mut self, now: Stamp, bytes: u64) {
        self.bytes += bytes;
        match self.points.back_mut() {
            Some(last) if now.micros_since(last.0) < LOG_GRAIN => last.1 = self.bytes,
            _ => self.points.push_back((now, self.bytes)),
        }
        if self.points.len() > LOG_MAX {
            let mut kept = Stamp(i64::MIN);
            self.points.retain(|(at, _)| {
                let is_kept = at.micros_since(kept) >= now.micros_since(*at) / LOG_PRECISION;
                kept = if is_kept { *at } else { kept };
                is_kept
            });
            // Of days.
            self.points.drain(..self.points.len().saturating_sub(LOG_MAX));
        }
    }

    /// Bytes sent up to a time.
    pub(super) fn upto(&self, at: Stamp) -> Option<u64> {
        let after = self.points.partition_point(|(sent, _)| *sent <= at);
        self.points.get(after.checked_sub(1)?).map(|(_, bytes)| *bytes)
    }
}
