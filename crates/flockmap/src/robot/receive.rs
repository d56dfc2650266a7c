//! What comes in: packages of others wait, are decoded and merged, and the session gets the verdict.

use flockmap_codec::{Content, ContentKind, Header, Package, PackageError, Span};
use flockmap_grid::mutation::{self, Mutation};
use flockmap_grid::{Changes, PresentState, Stamp, Stream};

use super::Robot;
use crate::tiles::{SetId, TileSet, Tiles, Turn};
use crate::{Event, Refusal};

/// Damaged packages remembered; of more, all are forgotten.
const DAMAGED_MAX: usize = 256;

impl Robot {
    /// Gives every event of the session its answer.
    pub(super) fn answer_session(&mut self, now: Stamp) {
        use flockmap_sync::Event as SessionEvent;
        while let Some(event) = self.session.poll_event() {
            match event {
                SessionEvent::Received(package) => self.receive(now, package),
                SessionEvent::PresentStateWanted { stream, since, newer_than, upto, bytes_max, .. } => {
                    self.provide_present_state(now, Span { stream, since, upto }, newer_than, bytes_max);
                }
                SessionEvent::StreamForgotten(stream) => {
                    self.waiting.forget(stream);
                    self.tiles.drop_upto(stream, u32::MAX);
                    self.fusion.forget(&self.mapper, stream);
                    self.push_event(Event::RunForgotten(stream));
                }
                SessionEvent::EpochTooLow { used } => self.begin_anew(now, used),
                SessionEvent::StateContains { stream, set, held } => {
                    self.push_event(Event::StateContains { stream, set, held });
                }
                SessionEvent::CaughtUp { stream, upto } => {
                    self.waiting.drop_upto(stream, upto);
                    self.tiles.drop_upto(stream, upto);
                    self.push_event(Event::CaughtUp { stream, upto });
                    self.release(now, stream);
                }
                SessionEvent::PeerSeen(stream) => self.push_event(Event::PeerSeen(stream)),
                SessionEvent::PeerLost(stream) => self.push_event(Event::PeerLost(stream)),
                SessionEvent::SameIdentity => self.push_event(Event::SameIdentity),
                SessionEvent::CountersSpent => self.push_event(Event::CountersSpent),
                _ => {}
            }
        }
    }

    /// Merges a package, and those that waited for it; or lets it wait for what it builds on.
    fn receive(&mut self, now: Stamp, package: Package) {
        let stream = package.header().stream;
        if let Some((id, tile)) = Tiles::place_of(&package)
            && package.header().resolution == self.config.mapper.resolution
        {
            self.receive_tile(now, id, tile, package);
        } else if self.must_wait(&package) {
            self.counters.waited += 1;
            for dropped in self.waiting.insert(package) {
                self.counters.waiting_dropped += 1;
                let (index, reference) = (dropped.header().index, dropped.header().reference);
                self.session.reject(now, &dropped);
                self.push_event(Event::Refused {
                    stream: dropped.header().stream,
                    index,
                    reason: Refusal::Waiting { reference },
                });
            }
        } else if self.merge_and_answer(now, &package) {
            self.release(now, stream);
        }
    }

    /// Whether a package builds on some that are not held yet. One of another resolution is not merged anyhow.
    fn must_wait(&self, package: &Package) -> bool {
        let header = package.header();
        header.reference > self.prefix(header.stream) && header.resolution == self.config.mapper.resolution
    }

    /// All packages from 1 to this one are held.
    fn prefix(&self, stream: Stream) -> u32 {
        self.session.held(stream).map_or(0, flockmap_sync::IntervalSet::prefix)
    }

    /// Merges what waited in a stream and need not any more, in the order of the indices.
    fn release(&mut self, now: Stamp, stream: Stream) {
        // A package that has to go on waiting keeps the prefix below itself, so that none before it can become ready on the way.
        let mut after = 0;
        while let Some(package) = self.waiting.take_ready(stream, after, self.prefix(stream)) {
            after = package.header().index;
            self.merge_and_answer(now, &package);
        }
    }

    /// Merges a tile that is told against those before it, and the ones that waited for it; or lets it wait.
    fn receive_tile(&mut self, now: Stamp, id: SetId, tile: u32, package: Package) {
        let is_received = |id: SetId| self.session.is_receiving(id.0, id.1);
        let (set, dropped) = self.tiles.open(now, id, package.header().index, is_received);
        match set.turn_of(tile) {
            Turn::Past => self.session.accept(now, &package),
            Turn::Later => {
                self.counters.waited += 1;
                if let Some(dropped) = set.wait(tile, package) {
                    self.counters.waiting_dropped += 1;
                    self.session.reject(now, &dropped);
                }
            }
            Turn::Now => {
                let mut next = Some(package);
                while next.take().is_some_and(|tile| self.merge_tile(now, id, &tile)) {
                    next = self.tiles.get_mut(id).and_then(TileSet::take_next);
                }
            }
        }
        if let Some((stream, set)) = dropped {
            self.session.restart_present_state(now, stream, set);
        }
    }

    /// Decodes and merges the tile whose turn it is, and gives the session the verdict; whether it is held now.
    fn merge_tile(&mut self, now: Stamp, id: SetId, package: &Package) -> bool {
        let header = package.header();
        match self.tiles.make_room(now, package) {
            Ok(dropped) => {
                for (stream, set) in dropped {
                    self.session.restart_present_state(now, stream, set);
                }
            }
            Err(reason) => {
                self.counters.no_room += 1;
                self.session.reject(now, package);
                self.push_event(Event::Refused { stream: header.stream, index: header.index, reason });
                return false;
            }
        }
        // Opened by the caller.
        let Some(set) = self.tiles.get_mut(id) else { return false };
        let read = set.read(&mut self.decoder, package);
        self.counters.steps += self.decoder.take_steps();
        let reason = match read {
            Ok(state) => match self.merge_present(now, package, &state) {
                Ok(event) => {
                    if let Some(set) = self.tiles.get_mut(id) {
                        set.note_merged(now);
                    }
                    self.counters.merged += 1;
                    self.session.accept(now, package);
                    self.push_event(event);
                    return true;
                }
                Err(reason) => {
                    if let Some(set) = self.tiles.get_mut(id) {
                        set.unmerged = Some(state);
                    }
                    self.counters.no_room += 1;
                    self.session.reject(now, package);
                    reason
                }
            },
            Err(error) => {
                // Which of the tiles so far is at fault cannot be told.
                self.counters.damaged += 1;
                self.tiles.drop_set(id);
                self.session.reject(now, package);
                self.session.restart_present_state(now, id.0, id.1);
                error.into()
            }
        };
        self.push_event(Event::Refused { stream: header.stream, index: header.index, reason });
        false
    }

    /// Decodes and merges a package, and gives the session the verdict; whether it is held now.
    fn merge_and_answer(&mut self, now: Stamp, package: &Package) -> bool {
        let header = package.header();
        let held = self.session.held(header.stream);
        if header.content == ContentKind::Changes && held.is_some_and(|held| held.contains(header.index)) {
            // A present state has brought it meanwhile.
            return false;
        }
        if mutation::is(Mutation::AcceptedUnmerged) {
            self.session.accept(now, package);
            return true;
        }
        let reason = match self.merge(now, package) {
            Ok(event) => {
                self.counters.merged += 1;
                self.session.accept(now, package);
                self.push_event(event);
                return true;
            }
            Err(reason) => reason,
        };
        let is_held = match &reason {
            Refusal::Package(PackageError::Overtaken(_) | PackageError::ReferenceMissing { .. }) => {
                self.counters.overtaken += 1;
                self.session.give_up(now, package);
                false
            }
            Refusal::Resolution { .. } => {
                // It will never fit here, but others may be able to use it.
                self.counters.foreign_resolution += 1;
                self.session.accept(now, package);
                true
            }
            Refusal::Fusion(_) | Refusal::Tiles { .. } => {
                self.counters.no_room += 1;
                self.session.reject(now, package);
                false
            }
            Refusal::Package(_) | Refusal::Waiting { .. } => {
                self.counters.damaged += 1;
                if self.is_damaged_again(package) {
                    self.session.give_up(now, package);
                } else {
                    self.session.reject(now, package);
                }
                false
            }
        };
        let (stream, index) = (package.header().stream, package.header().index);
        self.push_event(Event::Refused { stream, index, reason });
        is_held
    }

    /// Whether a package that builds on others was damaged before: asking for it again does not help then. Should a layer ever differ from
    /// its sender's, this is what heals it.
    fn is_damaged_again(&mut self, package: &Package) -> bool {
        let header = package.header();
        if header.is_alone {
            return false;
        }
        if self.damaged.len() >= DAMAGED_MAX {
            self.damaged.clear();
        }
        !self.damaged.insert((header.stream, header.index))
    }

    fn merge(&mut self, now: Stamp, package: &Package) -> Result<Event, Refusal> {
        let header = *package.header();
        let stream = header.stream;
        let own = self.config.mapper.resolution;
        if header.resolution != own {
            return Err(Refusal::Resolution { got: header.resolution, own });
        }
        let content = self.decoder.decode_against(package, self.fusion.layer(stream));
        self.counters.steps += self.decoder.take_steps();
        let changes = match content? {
            Content::Changes(changes) => changes,
            Content::Present(state) => return self.merge_present(now, package, &state),
        };
        self.note_clock(stream);
        let taken = self.fusion.apply(&self.mapper, stream, &changes, header.cycle_end, now)?;
        if let Some(sensor) = package.sensor() {
            self.fusion.note_sensor(stream, header.cycle_end, sensor);
        }
        Ok(merged(package, changes, taken))
    }

    fn merge_present(
        &mut self,
        now: Stamp,
        package: &Package,
        state: &PresentState,
    ) -> Result<Event, Refusal> {
        let stream = package.header().stream;
        self.note_clock(stream);
        let taken = self.fusion.apply_present(&self.mapper, stream, state, now)?;
        Ok(merged(package, Changes::default(), taken))
    }

    /// Tells the fusion how far the clock of a stream is off.
    fn note_clock(&mut self, stream: Stream) {
        if let Some(offset) = self.session.clock_offset(stream) {
            self.fusion.set_clock_offset(stream.origin, offset.saturating_neg());
        }
    }
}

fn merged(package: &Package, changes: Changes, taken: usize) -> Event {
    let &Header { stream, index, cycle_start, cycle_end, .. } = package.header();
    Event::Merged { stream, index, cycle_start, cycle_end, changes, taken, package: package.clone() }
}
