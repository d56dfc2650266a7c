//! From a package back to its content.

use crate::check::{check_changes, check_present};
use crate::states::{self, Others, Scratch};
use crate::varint::Reader;
use crate::{Content, ContentKind, Package, PackageError, stamps};

/// Decodes packages and keeps its memory from one to the next: up to 2.25 bytes for each voxel of the largest box
/// so far. One for each thread.
#[derive(Default)]
pub struct Decoder {
    scratch: Scratch,
}

impl Decoder {
    /// A decoder that holds no memory yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// The content of a package, see [`Package::decode`].
    pub fn decode(&mut self, package: &Package) -> Result<Content, PackageError> {
        let (header, payload) = (package.header(), package.payload());
        let (codec, region) = (header.codec, header.region);
        let (content, found) = match header.content {
            ContentKind::Changes => {
                let states = states::decode(codec, payload, &region, Others::Unchanged, &mut self.scratch)?;
                let check = check_changes(package.checked(), &states);
                (Content::Changes(states), check)
            }
            ContentKind::Present { .. } => {
                let rule = "the length of the states, the states, the stamps";
                let mut reader = Reader::new(payload);
                let length = reader.number("length of states", payload.len() as u64)? as usize;
                let (states, stamps) =
                    reader.rest().split_at_checked(length).ok_or(PackageError::Payload { codec, rule })?;
                let states = states::decode(codec, states, &region, Others::Unknown, &mut self.scratch)?;
                let ends = [header.cycle_start, header.cycle_end];
                let grid = &mut self.scratch.grid;
                let state = stamps::decode(codec, stamps, states, region, ends, payload.len(), grid)?;
                let check = check_present(package.checked(), &state);
                (Content::Present(state), check)
            }
        };
        if found != package.check() {
            return Err(PackageError::Check { stated: package.check(), found });
        }
        Ok(content)
    }
}
