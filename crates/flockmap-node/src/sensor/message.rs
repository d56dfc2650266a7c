//! One message of a sensor program, byte by byte as in `docs/sensor-input.md`.

use flockmap::{Pose, RobotId, Scan, Stamp};
use flockmap_io::Frame;

use super::fields::{HEADER_BYTES, MESSAGE_VERSION, MessageError, Reader};
use super::states::{self, StatesMessage};

const MAGIC: [u8; 4] = *b"FLKS";
/// Header, stamp, pose, two counts.
const SCAN_HEADER_BYTES: usize = HEADER_BYTES + 8 + 56 + 8;
const POINT_BYTES: usize = 12;

/// What a message may be.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct MessageLimits {
    /// Most points and rays without a return, together, in one scan. Worst case held: 36 bytes each.
    pub scan_points_max: u32,
    /// Most single voxels of one message of states, at most `StatesUpdate::VOXELS_MAX`. Worst case held: 29 bytes each.
    pub states_max: u32,
    /// Most voxels of a box, at most `StatesUpdate::BOX_VOXELS_MAX`. Worst case held: 2 bytes each.
    pub box_states_max: u32,
    /// A scan or states whose stamp is off the machine's clock by more than this many microseconds is refused.
    pub stamp_error_max_micros: i64,
}

impl Default for MessageLimits {
    fn default() -> Self {
        Self {
            scan_points_max: 1 << 20,
            states_max: 1 << 20,
            box_states_max: 1 << 24,
            stamp_error_max_micros: 10_000_000,
        }
    }
}

impl MessageLimits {
    /// The longest message.
    pub fn bytes_max(&self) -> usize {
        let scan = SCAN_HEADER_BYTES + POINT_BYTES * self.scan_points_max as usize;
        scan.max(states::bytes_max(self.states_max, self.box_states_max))
    }
}

/// What a sensor program may say.
#[derive(Clone, PartialEq, Debug)]
pub enum SensorMessage {
    /// Kind 1: a scan and the pose of the sensor. Stamp 0 means now.
    Scan(Frame),
    /// Kind 2: `T_own_origin`, how the frame of another robot lies in the own one.
    Alignment(RobotId, Pose),
    /// Kind 3: where a team-mate is now, in metres in the own map.
    Teammate(RobotId, [f64; 3]),
    /// Kind 4 and 5: states of voxels, from a mapper elsewhere. Stamp 0 means now.
    States(StatesMessage),
    /// Kind 6: a submap of the own run begins.
    BeginSubmap,
    /// Kind 7: `T_map_submap`, how a submap of the own run lies in the own map; `None`: the newest one.
    SubmapPose(Option<u16>, Pose),
}

/// In place of the number of a submap: the newest one.
const NEWEST_SUBMAP: u16 = u16::MAX;

impl SensorMessage {
    /// Reads what follows the length. Allocates only what the bytes at hand fill.
    pub fn parse(bytes: &[u8], limits: &MessageLimits) -> Result<Self, MessageError> {
        let wrong_length = MessageError::Length { got: bytes.len() as u64, max: limits.bytes_max() };
        if bytes.len() < HEADER_BYTES || bytes.len() > limits.bytes_max() {
            return Err(wrong_length);
        }
        let mut reader = Reader { rest: bytes, got: bytes.len(), expected: HEADER_BYTES as u64 };
        let magic = reader.take()?;
        if magic != MAGIC {
            return Err(MessageError::Magic(magic));
        }
        let [version, kind] = reader.take()?;
        if version != MESSAGE_VERSION {
            return Err(MessageError::Version(version));
        }
        let robot = RobotId(u16::from_le_bytes(reader.take()?));
        match kind {
            1 => {
                reader.expected = SCAN_HEADER_BYTES as u64;
                let stamp = Stamp(i64::from_le_bytes(reader.take()?));
                let numbers = reader.numbers()?;
                let points = u32::from_le_bytes(reader.take()?);
                let no_returns = u32::from_le_bytes(reader.take()?);
                let count = u64::from(points) + u64::from(no_returns);
                if count > u64::from(limits.scan_points_max) {
                    return Err(wrong_length);
                }
                reader.expected += count * POINT_BYTES as u64;
                reader.check_length()?;
                let t_map_sensor = pose(numbers)?;
                let (points, no_returns) = (
                    reader.records(points)?.iter().map(point).collect(),
                    reader.records(no_returns)?.iter().map(point).collect(),
                );
                let scan = Scan { stamp, points, no_returns };
                Ok(Self::Scan(Frame { scan, t_map_sensor, points_dropped: 0 }))
            }
            2 => {
                reader.expected += 56;
                reader.check_length()?;
                Ok(Self::Alignment(robot, pose(reader.numbers()?)?))
            }
            3 => {
                reader.expected += 24;
                reader.check_length()?;
                let [x, y, z] = reader.numbers()?;
                pose([x, y, z, 0.0, 0.0, 0.0, 1.0])?;
                Ok(Self::Teammate(robot, [x, y, z]))
            }
            4 => Ok(Self::States(StatesMessage::parse_voxels(&mut reader, limits.states_max)?)),
            5 => Ok(Self::States(StatesMessage::parse_box(&mut reader, limits.box_states_max)?)),
            6 => {
                reader.check_length()?;
                Ok(Self::BeginSubmap)
            }
            7 => {
                reader.expected += 56;
                reader.check_length()?;
                let submap = Some(robot.0).filter(|number| *number != NEWEST_SUBMAP);
                Ok(Self::SubmapPose(submap, pose(reader.numbers()?)?))
            }
            kind => Err(MessageError::Kind(kind)),
        }
    }

    /// The message with its length, as it goes over the connection.
    pub fn emit(&self) -> Vec<u8> {
        let mut out = vec![0; 4];
        out.extend(MAGIC);
        out.push(MESSAGE_VERSION);
        let mut begin = |kind: u8, robot: RobotId| {
            out.push(kind);
            out.extend(robot.0.to_le_bytes());
        };
        match self {
            Self::Scan(frame) => {
                begin(1, RobotId(0));
                out.extend(frame.scan.stamp.0.to_le_bytes());
                put_pose(&mut out, &frame.t_map_sensor);
                out.extend((frame.scan.points.len() as u32).to_le_bytes());
                out.extend((frame.scan.no_returns.len() as u32).to_le_bytes());
                for point in frame.scan.points.iter().chain(&frame.scan.no_returns) {
                    out.extend(point.iter().flat_map(|v| v.to_le_bytes()));
                }
            }
            Self::Alignment(robot, pose) => {
                begin(2, *robot);
                put_pose(&mut out, pose);
            }
            Self::Teammate(robot, position) => {
                begin(3, *robot);
                out.extend(position.iter().flat_map(|v| v.to_le_bytes()));
            }
            Self::States(states) => {
                begin(states.kind(), RobotId(0));
                states.emit(&mut out);
            }
            Self::BeginSubmap => begin(6, RobotId(0)),
            Self::SubmapPose(submap, pose) => {
                begin(7, RobotId(submap.unwrap_or(NEWEST_SUBMAP)));
                put_pose(&mut out, pose);
            }
        }
        let length = (out.len() as u32 - 4).to_le_bytes();
        out[..4].copy_from_slice(&length);
        out
    }
}

fn point(bytes: &[u8; POINT_BYTES]) -> [f32; 3] {
    let [a, b, c, d, e, f, g, h, i, j, k, l] = *bytes;
    [[a, b, c, d], [e, f, g, h], [i, j, k, l]].map(f32::from_le_bytes)
}

fn pose(got: [f64; 7]) -> Result<Pose, MessageError> {
    let [x, y, z, quaternion @ ..] = got;
    Pose::new([x, y, z], quaternion).ok_or(MessageError::Pose(got))
}

fn put_pose(out: &mut Vec<u8>, pose: &Pose) {
    let numbers = pose.translation().into_iter().chain(pose.quaternion_xyzw());
    out.extend(numbers.flat_map(f64::to_le_bytes));
}

#[cfg(test)]
mod tests {
    use super::states::OwnedStates;
    use super::*;
    use flockmap::{Resolution, State, Voxel, VoxelBox};
    use proptest::prelude::*;

    const LIMITS: MessageLimits =
        MessageLimits { scan_points_max: 8, states_max: 6, box_states_max: 60, stamp_error_max_micros: 1 };

    fn states(states: OwnedStates, sensor: Option<[f64; 3]>) -> SensorMessage {
        let resolution = Resolution::from_metres(0.2).unwrap();
        SensorMessage::States(StatesMessage { stamp: Stamp(12_345_678), resolution, sensor, states })
    }

    fn voxels(count: i32) -> SensorMessage {
        let state = |k: i32| [State::Unknown, State::Free, State::Occupied][k as usize % 3];
        let voxels = (0..count).map(|k| (Voxel::new(k, -2, 3), state(k))).collect();
        states(OwnedStates::Voxels(voxels), Some([1.0, 2.0, 3.0]))
    }

    fn a_box(size: [u32; 3], clear_unknown: bool) -> SensorMessage {
        let region = VoxelBox::new(Voxel::new(-1, 0, 1), size).unwrap();
        let mut states = vec![State::Unknown; region.volume() as usize];
        states[1] = State::Free;
        *states.last_mut().unwrap() = State::Occupied;
        self::states(OwnedStates::Box { region, states, clear_unknown }, None)
    }

    fn scan(points: usize, no_returns: usize) -> SensorMessage {
        let point = |k: usize| [k as f32, 0.5, -1.0];
        SensorMessage::Scan(Frame {
            scan: Scan {
                stamp: Stamp(12_345_678),
                points: (0..points).map(point).collect(),
                no_returns: (0..no_returns).map(point).collect(),
            },
            t_map_sensor: Pose::from_translation([1.0, -2.0, 3.0]),
            points_dropped: 0,
        })
    }

    #[test]
    fn what_is_written_is_read_back() {
        let teammate = SensorMessage::Teammate(RobotId(513), [1.0, 2.0, -0.5]);
        let alignment = SensorMessage::Alignment(RobotId(2), Pose::from_translation([4.0, 0.0, 0.0]));
        let of_states = [voxels(0), voxels(6), a_box([5, 4, 3], true), a_box([2, 1, 1], false)];
        for message in [scan(0, 0), scan(5, 3), teammate, alignment].into_iter().chain(of_states) {
            let bytes = message.emit();
            assert_eq!(u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize, bytes.len() - 4);
            assert_eq!(SensorMessage::parse(&bytes[4..], &LIMITS), Ok(message));
        }
    }

    #[test]
    fn the_layout_is_the_documented_one() {
        let bytes = scan(1, 0).emit();
        assert_eq!(&bytes[..12], b"\x5c\0\0\0FLKS\x01\x01\0\0");
        assert_eq!(&bytes[12..20], &12_345_678i64.to_le_bytes());
        assert_eq!(&bytes[20..28], &1.0f64.to_le_bytes());
        assert_eq!(&bytes[68..76], &1.0f64.to_le_bytes(), "w comes last");
        assert_eq!(&bytes[76..84], b"\x01\0\0\0\0\0\0\0");
        assert_eq!(bytes.len(), 84 + 12);
    }

    #[test]
    fn the_layout_of_submaps_is_the_documented_one() {
        let bytes = SensorMessage::BeginSubmap.emit();
        assert_eq!(bytes, *b"\x08\0\0\0FLKS\x01\x06\0\0");
        let pose = Pose::from_translation([1.0, 2.0, 3.0]);
        for (submap, number) in [(Some(515), [3, 2]), (None, [255, 255])] {
            let message = SensorMessage::SubmapPose(submap, pose);
            let bytes = message.emit();
            assert_eq!(bytes[..12], [&[64, 0, 0, 0][..], b"FLKS", &[1, 7], &number].concat());
            assert_eq!(bytes[12..20], 1f64.to_le_bytes());
            assert_eq!((bytes.len(), &bytes[60..68]), (68, &1f64.to_le_bytes()[..]));
            assert_eq!(SensorMessage::parse(&bytes[4..], &LIMITS), Ok(message));
        }
        assert_eq!(
            SensorMessage::parse(&SensorMessage::BeginSubmap.emit()[4..], &LIMITS),
            Ok(SensorMessage::BeginSubmap)
        );
    }

    #[test]
    fn the_layout_of_states_is_the_documented_one() {
        let common = |bytes: &[u8], kind: u8, sensor: [f64; 3], flags: u32| {
            assert_eq!(bytes[4..12], [b'F', b'L', b'K', b'S', 1, kind, 0, 0]);
            assert_eq!(bytes[12..20], 12_345_678i64.to_le_bytes());
            assert_eq!(bytes[20..28], 0.2f64.to_le_bytes());
            for (place, metres) in bytes[28..52].chunks(8).zip(sensor) {
                assert_eq!(place, metres.to_le_bytes());
            }
            assert_eq!(bytes[52..56], flags.to_le_bytes());
        };
        let bytes = voxels(3).emit();
        common(&bytes, 4, [1.0, 2.0, 3.0], 1);
        assert_eq!(bytes[..4], 95u32.to_le_bytes());
        assert_eq!(bytes[56..60], 3u32.to_le_bytes());
        assert_eq!(bytes[60..73], *b"\0\0\0\0\xfe\xff\xff\xff\x03\0\0\0\0");
        assert_eq!((bytes[73], bytes[85], bytes[98], bytes.len()), (1, 1, 2, 99), "free, occupied");

        let bytes = a_box([3, 2, 1], true).emit();
        common(&bytes, 5, [0.0; 3], 2);
        assert_eq!(bytes[..4], 82u32.to_le_bytes());
        assert_eq!(bytes[56..68], *b"\xff\xff\xff\xff\0\0\0\0\x01\0\0\0");
        assert_eq!(bytes[68..80], *b"\x03\0\0\0\x02\0\0\0\x01\0\0\0");
        assert_eq!(bytes[80..], [0, 1, 0, 0, 0, 2]);
    }

    #[test]
    fn each_fault_of_states_is_named() {
        let parse = |message: SensorMessage, change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = message.emit()[4..].to_vec();
            change(&mut bytes);
            SensorMessage::parse(&bytes, &LIMITS).unwrap_err()
        };
        let voxel = |change: &dyn Fn(&mut Vec<u8>)| parse(voxels(2), change);
        assert_eq!(voxel(&|b| b[48] = 2), MessageError::Flags(2), "what is of a box");
        assert_eq!(voxel(&|b| b[16..24].fill(0)), MessageError::Resolution(0.0));
        assert_eq!(voxel(&|b| b[52] = 3), MessageError::Size { got: 82, expected: 95 });
        let too_many = voxel(&|b| b[52] = 7);
        assert_eq!(too_many, MessageError::TooMany { got: 7, max: 6, option: "states_max" });
        assert!(too_many.to_string().contains("[sensor] states_max"), "{too_many}");
        assert_eq!(voxel(&|b| b[81] = 3), MessageError::State { got: 3, number: 1 });
        assert!(matches!(voxel(&|b| b.truncate(50)), MessageError::Size { got: 50, expected: 56 }));

        let of_box = |change: &dyn Fn(&mut Vec<u8>)| parse(a_box([2, 2, 2], false), change);
        assert_eq!(of_box(&|b| b[48] = 4), MessageError::Flags(4));
        assert_eq!(of_box(&|b| b[64] = 0), MessageError::Box { min: [-1, 0, 1], size: [0, 2, 2] });
        let far = MessageError::Box { min: [-1, 0, 1], size: [2 + (1 << 31), 2, 2] };
        assert_eq!(of_box(&|b| b[67] = 0x80), far);
        let too_many = MessageError::TooMany { got: 64, max: 60, option: "box_states_max" };
        assert_eq!(of_box(&|b| b[64] = 16), too_many);
        assert_eq!(of_box(&|b| b[64] = 3), MessageError::Size { got: 84, expected: 88 });
        assert_eq!(of_box(&|b| b[76] = 9), MessageError::State { got: 9, number: 0 });
        // A side of 2^28 each way: more than any number of bytes.
        let huge = of_box(&|b| {
            b[52..56].fill(0);
            b[64..76].copy_from_slice(&[0, 0, 0, 16, 0, 0, 0, 16, 0, 0, 0, 16]);
        });
        assert!(matches!(huge, MessageError::TooMany { got, .. } if got == 1 << 84), "{huge}");
    }

    #[test]
    fn each_fault_is_named() {
        let good = scan(2, 0).emit()[4..].to_vec();
        let parse = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = good.clone();
            change(&mut bytes);
            SensorMessage::parse(&bytes, &LIMITS).unwrap_err()
        };
        assert!(matches!(parse(&|b| b[0] = b'X'), MessageError::Magic(_)));
        assert_eq!(parse(&|b| b[4] = 9), MessageError::Version(9));
        assert_eq!(parse(&|b| b[5] = 8), MessageError::Kind(8));
        assert!(matches!(parse(&|b| b[5] = 6), MessageError::Size { got: 104, expected: 8 }));
        assert!(matches!(parse(&|b| b[72] = 3), MessageError::Size { got: 104, expected: 116 }));
        assert!(matches!(parse(&|b| b[72] = 9), MessageError::Length { .. }), "more points than allowed");
        assert!(matches!(parse(&|b| b[16..72].fill(0)), MessageError::Pose(_)));
        assert!(matches!(parse(&|b| b.truncate(3)), MessageError::Length { got: 3, .. }));
        assert!(matches!(parse(&|b| b.truncate(40)), MessageError::Size { got: 40, .. }));
        assert!(matches!(parse(&|b| b.extend([0; 200])), MessageError::Length { .. }));
    }

    proptest! {
        #[test]
        fn random_bytes_do_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = SensorMessage::parse(&bytes, &LIMITS);
        }

        #[test]
        fn damaged_messages_do_no_harm(
            kind in 0usize..7, cut in 0usize..200, flips in prop::collection::vec((0usize..200, any::<u8>()), 0..4),
        ) {
            let message = match kind {
                0 => scan(4, 2),
                1 => SensorMessage::Teammate(RobotId(1), [0.0; 3]),
                2 => voxels(5),
                3 => a_box([5, 4, 3], true),
                4 => SensorMessage::BeginSubmap,
                5 => SensorMessage::SubmapPose(Some(3), Pose::IDENTITY),
                _ => SensorMessage::Alignment(RobotId(1), Pose::IDENTITY),
            };
            let mut bytes = message.emit().split_off(4);
            bytes.truncate(cut);
            for (at, value) in flips {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte ^= value;
                }
            }
            match SensorMessage::parse(&bytes, &LIMITS) {
                Ok(SensorMessage::Scan(frame)) => {
                    prop_assert!(frame.scan.points.len() + frame.scan.no_returns.len() <= 8);
                }
                Ok(SensorMessage::States(message)) => match &message.states {
                    OwnedStates::Voxels(voxels) => prop_assert!(voxels.len() <= 6),
                    OwnedStates::Box { region, states, .. } => {
                        prop_assert!(region.volume() == states.len() as u128 && states.len() <= 60);
                    }
                },
                _ => {}
            }
        }
    }
}
