//! A state that is too large for one snapshot comes in pieces, the oldest first. Who holds some of them lacks what later
//! packages changed until it holds those too, and what packages say that build on that cannot be told meanwhile.

use super::Session;
use flockmap_codec::{Header, Package, PackageError};
use flockmap_grid::{Stamp, Stream};

/// What a state of a stream can be cut by.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Cuts {
    /// Packages with their stamps, ascending: what the layer holds of packages up to one of them is not newer.
    pub stamps: Vec<(u32, Stamp)>,
    /// What packages up to this one changed is not in what is older than that: of later ones nothing was merged.
    pub newest: u32,
    /// All packages up to that one are held.
    pub has_all: bool,
    /// What packages up to this one changed is lacking in any case, since not all of them are held. `None`:
    /// nothing is.
    pub changed_upto: Option<u32>,
    /// Something of packages that are not contained, up to this one at most, is in the layer already. `None`: nothing is.
    pub says_upto: Option<u32>,
}

impl Session {
    /// What a state of packages 1 to `upto` of a stream can be cut by, and what it has of later ones: O(stamps), of which
    /// there are 512 at most.
    pub fn cuts(&self, stream: Stream, upto: u32) -> Cuts {
        let received = self.store.received(stream);
        let (prefix, last) = received.map_or((0, None), |received| (received.prefix(), received.last()));
        let changed_upto = Some(self.store.changed_upto(stream)).filter(|changed| *changed > prefix);
        let stamps = self.store.stamps(stream).filter(|(index, _)| *index < upto).collect();
        // Of a snapshot that is not complete yet, some is merged.
        let said = Some(self.store.said_upto(stream)).filter(|said| *said > prefix);
        let newest = last.max(changed_upto).max(said).unwrap_or(0);
        let says_upto = last.max(said).filter(|said| *said > upto);
        Cuts { stamps, newest, has_all: prefix == newest, changed_upto, says_upto }
    }

    /// A chunk of a snapshot is about to be merged, of which the rest may never come: it may say what packages that are
    /// not held changed. If it is of a piece, what later packages changed may be lacking in the layer from now on.
    pub fn note_merging(&mut self, header: &Header) {
        self.store.note_said(header.stream, header.index.max(header.says_upto.unwrap_or(0)));
        if let Some(upto) = header.changed_upto {
            self.store.note_changed(header.stream, upto);
        }
    }

    /// Whether what a package of changes builds on may be lacking here.
    ///
    /// # Errors
    /// [`PackageError::BaseMissing`] if so: a snapshot that contains it will come.
    pub fn check_base(&self, package: &Package) -> Result<(), PackageError> {
        let &Header { stream, index, base, is_independent, .. } = package.header();
        if is_independent || index > self.store.changed_upto(stream) {
            return Ok(());
        }
        Err(PackageError::BaseMissing { base })
    }
}

impl Cuts {
    /// The newest package after `since` of which a state holds all that it needs if it holds nothing newer than a stamp;
    /// with its own stamp.
    pub fn upto(&self, since: u32, stamp: Stamp) -> Option<(u32, Stamp)> {
        self.stamps
            .iter()
            .take_while(|(_, of)| *of <= stamp)
            .last()
            .copied()
            .filter(|(index, _)| *index > since)
    }
}
