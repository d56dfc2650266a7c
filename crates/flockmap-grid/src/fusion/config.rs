//! Limits and rules of fusion.

/// How layers become one map.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(default, deny_unknown_fields))]
pub struct FusionConfig {
    /// A robot's own observation of a voxel wins over a team-mate's that is newer by up to this much.
    /// Microseconds; default 1 s.
    #[cfg_attr(feature = "serde", serde(rename = "own_priority_ms", with = "crate::units::Times::<1_000>"))]
    pub own_priority_micros: i64,
    /// The layers of other robots are kept, and left out of the map as if each were muted: for who only keeps
    /// and passes on, which takes less memory and time then. Default `false`.
    pub mutes_others: bool,
    /// Obstacles of a submap are cleared where a newer submap of the same run has one within so many voxels, in the same
    /// block of 8³: it is the same wall, not put right quite to where it is seen now. A cleared voxel is what other parts
    /// know of it, else Unknown. 0 to 7; default 0: nothing is cleared, the newest stamp decides.
    pub submap_clears_voxels: u8,
    /// Most bytes that the layers of all other streams may hold together, with what they add to the fused
    /// map; beyond that what is far and old is dropped for what is near and new. A block of 8³ voxels takes 0.5 to
    /// 1.5 kB as a rule while it is changed, and 11 kB if each of its voxels changed last in another batch; 0.1 kB,
    /// when nothing near it has changed for long. One merge may go beyond by what it adds to the fused map in new places, at most
    /// 64 MiB. Default 768 MiB.
    #[cfg_attr(feature = "serde", serde(rename = "layers_mb", with = "crate::units::Mebibytes"))]
    pub layer_bytes_max: usize,
    /// The same for the layer of the own stream: what of the own map was published. Who joins late gets what is left
    /// of it. Default 256 MiB.
    #[cfg_attr(feature = "serde", serde(rename = "own_layer_mb", with = "crate::units::Mebibytes"))]
    pub own_layer_bytes_max: usize,
    /// Most streams that are kept. Default 256.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub streams_max: usize,
}

impl Default for FusionConfig {
    fn default() -> Self {
        Self {
            own_priority_micros: 1_000_000,
            mutes_others: false,
            submap_clears_voxels: 0,
            layer_bytes_max: 768 << 20,
            own_layer_bytes_max: 256 << 20,
            streams_max: 256,
        }
    }
}
