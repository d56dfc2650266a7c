//! A recording or a simulation, played in real time.

use std::thread;
use std::time::Duration;

use flockmap::Stamp;
use flockmap_io::Frames;
use tokio::sync::mpsc::Sender;

use super::Input;
use crate::Clock;

/// Reads frames and passes each on when its time has come, until they end or nobody listens any more. Frames that
/// wait make the reader wait, so memory is bounded; what comes too late is passed on at once.
pub(crate) fn play(
    frames: Frames,
    speed: f64,
    skip: Duration,
    begin: Option<Stamp>,
    clock: &Clock,
    to: &Sender<Input>,
) {
    // Stamp of the first frame, and when it was played.
    let mut origin: Option<(Stamp, Stamp)> = None;
    let mut record_begin: Option<Stamp> = None;
    let skip = i64::try_from(skip.as_micros()).unwrap_or(i64::MAX);
    for frame in frames {
        let mut frame = match frame {
            Ok(frame) => frame,
            Err(fault) => {
                if to.blocking_send(Input::Fault(fault.to_string())).is_err() {
                    return;
                }
                continue;
            }
        };
        let stamp = frame.scan.stamp;
        if stamp.micros_since(*record_begin.get_or_insert(stamp)) < skip {
            continue;
        }
        let now = clock.now();
        let (first, played) =
            *origin.get_or_insert_with(|| (stamp, begin.map_or(now, |begin| begin.max(now))));
        let due = played.plus_micros((stamp.micros_since(first) as f64 / speed) as i64);
        // In short steps, so that the thread ends soon when the node has ended.
        while clock.now() < due {
            let rest = Duration::from_micros(due.micros_since(clock.now()).max(0).unsigned_abs());
            thread::sleep(rest.min(Duration::from_millis(100)));
            if to.is_closed() {
                return;
            }
        }
        frame.scan.stamp = due;
        if to.blocking_send(Input::Frame(frame)).is_err() {
            return;
        }
    }
}
