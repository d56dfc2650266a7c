//! When readers are told how submaps lie.

use std::time::Instant;

use flockmap::Robot;
use flockmap_feed::RunSubmaps;
use flockmap_view::serve::Numbered;

use super::said::submaps_of;

/// It is looked again after so many times what a look took: a tenth of the driver's time at most.
const LOOK_REST: u32 = 9;

/// How submaps lie, as it was said last.
pub(super) struct Submaps {
    said: Numbered<Vec<RunSubmaps>>,
    not_before: Instant,
    /// Something may have changed since it was looked.
    is_unseen: bool,
}

impl Submaps {
    pub(super) fn new(now: Instant) -> Self {
        Self { said: Numbered::default(), not_before: now, is_unseen: false }
    }

    /// Looks how they lie now, if something may be given out and it is not too soon, or `at_once`. O(submaps).
    pub(super) fn look(&mut self, robot: &Robot, may_give: bool, at_once: bool) {
        let began = Instant::now();
        self.is_unseen = !at_once && (!may_give || began < self.not_before);
        if self.is_unseen {
            return;
        }
        let runs = submaps_of(robot);
        // At first there is something to say also where there are no runs.
        if self.said.number() == 0 || *self.said.value() != runs {
            self.said.replace(runs);
        }
        self.not_before = Instant::now() + began.elapsed() * LOOK_REST;
    }

    /// Nobody wants to know.
    pub(super) const fn rest(&mut self) {
        self.is_unseen = false;
    }

    /// When to look again, where they may have changed since; until then no map is given out, whose submaps they would not be.
    pub(super) fn unseen_until(&self) -> Option<Instant> {
        self.is_unseen.then_some(self.not_before)
    }

    pub(super) const fn number(&self) -> u64 {
        self.said.number()
    }

    pub(super) fn said(&self) -> Numbered<Vec<RunSubmaps>> {
        self.said.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Resolution, RobotConfig, RobotId, Stamp};

    #[test]
    fn submaps_are_said_at_first_and_when_they_change_and_what_may_not_be_given_yet_is_looked_at_later() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let mut robot = Robot::new(RobotConfig::new(RobotId(1), resolution, 7.0), Stamp(0)).unwrap();
        let mut submaps = Submaps::new(Instant::now());
        // A look is followed by a rest.
        let look = |submaps: &mut Submaps, robot: &Robot| {
            std::thread::sleep(submaps.not_before.saturating_duration_since(Instant::now()));
            submaps.look(robot, true, false);
            assert_eq!(submaps.unseen_until(), None);
            (submaps.number(), submaps.said().value().len())
        };
        assert_eq!(look(&mut submaps, &robot), (1, 1));
        assert_eq!(look(&mut submaps, &robot), (1, 1));
        robot.begin_submap(Stamp(1)).unwrap();
        submaps.look(&robot, false, false);
        assert_eq!(submaps.number(), 1);
        assert!(submaps.unseen_until().is_some());
        assert_eq!(look(&mut submaps, &robot), (2, 1));
        submaps.look(&robot, false, false);
        submaps.rest();
        assert_eq!(submaps.unseen_until(), None, "nobody wants to know");
        robot.begin_submap(Stamp(2)).unwrap();
        submaps.look(&robot, false, true);
        assert_eq!((submaps.number(), submaps.unseen_until()), (3, None), "at the end it is looked at once");
    }
}
