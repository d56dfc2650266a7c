//! A record played over and over.

use flockmap::Stamp;
use flockmap_io::{Frames, ReadError};

/// Time between the last frame of a round and the first of the next: that of a LiDAR of 10 Hz.
const PAUSE_MICROS: i64 = 100_000;

/// The frames of a record so many times, with stamps that go on rising: each round begins a tenth of a second
/// after the one before has ended. `open` reads the record from its start again. Ends early if that fails, or
/// if a round has no frame.
pub(crate) fn repeated(
    mut frames: Frames,
    times: u32,
    mut open: impl FnMut() -> Result<Frames, ReadError> + Send + 'static,
) -> Frames {
    // After this one.
    let mut rounds_left = times.saturating_sub(1);
    // Added to the stamps of this round, in microseconds; `None` until its first frame is known.
    let mut shift = Some(0);
    // The last frame that was given.
    let mut last: Option<Stamp> = None;
    Frames::new(std::iter::from_fn(move || {
        loop {
            match frames.next() {
                Some(Ok(mut frame)) => {
                    let stamp = &mut frame.scan.stamp;
                    let begins =
                        || last.map_or(0, |last| last.plus_micros(PAUSE_MICROS).micros_since(*stamp));
                    let shift = *shift.get_or_insert_with(begins);
                    *stamp = stamp.plus_micros(shift);
                    last = Some(*stamp);
                    return Some(Ok(frame));
                }
                Some(Err(error)) => return Some(Err(error)),
                None if rounds_left == 0 || shift.is_none() => return None,
                None => {
                    rounds_left -= 1;
                    shift = None;
                    match open() {
                        Ok(again) => frames = again,
                        Err(error) => {
                            rounds_left = 0;
                            return Some(Err(error));
                        }
                    }
                }
            }
        }
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::Scan;
    use flockmap_io::Frame;

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
