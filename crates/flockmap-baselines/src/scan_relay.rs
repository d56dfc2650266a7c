//! The scans themselves, cast again at the receiver with an equal mapper.
//!
//! At the end of each cycle all its scans go out in one message, since a mapper gives an equal map only if it takes the same
//! changes at the same times. The order of the points of a scan makes no difference to a mapper, so a relay may choose it.
//!
//! A message: 1 if the cycle took occupied voxels alone, else 0; layout (u8); then length and zstd frame of the scans. For each scan: a 1;
//! stamp (i64); pose (translation and quaternion, 7 × f64); number of masks; their centres and radii (4 × f64); number of
//! points; number of rays without a return. A 0 ends the scans; then come the points of all scans, as the module `relay_points` says.

use flockmap_codec::Cycle;
use flockmap_grid::{
    BlockIndex, Changes, ConfigError, Mapper, MapperConfig, Pose, Scan, Sphere, Stamp, State, StateBlock,
    Voxel, Which,
};

use crate::bytes::{Packer, Reader, unpack, write_varint};
use crate::relay_points::{self, Points};
use crate::{Observation, ReceiveError, Receiver, SendError, Sender, StateMap};

/// Most masks of a scan.
const MASKS_MAX: u64 = 4_096;

/// Keeps the scans of a cycle and sends them at its end.
pub(crate) struct RelaySender {
    points: Points,
    /// Beyond this, and nearer than this, points mean nothing to the mapper.
    range_m: [f64; 2],
    heads: Vec<u8>,
    scans: Vec<relay_points::ScanPoints>,
    packer: Packer,
}

impl RelaySender {
    pub(crate) fn new(points: Points, config: &MapperConfig) -> Self {
        Self {
            points,
            range_m: [config.range_min_m, config.range_m],
            heads: Vec::new(),
            scans: Vec::new(),
            packer: Packer::new(points.method(), points.zstd_level()),
        }
    }
}

impl Sender for RelaySender {
    fn scan(&mut self, seen: &Observation<'_>, _out: &mut Vec<Vec<u8>>) -> Result<(), SendError> {
        let points = self.points.of_scan(seen, self.range_m);
        // A relay that cuts points has applied the masks itself.
        let masks = if self.points == Points::Exact { seen.masks } else { &[] };
        if masks.len() as u64 > MASKS_MAX {
            return Err(SendError::Limit {
                method: self.points.method(),
                limit: "a scan has at most 4,096 masks",
            });
        }
        self.heads.push(1);
        self.heads.extend_from_slice(&seen.scan.stamp.0.to_le_bytes());
        let numbers = seen.pose.translation().into_iter().chain(seen.pose.quaternion_xyzw());
        self.heads.extend(numbers.flat_map(f64::to_le_bytes));
        write_varint(&mut self.heads, masks.len() as u64);
        for mask in masks {
            let numbers = mask.centre.into_iter().chain([mask.radius]);
            self.heads.extend(numbers.flat_map(f64::to_le_bytes));
        }
        for count in points.counts() {
            write_varint(&mut self.heads, count as u64);
        }
        self.scans.push(points);
        Ok(())
    }

    fn cycle(
        &mut self,
        _now: Stamp,
        _cycle: &Cycle,
        changes: &Changes,
        _mapper: &Mapper,
        out: &mut Vec<Vec<u8>>,
    ) -> Result<(), SendError> {
        // With no free voxel among the changes, taking all or just the occupied ones is the same.
        let any_free = changes.blocks().iter().any(|(_, block)| *block.free() != [0; 8]);
        let mut plain = core::mem::take(&mut self.heads);
        plain.push(0);
        let mut best: Option<(u8, Vec<u8>)> = None;
        for layout in self.points.layouts() {
            let head = plain.len();
            relay_points::write(*layout, &self.scans, &mut plain);
            let packed = self.packer.pack(&plain)?;
            plain.truncate(head);
            if best.as_ref().is_none_or(|(_, smallest)| packed.len() < smallest.len()) {
                best = Some((*layout, packed));
            }
        }
        self.scans.clear();
        if let Some((layout, packed)) = best {
            let mut message = vec![u8::from(!any_free), layout];
            message.extend_from_slice(&packed);
            out.push(message);
        }
        Ok(())
    }
}

/// Casts the scans into a mapper of its own.
pub(crate) struct RelayReceiver {
    method: &'static str,
    mapper: Mapper,
    map: StateMap,
}

impl RelayReceiver {
    pub(crate) fn new(points: Points, config: &MapperConfig) -> Result<Self, ConfigError> {
        Ok(Self { method: points.method(), mapper: Mapper::new(config.clone())?, map: StateMap::default() })
    }
}

struct Head {
    scan: Scan,
    pose: Pose,
    masks: Vec<Sphere>,
}

impl Receiver for RelayReceiver {
    fn receive(&mut self, message: &[u8]) -> Result<(), ReceiveError> {
        let mut reader = Reader::new(self.method, message);
        let which = match reader.u8("which changes the cycle took")? {
            0 => Which::All,
            1 => Which::Occupied,
            _ => return Err(reader.wrong("0 for all changes or 1 for occupied ones")),
        };
        let layout = reader.u8("a layout")?;
        let plain = unpack(&mut reader)?;
        let mut plain = Reader::new(self.method, &plain);
        let mut heads = Vec::new();
        let mut counts = Vec::new();
        while plain.u8("a 1 before each scan, a 0 after the last")? == 1 {
            let (head, count) = read_head(&mut plain)?;
            heads.push(head);
            counts.push(count);
        }
        for (head, [returns, no_returns]) in
            heads.iter_mut().zip(relay_points::read(layout, &counts, &mut plain)?)
        {
            head.scan.points = returns;
            head.scan.no_returns = no_returns;
        }
        if !plain.is_empty() {
            return Err(plain.wrong("nothing after the points"));
        }
        for head in &heads {
            self.mapper.insert(&head.scan, &head.pose, &head.masks);
        }
        self.map.apply(&self.mapper.take_changes(which))?;
        Ok(())
    }

    fn state(&self, voxel: Voxel) -> State {
        self.map.state(voxel)
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.map.blocks())
    }
}

fn read_head(plain: &mut Reader<'_>) -> Result<(Head, [usize; 2]), ReceiveError> {
    let stamp = Stamp(i64::from_le_bytes(plain.array("a stamp")?));
    let rule = "a pose: 7 numbers";
    let mut pose = [0.0; 7];
    for number in &mut pose {
        *number = plain.f64(rule)?;
    }
    let [x, y, z, qx, qy, qz, qw] = pose;
    let pose = Pose::new([x, y, z], [qx, qy, qz, qw]).ok_or_else(|| plain.wrong(rule))?;
    let rule = "at most 4,096 masks";
    let masks = plain.varint(MASKS_MAX, rule)?;
    let masks = (0..masks).map(|_| {
        let centre = [plain.f64(rule)?, plain.f64(rule)?, plain.f64(rule)?];
        Ok(Sphere { centre, radius: plain.f64(rule)? })
    });
    let masks = masks.collect::<Result<Vec<_>, ReceiveError>>()?;
    let rule = "numbers of points and of rays without a return";
    let max = relay_points::POINTS_MAX as u64;
    let counts = [plain.varint(max, rule)? as usize, plain.varint(max, rule)? as usize];
    Ok((Head { scan: Scan { stamp, ..Scan::default() }, pose, masks }, counts))
}
