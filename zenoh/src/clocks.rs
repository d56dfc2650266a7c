//! The clocks of robots, as they were taken over from holders.

use std::collections::{BTreeMap, BTreeSet};

use flockmap::RobotId;

/// Clocks that differ from what is set by less stay as they are: each change makes the map anew where it matters.
const CHANGE_MICROS: u64 = 50_000;

/// What is set.
#[derive(Debug, Default)]
pub(crate) struct Clocks(BTreeMap<RobotId, i64>);

impl Clocks {
    /// What is to be set now that these are said. Of robots of which nothing is `held` clocks are kept as well, since
    /// packages may come next; but no more than `others_max`, whoever makes them up. `None`: to be measured again.
    pub(crate) fn change(
        &mut self,
        said: &BTreeMap<RobotId, i64>,
        held: &BTreeSet<RobotId>,
        others_max: usize,
    ) -> Vec<(RobotId, Option<i64>)> {
        let mut changes = Vec::new();
        let mut others = self.0.keys().filter(|robot| !held.contains(robot)).count();
        if others >= others_max {
            // Those that nobody speaks of make room.
            self.0.retain(|robot, _| {
                let is_wanted = held.contains(robot) || said.contains_key(robot);
                if !is_wanted {
                    changes.push((*robot, None));
                    others -= 1;
                }
                is_wanted
            });
        }
        for (&robot, &micros) in said {
            let set = self.0.get(&robot);
            if set.is_some_and(|set| set.abs_diff(micros) <= CHANGE_MICROS) {
                continue;
            }
            if set.is_none() && !held.contains(&robot) {
                if others >= others_max {
                    continue;
                }
                others += 1;
            }
            self.0.insert(robot, micros);
            changes.push((robot, Some(micros)));
        }
        changes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(clocks: impl IntoIterator<Item = (u16, i64)>) -> BTreeMap<RobotId, i64> {
        clocks.into_iter().map(|(robot, micros)| (RobotId(robot), micros)).collect()
    }

    #[test]
    fn a_clock_is_set_once_and_again_when_it_differs() {
        let mut clocks = Clocks::default();
        let held = BTreeSet::from([RobotId(1)]);
        assert_eq!(
            clocks.change(&said([(1, 7), (2, 8)]), &held, 10),
            [(RobotId(1), Some(7)), (RobotId(2), Some(8))]
        );
        assert_eq!(clocks.change(&said([(1, 40_000), (2, -40_000)]), &held, 10), []);
        assert_eq!(clocks.change(&said([(1, 90_000)]), &held, 10), [(RobotId(1), Some(90_000))]);
    }

    #[test]
    fn made_up_robots_take_no_place_of_those_that_are_held() {
        let mut clocks = Clocks::default();
        let held: BTreeSet<RobotId> = [RobotId(60_000), RobotId(60_001)].into();
        for round in 0..20u16 {
            let flood = (0..1_000).map(|id| (round * 1_000 + id, 5));
            clocks.change(&said(flood), &held, 64);
            assert!(clocks.0.len() <= 64, "round {round}");
        }
        let changes = clocks.change(&said([(60_000, 1), (60_001, 2), (7, 5)]), &held, 64);
        for robot in held {
            assert!(changes.iter().any(|(of, set)| *of == robot && set.is_some()), "{robot:?}");
        }
        // What was made up is measured again.
        assert!(changes.contains(&(RobotId(19_000), None)));
        assert_eq!(clocks.0.len(), 3);
    }
}
