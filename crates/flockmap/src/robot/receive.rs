//! What comes in: packages of others are decoded and merged, and the session gets the verdict.

use flockmap_codec::{Content, Header, Package, PackageError};
use flockmap_grid::{Changes, Snapshot, Stamp, Stream};
use flockmap_mutation::{self as mutation, Mutation};
use flockmap_sync::Verdict;

use super::{RestoreError, Robot};
use crate::effort::MERGE_BLOCK_STEPS;
use crate::readers::{Readers, SnapshotId};
use crate::snapshots::Wanted;
use crate::{Event, Refusal};

impl Robot {
    /// Takes in a package of another robot, or a chunk of a snapshot, that came by another way than the radio: over a
    /// network of its own, from an archive. It is decoded, checked, merged and held as one that was received, and offered
    /// to peers; what builds on a package that is lacking waits for it. One that is known already, or is of the own run,
    /// changes nothing. At most 1,024 may wait for the call that merges them: more are dropped and counted, and can be
    /// given again. What a snapshot of a history with gaps contains is said behind its chunks by
    /// [`Self::restore_contents`].
    ///
    /// # Errors
    /// [`RestoreError::NoRoom`]; nothing is changed then. That one does not decode is an event, as for every package.
    pub fn receive_package(&mut self, now: Stamp, package: Package) -> Result<(), RestoreError> {
        let stream = package.header().stream;
        if stream == self.own_stream() {
            return Ok(());
        }
        let now = self.advance(now);
        let has_room = self.session.deliver_package(now, package);
        self.after_datagram(now);
        if has_room { Ok(()) } else { Err(RestoreError::NoRoom(stream)) }
    }

    /// Gives the events of the session their answers, as far as this call has time for it.
    pub(super) fn answer_session(&mut self, now: Stamp) {
        use flockmap_sync::Event as SessionEvent;
        while self.merge_steps_left > 0
            && let Some(event) = self.session.poll_event()
        {
            // Before what the event brings may be dropped in turn.
            self.note_complete();
            match event {
                SessionEvent::Received(package) => {
                    let verdict = self.receive(now, &package);
                    self.session.verdict(now, &package, verdict);
                }
                SessionEvent::SnapshotWanted {
                    stream,
                    since,
                    newer_than,
                    upto,
                    bytes_max,
                    in_pieces,
                    ..
                } => {
                    let wanted = Wanted { stream, since, upto, newer_than, bytes_max, in_pieces };
                    self.snapshots.want(wanted);
                    // A small one is made at once.
                    self.go_on_with_snapshots(now);
                }
                SessionEvent::SnapshotDropped { stream, snapshot_id } => {
                    self.readers.drop_one((stream, snapshot_id))
                }
                SessionEvent::NoRoomToWait { stream, index, base } => {
                    self.push_event(Event::Refused { stream, index, reason: Refusal::Waiting { base } });
                }
                SessionEvent::StreamForgotten(stream) => {
                    self.readers.drop_upto(stream, u32::MAX);
                    self.snapshots.forget(stream);
                    self.fusion.forget(stream);
                    self.push_event(Event::RunForgotten(stream));
                }
                SessionEvent::EpochTooLow { used } => self.begin_anew(now, used),
                SessionEvent::SnapshotContains { stream, snapshot_id, received } => {
                    self.push_event(Event::SnapshotContains { stream, snapshot_id, received });
                }
                SessionEvent::CaughtUp { stream, upto } => {
                    self.readers.drop_upto(stream, upto);
                    self.push_event(Event::CaughtUp { stream, upto });
                }
                SessionEvent::PeerSeen(stream) => self.push_event(Event::PeerSeen(stream)),
                SessionEvent::PeerLost(stream) => self.push_event(Event::PeerLost(stream)),
                SessionEvent::SameIdentity => self.push_event(Event::SameIdentity),
                SessionEvent::NoncesExhausted => self.push_event(Event::NoncesExhausted),
                _ => {}
            }
        }
        self.note_complete();
    }

    /// Decodes and merges a package; the verdict on it.
    fn receive(&mut self, now: Stamp, package: &Package) -> Verdict {
        if mutation::is(Mutation::AcceptedUnmerged) {
            return Verdict::Merged;
        }
        let reason = match self.merge(now, package) {
            Ok(event) => {
                self.counters.merged += 1;
                self.push_event(event);
                return Verdict::Merged;
            }
            Err(reason) => reason,
        };
        let (counter, verdict) = match &reason {
            Refusal::Package(PackageError::BaseSuperseded(_) | PackageError::BaseMissing { .. }) => {
                (&mut self.counters.superseded, Verdict::Undecodable)
            }
            // It will never fit here, but others may be able to use it.
            Refusal::Resolution { .. } => (&mut self.counters.foreign_resolution, Verdict::Merged),
            Refusal::Fusion(_) | Refusal::Chunks { .. } => (&mut self.counters.no_room, Verdict::NoRoom),
            Refusal::Package(_) | Refusal::Waiting { .. } => (&mut self.counters.damaged, Verdict::Damaged),
        };
        *counter += 1;
        let (stream, index) = (package.header().stream, package.header().index);
        self.push_event(Event::Refused { stream, index, reason });
        verdict
    }

    fn merge(&mut self, now: Stamp, package: &Package) -> Result<Event, Refusal> {
        match Readers::snapshot_of(package) {
            Some(id) => self.merge_chunk(now, id, package),
            None => self.merge_package(now, package),
        }
    }

    /// Refuses a package whose resolution is not that of this robot. It counts as held then ([`Refusal::Resolution`]),
    /// so a damaged header must not pass for one. All packages of a run have one resolution: if the run has a layer
    /// here, the package is damaged. If it has none, its check decides, which covers the header. A package that builds
    /// on others cannot be decoded without a layer; those others came first, and had another resolution too, or there
    /// would be a layer.
    fn check_resolution(&mut self, package: &Package) -> Result<(), Refusal> {
        let (got, own) = (package.header().resolution, self.config.mapper.resolution);
        if got == own {
            return Ok(());
        }
        if self.fusion.layer(package.header().stream).is_some() {
            let rule = "all packages of a run have one resolution";
            return Err(PackageError::Header { rule }.into());
        }
        let decoded = self.decoder.decode(package);
        self.note_decoded();
        match decoded {
            Ok(_) | Err(PackageError::BaseMissing { .. } | PackageError::ChunkMissing { .. }) => {
                Err(Refusal::Resolution { got, own })
            }
            Err(error) => Err(error.into()),
        }
    }

    fn merge_package(&mut self, now: Stamp, package: &Package) -> Result<Event, Refusal> {
        let header = *package.header();
        let stream = header.stream;
        self.check_resolution(package)?;
        self.session.check_base(package)?;
        let content = self.decoder.decode_against(package, self.fusion.layer(stream));
        self.note_decoded();
        let changes = match content? {
            Content::Changes(changes) => changes,
            Content::Snapshot(state) => return self.merge_snapshot(now, package, &state),
        };
        self.note_clock(stream);
        self.note_merging(changes.blocks().len());
        let taken = self.fusion.apply(&self.mapper, stream, &changes, header.batch_end, now)?;
        self.note_dropped();
        if let Some(sensor) = package.sensor() {
            self.fusion.note_sensor(stream, header.batch_end, sensor);
        }
        Ok(merged(package, changes, taken))
    }

    /// Merges the next chunk of those that build on one another.
    fn merge_chunk(&mut self, now: Stamp, id: SnapshotId, chunk: &Package) -> Result<Event, Refusal> {
        self.check_resolution(chunk).inspect_err(|_| self.readers.drop_one(id))?;
        for (stream, snapshot_id) in self.readers.make_room(now, id, chunk)? {
            self.session.restart_snapshot(now, stream, snapshot_id);
        }
        let read = self.readers.read(now, id, &mut self.decoder, chunk);
        self.note_decoded();
        let state = read.inspect_err(|_| self.readers.drop_one(id))?;
        let merged = self.merge_snapshot(now, chunk, &state);
        match merged {
            Ok(_) => self.readers.note_merged(now, id),
            Err(_) => self.readers.keep(id, state),
        }
        merged
    }

    fn merge_snapshot(&mut self, now: Stamp, package: &Package, state: &Snapshot) -> Result<Event, Refusal> {
        let header = package.header();
        let stream = header.stream;
        self.session.note_merging(header);
        self.note_clock(stream);
        self.note_merging(state.parts.iter().map(|(_, part)| part.blocks().len()).sum());
        if self.session.begin_part(header)
            && let Some(lost_upto) = header.lost_upto
        {
            self.fusion.begin_part(&self.mapper, stream, lost_upto);
        }
        let is_rest = self.session.brings_back(header);
        let taken = self.fusion.apply_snapshot(&self.mapper, stream, state, is_rest, now)?;
        self.note_dropped();
        Ok(merged(package, Changes::default(), taken))
    }

    fn note_decoded(&mut self) {
        let steps = self.decoder.take_steps();
        self.counters.steps += steps;
        self.merge_steps_left = self.merge_steps_left.saturating_sub(steps);
    }

    const fn note_merging(&mut self, blocks: usize) {
        self.merge_steps_left = self.merge_steps_left.saturating_sub(blocks as u64 * MERGE_BLOCK_STEPS);
    }

    /// Sets for the fusion how far the clock of a stream is off.
    fn note_clock(&mut self, stream: Stream) {
        if let Some(offset) = self.session.clock_offset_micros(stream) {
            self.fusion.set_clock_offset(stream.origin, offset.saturating_neg());
        }
    }
}

fn merged(package: &Package, changes: Changes, taken: usize) -> Event {
    let &Header { stream, index, batch_start, batch_end, .. } = package.header();
    Event::Merged { stream, index, batch_start, batch_end, changes, taken, package: package.clone() }
}
