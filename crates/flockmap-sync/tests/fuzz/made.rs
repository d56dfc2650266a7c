//! Packages and requests that are well formed and say what the input chooses.

use flockmap_codec::{Batch, Codec, Encoder, PACKAGE_BYTES_MAX, PACKAGE_BYTES_MIN, Package, Span};
use flockmap_grid::{
    Changes, Resolution, RobotId, Snapshot, SnapshotVoxels, Stamp, State, Stream, Voxel, VoxelBox,
};
use flockmap_sync::IntervalSet;
use flockmap_sync::wire::{
    ClockReport, DatagramHeader, Echo, Kind, OriginRange, PackagesWriter, Received, Request, SnapshotRequest,
    TransferProgress,
};

use super::Choices;

/// The robot that is fuzzed.
pub(crate) const OWN: Stream = Stream { origin: RobotId(1), epoch: 5 };

pub(crate) struct Maker {
    encoder: Encoder,
}

impl Maker {
    pub(crate) fn new() -> Self {
        Self { encoder: Encoder::new() }
    }

    /// A package of changes, small or long.
    pub(crate) fn package(&mut self, stream: Stream, index: u32, long: bool) -> Package {
        let batch =
            Batch { stream, start: Stamp(0), end: Stamp(1), resolution: resolution(), sensor: [0; 3] };
        let end = if long { 2_000 } else { 9 };
        let changes = Changes::from_voxels([
            (Voxel::new(0, 0, 0), State::Free),
            (Voxel::new(end, 0, 0), State::Occupied),
        ]);
        self.encoder.encode_whole(Codec::Raw, &batch, index, &changes).unwrap()
    }

    /// A snapshot, whole or of what came after a package, in so many small chunks, or a few more or less.
    pub(crate) fn chunks(
        &mut self,
        stream: Stream,
        (since, upto): (u32, u32),
        chunks: u32,
        content: u8,
    ) -> Vec<Package> {
        let end = 40 * chunks as i32;
        let state_of = |x| if (x + i32::from(content)) % 3 == 0 { State::Occupied } else { State::Free };
        let voxels = (0..end).map(|x| (Voxel::new(x * 9, 0, 0), state_of(x)));
        let part = Changes::from_voxels(voxels);
        let region = VoxelBox::spanning(Voxel::new(0, 0, 0), Voxel::new(end * 9, 0, 0)).unwrap();
        let state = Snapshot { region, parts: vec![(Stamp(1), part)], sensors: Vec::new() };
        let voxels = SnapshotVoxels::from_state(&state).unwrap();
        let bytes_max = if chunks > 1 { PACKAGE_BYTES_MIN } else { PACKAGE_BYTES_MAX };
        let span = Span::new(stream, since, upto);
        // A span that ends before it begins cannot be encoded.
        self.encoder.encode_span(Codec::Raw, span, resolution(), &voxels, bytes_max).unwrap_or_default()
    }
}

fn resolution() -> Resolution {
    Resolution::from_micrometres(100_000).unwrap()
}

/// A stream of one of a few robots, the own one among them, seldom of any.
pub(crate) fn stream(choices: &mut Choices<'_>) -> Stream {
    match choices.below(16) {
        0 => OWN,
        1 => Stream { origin: OWN.origin, epoch: choices.below(9).into() },
        2 => Stream { origin: RobotId(choices.word() as u16), epoch: choices.word().into() },
        n => Stream { origin: RobotId(2 + n as u16 % 5), epoch: 1 + u64::from(choices.below(6)) },
    }
}

/// A low index as a rule, else one at the end of the range, or any.
pub(crate) fn index(choices: &mut Choices<'_>) -> u32 {
    match choices.below(8) {
        0 => u32::MAX - choices.below(4),
        1 => choices.word().max(1),
        _ => 1 + choices.below(60),
    }
}

pub(crate) fn header(choices: &mut Choices<'_>, kind: Kind, now: Stamp) -> DatagramHeader {
    let swarm = u16::from(choices.below(32) == 31);
    let stamp = match choices.below(16) {
        0 => Stamp(i64::MIN + i64::from(choices.byte())),
        1 => Stamp(i64::MAX - i64::from(choices.byte())),
        n => now.plus_micros(i64::from(n) * 1_000 - 8_000),
    };
    DatagramHeader { kind, swarm, sender: stream(choices), stamp }
}

fn set(choices: &mut Choices<'_>) -> IntervalSet {
    let (first, count) = (index(choices), choices.below(40));
    let (length, gap) = (choices.below(4), 1 + choices.below(9));
    let low = |n: u32| first.saturating_add(n * (length + gap + 1));
    let intervals = (0..count).map(|n| (low(n), low(n).saturating_add(length)));
    IntervalSet::from_intervals(1_000, intervals.collect())
}

/// A request with some of everything.
pub(crate) fn request(choices: &mut Choices<'_>, now: Stamp) -> Vec<u8> {
    let header = header(choices, Kind::Request, now);
    let flags = choices.byte();
    let mut request =
        Request { all_echoes: flags & 2 != 0, no_new_streams: flags & 12 == 12, ..Request::default() };
    if flags & 1 != 0 {
        let first = RobotId(choices.below(8) as u16);
        let last = RobotId(first.0.wrapping_add(choices.below(8) as u16));
        request.origins = Some(if flags & 64 != 0 {
            OriginRange::all_from(RobotId(0))
        } else {
            OriginRange { first, last }
        });
    }
    for _ in 0..choices.below(4) {
        let robot = stream(choices);
        request.echoes.push(Echo {
            robot: robot.origin,
            epoch_low: robot.epoch as u16,
            stamp_low: (now.0 as u32).wrapping_sub(1_000 * choices.below(256)),
            age_micros: if choices.below(8) == 7 { choices.word() } else { 500 * choices.below(256) },
        });
    }
    for _ in 0..choices.below(4) {
        let (stream, received) = (stream(choices), set(choices));
        let from = if choices.below(4) == 3 { received.first().unwrap_or(1) } else { 1 };
        request.received.push(Received {
            in_part: None,
            is_oldest_wanted: false,
            stream,
            from,
            received: received.within(from, u32::MAX),
        });
    }
    for _ in 0..choices.below(3) {
        let mine = choices.below(4) > 0;
        request.transfers.push(TransferProgress {
            source: if mine { OWN.origin } else { RobotId(choices.byte().into()) },
            stream: stream(choices),
            since: if choices.below(2) == 0 { 0 } else { index(choices) },
            upto: index(choices),
            snapshot_id: choices.word(),
            chunks: index(choices),
            from: 1,
            accepted: set(choices),
        });
    }
    for _ in 0..choices.below(3) {
        let (since, upto) =
            if choices.below(2) == 0 { (0, index(choices)) } else { (index(choices), index(choices)) };
        let undecodable = IntervalSet::from_intervals(1, vec![(upto, upto)]);
        request.snapshot_requests.push(SnapshotRequest {
            stream: stream(choices),
            since,
            from: 1,
            undecodable,
        });
    }
    if flags & 16 != 0
        && let Some(received) = request.received.last_mut()
    {
        received.is_oldest_wanted = true;
    }
    if flags & 32 != 0 {
        let robot = stream(choices);
        let offset_micros = i64::from(choices.word()) << choices.below(33);
        request.clocks.push(ClockReport {
            robot: robot.origin,
            epoch_low: robot.epoch as u16,
            offset_micros,
        });
    }
    request.emit(header, 1_200)
}

/// A datagram of packages or chunks; some of them changed in one byte, if they can still be read then.
pub(crate) fn packages(choices: &mut Choices<'_>, maker: &mut Maker, now: Stamp) -> Vec<u8> {
    let header = header(choices, Kind::Packages, now);
    let mut writer = PackagesWriter::new(header, 1_200);
    for _ in 0..=choices.below(6) {
        let stream = if choices.below(2) == 0 { header.sender } else { stream(choices) };
        let index = index(choices);
        let mut package = match choices.below(4) {
            0 => {
                let since = if choices.below(2) == 0 { 0 } else { choices.below(index.min(256)) };
                let chunks = maker.chunks(stream, (since, index), 1 + choices.below(6), choices.byte());
                match chunks.get(choices.below(8) as usize % chunks.len().max(1)) {
                    Some(chunk) => chunk.clone(),
                    None => continue,
                }
            }
            n => maker.package(stream, index, n == 1),
        };
        if choices.below(8) == 7 {
            let mut bytes = package.bytes().to_vec();
            let at = choices.below(256) as usize % bytes.len();
            bytes[at] = choices.byte();
            if let Ok(changed) = Package::parse(&bytes) {
                package = changed;
            }
        }
        if !writer.push(&package) {
            break;
        }
    }
    writer.finish()
}

/// One of three robots that mean well; its run is new enough to be heard.
pub(crate) fn honest_peer(choices: &mut Choices<'_>) -> Stream {
    Stream { origin: RobotId(20 + choices.below(3) as u16), epoch: 4 }
}

/// A whole request of somebody who has heard this robot at `stamp`.
pub(crate) fn honest_request(stamp: Stamp) -> Request {
    let echo =
        Echo { robot: OWN.origin, epoch_low: OWN.epoch as u16, stamp_low: stamp.0 as u32, age_micros: 200 };
    Request {
        origins: Some(OriginRange::all_from(RobotId(0))),
        all_echoes: true,
        echoes: vec![echo],
        ..Request::default()
    }
}
