//! Coded repair: symbols that help whoever lacks whatever of a block of packages.
//!
//! Many receivers of one broadcast each lack other packages. A holder of packages `first ..= last` of a
//! stream cuts them into K source symbols, and makes of these as many repair symbols as it likes. Whoever
//! lacks n of the source symbols finds them from n repair symbols, of whichever holders, together with the
//! packages that it has; once in 200 times it needs one more. The code is RaptorQ, by the crate `raptorq`.
//! `docs/coded-repair.md` says what else was measured, and `WIRE.md` what goes on the air.
//!
//! [`Block`] is the layout, [`BlockEncoder`] the sender's side, [`Mender`] the receiver's.

mod block;
mod code;
mod error;
mod mender;
#[cfg(test)]
mod tests;

pub(crate) use block::{Block, PACKAGES_MAX, SYMBOL_NUMBERS, SYMBOL_UNIT, symbol_number};
pub(crate) use code::BlockEncoder;
pub(crate) use mender::{Mended, Mender};

#[cfg(test)]
pub(crate) use block::SOURCES_MAX;
#[cfg(test)]
pub(crate) use code::repair_symbols;
#[cfg(test)]
pub(crate) use error::MendError;
