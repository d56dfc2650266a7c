//! Reading the fields of a message, and what may be wrong with them.

/// The version of the layout.
pub const MESSAGE_VERSION: u8 = 1;

/// Magic, version, kind, robot.
pub(super) const HEADER_BYTES: usize = 8;

/// A message that cannot be used. The program that sent it is at fault; the connection is closed.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MessageError {
    /// The length says more than is allowed, or less than a message has.
    #[error("length {got}, expected {HEADER_BYTES} to {max}")]
    Length {
        /// As sent.
        got: u64,
        /// The longest that is allowed.
        max: usize,
    },
    /// Not a message at all: its first four bytes.
    #[error("starts with \"{}\", expected \"FLKS\"", .0.escape_ascii())]
    Magic([u8; 4]),
    /// Of another version: this one.
    #[error("version {0}, expected {MESSAGE_VERSION}")]
    Version(u8),
    /// Of no known kind: this one.
    #[error(
        "kind {0}, expected 1 (scan), 2 (alignment), 3 (team-mate), 4 (voxels), 5 (box), 6 (a submap begins) or 7 (pose of a submap)"
    )]
    Kind(u8),
    /// The length does not fit what is in it.
    #[error("{got} bytes, expected {expected} by its kind and counts")]
    Size {
        /// As sent.
        got: usize,
        /// What the kind and the counts call for.
        expected: u64,
    },
    /// The pose, these seven numbers, is none.
    #[error("the pose {0:?} is none, expected finite x y z and a quaternion x y z w that is not 0")]
    Pose([f64; 7]),
    /// More voxels than are allowed.
    #[error("{got} voxels, expected at most {max} in a message ([sensor] {option})")]
    TooMany {
        /// As sent.
        got: u128,
        /// The most that are allowed.
        max: u32,
        /// The option that says so.
        option: &'static str,
    },
    /// This is no side of a voxel.
    #[error("voxels of {0} m, expected 0.001 to 100")]
    Resolution(f64),
    /// Flags that mean nothing for this kind.
    #[error(
        "flags {0:#x}, expected 1 (the sensor's place is given), for a box with 2 (Unknown clears), or none"
    )]
    Flags(u32),
    /// This is no state.
    #[error("state {got} of voxel {number}, expected 0 (unknown), 1 (free) or 2 (occupied)")]
    State {
        /// As sent.
        got: u8,
        /// Which one, from 0.
        number: usize,
    },
    /// A box without voxels, or one that goes beyond the grid.
    #[error(
        "a box from {min:?} of {size:?} voxels, expected 1 or more each way, within the grid of ±2^28 voxels"
    )]
    Box {
        /// Its lowest voxel.
        min: [i32; 3],
        /// Voxels along each axis.
        size: [u32; 3],
    },
    /// The connection ended within a message.
    #[error("ended after {got} of {expected} bytes")]
    Truncated {
        /// Bytes received.
        got: usize,
        /// Bytes announced.
        expected: usize,
    },
}

/// A message that is being read.
pub(super) struct Reader<'a> {
    /// The bytes not read yet.
    pub(super) rest: &'a [u8],
    /// Bytes of the whole message.
    pub(super) got: usize,
    /// Bytes that it should have, as far as is known.
    pub(super) expected: u64,
}

impl Reader<'_> {
    pub(super) const fn wrong_size(&self) -> MessageError {
        MessageError::Size { got: self.got, expected: self.expected }
    }

    pub(super) fn check_length(&self) -> Result<(), MessageError> {
        if self.got as u64 == self.expected { Ok(()) } else { Err(self.wrong_size()) }
    }

    pub(super) fn take<const N: usize>(&mut self) -> Result<[u8; N], MessageError> {
        let (taken, rest) = self.rest.split_first_chunk::<N>().ok_or_else(|| self.wrong_size())?;
        self.rest = rest;
        Ok(*taken)
    }

    pub(super) fn numbers<const N: usize>(&mut self) -> Result<[f64; N], MessageError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = f64::from_le_bytes(self.take()?);
        }
        Ok(numbers)
    }

    /// The next so many records of `N` bytes.
    pub(super) fn records<const N: usize>(&mut self, count: u32) -> Result<&[[u8; N]], MessageError> {
        let records = self.rest.split_at_checked(count as usize * N);
        let (records, rest) = records.ok_or_else(|| self.wrong_size())?;
        self.rest = rest;
        Ok(records.as_chunks().0)
    }
}
