//! What can go wrong, and whose fault it is.

use flockmap_codec::{EncodeError, PackageError};
use thiserror::Error;

/// A method cannot say this: its own form has no room for it.
#[derive(Clone, PartialEq, Debug, Error)]
#[non_exhaustive]
pub enum SendError {
    /// The package codecs refused.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// The sender's note of what it has told is full.
    #[error(transparent)]
    Map(#[from] MapTooLarge),
    /// The form of the method ends before this.
    #[error("{method} cannot send this: {limit}")]
    Limit {
        /// Name of the method.
        method: &'static str,
        /// What its messages can hold.
        limit: &'static str,
    },
}

/// A message is damaged or was not made by this method: the sender's fault, or the way's.
#[derive(Clone, PartialEq, Debug, Error)]
#[non_exhaustive]
pub enum ReceiveError {
    /// A map package is damaged.
    #[error(transparent)]
    Package(#[from] PackageError),
    /// A message breaks a rule of its form.
    #[error("damaged message of {method}: expected {rule}")]
    Message {
        /// Name of the method.
        method: &'static str,
        /// The rule.
        rule: &'static str,
    },
    /// The map would grow beyond what a receiver holds.
    #[error(transparent)]
    Map(#[from] MapTooLarge),
}

/// A map of states has no room for one more block.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Error)]
#[error("the map would grow beyond {} blocks of 8³ voxels", crate::BLOCKS_MAX)]
pub struct MapTooLarge;
