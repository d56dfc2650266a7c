//! The time of ROS, and the clock of the node: stamps go from the one to the other.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

use flockmap::Stamp;
use flockmap_io::ros::Time;
use flockmap_node::Clock;

/// `/clock` that goes on by this much more than the node's clock has jumped.
const JUMP_ON_MICROS: i64 = 5_000_000;
/// One that goes back by this much is of another run. By less, messages came out of order.
const JUMP_BACK_MICROS: i64 = 1_000_000;

/// Stamps of scans that are remembered, so that a map gets exactly the stamp of its newest scan.
const REMEMBERED_MAX: usize = 256;

/// The time of ROS: that of the machine, or of `/clock`.
#[derive(Debug)]
pub(crate) struct RosClock {
    node: Clock,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    is_simulated: bool,
    /// How far the simulated time is ahead of the node's clock, once it was heard.
    ahead: Option<i64>,
    /// What `/clock` said last.
    heard: Option<Stamp>,
    /// Scans by their stamps on the node's clock and in ROS.
    remembered: VecDeque<(Stamp, Time)>,
}

/// How the simulated time has jumped.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Jump {
    /// Back by so many microseconds: what was known of earlier times is of another run.
    Back(i64),
    /// On by so many microseconds.
    On(i64),
}

impl RosClock {
    pub(crate) const fn new(node: Clock, is_simulated: bool) -> Self {
        let state = State { is_simulated, ahead: None, heard: None, remembered: VecDeque::new() };
        Self { node, state: Mutex::new(state) }
    }

    /// What `/clock` says.
    pub(crate) fn take_clock(&self, time: Stamp) -> Option<Jump> {
        let ahead = time.micros_since(self.node.now());
        let mut state = self.lock();
        let (before, heard) = (state.ahead.replace(ahead), state.heard.replace(time));
        // A recording that is played slowly, or rests, falls behind the node's clock, and does not go back.
        let back = heard?.micros_since(time);
        let on = ahead.saturating_sub(before?);
        if back > JUMP_BACK_MICROS {
            Some(Jump::Back(back))
        } else {
            (on > JUMP_ON_MICROS).then_some(Jump::On(on))
        }
    }

    /// The time of ROS now; `None` before the first `/clock`.
    pub(crate) fn now(&self) -> Option<Stamp> {
        Some(self.node.now().plus_micros(self.ahead()?))
    }

    /// When a scan with this stamp was made on the node's clock: not in the future, whatever jitter /clock has. `None`
    /// before the first `/clock`. It is remembered.
    pub(crate) fn to_node(&self, ros: Time) -> Option<Stamp> {
        let node = Stamp(Stamp::from(ros).0.saturating_sub(self.ahead()?)).min(self.node.now());
        let remembered = &mut self.lock().remembered;
        remembered.truncate(REMEMBERED_MAX - 1);
        remembered.push_front((node, ros));
        Some(node)
    }

    /// A stamp of the node's clock in ROS; that of the scan to the nanosecond if it is of one.
    pub(crate) fn to_ros(&self, node: Stamp) -> Option<Time> {
        let remembered = self.lock().remembered.iter().find(|(of, _)| *of == node).map(|(_, ros)| *ros);
        remembered.or_else(|| Some(node.plus_micros(self.ahead()?).into()))
    }

    fn ahead(&self) -> Option<i64> {
        let state = self.lock();
        if state.is_simulated { state.ahead } else { Some(self.node.system_ahead()) }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // What a thread that panicked has left behind is whole.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn simulated_time_is_that_of_the_clock_topic_and_jumps_are_told() {
        let node = Clock::at(Stamp(1_000_000_000));
        let clock = RosClock::new(node, true);
        let time = |micros: i64| Time::from(Stamp(micros));
        assert_eq!((clock.now(), clock.to_node(time(5))), (None, None));
        assert_eq!(clock.take_clock(Stamp(50_000_000)), None);
        let scan = clock.to_node(Time { sec: 49, nanosec: 900_000_123 }).unwrap();
        assert!((scan.micros_since(node.now()) + 100_000).abs() < 1_000_000, "{scan:?}");
        assert_eq!(clock.to_ros(scan), Some(Time { sec: 49, nanosec: 900_000_123 }));
        assert_eq!(clock.take_clock(Stamp(50_500_000)), None);
        // The scan keeps its stamp, however the clock goes on.
        assert_eq!(clock.to_ros(scan), Some(Time { sec: 49, nanosec: 900_000_123 }));
        // It rested for a while, by this clock for 20 s.
        let rested = RosClock::new(Clock::at(Stamp(1_020_000_000)), true);
        rested.lock().ahead = clock.lock().ahead;
        rested.lock().heard = clock.lock().heard;
        assert_eq!(rested.take_clock(Stamp(50_600_000)), None);
        let early = clock.to_node(time(51_000_000)).unwrap();
        assert!(early <= node.now());
        assert_eq!(clock.to_ros(early), Some(time(51_000_000)));
        assert!(matches!(clock.take_clock(Stamp(10_000_000)), Some(Jump::Back(by)) if by > 39_000_000));
        assert!(matches!(clock.take_clock(Stamp(90_000_000)), Some(Jump::On(by)) if by > 79_000_000));
    }

    #[test]
    fn without_simulation_it_is_the_time_of_the_machine() {
        let clock = RosClock::new(Clock::new(), false);
        let now = clock.now().unwrap();
        let there = clock.to_ros(clock.to_node(now.into()).unwrap()).unwrap();
        assert_eq!(there, now.into());
    }
}
