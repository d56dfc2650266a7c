//! A pose as bits: every pattern of bits is a pose, so nothing that comes over a radio can be none.

use crate::{Pose, PoseError};

/// Bits of a pose, the lowest first: of three words 64, 56 and 50.
pub(crate) type PoseBits = [u64; 3];

/// Which bits of the words count.
pub(crate) const POSE_MASK: PoseBits = [u64::MAX, (1 << 56) - 1, (1 << 50) - 1];

/// Units of the translation in a metre: it goes to ±214 km, in tenths of a millimetre.
const PER_METRE: f64 = 10_000.0;
/// Units of the smallest three parts of a unit quaternion, none of which is beyond ±0.71: at 1 km from the origin half
/// a millimetre at most is lost.
const PER_ONE: f64 = 4_194_304.0;
const ROTATION_BITS: u32 = 24;

/// Farthest translation along each axis, in metres.
const TRANSLATION_MAX: f64 = i32::MAX as f64 / PER_METRE;

impl Pose {
    /// The pose as it is sent: its translation in tenths of a millimetre, its rotation in steps of 2⁻²² of the smallest
    /// three parts of the quaternion.
    ///
    /// # Errors
    /// [`PoseError`] if it is no pose, or lies farther out than ±214 km on an axis.
    pub(crate) fn to_bits(self) -> Result<PoseBits, PoseError> {
        let (position, quaternion) = (self.translation(), self.quaternion_xyzw());
        if !position.iter().all(|at| at.is_finite()) {
            return Err(PoseError::Position(position));
        }
        if !quaternion.iter().all(|part| part.is_finite()) {
            return Err(PoseError::Rotation(quaternion));
        }
        if !position.iter().all(|at| at.abs() <= TRANSLATION_MAX) {
            return Err(PoseError::BeyondSubmaps { position, limit_m: TRANSLATION_MAX });
        }
        let [x, y, z] = position.map(|at| zigzag((at * PER_METRE).round() as i32));
        let largest = (0..4)
            .fold(3, |best, part| if quaternion[part].abs() > quaternion[best].abs() { part } else { best });
        let sign = if quaternion[largest] < 0.0 { -1.0 } else { 1.0 };
        let mut parts = (0..4)
            .filter(|part| *part != largest)
            .map(|part| zigzag((quaternion[part] * sign * PER_ONE).round() as i32));
        let mut next = || parts.next().unwrap_or(0);
        let (a, b, c) = (next(), next(), next());
        // The last one, w, is nearly always the largest: then its number is 0.
        let number = 3 - largest as u64;
        Ok([x | y << 32, z | a << 32, b | c << ROTATION_BITS | number << (2 * ROTATION_BITS)])
    }

    /// The pose that these bits stand for.
    pub(crate) fn from_bits(bits: PoseBits) -> Self {
        let [low, middle, high] = bits;
        let translation =
            [low, low >> 32, middle].map(|bits| f64::from(unzigzag(bits & 0xffff_ffff)) / PER_METRE);
        let mask = (1u64 << ROTATION_BITS) - 1;
        let [a, b, c] = [middle >> 32, high, high >> ROTATION_BITS]
            .map(|bits| f64::from(unzigzag(bits & mask)) / PER_ONE);
        let rest = (1.0 - a * a - b * b - c * c).max(0.0).sqrt();
        let quaternion = match high >> (2 * ROTATION_BITS) & 3 {
            0 => [a, b, c, rest],
            1 => [a, b, rest, c],
            2 => [a, rest, b, c],
            _ => [rest, a, b, c],
        };
        // Never so: it is as long as 1, or longer.
        Self::new(translation, quaternion).unwrap_or_default()
    }

    /// The pose as others get it where it is that of a submap: its translation to a tenth of a millimetre, its rotation to
    /// 2⁻²² of the smallest three parts of the quaternion.
    ///
    /// # Errors
    /// [`PoseError`] if it is no pose, or lies farther out than ±214 km on an axis.
    pub fn rounded(self) -> Result<Self, PoseError> {
        self.to_bits().map(Self::from_bits)
    }
}

/// Small numbers of either sign become small ones.
const fn zigzag(number: i32) -> u64 {
    ((number << 1) ^ (number >> 31)) as u32 as u64
}

const fn unzigzag(bits: u64) -> i32 {
    (bits as u32 >> 1) as i32 ^ -((bits & 1) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_pose_comes_back_to_a_tenth_of_a_millimetre(
            at in prop::array::uniform3(-214_000.0..214_000.0f64), turn in prop::array::uniform4(-1.0..1.0f64),
            point in prop::array::uniform3(-1_000.0..1_000.0f64),
        ) {
            let Some(pose) = Pose::new(at, turn) else { return Ok(()) };
            let bits = pose.to_bits().unwrap();
            prop_assert!((0..3).all(|word| bits[word] & !POSE_MASK[word] == 0));
            let back = Pose::from_bits(bits);
            let origin = (0..3).map(|axis| (back.translation()[axis] - at[axis]).abs()).fold(0.0, f64::max);
            prop_assert!(origin <= 0.5e-4 + 1e-9, "{origin}");
            let (a, b) = (pose.transform(point), back.transform(point));
            let error = (0..3).map(|axis| (a[axis] - b[axis]).abs()).fold(0.0, f64::max);
            prop_assert!(error < 2e-3, "{error} m off");
        }

        #[test]
        fn every_pattern_of_bits_is_a_pose(low in any::<u64>(), middle in any::<u64>(), high in any::<u64>()) {
            let pose = Pose::from_bits([low, middle, high]);
            let length: f64 = pose.quaternion_xyzw().iter().map(|part| part * part).sum();
            prop_assert!((length - 1.0).abs() < 1e-9, "{pose:?}");
            prop_assert!(pose.translation().iter().all(|at| at.abs() <= 214_748.364_8), "{pose:?}");
        }
    }

    #[test]
    fn the_identity_is_zero_and_comes_back_exactly() {
        assert_eq!(Pose::IDENTITY.to_bits(), Ok([0; 3]));
        assert_eq!(Pose::from_bits([0; 3]), Pose::IDENTITY);
        let far = Pose::from_translation([0.0, 215_000.0, 0.0]).to_bits().unwrap_err();
        assert!(far.to_string().contains("214748"), "{far}");
        assert!(Pose::from_translation([f64::NAN, 0.0, 0.0]).to_bits().is_err());
        assert!(Pose::from_yaw([0.0; 3], f64::INFINITY).to_bits().is_err());
    }
}
