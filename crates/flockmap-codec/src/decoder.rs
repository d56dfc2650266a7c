//! From a package back to its content.

use flockmap_grid::Layer;
use flockmap_mutation::{self as mutation, Mutation};

use crate::check::{check_changes, check_present};
use crate::flock;
use crate::reference::Known;
use crate::states::{self, Others, Scratch};
use crate::varint::Reader;
use crate::work::Work;
use crate::{Codec, Content, ContentKind, Package, PackageError, Priority, TilesRead, stamps};

/// Decodes packages and keeps its memory from one to the next: up to 2.25 bytes for each voxel of the largest box
/// so far. For [`Codec::Flock`] in place of that: 550 bytes for each block of the largest package and each known one in its box or beside
/// it, 45 bytes at most for each block of the box (of which there are at most 2¹⁸), and 40 KB. The tables of that codec, 690 KB, are one
/// for the whole process. One for each thread.
#[derive(Default)]
pub struct Decoder {
    scratch: Scratch,
    steps: u64,
    /// Made with the first package in that codec.
    pub(crate) flock: Option<Box<flock::Workspace>>,
}

impl Decoder {
    /// A decoder that holds no memory yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// The content of a package that needs nothing else, see [`Package::decode`].
    pub fn decode(&mut self, package: &Package) -> Result<Content, PackageError> {
        self.decode_against(package, None)
    }

    /// The content of a package that was coded against what earlier ones said: `layer` is that of its stream and must hold all
    /// packages up to `reference` of the header. Packages of the same cycle may have been applied to it already.
    ///
    /// # Errors
    /// [`PackageError::Overtaken`] if a later cycle or a present state has been applied to a block that the package builds on:
    /// what it was before is gone, and the package can only be replaced by a present state.
    pub fn decode_against(
        &mut self,
        package: &Package,
        layer: Option<&Layer>,
    ) -> Result<Content, PackageError> {
        let header = package.header();
        let codec = header.codec;
        if codec == Codec::Flock && matches!(header.content, ContentKind::Present { .. }) {
            return self.decode_tile(package, &mut TilesRead::default()).map(Content::Present);
        }
        let mut work = Work::new(codec, package.payload().len());
        let content = self.content(package, layer, &mut work);
        self.steps = work.taken();
        let content = content?;
        let found = match &content {
            Content::Changes(changes) => check_changes(&package.checked(), changes),
            Content::Present(state) => check_present(&package.checked(), state),
        };
        if let Content::Changes(changes) = &content
            && changes.has_occupied() != (header.priority == Priority::Obstacles)
        {
            return Err(PackageError::Header {
                rule: "the priority of obstacles is that of changes to Occupied",
            });
        }
        if found != package.check() && !mutation::is(Mutation::CheckSkipped) {
            return Err(PackageError::Check { stated: package.check(), found });
        }
        Ok(content)
    }

    /// Steps of work that the last package took, as `WIRE.md` counts them; of a refused one those up to its refusal.
    pub const fn steps(&self) -> u64 {
        self.steps
    }

    /// The same, and none from then on until the next package.
    pub const fn take_steps(&mut self) -> u64 {
        core::mem::replace(&mut self.steps, 0)
    }

    pub(crate) fn note_steps(&mut self, steps: u64) {
        self.steps = steps;
    }

    /// What the payload says, before it is checked.
    fn content(
        &mut self,
        package: &Package,
        layer: Option<&Layer>,
        work: &mut Work,
    ) -> Result<Content, PackageError> {
        let (header, payload) = (package.header(), package.payload());
        let (codec, region) = (header.codec, header.region);
        match header.content {
            ContentKind::Changes if codec == Codec::Flock => {
                let layer = if header.is_alone { None } else { layer };
                if !header.is_alone && layer.is_none() {
                    return Err(PackageError::ReferenceMissing { reference: header.reference });
                }
                let known = Known::new(layer, header.cycle_end);
                flock::decode(&mut self.flock, &known, payload, &region, work).map(Content::Changes)
            }
            ContentKind::Changes => {
                let others = Others::Unchanged;
                states::decode(codec, payload, &region, others, &mut self.scratch, work).map(Content::Changes)
            }
            ContentKind::Present { .. } => {
                let rule = "the length of the states, the states, the stamps";
                let mut reader = Reader::new(payload);
                let length = reader.number("length of states", payload.len() as u64)? as usize;
                let (states, stamps) =
                    reader.rest().split_at_checked(length).ok_or(PackageError::Payload { codec, rule })?;
                let states =
                    states::decode(codec, states, &region, Others::Unknown, &mut self.scratch, work)?;
                let ends = [header.cycle_start, header.cycle_end];
                let grid = &mut self.scratch.grid;
                stamps::decode(codec, stamps, states, region, ends, work, grid).map(Content::Present)
            }
        }
    }
}
