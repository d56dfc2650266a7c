//! The methods by name.

use core::fmt;
use core::str::FromStr;

use flockmap_codec::Codec;
use flockmap_grid::{ConfigError, MapperConfig};

use crate::package::{PackageReceiver, PackageSender};
use crate::{Receiver, Sender};

/// A way of telling others what a robot maps. Every one is given the same cycles of the same map.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[non_exhaustive]
pub enum Method {
    /// A codec of map packages, each cycle as one package whatever its size.
    Whole(Codec),
    /// A codec of map packages, each cycle cut into packages of at most 1,150 bytes, each useful on its own.
    Datagrams(Codec),
}

const DATAGRAMS: &str = "-datagrams";

impl Method {
    /// All methods.
    pub const ALL: [Self; 8] = [
        Self::Whole(Codec::Raw),
        Self::Whole(Codec::NestedZlib),
        Self::Whole(Codec::Paper),
        Self::Whole(Codec::Racer),
        Self::Datagrams(Codec::Raw),
        Self::Datagrams(Codec::NestedZlib),
        Self::Datagrams(Codec::Paper),
        Self::Datagrams(Codec::Racer),
    ];

    /// The half that tells, with nothing told yet. `config` is that of the mapper whose cycles it will be given.
    pub fn sender(self, _config: &MapperConfig) -> Box<dyn Sender> {
        match self {
            Self::Whole(codec) => Box::new(PackageSender::new(codec, false)),
            Self::Datagrams(codec) => Box::new(PackageSender::new(codec, true)),
        }
    }

    /// The half that listens, with an empty map. `config` is that of the sender's mapper.
    ///
    /// # Errors
    /// [`ConfigError`] if no mapper can be made of `config`.
    pub fn receiver(self, _config: &MapperConfig) -> Result<Box<dyn Receiver>, ConfigError> {
        Ok(match self {
            Self::Whole(_) | Self::Datagrams(_) => Box::new(PackageReceiver::default()),
        })
    }

    /// Whether the receiver must come to hold exactly what the sender packed.
    pub const fn is_lossless(self) -> bool {
        match self {
            Self::Whole(_) | Self::Datagrams(_) => true,
        }
    }

    /// In a sentence: what it sends, what is kept of its behaviour, where it is from.
    pub const fn about(self) -> &'static str {
        match self {
            Self::Whole(Codec::Raw) => "2 bits for each voxel of the box of the changes, nested order.",
            Self::Whole(Codec::NestedZlib) => {
                "As raw, then zlib level 6: the nested half of the paper's Table II."
            }
            Self::Whole(Codec::Paper) => {
                "The paper's method (Sec. III): 2 bits for each voxel of the box along a Hilbert walk, zlib level 6."
            }
            Self::Whole(Codec::Racer) => {
                "RACER as the paper describes it: a 4-byte address and a byte of state for every change of state, in one package a cycle."
            }
            Self::Whole(_) => "A codec of map packages, one package a cycle.",
            Self::Datagrams(_) => {
                "The same codec, cut into packages of at most 1,150 bytes, each useful on its own."
            }
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Whole(codec) => f.pad(codec.name()),
            Self::Datagrams(codec) => f.pad(&format!("{}{DATAGRAMS}", codec.name())),
        }
    }
}

/// No method has this name.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("no method is called {name:?}; there are {known}")]
pub struct UnknownMethod {
    /// The name asked for.
    pub name: String,
    known: String,
}

impl FromStr for Method {
    type Err = UnknownMethod;

    fn from_str(name: &str) -> Result<Self, UnknownMethod> {
        Self::ALL.into_iter().find(|method| method.to_string() == name).ok_or_else(|| UnknownMethod {
            name: name.to_owned(),
            known: Self::ALL.map(|method| method.to_string()).join(", "),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_method_has_a_name_that_stands_for_it() {
        for method in Method::ALL {
            assert_eq!(method.to_string().parse::<Method>(), Ok(method));
            assert!(method.about().ends_with('.'), "{method}");
        }
        let error = "zip".parse::<Method>().unwrap_err().to_string();
        assert!(error.contains("zip") && error.contains("paper-datagrams"), "{error}");
    }

    #[test]
    fn every_codec_is_a_method() {
        for codec in Codec::ALL {
            assert!(Method::ALL.contains(&Method::Whole(codec)), "{codec}");
            assert!(Method::ALL.contains(&Method::Datagrams(codec)), "{codec}");
        }
    }
}
