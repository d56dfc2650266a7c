//! The numbers that bound a package.

/// The version of the package format, the first byte of every package.
pub const FORMAT_VERSION: u8 = 5;

/// Largest package that goes into one datagram: a datagram header and an authentication tag still fit beside
/// it in 1,200 bytes of UDP payload, which no ordinary link fragments.
pub const PACKAGE_BYTES_MAX: usize = 1150;

/// Smallest size limit that [`Encoder`](crate::Encoder) takes: one voxel fits in it whatever the header
/// holds.
pub const PACKAGE_BYTES_MIN: usize = 192;

/// Most voxels in the box of one package, 2²⁷. A larger box is refused before memory is taken for it, and so
/// is one that the payload could not fill: under 2²³ voxels for a package of [`PACKAGE_BYTES_MAX`] bytes.
/// ([`Codec::Racer`](crate::Codec::Racer) takes memory for the voxels it lists, not for its box.)
pub const BOX_VOXELS_MAX: u64 = 1 << 27;
