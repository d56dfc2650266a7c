//! How parts of a robot say that they are well.

use serde::{Deserialize, Serialize};

use super::parts;
use super::time::Header;

/// `diagnostic_msgs/msg/KeyValue`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
pub struct KeyValue {
    /// What it is.
    #[serde(with = "parts::text")]
    pub key: String,
    /// How much it is.
    #[serde(with = "parts::text")]
    pub value: String,
}

/// `diagnostic_msgs/msg/DiagnosticStatus`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
pub struct DiagnosticStatus {
    /// [`Self::OK`] and others.
    pub level: u8,
    /// The part that speaks.
    #[serde(with = "parts::text")]
    pub name: String,
    /// How it is.
    #[serde(with = "parts::text")]
    pub message: String,
    /// Its hardware.
    #[serde(with = "parts::text")]
    pub hardware_id: String,
    /// Figures.
    pub values: Vec<KeyValue>,
}

impl DiagnosticStatus {
    /// All is well.
    pub const OK: u8 = 0;
    /// Something should be looked at.
    pub const WARN: u8 = 1;
    /// Something does not work.
    pub const ERROR: u8 = 2;
    /// Nothing was heard for a while.
    pub const STALE: u8 = 3;
}

/// `diagnostic_msgs/msg/DiagnosticArray`.
#[derive(Serialize, Deserialize, Clone, PartialEq, Eq, Debug, Default)]
pub struct DiagnosticArray {
    /// When.
    pub header: Header,
    /// One for each part.
    pub status: Vec<DiagnosticStatus>,
}
