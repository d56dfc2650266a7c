//! What goes out: when a cycle is told and how much of it, coded, taken into the own layer and given to the session.

use std::borrow::Cow;

use flockmap_codec::{Codec, Cycle, EncodeError, PACKAGE_BYTES_MAX, Package, Reference};
use flockmap_grid::mutation::{self, Mutation};
use flockmap_grid::{BlockIndex, Changes, Fusion, Plane, Stamp};
use flockmap_sync::Pace;

use super::Robot;
use crate::Event;

/// A cycle that the budget holds back is looked at again after so many microseconds.
const HELD_PAUSE: i64 = 10_000;

/// And where there was nothing to tell, after so many.
const NOTHING_PAUSE: i64 = 50_000;

/// A cycle that is due and is held back.
#[derive(Clone, Copy)]
pub(super) struct Held {
    since: Stamp,
    /// When to look again.
    pub(super) until: Stamp,
}

impl Robot {
    /// The cycle that is due, unless own packages still wait for the radio's budget: then what changes is merged in the map, which costs
    /// less than packages that wait, and nothing builds on them. Of what is due, as much as the radio takes.
    pub(super) fn close_due(&mut self, now: Stamp) -> Option<(Cycle, Changes)> {
        if self.packer.deadline(&self.mapper).is_none_or(|due| due > now) {
            return None;
        }
        let (bytes_per_s, waits) = match self.session.pace(now) {
            Pace::Free => {
                self.held = None;
                return self.packer.close_due(now, &mut self.mapper);
            }
            Pace::AllSent { bytes_per_s } => (bytes_per_s, false),
            Pace::Waiting { bytes_per_s } => (bytes_per_s, true),
        };
        let room = self.cost.room(bytes_per_s);
        let since = self.held.map_or(now, |held| held.since);
        if waits && now.micros_since(since) < room.hold_max {
            self.counters.cycles_held += u64::from(self.held.is_none());
            self.held = Some(Held { since, until: now.plus_micros(HELD_PAUSE) });
            if now.micros_since(since) >= 1_000 * i64::from(self.config.cycle.t_l_ms) {
                self.packer.note_late();
            }
            return None;
        }
        self.held = None;
        let fusion = &self.fusion;
        let closed =
            self.packer.close_part(now, &mut self.mapper, room, |block| believed_occupied(fusion, block));
        let Some(closed) = closed else {
            // There may be nothing but what a team-mate knows better.
            self.held = Some(Held { since: now, until: now.plus_micros(NOTHING_PAUSE) });
            return None;
        };
        self.counters.cycles_in_parts +=
            u64::from(self.packer.deadline(&self.mapper).is_some_and(|due| due <= now));
        Some(closed)
    }

    /// Codes a cycle, takes it into the own layer and gives it to the session.
    pub(super) fn publish(&mut self, now: Stamp, cycle: Cycle, changes: Changes) {
        let mut coded = Cow::Borrowed(&changes);
        if mutation::is(Mutation::BlockLeftOut) && changes.blocks().len() > 1 {
            coded = Cow::Owned(Changes::from_blocks(changes.blocks()[1..].to_vec()));
        }
        let packages = match self.encode(&cycle, &coded) {
            Ok(packages) => packages,
            Err(error) => {
                // The map goes on without these changes, and what is told next counts on them.
                self.own_layer_is_whole = false;
                return self.push_event(Event::EncodeFailed(error));
            }
        };
        self.counters.cycles += 1;
        self.counters.changes += changes.len() as u64;
        for package in &packages {
            self.next_index += 1;
            self.counters.packages += 1;
            self.counters.package_bytes += package.bytes().len() as u64;
            // Numbered and sized by us, so the session takes it.
            let published = self.session.publish(now, package.clone());
            debug_assert_eq!(published, Ok(()));
        }
        self.sent.note_cycle(&packages);
        self.cost.note_cycle(&changes, &packages);
        self.repair.note_cycle(now, self.next_index - 1);
        if let Err(error) = self.fusion.apply(&self.mapper, self.own, &changes, cycle.end, now) {
            // The packages are out all the same; only a present state of this stream would lack them. And the others hold more from now
            // on than the own layer, so that nothing can be told against it any more.
            self.own_layer_is_whole = false;
            self.own_layer_has_all = false;
            self.counters.no_room += 1;
            let reason = error.into();
            self.push_event(Event::Refused { stream: self.own, index: self.next_index - 1, reason });
        }
        self.fusion.note_sensor(self.own, cycle.end, cycle.sensor);
        self.push_event(Event::CycleClosed { cycle, changes, packages });
        self.answer_session(now);
    }

    /// The packages of a cycle, told against what the others will hold; without, if repair is slow.
    fn encode(&mut self, cycle: &Cycle, changes: &Changes) -> Result<Vec<Package>, EncodeError> {
        let Self { encoder, fusion, sent, counters, config, .. } = self;
        let is_alone = !self.own_layer_is_whole || self.repair.is_slow();
        counters.cycles_without_reference += u64::from(is_alone && config.codec == Codec::Flock);
        let layer = fusion.layer(self.own).filter(|_| !is_alone);
        let reference = Reference { layer, cycles: sent.cycles(), readers: sent.readers() };
        let mut encode = |reference: Option<&Reference<'_>>| {
            encoder.encode_cycle_against(
                config.codec,
                cycle,
                self.next_index,
                changes,
                reference,
                PACKAGE_BYTES_MAX,
            )
        };
        match encode(Some(&reference)) {
            // The own layer holds something as new, which no cycle should meet: it can be told all the same.
            Err(EncodeError::Overtaken(_)) => encode(Some(&Reference { layer: None, ..reference })),
            coded => coded,
        }
    }
}

/// The voxels of a block that are Occupied in the fused map.
pub(super) fn believed_occupied(fusion: &Fusion, block: BlockIndex) -> Plane {
    fusion.map().block(block).map_or([0; 8], |states| *states.occupied())
}
