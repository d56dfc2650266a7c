//! What can be wrong with repair symbols.

use flockmap_codec::PackageError;

/// With so many symbols beyond those that are lacking, one that is true is found.
pub(super) const BEYOND_MAX: usize = 8;

/// Why a block was dropped, with all its symbols.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub(crate) enum MendError {
    /// A symbol or the check is false.
    #[error("what was found from repair symbols does not match the check of its block")]
    Check,
    /// The numbers of the symbols were chosen so that they say the same again and again.
    #[error("repair symbols that do not suffice, with {BEYOND_MAX} more than are lacking")]
    Dependent,
    /// A stored package takes another number of symbols than the block says.
    #[error("a block of other packages than those that are stored")]
    Layout,
    /// The check is right, and still it is no package.
    #[error("what was found from repair symbols is no package: {0}")]
    Package(PackageError),
    /// It is a package with another index, a chunk of a snapshot, or longer than any.
    #[error("what was found from repair symbols is another package than its block says")]
    Another,
}
