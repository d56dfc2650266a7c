//! Rigid transforms (SE(3)).

use glam::{DMat3, DQuat, DVec3};

use crate::submap::RESERVED;
use crate::{Resolution, VOXEL_LIMIT};

/// A rigid transform. `T_a_b` takes coordinates in frame `b` (metres) to coordinates in frame `a`;
/// `T_map_sensor` is the pose of the sensor in the map.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Pose {
    rotation: DQuat,
    translation: DVec3,
}

/// Why a pose or a position was refused. Nothing has been changed then.
#[derive(Clone, Copy, PartialEq, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PoseError {
    /// The position has a number that is none.
    #[error(
        "position {0:?} m is not finite: give no pose while the localisation has none, and look at where it was computed"
    )]
    Position([f64; 3]),
    /// The rotation has a number that is none.
    #[error(
        "rotation {0:?} (quaternion x, y, z, w) is not finite: give no pose while the localisation has none, and look at \
         where it was computed"
    )]
    Rotation([f64; 4]),
    /// The position lies where the grid has no voxels, or too near to its end for a ray.
    #[error(
        "position {position:?} m lies beyond the grid, which at voxels of {resolution:?} goes to ±{limit_m:.1} m on each axis: \
         take metres, from an origin near the robots"
    )]
    BeyondGrid {
        /// Metres.
        position: [f64; 3],
        /// The farthest from the origin that a position may be on each axis, in metres.
        limit_m: f64,
        /// Side of a voxel.
        resolution: Resolution,
    },
    /// The position lies where the grid has no room for robots.
    #[error(
        "position {position:?} m lies where the grid keeps what is seen anew: between {low_m:.1} and {high_m:.1} m up"
    )]
    Reserved {
        /// Metres.
        position: [f64; 3],
        /// From this height …
        low_m: f64,
        /// … to this one, in metres.
        high_m: f64,
    },
    /// The pose of a submap lies too far out to be sent.
    #[error(
        "position {position:?} m of a submap lies beyond ±{limit_m:.0} m: take metres, from an origin near the robots"
    )]
    BeyondSubmaps {
        /// Metres.
        position: [f64; 3],
        /// The farthest from the origin that it may be on each axis, in metres.
        limit_m: f64,
    },
}

/// Voxels between the farthest position that is taken and the end of the grid: room for the longest ray, so
/// that every end has a voxel.
pub(crate) const MARGIN: i32 = 1_024;

impl Resolution {
    /// Whether a sensor, a team-mate or the origin of a frame may be at this position (metres): finite, and
    /// at least 1,024 voxels within the end of the grid, and as far from what it keeps for what is seen anew
    /// ([`Sheet`](crate::Sheet)), from 2²⁶ to 2²⁷ voxels up.
    ///
    /// # Errors
    /// [`PoseError`] says what was wrong.
    pub fn check_position(self, position: [f64; 3]) -> Result<(), PoseError> {
        let (scale, limit) = (1.0 / self.metres(), f64::from(VOXEL_LIMIT - MARGIN));
        if !position.iter().all(|metres| metres.is_finite()) {
            return Err(PoseError::Position(position));
        }
        let is_within = position.iter().all(|metres| (metres * scale).abs() <= limit);
        let [low_m, high_m] = [RESERVED.start(), RESERVED.end()].map(|end| f64::from(*end) * self.metres());
        if is_within && (low_m..=high_m).contains(&position[2]) {
            return Err(PoseError::Reserved { position, low_m, high_m });
        }
        if is_within {
            return Ok(());
        }
        Err(PoseError::BeyondGrid { position, limit_m: limit * self.metres(), resolution: self })
    }
}

impl Default for Pose {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl Pose {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// From a translation in metres and a rotation as a quaternion `[x, y, z, w]`, which is normalised unless
    /// its length is 1 within rounding: so a pose that was taken apart comes back bit for bit. `None` if a
    /// number is not finite or the quaternion is (nearly) zero.
    pub fn new(translation: [f64; 3], quaternion_xyzw: [f64; 4]) -> Option<Self> {
        let rotation = DQuat::from_array(quaternion_xyzw);
        let translation = DVec3::from_array(translation);
        let length = rotation.length();
        let is_unit = (rotation.length_squared() - 1.0).abs() <= 8.0 * f64::EPSILON;
        (translation.is_finite() && length.is_finite() && length > 1e-6)
            .then(|| Self { rotation: if is_unit { rotation } else { rotation.normalize() }, translation })
    }

    /// A translation in metres without a rotation. Numbers that are not finite are refused where the pose is
    /// used: [`Self::check`].
    pub fn from_translation(translation: [f64; 3]) -> Self {
        Self { rotation: DQuat::IDENTITY, translation: DVec3::from_array(translation) }
    }

    /// A translation in metres and a rotation of `yaw` radians about z. Numbers that are not finite are
    /// refused where the pose is used: [`Self::check`].
    pub fn from_yaw(translation: [f64; 3], yaw: f64) -> Self {
        Self { rotation: DQuat::from_rotation_z(yaw), translation: DVec3::from_array(translation) }
    }

    /// From the twelve numbers of a KITTI pose line: a 3 × 4 matrix, row by row. `None` if a number is not
    /// finite or the left 3 × 3 part is not a rotation (columns of length 1 and right-angled within 1 %).
    pub fn from_rows(m: [f64; 12]) -> Option<Self> {
        let rotation = DMat3::from_cols(
            DVec3::new(m[0], m[4], m[8]),
            DVec3::new(m[1], m[5], m[9]),
            DVec3::new(m[2], m[6], m[10]),
        );
        let product = rotation.transpose() * rotation;
        let is_rotation = (product - DMat3::IDENTITY).abs_diff_eq(DMat3::ZERO, 0.02)
            && rotation.determinant() > 0.0
            && m.iter().all(|v| v.is_finite());
        is_rotation.then(|| Self {
            rotation: DQuat::from_mat3(&rotation).normalize(),
            translation: DVec3::new(m[3], m[7], m[11]),
        })
    }

    /// Whether this is a pose that lies in a grid of this resolution. Whoever takes a pose asks this: one
    /// that was composed of sound poses can be none.
    ///
    /// # Errors
    /// [`PoseError`] says what was wrong.
    pub fn check(&self, resolution: Resolution) -> Result<(), PoseError> {
        if !self.rotation.is_finite() {
            return Err(PoseError::Rotation(self.quaternion_xyzw()));
        }
        resolution.check_position(self.translation())
    }

    /// The translation in metres.
    pub fn translation(&self) -> [f64; 3] {
        self.translation.to_array()
    }

    /// The rotation as a unit quaternion `[x, y, z, w]`.
    pub fn quaternion_xyzw(&self) -> [f64; 4] {
        self.rotation.to_array()
    }

    /// The rotation as a matrix, row by row.
    pub fn rotation_rows(&self) -> [[f64; 3]; 3] {
        DMat3::from_quat(self.rotation).transpose().to_cols_array_2d()
    }

    /// `T_a_b · p_b = p_a`. To transform many points, take [`Self::rotation_rows`] once.
    pub fn transform(&self, point: [f64; 3]) -> [f64; 3] {
        (self.rotation * DVec3::from_array(point) + self.translation).to_array()
    }

    /// `T_a_b · T_b_c = T_a_c`.
    pub fn compose(&self, other: &Self) -> Self {
        Self {
            rotation: (self.rotation * other.rotation).normalize(),
            translation: self.rotation * other.translation + self.translation,
        }
    }

    /// `T_b_a` of `T_a_b`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { rotation, translation: -(rotation * self.translation) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn near(a: [f64; 3], b: [f64; 3]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9)
    }

    #[test]
    fn inverse_undoes_and_compose_chains() {
        let a = Pose::new([1.0, -2.0, 3.0], [0.1, 0.2, -0.3, 0.9]).unwrap();
        let b = Pose::from_yaw([0.5, 0.0, -1.0], 1.0);
        let p = [4.0, 5.0, 6.0];
        assert!(near(a.inverse().transform(a.transform(p)), p));
        assert!(near(a.compose(&b).transform(p), a.transform(b.transform(p))));
    }

    #[test]
    fn rows_of_a_pose_give_it_back() {
        let a = Pose::new([1.0, -2.0, 3.0], [0.1, 0.2, -0.3, 0.9]).unwrap();
        let [x, y, z] = a.rotation_rows();
        let t = a.translation();
        let b = Pose::from_rows([x[0], x[1], x[2], t[0], y[0], y[1], y[2], t[1], z[0], z[1], z[2], t[2]])
            .unwrap();
        assert!(near(a.transform([1.0, 2.0, 3.0]), b.transform([1.0, 2.0, 3.0])));
    }

    proptest! {
        #[test]
        fn a_pose_taken_apart_comes_back_bit_for_bit(
            at in prop::array::uniform3(-1e6..1e6f64), turn in prop::array::uniform4(-10.0..10.0f64), yaw in -7.0..7.0f64,
        ) {
            let Some(pose) = Pose::new(at, turn) else { return Ok(()) };
            let mut chain = pose;
            for step in 0..20 {
                let turn = Pose::from_yaw(at, yaw + f64::from(step));
                chain = chain.compose(&turn).inverse();
                for pose in [pose, turn, chain] {
                    let bits = |p: &Pose| (p.translation().map(f64::to_bits), p.quaternion_xyzw().map(f64::to_bits));
                    let back = Pose::new(pose.translation(), pose.quaternion_xyzw()).unwrap();
                    prop_assert_eq!(bits(&back), bits(&pose));
                }
            }
        }
    }

    /// Numbers of every kind, those that are none and those at the limits among them.
    fn number() -> impl Strategy<Value = f64> {
        let special = [
            0.0,
            f64::NAN,
            f64::INFINITY,
            -f64::INFINITY,
            1e300,
            -1.7e308,
            5e-324,
            26_843_443.2,
            26_843_444.0,
        ];
        prop_oneof![
            3 => -100.0..100.0f64,
            1 => prop::sample::select(special.to_vec()),
            1 => any::<u64>().prop_map(f64::from_bits),
        ]
    }

    proptest! {
        /// Whatever it is made of: a pose that is taken brings every voxel of the grid to a place that is a
        /// number, and back.
        #[test]
        fn a_pose_is_taken_if_and_only_if_all_it_says_is_a_number_within_the_grid(
            at in prop::array::uniform3(number()), turn in prop::array::uniform4(number()), yaw in number(),
            chained in any::<bool>(),
        ) {
            let resolution = Resolution::from_metres(0.1).unwrap();
            let poses = [Some(Pose::from_translation(at)), Some(Pose::from_yaw(at, yaw)), Pose::new(at, turn)];
            for mut pose in poses.into_iter().flatten() {
                if chained {
                    pose = pose.compose(&Pose::from_yaw(at, 1.0)).inverse();
                }
                let all = [&pose.translation()[..], &pose.quaternion_xyzw()[..]].concat();
                let is_number = all.iter().all(|number| number.is_finite());
                let is_within = pose.translation().iter().all(|metres| metres.abs() <= 26_843_443.2)
                    && !(6_710_784.0..=13_421_875.2).contains(&pose.translation()[2]);
                let checked = pose.check(resolution);
                prop_assert_eq!(checked.is_ok(), is_number && is_within, "{:?}: {:?}", pose, checked);
                if checked.is_ok() {
                    let far = resolution.centre(crate::Voxel::new(VOXEL_LIMIT, -VOXEL_LIMIT, VOXEL_LIMIT));
                    let there = pose.transform(far);
                    let back = pose.inverse().transform(there);
                    let error = (0..3).map(|axis| (back[axis] - far[axis]).abs()).fold(0.0, f64::max);
                    prop_assert!(error < 1e-3, "{error} m off at the end of the grid");
                }
            }
        }
    }

    #[test]
    fn a_pose_that_is_refused_says_what_was_wrong_and_what_to_do() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let said = |pose: Pose| pose.check(resolution).unwrap_err().to_string();
        let text = said(Pose::from_translation([1.0, f64::NAN, 0.0]));
        assert!(text.contains("position [1.0, NaN, 0.0] m is not finite"), "{text}");
        let text = said(Pose::from_yaw([1.0, 2.0, 3.0], f64::INFINITY));
        assert!(text.contains("rotation") && text.contains("NaN") && text.contains("give no pose"), "{text}");
        let text = said(Pose::from_translation([0.0, 0.0, 1e300]));
        assert!(text.contains("beyond the grid") && text.contains("±26843443.2 m"), "{text}");
        let text = said(Pose::from_translation([0.0, 0.0, 7e6]));
        assert!(text.contains("between 6710784.0 and 13421875.2 m up"), "{text}");
        assert_eq!(Pose::from_translation([26_843_443.2, -26_843_443.2, 0.0]).check(resolution), Ok(()));
    }

    #[test]
    fn what_is_no_rotation_is_refused() {
        assert!(Pose::from_rows([2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0]).is_none());
        assert!(Pose::new([0.0; 3], [0.0; 4]).is_none());
        assert!(Pose::new([f64::NAN, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).is_none());
    }
}
