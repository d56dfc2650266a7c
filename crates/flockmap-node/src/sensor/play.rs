//! A recording or a simulation, played in real time.

use std::thread;
use std::time::Duration;

use flockmap::{Stamp, SubmapId};
use flockmap_io::{Frames, SubmapPose, SubmapPoses};
use tokio::sync::mpsc::Sender;

use super::Input;
use crate::Clock;

/// A pause that is longer than this is said, so that nobody takes it for a fault.
const PAUSE_SAID_MICROS: i64 = 10_000_000;

/// A record whose stamps go back by more than this was made while a clock was stepped. It is played on at once.
const STEP_BACK_MICROS: i64 = 1_000_000;

/// Reads frames and passes each on when its time has come, until they end or nobody listens any more. Frames
/// that wait make the reader wait, so memory is bounded; what comes too late is passed on at once. What is said of
/// submaps comes with the frame that follows, and what is said after the last one behind that. Where the first frames
/// are skipped, the run begins with the submap that was open then. `None`: nobody listens any more.
pub(crate) fn play(
    (frames, mut submaps): (Frames, SubmapPoses),
    speed: f64,
    skip: Duration,
    begin: Option<Stamp>,
    clock: &Clock,
    to: &Sender<Input>,
) -> Option<()> {
    // Stamp of the first frame, and when it was played.
    let mut origin: Option<(Stamp, Stamp)> = None;
    let mut record_begin: Option<Stamp> = None;
    let mut last: Option<Stamp> = None;
    let mut newest = SubmapId::FIRST;
    let skip = i64::try_from(skip.as_micros()).unwrap_or(i64::MAX);
    for frame in frames {
        let mut frame = match frame {
            Ok(frame) => frame,
            Err(fault) => {
                to.blocking_send(Input::Fault(fault.to_string())).ok()?;
                continue;
            }
        };
        let stamp = frame.scan.stamp;
        let since_begin = stamp.micros_since(*record_begin.get_or_insert(stamp));
        if origin.is_none() && (0..skip).contains(&since_begin) {
            continue;
        }
        if origin.is_none() {
            submaps = submaps.begun_at(stamp);
        }
        let now = clock.now();
        let back = last.replace(stamp).map_or(0, |last| last.micros_since(stamp));
        let mut note = None;
        if back > STEP_BACK_MICROS {
            origin = Some((stamp, now));
            let seconds = back as f64 / 1e6;
            note = Some(format!(
                "the stamps of the record go back by {seconds:.3} s here: it is played on at once"
            ));
        }
        let (first, played) =
            *origin.get_or_insert_with(|| (stamp, begin.map_or(now, |begin| begin.max(now))));
        let due = played.plus_micros((stamp.micros_since(first) as f64 / speed) as i64);
        let pause = due.micros_since(now);
        if pause > PAUSE_SAID_MICROS {
            note = Some(format!("the next scan of the record is played in {:.1} s", pause as f64 / 1e6));
        }
        if let Some(note) = note {
            to.blocking_send(Input::Note(note)).ok()?;
        }
        // In short steps, so that the thread ends soon when the node has ended.
        while clock.now() < due {
            let rest = Duration::from_micros(due.micros_since(clock.now()).max(0).unsigned_abs());
            thread::sleep(rest.min(Duration::from_millis(100)));
            if to.is_closed() {
                return None;
            }
        }
        say_submaps(&mut submaps, stamp, &mut newest, to)?;
        frame.scan.stamp = due;
        to.blocking_send(Input::Frame(frame)).ok()?;
    }
    say_submaps(&mut submaps, Stamp(i64::MAX), &mut newest, to)
}

/// Passes on what is due of submaps: the node begins one where it is a new one. `newest`: the one that began last.
fn say_submaps(
    submaps: &mut SubmapPoses,
    until: Stamp,
    newest: &mut SubmapId,
    to: &Sender<Input>,
) -> Option<()> {
    while let Some(SubmapPose { submap, t_map_submap, .. }) = submaps.take_due(until) {
        if submap > *newest {
            *newest = submap;
            to.blocking_send(Input::BeginSubmap).ok()?;
        }
        to.blocking_send(Input::SubmapPose(Some(submap.number()), t_map_submap)).ok()?;
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::Scan;
    use flockmap_io::Frame;

    /// What comes of a record with these stamps, up to so many inputs.
    fn played(stamps: &'static [i64], count: usize) -> (Clock, Vec<Input>) {
        let frame = |&micros: &i64| {
            let scan = Scan { stamp: Stamp(micros), points: Vec::new(), no_returns: Vec::new() };
            Ok(Frame { scan, ..Frame::default() })
        };
        let frames = Frames::new(stamps.iter().map(frame));
        let clock = Clock::new();
        let (to, mut from) = tokio::sync::mpsc::channel(4);
        let thread = thread::spawn(move || {
            play((frames, SubmapPoses::default()), 1.0, Duration::ZERO, None, &clock, &to)
        });
        let inputs = (0..count).map_while(|_| from.blocking_recv()).collect();
        drop(from);
        thread.join().unwrap();
        (clock, inputs)
    }

    #[test]
    fn a_record_whose_clock_was_stepped_back_is_played_on_with_rising_stamps() {
        const HOUR: i64 = 3_600_000_000;
        // Also before the stamp where the record begins.
        let (clock, inputs) = played(&[2 * HOUR, 2 * HOUR + 1_000, HOUR, HOUR + 1_000], 5);
        let [Input::Frame(a), Input::Frame(b), Input::Note(note), Input::Frame(c), Input::Frame(d)] =
            inputs.as_slice()
        else {
            panic!("{inputs:?}")
        };
        assert!(note.contains("go back by 3600.001 s"), "{note}");
        let stamps = [a, b, c, d].map(|frame| frame.scan.stamp);
        assert!(stamps.is_sorted() && stamps[3] <= clock.now(), "{stamps:?}");
        assert_eq!(stamps[3].micros_since(stamps[2]), 1_000);
    }

    #[test]
    fn a_long_pause_of_a_record_is_said() {
        let (_, inputs) = played(&[0, i64::MAX], 2);
        let [Input::Frame(_), Input::Note(note)] = inputs.as_slice() else { panic!("{inputs:?}") };
        assert!(note.contains("the next scan of the record is played in"), "{note}");
    }
}
