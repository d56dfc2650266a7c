//! A record played over and over.

use flockmap::Stamp;
use flockmap_io::{Frame, Frames, ReadError};

/// Time between the last frame of a round and the first of the next: that of a LiDAR of 10 Hz.
const PAUSE_MICROS: i64 = 100_000;

/// The frames of a record so many times, with stamps that go on rising: each round begins a tenth of a second after the one before
/// has ended. `open` reads the record from its start again. Ends early if that fails, or if a round has no frame.
pub(crate) fn repeated(
    first: Frames,
    times: u32,
    open: impl FnMut() -> Result<Frames, ReadError> + Send + 'static,
) -> Frames {
    Frames::new(Repeated {
        frames: first,
        rounds_left: times.saturating_sub(1),
        open,
        shift: Some(0),
        last: None,
    })
}

struct Repeated<F> {
    frames: Frames,
    /// Rounds after this one.
    rounds_left: u32,
    open: F,
    /// Added to the stamps of this round, in microseconds; `None` until its first frame is known.
    shift: Option<i64>,
    /// The last frame that was given.
    last: Option<Stamp>,
}

impl<F: FnMut() -> Result<Frames, ReadError>> Iterator for Repeated<F> {
    type Item = Result<Frame, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            match self.frames.next() {
                Some(Ok(mut frame)) => {
                    let begins = || {
                        self.last
                            .map_or(0, |last| last.plus_micros(PAUSE_MICROS).micros_since(frame.scan.stamp))
                    };
                    let shift = self.shift.unwrap_or_else(begins);
                    self.shift = Some(shift);
                    frame.scan.stamp = frame.scan.stamp.plus_micros(shift);
                    self.last = Some(frame.scan.stamp);
                    return Some(Ok(frame));
                }
                Some(Err(error)) => return Some(Err(error)),
                None if self.rounds_left == 0 || self.shift.is_none() => return None,
                None => {
                    self.rounds_left -= 1;
                    self.shift = None;
                    match (self.open)() {
                        Ok(frames) => self.frames = frames,
                        Err(error) => {
                            self.rounds_left = 0;
                            return Some(Err(error));
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::Scan;

    fn frames(stamps: &'static [i64]) -> Frames {
        let frame = |&micros: &i64| {
            let scan = Scan { stamp: Stamp(micros), points: Vec::new(), no_returns: Vec::new() };
            Ok(Frame { scan, ..Frame::default() })
        };
        Frames::new(stamps.iter().map(frame))
    }

    fn stamps(frames: Frames) -> Vec<i64> {
        frames.map(|frame| frame.unwrap().scan.stamp.0).collect()
    }

    #[test]
    fn rounds_follow_each_other_with_rising_stamps() {
        let record = &[5_000_000, 5_050_000, 5_250_000];
        let all = stamps(repeated(frames(record), 3, || Ok(frames(record))));
        assert_eq!(all[..3], record[..]);
        assert_eq!(all[3..6], [5_350_000, 5_400_000, 5_600_000]);
        assert_eq!(all[6..], [5_700_000, 5_750_000, 5_950_000]);
        assert_eq!(stamps(repeated(frames(record), 1, || Ok(frames(record)))), record);
    }

    #[test]
    fn an_empty_record_ends() {
        assert!(stamps(repeated(frames(&[]), u32::MAX, || Ok(frames(&[])))).is_empty());
    }
}
