//! Snapshots for peers that miss too much: begun when the session wants one, made in slices.

use flockmap_codec::Package;
use flockmap_grid::Stamp;

use super::Robot;
use crate::snapshots::Form;
use crate::{Event, RobotConfig};

impl Robot {
    /// Begins and makes some more of the snapshots that are wanted, as far as this call has time for it, and gives the
    /// session what is complete.
    pub(super) fn go_on_with_snapshots(&mut self, now: Stamp) {
        let form = self.snapshot_form();
        loop {
            if let Some(wanted) = self.snapshots.take_turn() {
                let stream = wanted.stream;
                let is_whole = stream != self.own_stream() || self.own_layer_has_all();
                let Some(layer) = self.fusion.layer(stream).filter(|_| is_whole) else {
                    // There is none to give.
                    self.session.provide_snapshot(now, stream, Vec::new());
                    continue;
                };
                self.snapshots.begin(layer, wanted, self.session.cuts(stream, wanted.upto), form);
            }
            let Some((stream, result)) = self.snapshots.go_on(form) else { break };
            match result {
                Ok(chunks) => {
                    self.counters.snapshots += u64::from(!chunks.is_empty());
                    let is_piece = |chunk: &Package| chunk.header().changed_upto.is_some();
                    self.counters.snapshot_pieces += u64::from(chunks.first().is_some_and(is_piece));
                    self.session.provide_snapshot(now, stream, chunks);
                }
                Err(error) => self.push_event(Event::EncodeFailed(error)),
            }
        }
        self.counters.snapshot_steps_most = self.snapshots.steps_most();
        for stream in self.snapshots.streams() {
            self.session.snapshot_is_coming(now, stream);
        }
    }

    const fn snapshot_form(&self) -> Form {
        let RobotConfig { codec, ref mapper, ref session, snapshot_piece_bytes: piece_bytes, .. } =
            self.config;
        Form {
            codec,
            resolution: mapper.resolution,
            chunks_bytes_max: session.snapshot_bytes_max,
            piece_bytes,
        }
    }
}
