//! A layer seen from another frame.

use std::borrow::Cow;

use rustc_hash::FxHashMap;

use crate::block::voxel_bit;
use crate::{BlockIndex, Layer, Plane, Pose, Resolution, Stamp, State, Voxel};

/// `T_own_origin` and its inverse, in voxel units.
#[derive(Clone, Debug)]
pub(super) struct Alignment {
    forward: Rigid,
    backward: Rigid,
    is_identity: bool,
}

#[derive(Clone, Copy, Debug)]
struct Rigid {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
}

impl Rigid {
    fn new(pose: &Pose, resolution: Resolution) -> Self {
        let scale = 1.0 / resolution.metres();
        Self { rotation: pose.rotation_rows(), translation: pose.translation().map(|t| t * scale) }
    }

    /// The voxel of the target grid that holds the centre of this voxel.
    fn voxel(&self, v: Voxel) -> Voxel {
        let p = [v.x, v.y, v.z].map(|i| f64::from(i) + 0.5);
        let [x, y, z] = core::array::from_fn(|axis| {
            let [a, b, c] = self.rotation[axis];
            // Saturates far out, where no voxel is.
            (a * p[0] + b * p[1] + c * p[2] + self.translation[axis]).floor() as i32
        });
        Voxel::new(x, y, z)
    }
}

impl Alignment {
    /// Of a pose that lies in the grid. What it brings beyond the end of the grid is not there.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub(super) fn new(T_own_origin: &Pose, resolution: Resolution) -> Self {
        Self {
            forward: Rigid::new(T_own_origin, resolution),
            backward: Rigid::new(&T_own_origin.inverse(), resolution),
            is_identity: *T_own_origin == Pose::IDENTITY,
        }
    }

    /// Whether voxels of both grids are the same voxels.
    pub(super) const fn is_identity(&self) -> bool {
        self.is_identity
    }

    /// What a layer says of a voxel of the own grid, and with which stamp.
    ///
    /// Occupied voxels are carried forward: the voxel is Occupied if the centre of any occupied voxel of the layer
    /// comes to lie in it, so that no obstacle is lost. Free is looked up backwards: the voxel is Free if its own
    /// centre lies in a free voxel of the layer, so that no holes appear.
    pub(super) fn look_up(&self, layer: &Layer, target: Voxel) -> Option<(State, Stamp)> {
        let source = self.backward.voxel(target);
        if !source.in_limits() {
            return None;
        }
        let mut occupied: Option<Stamp> = None;
        for near in neighbours(source) {
            if let Some((State::Occupied, stamp)) = layer.get(near)
                && self.forward.voxel(near) == target
            {
                occupied = occupied.max(Some(stamp));
            }
        }
        match occupied {
            Some(stamp) => Some((State::Occupied, stamp)),
            None => layer.get(source).filter(|(state, _)| *state == State::Free),
        }
    }

    /// The voxels of the own grid on which these voxels of the layer can have a say.
    pub(super) fn reach<'a>(&self, source: &'a [(BlockIndex, Plane)]) -> Cow<'a, [(BlockIndex, Plane)]> {
        if self.is_identity {
            return Cow::Borrowed(source);
        }
        let mut reached = FxHashMap::<BlockIndex, Plane>::default();
        let mut add = |voxel: Voxel| {
            let bit = voxel_bit(voxel);
            reached.entry(voxel.block()).or_default()[bit / 64] |= 1 << (bit % 64);
        };
        for (index, mask) in source {
            for (voxel, _) in super::voxels_of(*index, mask) {
                let image = self.forward.voxel(voxel);
                if image.in_limits() {
                    add(image);
                    // At the end of the grid there are neighbours that lie beyond it.
                    let near = neighbours(image).filter(|near| near.in_limits());
                    near.filter(|near| self.backward.voxel(*near) == voxel).for_each(&mut add);
                }
            }
        }
        let mut reached: Vec<_> = reached.into_iter().collect();
        reached.sort_unstable_by_key(|(index, _)| *index);
        Cow::Owned(reached)
    }
}

/// A voxel and the 26 around it. The centre of a voxel that a rigid motion brings into a voxel lies within 0.87
/// voxels of that voxel's centre, so its grid place is at most one off on each axis.
fn neighbours(v: Voxel) -> impl Iterator<Item = Voxel> {
    (-1..=1).flat_map(move |x| {
        (-1..=1).flat_map(move |y| (-1..=1).map(move |z| Voxel::new(v.x + x, v.y + y, v.z + z)))
    })
}
