//! Long work, of which each call of [`Robot::handle_timeout`] does a slice.

use core::time::Duration;

use flockmap_grid::Stamp;

use super::Robot;
use crate::effort::Work;

/// Blocks of the fused map that one call of [`Robot::handle_timeout`] works out at most while the map is made anew:
/// each takes 10 to 40 µs.
pub const REBUILD_BLOCKS: usize = 128;

/// Submaps that are moved again and again, here or by another robot, come into force no sooner after one another: each time
/// much of the map may be worked out anew.
const MOVES_APART: Duration = Duration::from_millis(500);

impl Robot {
    /// Whether there is work that goes on in slices.
    pub(super) fn is_busy(&self) -> bool {
        [Work::Rebuild, Work::Snapshots, Work::Republish].into_iter().any(|work| self.has(work))
            || self.readers.is_any_discarded()
            || self.session.has_events()
    }

    /// Does a slice of the long work whose turn it is: of one kind, so that slices do not add up.
    pub(super) fn do_slice(&mut self, now: Stamp) {
        let turns = [self.turn, self.turn.next(), self.turn.next().next()];
        let Some(work) = turns.into_iter().find(|work| self.has(*work)) else { return };
        self.turn = work.next();
        match work {
            Work::Rebuild => {
                let is_moved = self.fusion.is_moved();
                self.fusion.work(&self.mapper, REBUILD_BLOCKS);
                if is_moved && !self.fusion.is_moved() {
                    self.moves_from = Some(now.plus(MOVES_APART));
                }
            }
            Work::Snapshots => self.go_on_with_snapshots(now),
            Work::Republish => self.go_on_with_republishing(now),
        }
    }

    /// When submaps come into force that were moved soon after others.
    pub(super) fn moves_due(&self) -> Option<Stamp> {
        self.moves_from.filter(|_| self.fusion.is_moved())
    }

    /// Lets them wait, or no longer.
    pub(super) fn hold_moves(&mut self, now: Stamp) {
        self.fusion.hold_moves(self.moves_from.is_some_and(|from| now < from));
    }

    fn has(&self, work: Work) -> bool {
        match work {
            Work::Rebuild => self.fusion.has_work(),
            Work::Snapshots => self.snapshots.is_busy(),
            Work::Republish => self.republishing.is_some(),
        }
    }
}
