//! What the packages of a batch, or the sections of a snapshot, have taught the writer so far.

use flockmap_grid::BaseSuperseded;

use super::adaptive_state::Carry;
use super::choice::choose;
use super::known::Known;
use super::model::Model;
use super::order::Changed;
use super::tables::TableSet;

/// Which tables suit, and how many bytes changes take.
pub(crate) struct Habits {
    /// The sets of tables to choose from; one that was chosen.
    sets: Vec<TableSet>,
    /// Bytes for each 1,024 changes.
    rate: usize,
    /// Of sections of a snapshot.
    pub(crate) carry: Option<Carry>,
}

impl Habits {
    pub(crate) fn new(sets: &[TableSet]) -> Self {
        Self { sets: sets.to_vec(), rate: 0, carry: None }
    }

    pub(crate) fn of_snapshot(sets: &[TableSet]) -> Self {
        Self { carry: Some(Carry::default()), ..Self::new(sets) }
    }

    /// Chooses tables when it sees the first blocks of a batch.
    pub(crate) fn tables(
        &mut self,
        model: &mut Model,
        known: &Known<'_>,
        sensor: [i32; 3],
        blocks: &[Changed<'_>],
    ) -> Result<TableSet, BaseSuperseded> {
        let set = match *self.sets {
            [set] => set,
            _ => choose(model, known, &self.sets, sensor, blocks)?,
        };
        if self.rate == 0 {
            self.sets = vec![set];
            self.rate = match set {
                TableSet::Dense => 140,
                TableSet::Free => 70,
                TableSet::Sparse => 300,
                TableSet::Obstacles => 750,
            };
        }
        Ok(set)
    }

    /// Learns from a payload with so many changes.
    pub(crate) fn learn(&mut self, payload_bytes: usize, changes: usize) {
        self.rate = (payload_bytes * 1_024 / changes.max(1)).max(1);
    }

    /// A section goes out as it was written last.
    pub(crate) fn accept(&mut self, set: TableSet) {
        if let Some(Carry { state, at_end }) = &mut self.carry {
            state.note(set, at_end);
        }
    }

    /// How many blocks from the front fill so many bytes, if there are as many: twice as many as are likely to. To
    /// write a package again, for too few, takes longer than a larger box.
    pub(crate) fn reach(&self, blocks: &[Changed<'_>], room: usize) -> usize {
        let changes = room.saturating_mul(2 * 1_024) / self.rate.max(1);
        let mut left = u32::try_from(changes.max(1)).unwrap_or(u32::MAX);
        let full = blocks.iter().position(|(_, states)| {
            let changes = states.known_count();
            let is_full = changes >= left;
            left = left.saturating_sub(changes);
            is_full
        });
        full.map_or(blocks.len(), |last| last + 1)
    }
}
