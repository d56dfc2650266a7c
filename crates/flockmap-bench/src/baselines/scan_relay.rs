//! The scans themselves, cast again at the receiver with an equal mapper.
//!
//! At the end of each batch all its scans go out in one message, since a mapper gives an equal map only if it
//! takes the same changes at the same times. The order of the points of a scan makes no difference to a
//! mapper, so a relay may choose it.
//!
//! A message: what the batch took, 0 all changes, 1 only occupied voxels, 2 nothing since it goes on; layout
//! (u8); then length and zstd frame of the scans. For each scan: a 1; stamp (i64); pose (translation and
//! quaternion, 7 × f64); number of masks; their centres and radii (4 × f64); number of points; number of rays
//! without a return. A 0 ends the scans; then come the points of all scans, as the module `relay_points`
//! says.

use anyhow::{Context, Result, ensure};
use flockmap::codec::Batch;
use flockmap::grid::{
    BlockIndex, Changes, Mapper, MapperConfig, Pose, Scan, Sphere, Stamp, StateBlock, Which,
};

use crate::baselines::bytes::{Packer, Reader, put_varint, read_f64s, unpack, varint_up_to};
use crate::baselines::relay_points::{self, Points};
use crate::baselines::state_map::{DAMAGED, StateMap};
use crate::baselines::traits::{Messages, Observation, Receiver, Sender};

/// Most masks of a scan.
const MASKS_MAX: u64 = 4_096;

/// Most bytes of stamps, poses and masks that wait for the end of a batch.
const HEADS_BYTES_MAX: usize = 1 << 20;

const TOOK_ALL: u8 = 0;
const TOOK_OCCUPIED: u8 = 1;
const GOES_ON: u8 = 2;

/// Keeps the scans of a batch and sends them at its end.
pub(crate) struct RelaySender {
    points: Points,
    /// Beyond this, and nearer than this, points mean nothing to the mapper.
    range_m: [f64; 2],
    heads: Vec<u8>,
    scans: Vec<relay_points::ScanPoints>,
    /// Points in `scans`, and most that may wait for the end of a batch: of a still scene there is no end.
    waiting: usize,
    waiting_max: usize,
    /// Quick, to choose the layout by.
    trial: Packer,
    packer: Packer,
}

impl RelaySender {
    pub(crate) fn new(points: Points, config: &MapperConfig) -> Self {
        Self {
            points,
            range_m: [config.range_min_m, config.range_m],
            heads: Vec::new(),
            scans: Vec::new(),
            waiting: 0,
            waiting_max: relay_points::POINTS_MAX,
            trial: Packer::new(points.method(), 3),
            packer: Packer::new(points.method(), 19),
        }
    }
}

impl Sender for RelaySender {
    fn scan(&mut self, seen: &Observation<'_>, out: &mut Messages) -> Result<()> {
        let points = self.points.of_scan(seen, self.range_m);
        // A relay that cuts points has applied the masks itself.
        let masks = if self.points == Points::Exact { seen.masks } else { &[] };
        let method = self.points.method();
        ensure!(masks.len() as u64 <= MASKS_MAX, "{method} cannot send this: a scan has at most 4,096 masks");
        let counts = points.each_ref().map(Vec::len);
        let count: usize = counts.iter().sum();
        if self.waiting + count > self.waiting_max || self.heads.len() > HEADS_BYTES_MAX {
            self.flush(GOES_ON, out)?;
        }
        self.waiting += count;
        self.heads.push(1);
        self.heads.extend_from_slice(&seen.scan.stamp.0.to_le_bytes());
        let numbers = seen.pose.translation().into_iter().chain(seen.pose.quaternion_xyzw());
        self.heads.extend(numbers.flat_map(f64::to_le_bytes));
        put_varint(&mut self.heads, masks.len() as u64);
        for mask in masks {
            let numbers = mask.centre.into_iter().chain([mask.radius]);
            self.heads.extend(numbers.flat_map(f64::to_le_bytes));
        }
        for count in counts {
            put_varint(&mut self.heads, count as u64);
        }
        self.scans.push(points);
        Ok(())
    }

    fn batch(&mut self, _now: Stamp, _batch: &Batch, changes: &Changes, out: &mut Messages) -> Result<()> {
        // With no free voxel among the changes, taking all or just the occupied ones is the same.
        let any_free = changes.blocks().iter().any(|(_, block)| *block.free() != [0; 8]);
        self.flush(if any_free { TOOK_ALL } else { TOOK_OCCUPIED }, out)
    }
}

impl RelaySender {
    /// Sends the scans that wait.
    fn flush(&mut self, took: u8, out: &mut Messages) -> Result<()> {
        let mut plain = core::mem::take(&mut self.heads);
        let scans = core::mem::take(&mut self.scans);
        self.waiting = 0;
        plain.push(0);
        let head = plain.len();
        let mut lengths = Vec::new();
        for layout in self.points.layouts() {
            relay_points::write(*layout, &scans, &mut plain);
            lengths.push((self.trial.pack(&plain)?.len(), *layout));
            plain.truncate(head);
        }
        let Some((_, layout)) = lengths.into_iter().min() else { return Ok(()) };
        relay_points::write(layout, &scans, &mut plain);
        let mut message = vec![took, layout];
        message.extend_from_slice(&self.packer.pack(&plain)?);
        out.push(message);
        Ok(())
    }
}

/// Casts the scans into a mapper of its own.
pub(crate) struct RelayReceiver {
    mapper: Mapper,
    map: StateMap,
}

impl RelayReceiver {
    pub(crate) fn new(config: &MapperConfig) -> Result<Self> {
        Ok(Self { mapper: Mapper::new(config.clone())?, map: StateMap::default() })
    }
}

impl Receiver for RelayReceiver {
    fn receive(&mut self, message: &[u8]) -> Result<()> {
        let (which, seen) = parse(message).context(DAMAGED)?;
        for (scan, pose, masks) in &seen {
            self.mapper.insert(scan, pose, masks);
        }
        which.map_or(Ok(()), |which| self.map.apply(&self.mapper.take_changes(which)))
    }

    fn states(&self) -> Box<dyn Iterator<Item = (BlockIndex, StateBlock)> + '_> {
        Box::new(self.map.blocks())
    }
}

type Seen = (Scan, Pose, Vec<Sphere>);

/// What the batch took, if it ends here, and the scans.
fn parse(message: &[u8]) -> Option<(Option<Which>, Vec<Seen>)> {
    let mut reader = Reader::new(message);
    let which = match reader.u8()? {
        TOOK_ALL => Some(Which::All),
        TOOK_OCCUPIED => Some(Which::Occupied),
        GOES_ON => None,
        _ => return None,
    };
    let layout = reader.u8()?;
    let plain = unpack(&mut reader)?;
    let mut plain = Reader::new(&plain);
    let (mut seen, mut counts) = (Vec::new(), Vec::new());
    while plain.u8()? == 1 {
        let (head, count) = read_head(&mut plain)?;
        seen.push(head);
        counts.push(count);
    }
    let lists = relay_points::read(layout, &counts, &mut plain)?;
    for ((scan, ..), [returns, no_returns]) in seen.iter_mut().zip(lists) {
        (scan.points, scan.no_returns) = (returns, no_returns);
    }
    plain.is_empty().then_some((which, seen))
}

/// A scan without its points, and how many there are, and rays without a return.
fn read_head(plain: &mut Reader<'_>) -> Option<(Seen, [usize; 2])> {
    let stamp = Stamp(plain.i64()?);
    let [x, y, z, qx, qy, qz, qw] = read_f64s(plain)?;
    let pose = Pose::new([x, y, z], [qx, qy, qz, qw])?;
    let masks = (0..varint_up_to(plain, MASKS_MAX)?).map(|_| {
        let [x, y, z, radius] = read_f64s(plain)?;
        Some(Sphere { centre: [x, y, z], radius })
    });
    let masks = masks.collect::<Option<_>>()?;
    let mut count = || Some(varint_up_to(plain, relay_points::POINTS_MAX as u64)? as usize);
    let counts = [count()?, count()?];
    Some(((Scan { stamp, ..Scan::default() }, pose, masks), counts))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::grid::{Preset, Resolution, RobotId, Stream};

    #[test]
    fn a_batch_without_an_end_goes_out_in_parts() {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let config = MapperConfig::preset(Preset::RogMap, resolution, 5.0);
        let mut mapper = Mapper::new(config.clone()).unwrap();
        let mut sender = RelaySender { waiting_max: 100, ..RelaySender::new(Points::Exact, &config) };
        let mut receiver = RelayReceiver::new(&config).unwrap();
        let mut out = Vec::new();
        for number in 0..10u8 {
            let point = |n: u8| [2.0, f32::from(n) * 0.1 - 1.0, f32::from(number) * 0.1];
            let scan = Scan { points: (0..30).map(point).collect(), ..Scan::default() };
            mapper.insert(&scan, &Pose::IDENTITY, &[]);
            let seen = Observation { scan: &scan, pose: &Pose::IDENTITY, masks: &[] };
            sender.scan(&seen, &mut out).unwrap();
        }
        assert_eq!(out.len(), 3, "three scans fit into 100 points");
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let batch = Batch { stream, start: Stamp(0), end: Stamp(0), resolution, sensor: [0; 3] };
        let changes = mapper.take_changes(Which::All);
        sender.batch(Stamp(0), &batch, &changes, &mut out).unwrap();
        out.iter().for_each(|message| receiver.receive(message).unwrap());
        assert_eq!(Changes::from_blocks(receiver.states().collect()), changes);
    }
}
