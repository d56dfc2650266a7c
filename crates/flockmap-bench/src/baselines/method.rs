//! The methods by name.

use core::fmt;
use core::str::FromStr;

use anyhow::Result;
use flockmap::codec::Codec;
use flockmap::grid::MapperConfig;

use crate::baselines::address_delta::AddressDeltaSender;
use crate::baselines::colag::{ColagSender, Region};
use crate::baselines::gvp::GvpSender;
use crate::baselines::octomap_diff::OctomapDiffSender;
use crate::baselines::package::{PackageReceiver, PackageSender};
use crate::baselines::relay_points::Points;
use crate::baselines::scan_relay::{RelayReceiver, RelaySender};
use crate::baselines::state_map::MapReceiver;
use crate::baselines::traits::{Receiver, Sender};
use crate::baselines::{address_delta, colag, gvp, octomap_diff};

/// A method of sending others what a robot maps. Every one is given the same batches of the same map.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
#[non_exhaustive]
pub enum Method {
    /// A codec of map packages, each batch as one package whatever its size.
    Whole(Codec),
    /// A codec of map packages, each batch cut into packages of at most 1,150 bytes, each useful on its own.
    Datagrams(Codec),
    /// ColAG: addresses of occupied and unknown voxels in the box of the changes, all else free.
    Colag,
    /// The same with the smallest region that it could have: the boxes of the changes in each block of 8³ voxels.
    ColagBlocks,
    /// GVP-MREP's block bitmap with its rule of when a block goes out.
    Gvp,
    /// MARBLE's pruned binary OctoMap of the changed voxels, at the end of each batch.
    OctomapDiff,
    /// The same as MARBLE sends it: every 10 s, if it has more than 1,000 nodes.
    OctomapDiff10s,
    /// A sorted list of addresses, packed as well as zstd can.
    AddressDeltaZstd,
    /// The scans themselves, cast again at the receiver.
    ScanRelay,
    /// The same with points rounded to a centimetre.
    ScanRelay1cm,
}

const DATAGRAMS: &str = "-datagrams";

impl Method {
    /// All methods.
    pub const ALL: [Self; 18] = [
        Self::Datagrams(Codec::Flock),
        Self::Whole(Codec::Flock),
        Self::Whole(Codec::Raw),
        Self::Whole(Codec::NestedZlib),
        Self::Whole(Codec::Paper),
        Self::Whole(Codec::Racer),
        Self::Datagrams(Codec::Raw),
        Self::Datagrams(Codec::NestedZlib),
        Self::Datagrams(Codec::Paper),
        Self::Datagrams(Codec::Racer),
        Self::Colag,
        Self::ColagBlocks,
        Self::Gvp,
        Self::OctomapDiff,
        Self::OctomapDiff10s,
        Self::AddressDeltaZstd,
        Self::ScanRelay,
        Self::ScanRelay1cm,
    ];

    /// The half that sends, with nothing sent yet. `config` is that of the mapper whose batches it will be given.
    pub fn sender(self, config: &MapperConfig) -> Box<dyn Sender> {
        match self {
            Self::Whole(codec) => Box::new(PackageSender::new(codec, false)),
            Self::Datagrams(codec) => Box::new(PackageSender::new(codec, true)),
            Self::Colag => Box::new(ColagSender::new(Region::Box)),
            Self::ColagBlocks => Box::new(ColagSender::new(Region::Blocks)),
            Self::Gvp => Box::new(GvpSender::default()),
            Self::OctomapDiff => Box::new(OctomapDiffSender::new(false)),
            Self::OctomapDiff10s => Box::new(OctomapDiffSender::new(true)),
            Self::AddressDeltaZstd => Box::new(AddressDeltaSender::new()),
            Self::ScanRelay => Box::new(RelaySender::new(Points::Exact, config)),
            Self::ScanRelay1cm => Box::new(RelaySender::new(Points::Centimetre, config)),
        }
    }

    /// The half that listens, with an empty map. `config` is that of the sender's mapper; a relay of scans
    /// holds such a mapper itself, within its own limit of memory, beside its map.
    ///
    /// # Errors
    /// If no mapper can be made of `config`.
    pub fn receiver(self, config: &MapperConfig) -> Result<Box<dyn Receiver>> {
        Ok(match self {
            Self::Whole(_) | Self::Datagrams(_) => Box::new(PackageReceiver::default()),
            Self::Colag | Self::ColagBlocks => Box::new(MapReceiver::new(colag::parse)),
            Self::Gvp => Box::new(MapReceiver::new(gvp::parse)),
            Self::OctomapDiff | Self::OctomapDiff10s => Box::new(MapReceiver::new(octomap_diff::parse)),
            Self::AddressDeltaZstd => Box::new(MapReceiver::new(address_delta::parse)),
            Self::ScanRelay | Self::ScanRelay1cm => Box::new(RelayReceiver::new(config)?),
        })
    }

    /// Whether the receiver must come to hold exactly what the sender packed.
    pub const fn is_lossless(self) -> bool {
        !matches!(self, Self::Gvp | Self::OctomapDiff10s | Self::ScanRelay1cm)
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
                "RACER as the paper describes it: a 4-byte address and a byte of state for every change of state, in one package a batch."
            }
            Self::Whole(Codec::Flock) => {
                "Flockmap's own codec in one package a batch, which stands for itself: coded independently of all others."
            }
            Self::Whole(_) => "A codec of map packages, one package a batch.",
            Self::Datagrams(Codec::Flock) => {
                "Flockmap's own codec: decisions of an arithmetic coder with trained contexts, coded against what the receiver holds, in packages of at most 1,150 bytes."
            }
            Self::Datagrams(_) => {
                "The same codec, cut into packages of at most 1,150 bytes, each useful on its own."
            }
            Self::Colag => {
                "ColAG (the paper's [6]): 4-byte addresses of the occupied and the unknown voxels in a region round the robot, all else free. The region is no larger than the box of the batch's changes, sent once a batch; what is said to be unknown erases nothing, so every change arrives."
            }
            Self::ColagBlocks => {
                "ColAG with the least region it could have, which it has not: the boxes of the changes in each block of 8³ voxels, once a batch."
            }
            Self::Gvp => {
                "GVP-MREP's MapC: blocks of 8³ voxels, 8 bytes if all one state, else 8 + 128 with 2 bits a voxel. A block goes out when first more than 97.5 % known, or 2 s after the last time with at least 15 % of it new; what never comes to that stays unsent."
            }
            Self::OctomapDiff => {
                "MARBLE's difference: the changed voxels as a pruned binary OctoMap, 2 bits for each child of an inner node, once a batch in place of every 10 s."
            }
            Self::OctomapDiff10s => {
                "MARBLE's difference as MARBLE sends it: every 10 s, if it has more than 1,000 nodes; what is left at the end stays unsent. Its republishing of old differences is left out."
            }
            Self::AddressDeltaZstd => {
                "Sorted addresses, differences or runs as varints, states as bits or runs, zstd 19; the smallest of three layouts, once a batch. What one would try first; from nobody in particular."
            }
            Self::ScanRelay => {
                "The scans of a batch, every bit of their points (differences as byte planes, zstd 19), cast again at the receiver with an equal mapper."
            }
            Self::ScanRelay1cm => {
                "The scans of a batch with points cut at the range and rounded to a centimetre (Morton order or octree, zstd 19), cast again at the receiver with an equal mapper: rounding moves rays into other voxels, so some differ."
            }
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Datagrams(Codec::Flock) => f.pad(Codec::Flock.name()),
            Self::Whole(Codec::Flock) => f.pad("flock-whole"),
            Self::Whole(codec) => f.pad(codec.name()),
            Self::Datagrams(codec) => f.pad(&format!("{}{DATAGRAMS}", codec.name())),
            Self::Colag => f.pad("colag"),
            Self::ColagBlocks => f.pad("colag-blocks"),
            Self::Gvp => f.pad("gvp"),
            Self::OctomapDiff => f.pad("octomap-diff"),
            Self::OctomapDiff10s => f.pad("octomap-diff-10s"),
            Self::AddressDeltaZstd => f.pad("address-delta-zstd"),
            Self::ScanRelay => f.pad("scan-relay"),
            Self::ScanRelay1cm => f.pad("scan-relay-1cm"),
        }
    }
}

impl FromStr for Method {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|method| method.to_string() == name).ok_or_else(|| {
            let known = Self::ALL.map(|method| method.to_string()).join(", ");
            format!("no method is called {name:?}; there are {known}")
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
        let error = "zip".parse::<Method>().unwrap_err();
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
