//! Rigid transforms (SE(3)).

use glam::{DMat3, DQuat, DVec3};

/// A rigid transform. `T_a_b` takes coordinates in frame `b` (metres) to coordinates in frame `a`;
/// `T_map_sensor` is the pose of the sensor in the map.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Pose {
    rotation: DQuat,
    translation: DVec3,
}

impl Default for Pose {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl Pose {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// From a translation in metres and a rotation as a quaternion `[x, y, z, w]`, which is normalised unless its length
    /// is 1 within rounding: so a pose that was taken apart comes back bit for bit.
    /// `None` if a number is not finite or the quaternion is (nearly) zero.
    pub fn new(translation: [f64; 3], quaternion_xyzw: [f64; 4]) -> Option<Self> {
        let rotation = DQuat::from_array(quaternion_xyzw);
        let translation = DVec3::from_array(translation);
        let length = rotation.length();
        let is_unit = (rotation.length_squared() - 1.0).abs() <= 8.0 * f64::EPSILON;
        (translation.is_finite() && length.is_finite() && length > 1e-6)
            .then(|| Self { rotation: if is_unit { rotation } else { rotation.normalize() }, translation })
    }

    /// A translation in metres alone.
    pub fn from_translation(translation: [f64; 3]) -> Self {
        Self { rotation: DQuat::IDENTITY, translation: DVec3::from_array(translation) }
    }

    /// A translation in metres and a rotation of `yaw` radians about z.
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

    #[test]
    fn what_is_no_rotation_is_refused() {
        assert!(Pose::from_rows([2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0]).is_none());
        assert!(Pose::new([0.0; 3], [0.0; 4]).is_none());
        assert!(Pose::new([f64::NAN, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).is_none());
    }
}
