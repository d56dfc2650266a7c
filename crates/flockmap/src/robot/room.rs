//! What was dropped for want of room, and whether there is room again.

use super::Robot;
use crate::Event;

impl Robot {
    /// Says what had to go for what was merged last.
    pub(super) fn note_dropped(&mut self) {
        for dropped in self.fusion.take_dropped() {
            let flockmap_grid::Dropped { stream, blocks, newest } = dropped;
            let is_anywhere = self.fusion.layer(stream).is_some_and(flockmap_grid::Layer::lacks_anywhere);
            self.session.note_dropped(stream, newest, is_anywhere);
            if blocks == 0 {
                continue;
            }
            self.counters.blocks_dropped += blocks as u64;
            if stream != self.own_stream() {
                self.full_at = Some(self.fusion.memory_bytes_of_others(&self.mapper));
                self.session.set_has_room(false);
            }
            self.push_event(Event::Dropped { stream, blocks, newest });
        }
    }

    /// Takes in of which streams nothing is lacking any more.
    pub(super) fn note_complete(&mut self) {
        for stream in self.session.take_complete() {
            self.fusion.end_lack(stream);
            self.push_event(Event::Complete { stream });
        }
    }

    /// Says when there is room again for what was dropped: when the layers of others have shrunk to half.
    pub(super) fn note_room(&mut self) {
        let has_shrunk = |full| 2 * self.fusion.memory_bytes_of_others(&self.mapper) < full;
        if self.full_at.is_some_and(has_shrunk) {
            self.full_at = None;
            self.session.set_has_room(true);
        }
    }
}
