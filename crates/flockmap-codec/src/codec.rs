//! The codecs by name and number.

use core::fmt;
use core::str::FromStr;

/// How the payload of a package is coded. All are lossless.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
#[non_exhaustive]
pub enum Codec {
    /// 2 bits for each voxel of the box in nested order: what the others are measured from.
    Raw = 0,
    /// As `Raw`, then zlib level 6: the other half of the paper's Table II.
    NestedZlib = 1,
    /// The paper's method (Sec. III): 2 bits for each voxel of the box along a Hilbert walk, then zlib level
    /// 6.
    Paper = 2,
    /// The paper's baseline: for each changed voxel a 32-bit address in the box and a byte of state.
    Racer = 3,
    /// Flockmap's own: decisions of an arithmetic coder with trained contexts, coded against what the
    /// receivers hold (`docs/codec.md`). A third of the bytes of `Paper` and less.
    Flock = 4,
}

impl Codec {
    /// All codecs.
    pub const ALL: [Self; 5] = [Self::Raw, Self::NestedZlib, Self::Paper, Self::Racer, Self::Flock];

    /// The number that stands for the codec in a package.
    pub const fn id(self) -> u8 {
        self as u8
    }

    /// The codec with this number.
    pub fn from_id(id: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|codec| codec.id() == id)
    }

    /// The name that the command line and reports use.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::NestedZlib => "nested-zlib",
            Self::Paper => "paper",
            Self::Racer => "racer",
            Self::Flock => "flock",
        }
    }
}

impl fmt::Display for Codec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// No codec has this name.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("no codec is called {0:?}; there are raw, nested-zlib, paper, racer and flock")]
pub struct UnknownCodec(pub String);

impl FromStr for Codec {
    type Err = UnknownCodec;

    fn from_str(name: &str) -> Result<Self, UnknownCodec> {
        Self::ALL.into_iter().find(|codec| codec.name() == name).ok_or_else(|| UnknownCodec(name.to_owned()))
    }
}
