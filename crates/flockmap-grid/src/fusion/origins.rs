//! Who is behind the fused map: whose observation each voxel is, and where the sensors of others were.

use std::collections::BTreeMap;

use super::Fusion;
use super::contribution::contributions;
use crate::submap::BlockBox;
use crate::{BLOCK_SIDE, BlockIndex, Mapper, Plane, RobotId, Sheet, Stamp, State, Stream, set_bits};

impl Fusion {
    /// Whose observation each known voxel of a block is: the robots in ascending order of their ids, with voxels
    /// that no two of them share, together all that are known. Where several say the same of the same time, the
    /// own robot, then the lowest id. Worked out anew by the rules of fusion as they are in force, so nothing is
    /// kept for it; a clock offset that was measured since a voxel was fused counts already. O(streams), and a
    /// look into each layer for every voxel that several have seen: up to a tenth of a millisecond.
    pub fn origins(&self, mapper: &Mapper, index: BlockIndex) -> Vec<(RobotId, Plane)> {
        let Some(states) = self.shown.view.block(index) else { return Vec::new() };
        let targets = [(index, states.known())];
        let own = self.shown.is_own_plain(self.sources.own, mapper).then_some(mapper);
        let mut seen = own.and_then(|own| own.block(index)).map_or([0; 8], |block| block.known());
        let mut contested = [0u64; 8];
        let mut others = BTreeMap::<RobotId, Plane>::new();
        let parts = self.shown.parts(&self.sources, mapper, &BlockBox::new(index));
        let clears = self.shown.settings.submap_clears_voxels;
        let contributions = contributions(&parts, &self.shown.widened(&targets), clears);
        for one in &contributions {
            let new = one.states.masked(&targets[0].1).known();
            let plane = others.entry(parts[one.part].stream.origin).or_default();
            for z in 0..8 {
                contested[z] |= seen[z] & new[z];
                plane[z] |= new[z] & !seen[z];
                seen[z] |= new[z];
            }
        }
        for bit in set_bits(&contested) {
            let (word, mask) = (bit / 64, 1 << (bit % 64));
            others.values_mut().for_each(|plane| plane[word] &= !mask);
            let known_by = contributions.iter().filter(|one| one.states.get(bit) != State::Unknown);
            let known_by = known_by.map(|one| &parts[one.part]);
            let id_own = self.sources.own.origin;
            if let Some((_, id)) = self.shown.last_observation(known_by, id_own, own, index.voxel(bit)) {
                others.entry(id).or_default()[word] |= mask;
            }
        }
        // What is nobody else's is the own robot's, with what is its own by a former run.
        let [(_, mut own)] = targets;
        for (_, plane) in others.iter().filter(|(id, _)| **id != self.sources.own.origin) {
            own = core::array::from_fn(|z| own[z] & !plane[z]);
        }
        others.insert(self.sources.own.origin, own);
        others.into_iter().filter(|(_, plane)| *plane != [0; 8]).collect()
    }

    /// Where the sensor of each stream of others was in its newest batch, as far as was said: metres in the
    /// own frame, to a sixteenth of a voxel, and when, on the own clock. O(streams).
    pub fn sensors(&self) -> impl Iterator<Item = (Stream, [f64; 3], Stamp)> {
        let others = self.sources.iter().filter(|(stream, _)| *stream != self.sources.own);
        others.filter_map(|(stream, source)| {
            let (stamp, sensor) = source.layer.newest_sensor()?;
            let voxels = sensor.map(|at| f64::from(at) / 16.0);
            let [x, y, z] = sensor.map(|at| at.div_euclid(16 * BLOCK_SIDE));
            let sheet = Sheet::of(BlockIndex::new(x, y, z))?;
            let settings = &self.shown.settings;
            let at = settings.alignment(stream, false, source.spans.at(stamp), sheet)?.transform(voxels);
            let offset = settings.origin(stream.origin).clock_offset_micros;
            let made = source.received.made(stamp, offset);
            Some((stream, at.map(|at| at * self.resolution.metres()), made))
        })
    }
}
