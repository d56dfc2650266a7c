//! The model at work: decisions about block after block, each in sight of what is known round it.

use flockmap_grid::{BaseSuperseded, BlockIndex, StateBlock, meet};

use fearless_simd::{Level, dispatch};

use super::block;
use super::decide::Decide;
use super::field::Field;
use super::known::{Known, KnownClasses};
use super::neighbourhood::Neighbourhood;
use super::orientation::{Distance, Orientation, TurnedChanges};

/// The blocks that a package has looked at, and the one being coded.
#[derive(Default)]
pub(crate) struct Model {
    pub(crate) field: Field,
    cells: Neighbourhood,
}

impl Model {
    /// Makes the decisions of a block that has changes, of which so much was known. A writer knows them; a
    /// reader gets them.
    #[inline]
    pub(crate) fn code<D: Decide>(
        &mut self,
        decide: &mut D,
        known: &Known<'_>,
        index: BlockIndex,
        (orientation, distance): (Orientation, Distance),
        classes: KnownClasses,
        changes: Option<&StateBlock>,
    ) -> Result<StateBlock, BaseSuperseded> {
        let slots = self.field.around(known, index, orientation)?;
        let truth = changes.map(|changes| TurnedChanges::of(changes, orientation)).unwrap_or_default();
        // Whether any Free voxel becomes Occupied, and any Occupied one Free.
        let flips = match changes {
            Some(to) => known.block(index)?.map_or([false; 2], |from| {
                [meet(from.free(), to.occupied()), meet(from.occupied(), to.free())]
            }),
            None => [false; 2],
        };
        let Self { field, cells } = self;
        cells.gather(orientation, &slots, field.cells());
        let coded = dispatch!(Level::new(), simd => {
            block::code(simd, decide, cells, distance, classes, &truth, flips)
        });
        let coded = if D::KNOWS { truth } else { coded };
        Ok(self.field.note(&slots, index, orientation, &coded))
    }
}
