//! A robot without sockets, threads or clocks.

use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use flockmap::sync::SwarmKey;
use flockmap::{
    Destination, MapperConfig, RobotConfig, RobotId, Scan, Stamp, States, StatesUpdate, SubmapId, Voxel,
    VoxelBox, epoch,
};
use flockmap_node::{KEY_VARIABLE, NodeConfig};
use numpy::PyArray2;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyString};

use crate::arrays::{Points, states, triple, voxels_with_states};
use crate::errors::{self, ConfigError, DatagramError, Error};
use crate::event::Event;
use crate::given::{self, Time, named, pose, pose_rows, resolution};
use crate::map_view::MapView;
use crate::shared::Shared;
use crate::values::to_python;

/// A robot of a swarm: keeps its own map from its scans, gives datagrams for the others, takes theirs, and fuses what
/// all have seen into one map. It knows no sockets, threads or clocks.
///
/// After every input (`insert_scan`, `insert_states`, `handle_datagram`, `handle_timeout`) send all that `transmits`
/// gives, then wait for the next scan, the next datagram or `poll_timeout`, whichever is first.
///
/// Stamps (`now`, `stamp`) are seconds as a float or nanoseconds as an int, on any clock that never steps back.
/// Lengths are metres. Several threads may use one robot; they wait for each other, without the GIL.
#[pyclass(frozen, module = "flockmap", name = "Robot", weakref)]
pub(crate) struct Robot {
    id: RobotId,
    epoch: u64,
    resolution: flockmap::Resolution,
    robot: Shared<flockmap::Robot>,
}

#[pymethods]
impl Robot {
    /// A robot with an empty map.
    ///
    /// id: its number, 0 to 65,535, unique in the swarm.
    /// resolution: side of a voxel in metres, the same for all robots.
    /// range: rays are cut at this many metres, at most 500 voxels.
    /// key: the secret of the swarm (`flockmap key`): 64 hex digits, base64, or 32 bytes. None: anybody in reach of the
    ///     radio can read and change the map.
    /// epoch: the number of this run, which no two runs of a robot share. None: of the time and random bits.
    /// mapper: "rog-map", "racer" or "octomap".
    /// codec: "flock", "paper", "nested-zlib", "raw" or "racer".
    /// cast: "unicast" or "broadcast".
    /// swarm: robots of other swarms are ignored.
    /// publish_period, obstacle_period: changes go out after so many seconds; None: obstacles with all others.
    /// budget: bytes that go out in a second, over all links; None: no limit.
    /// now: the time at which it begins.
    #[new]
    #[pyo3(signature = (id, *, resolution, range, key=None, epoch=None, mapper="rog-map", codec="flock", cast="unicast",
        swarm=0, publish_period=0.5, obstacle_period=None, budget=Some(2_000_000), now=Time(Stamp(0))))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords")]
    fn new(
        py: Python<'_>,
        id: u16,
        resolution: f64,
        range: f64,
        key: Option<&Bound<'_, PyAny>>,
        epoch: Option<u64>,
        mapper: &str,
        codec: &str,
        cast: &str,
        swarm: u16,
        publish_period: f64,
        obstacle_period: Option<f64>,
        budget: Option<u32>,
        now: Time,
    ) -> PyResult<Self> {
        let mut config = RobotConfig::new(RobotId(id), self::resolution(resolution)?, range);
        config.epoch = epoch.map_or_else(new_epoch, Ok)?;
        let preset = mapper.parse().map_err(errors::config)?;
        config.mapper = MapperConfig::preset(preset, config.mapper.resolution, range);
        config.codec = named("codec", codec)?;
        config.session.cast = named("cast", cast)?;
        config.session.swarm = swarm;
        config.session.radio_bytes_per_s = budget;
        config.batch.publish_period_ms = milliseconds("publish_period", publish_period)?;
        config.batch.obstacle_period_ms =
            obstacle_period.map(|seconds| milliseconds("obstacle_period", seconds)).transpose()?;
        config.session.swarm_key = key.map(swarm_key).transpose()?;
        Self::make(py, config, now)
    }

    /// A robot with the options of a node's configuration: `crates/flockmap-node/robot.example.toml` shows all. Sections
    /// about sockets and files are checked and not used. The mapper has the threads that `[map] threads` says; where it
    /// does not, half of the cores, at most 4.
    ///
    /// config: the path of a file, or a text of TOML (a str with a line break).
    /// epoch, now: as above.
    #[staticmethod]
    #[pyo3(signature = (config, *, epoch=None, now=Time(Stamp(0))))]
    fn from_toml(py: Python<'_>, config: &Bound<'_, PyAny>, epoch: Option<u64>, now: Time) -> PyResult<Self> {
        let (config, path) = match Toml::of(config)? {
            Toml::Text(text) => (text.parse::<NodeConfig>().map_err(errors::config)?, PathBuf::new()),
            Toml::File(path) => (py.detach(|| NodeConfig::read(&path)).map_err(errors::config)?, path),
        };
        let variable = std::env::var(KEY_VARIABLE).ok();
        let key = config.swarm_key(&path, variable.as_deref()).map_err(errors::config)?;
        let mut robot = config.robot(epoch.map_or_else(new_epoch, Ok)?).map_err(errors::config)?;
        robot.session.swarm_key = key.map(|found| found.key);
        let (alignments, offsets) =
            (config.alignments().map_err(errors::config)?, config.clock_offsets().map_err(errors::config)?);
        let made = Self::make(py, robot, now)?;
        made.robot
            .with(py, |robot| {
                for (origin, pose) in &alignments {
                    robot.set_alignment(*origin, pose)?;
                }
                for (origin, micros) in offsets {
                    robot.set_clock_offset(origin, Some(micros));
                }
                for origin in &config.muted {
                    robot.set_muted(*origin, true);
                }
                Ok(())
            })?
            .map_err(|error: flockmap::PoseError| errors::pose(error))?;
        Ok(made)
    }

    /// Takes in a scan.
    ///
    /// points: (N, 3) float32 or float64, metres in the frame of the sensor. Points that are not finite are ignored.
    /// T_map_sensor: (4, 4) float64, the pose of the sensor in the map.
    /// stamp: when the scan was taken. One ahead of `now` counts as now.
    /// no_returns: (M, 3), for each ray that came back with nothing a point far out along it.
    /// now: default `stamp`.
    #[pyo3(signature = (points, T_map_sensor, stamp, no_returns=None, *, now=None))]
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    fn insert_scan(
        &self,
        py: Python<'_>,
        points: &Bound<'_, PyAny>,
        T_map_sensor: &Bound<'_, PyAny>,
        stamp: Time,
        no_returns: Option<&Bound<'_, PyAny>>,
        now: Option<Time>,
    ) -> PyResult<ScanReport> {
        let points = Points::new("points", points)?;
        let no_returns = no_returns.map(|given| Points::new("no_returns", given)).transpose()?;
        let (pose, stamp) = (pose("T_map_sensor", T_map_sensor)?, stamp.0);
        let now = now.map_or(stamp, |now| now.0);
        let report = self.robot.with(py, |robot| {
            let no_returns = no_returns.as_ref().map(Points::to_f32).unwrap_or_default();
            let scan = Scan { stamp, points: points.to_f32(), no_returns };
            robot.insert_scan(now, &scan, &pose).map(|report| ScanReport::from(&report))
        })?;
        report.map_err(errors::pose)
    }

    /// Takes in single voxels from a mapper elsewhere, such as the changed keys of an octree. Each counts as observed;
    /// of two for one voxel the later wins; Unknown takes back what this robot knew.
    ///
    /// indices: (N, 3) whole numbers; voxel (i, j, k) is the cube from (i, j, k) · resolution on.
    /// states: (N,) 0 Unknown, 1 Free, 2 Occupied.
    /// sensor: (3,) metres, where the sensor was. Give it where it is known: it takes fewer bytes on the radio.
    /// resolution: if given, it must be the robot's.
    #[pyo3(signature = (indices, states, stamp, *, sensor=None, resolution=None, now=None))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords")]
    fn insert_states(
        &self,
        py: Python<'_>,
        indices: &Bound<'_, PyAny>,
        states: &Bound<'_, PyAny>,
        stamp: Time,
        sensor: Option<&Bound<'_, PyAny>>,
        resolution: Option<f64>,
        now: Option<Time>,
    ) -> PyResult<ScanReport> {
        let pairs = voxels_with_states(indices, states)?;
        self.update(py, (stamp, now), sensor, resolution, States::Voxels(&pairs))
    }

    /// Takes in all voxels of a box, such as the local map that others publish. It is compared with what was there: only
    /// voxels whose state differs count as observed.
    ///
    /// low: (3,) whole numbers, the index of the lowest voxel.
    /// states: (X, Y, Z), 0 Unknown, 1 Free, 2 Occupied; states[x, y, z] is voxel low + (x, y, z).
    /// clear_unknown: whether Unknown takes back what this robot knew; else it leaves it.
    /// The others as for `insert_states`.
    #[pyo3(signature = (low, states, stamp, *, sensor=None, resolution=None, clear_unknown=false, now=None))]
    #[expect(clippy::too_many_arguments, reason = "they are keywords")]
    fn insert_box(
        &self,
        py: Python<'_>,
        low: [i32; 3],
        states: &Bound<'_, PyAny>,
        stamp: Time,
        sensor: Option<&Bound<'_, PyAny>>,
        resolution: Option<f64>,
        clear_unknown: bool,
        now: Option<Time>,
    ) -> PyResult<ScanReport> {
        let (shape, states) = self::states("states", states)?;
        let size: Option<[u32; 3]> = match shape[..] {
            [x, y, z] => [x, y, z].map(|n| u32::try_from(n).unwrap_or(0)).into(),
            _ => None,
        };
        let region = size.and_then(|size| VoxelBox::new(Voxel::new(low[0], low[1], low[2]), size));
        let region = region.ok_or_else(|| {
            let expected = "expected (X, Y, Z) of at least 1 voxel each, within the grid from low on";
            Error::new_err(format!("states: shape {shape:?} from {low:?} on, {expected}"))
        })?;
        self.update(
            py,
            (stamp, now),
            sensor,
            resolution,
            States::Box { region, states: &states, clear_unknown },
        )
    }

    /// Takes in a datagram of a team-mate.
    ///
    /// Raises DatagramError if it was refused. It is counted already and needs no action: go on.
    fn handle_datagram(&self, py: Python<'_>, now: Time, data: &[u8]) -> PyResult<()> {
        let handled = self.robot.with(py, |robot| robot.handle_datagram(now.0, data))?;
        handled.map_err(|error| DatagramError::new_err(error.to_string()))
    }

    /// Lets time pass: closes the batch that is due, and does what else has to be done.
    fn handle_timeout(&self, py: Python<'_>, now: Time) -> PyResult<()> {
        self.robot.with(py, |robot| robot.handle_timeout(now.0))
    }

    /// When to call `handle_timeout` at the latest, in seconds; may lie in the past. None: there is nothing to wait for.
    fn poll_timeout(&self, py: Python<'_>) -> PyResult<Option<f64>> {
        self.robot.with(py, |robot| robot.poll_timeout().map(Stamp::seconds))
    }

    /// Gives what is to be sent as `(to, data)`, one after the other: `to` is the id of a robot or None for everyone, `data`
    /// the bytes of one datagram.
    fn transmits(slf: Bound<'_, Self>, now: Time) -> Transmits {
        Transmits { robot: slf.unbind(), now: now.0 }
    }

    /// The events since the last call, oldest first; 1,024 are kept.
    fn events(&self, py: Python<'_>) -> PyResult<Vec<Event>> {
        self.robot.with(py, |robot| core::iter::from_fn(|| robot.poll_event()).map(Event::from).collect())
    }

    /// Closes the batch now, with whatever has changed.
    fn flush(&self, py: Python<'_>, now: Time) -> PyResult<()> {
        self.robot.with(py, |robot| robot.flush(now.0))
    }

    /// Says how a robot's frame lies in this one's. May change at any time; nothing is sent again. The map stays as it is
    /// until it has been made by the new one, a part with each handle_timeout, which is due until then.
    ///
    /// T_own_origin: (4, 4) float64.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    fn set_alignment(&self, py: Python<'_>, origin: u16, T_own_origin: &Bound<'_, PyAny>) -> PyResult<()> {
        let pose = pose("T_own_origin", T_own_origin)?;
        let set = self.robot.with(py, |robot| robot.set_alignment(RobotId(origin), &pose))?;
        set.map_err(errors::pose)
    }

    /// Begins the next submap of this run and returns its number: what is seen from now on moves with it.
    fn begin_submap(&self, py: Python<'_>, now: Time) -> PyResult<u16> {
        let begun = self.robot.with(py, |robot| robot.begin_submap(now.0))?;
        begun.map(SubmapId::number).map_err(errors::refused)
    }

    /// Says how a submap of this run lies in the map now, as after a closed loop: what all robots know of it moves there,
    /// and nothing of it is sent again. Rounded to a tenth of a millimetre.
    ///
    /// T_map_submap: (4, 4) float64, the correction of what was given as T_map_sensor while the submap was written.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    fn set_submap_pose(
        &self,
        py: Python<'_>,
        submap: u16,
        T_map_submap: &Bound<'_, PyAny>,
        now: Time,
    ) -> PyResult<()> {
        let (submap, pose) = (given::submap(submap)?, pose("T_map_submap", T_map_submap)?);
        let set = self.robot.with(py, |robot| robot.set_submap_pose(now.0, submap, &pose))?;
        set.map_err(errors::pose)
    }

    /// T_map_submap of a submap of this run, (4, 4) float64, as it was set, rounded.
    fn submap_pose<'py>(&self, py: Python<'py>, submap: u16) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let submap = given::submap(submap)?;
        matrix_of(py, &self.robot.with(py, |robot| robot.submap_pose(submap))?)
    }

    /// The number of the submap in which scans are written.
    #[getter]
    fn submap(&self, py: Python<'_>) -> PyResult<u16> {
        self.robot.with(py, |robot| robot.submap().number())
    }

    /// Says how far a robot's clock is ahead of this one's, in seconds; None: measure it again. Comes into
    /// force as an alignment does.
    #[pyo3(signature = (origin, seconds))]
    fn set_clock_offset(&self, py: Python<'_>, origin: u16, seconds: Option<f64>) -> PyResult<()> {
        if seconds.is_some_and(|seconds| !seconds.is_finite()) {
            return Err(Error::new_err(
                "seconds is not finite, expected how far the clock is ahead, or None",
            ));
        }
        let micros = seconds.map(|seconds| (seconds * 1e6).round() as i64);
        self.robot.with(py, |robot| robot.set_clock_offset(RobotId(origin), micros))
    }

    /// Leaves a robot's observations out of the map, or takes them in again. Comes into force as an alignment does.
    fn set_muted(&self, py: Python<'_>, origin: u16, is_muted: bool) -> PyResult<()> {
        self.robot.with(py, |robot| robot.set_muted(RobotId(origin), is_muted))
    }

    /// Says where a team-mate is: (3,) metres in the own map, so that it is not taken for an obstacle.
    fn set_teammate(&self, py: Python<'_>, id: u16, position: &Bound<'_, PyAny>, seen: Time) -> PyResult<()> {
        let position = triple("position", position)?;
        let set = self.robot.with(py, |robot| robot.set_teammate(RobotId(id), position, seen.0))?;
        set.map_err(errors::pose)
    }

    /// The fused map at this moment. Stays as it is while the robot goes on, and outlives it. O(1).
    fn view(&self, py: Python<'_>) -> PyResult<MapView> {
        self.robot.with(py, |robot| MapView(robot.view()))
    }

    /// Where the robots are, as far as is known: for each id a dict with `position` (3,) metres in the own map, `seen` in
    /// seconds, and `T_map_sensor` (4, 4) of the own robot, else None.
    fn poses<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for known in self.robot.with(py, |robot| robot.poses())? {
            let pose = known.orientation.and_then(|turn| flockmap::Pose::new(known.position, turn));
            let dict = PyDict::new(py);
            dict.set_item("position", known.position)?;
            dict.set_item("seen", known.seen.seconds())?;
            dict.set_item("T_map_sensor", pose.map(|pose| matrix_of(py, &pose)).transpose()?)?;
            all.set_item(known.stream.origin.0, dict)?;
        }
        Ok(all)
    }

    /// The robots heard: for each id a dict with `epoch`, `last_heard` (seconds, own clock), `hears_us`, `round_trip` and
    /// `clock_offset` (seconds, or None), `in_flight` (packages).
    fn peers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for peer in self.robot.with(py, |robot| robot.session().peers().collect::<Vec<_>>())? {
            let dict = PyDict::new(py);
            dict.set_item("epoch", peer.stream.epoch)?;
            dict.set_item("last_heard", peer.last_heard.seconds())?;
            dict.set_item("hears_us", peer.hears_us)?;
            dict.set_item("round_trip", peer.round_trip.map(|time| time.as_secs_f64()))?;
            dict.set_item("clock_offset", peer.clock_offset_micros.map(|micros| micros as f64 / 1e6))?;
            dict.set_item("in_flight", peer.in_flight)?;
            all.set_item(peer.stream.origin.0, dict)?;
        }
        Ok(all)
    }

    /// What was counted: a dict with the counters of the `robot` and of its `session`, by name.
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (robot, session) =
            self.robot.with(py, |robot| (*robot.counters(), *robot.session().counters()))?;
        let all = PyDict::new(py);
        all.set_item("robot", to_python(py, &robot)?)?;
        all.set_item("session", to_python(py, &session)?)?;
        Ok(all)
    }

    /// Voxels that have changed and are still to be published.
    fn unpublished(&self, py: Python<'_>) -> PyResult<usize> {
        self.robot.with(py, |robot| robot.unpublished())
    }

    /// Its number.
    #[getter]
    const fn id(&self) -> u16 {
        self.id.0
    }

    /// The number of its run.
    #[getter]
    const fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Side of a voxel in metres.
    #[getter]
    fn resolution(&self) -> f64 {
        self.resolution.metres()
    }

    /// Ends the robot and frees its memory. Views of it stay. Calls after this raise ClosedError.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let robot = self.robot.take(py)?;
        py.detach(|| drop(robot));
        Ok(())
    }

    fn __enter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyAny>) -> PyResult<()> {
        self.close(py)
    }

    fn __repr__(&self) -> String {
        format!("Robot({}, resolution={}, epoch={})", self.id, self.resolution.metres(), self.epoch)
    }
}

impl Robot {
    fn make(py: Python<'_>, mut config: RobotConfig, now: Time) -> PyResult<Self> {
        if config.session.swarm_key.is_some() {
            config.session.salt = random()?;
        }
        let (id, epoch, resolution) = (config.id, config.epoch, config.mapper.resolution);
        let robot = py.detach(|| flockmap::Robot::new(config, now.0)).map_err(errors::config)?;
        Ok(Self { id, epoch, resolution, robot: Shared::new("robot", robot) })
    }

    fn update(
        &self,
        py: Python<'_>,
        (stamp, now): (Time, Option<Time>),
        sensor: Option<&Bound<'_, PyAny>>,
        resolution: Option<f64>,
        states: States<'_>,
    ) -> PyResult<ScanReport> {
        let resolution = resolution.map_or(Ok(self.resolution), self::resolution)?;
        let sensor = sensor.map(|given| triple("sensor", given)).transpose()?;
        let now = now.map_or(stamp.0, |now| now.0);
        let update = StatesUpdate { stamp: stamp.0, resolution, sensor, states };
        let report = self
            .robot
            .with(py, |robot| robot.insert_states(now, &update).map(|report| ScanReport::from(&report)))?;
        report.map_err(errors::refused)
    }
}

/// The datagrams that a robot has to send. An iterator of `(to, data)`.
#[pyclass(frozen, module = "flockmap", name = "Transmits")]
pub(crate) struct Transmits {
    robot: Py<Robot>,
    now: Stamp,
}

#[pymethods]
impl Transmits {
    const fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Option<(Option<u16>, Bound<'py, PyBytes>)>> {
        let transmit = self.robot.get().robot.with(py, |robot| robot.poll_transmit(self.now))?;
        Ok(transmit.map(|transmit| {
            let to = match transmit.to {
                Destination::Peer(id) => Some(id.0),
                Destination::Everyone => None,
            };
            (to, PyBytes::new(py, &transmit.bytes))
        }))
    }
}

/// What a scan or an update of states did.
#[pyclass(frozen, module = "flockmap", name = "ScanReport", get_all)]
pub(crate) struct ScanReport {
    /// When it counts as made, in seconds.
    stamp: f64,
    /// Voxels that are Free or Occupied now and were not before.
    changed: usize,
    /// Rays that ended with a hit.
    hits: usize,
    /// Rays that were cut, or came back with nothing: they carve free space only.
    cut: usize,
    /// Points that were ignored: not finite, too near, or too far out for voxel indices.
    ignored: usize,
    /// Points that were ignored since they lie on a team-mate.
    masked: usize,
    /// Blocks of 8³ voxels that were forgotten for want of room.
    forgotten: usize,
}

#[pymethods]
impl ScanReport {
    fn __repr__(&self) -> String {
        let Self { stamp, changed, hits, cut, ignored, masked, forgotten } = self;
        format!(
            "ScanReport(stamp={stamp}, changed={changed}, hits={hits}, cut={cut}, ignored={ignored}, masked={masked}, \
             forgotten={forgotten})"
        )
    }
}

impl From<&flockmap::ScanReport> for ScanReport {
    fn from(report: &flockmap::ScanReport) -> Self {
        Self {
            stamp: report.stamp.seconds(),
            changed: report.changed.iter().map(|(_, block)| block.known_count() as usize).sum(),
            hits: report.hits,
            cut: report.cut,
            ignored: report.ignored,
            masked: report.masked,
            forgotten: report.forgotten.len(),
        }
    }
}

/// A configuration: a file, or its text.
pub(crate) enum Toml {
    File(PathBuf),
    Text(String),
}

impl Toml {
    pub(crate) fn of(given: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(text) = given.cast::<PyString>() {
            let text = text.to_str()?;
            if text.contains('\n') {
                return Ok(Self::Text(text.to_owned()));
            }
        }
        given.extract::<PathBuf>().map(Self::File).map_err(|_| {
            ConfigError::new_err(
                "expected the path of a TOML file, or a text of TOML (a str with a line break)",
            )
        })
    }
}

fn matrix_of<'py>(py: Python<'py>, pose: &flockmap::Pose) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let rows: Vec<Vec<f64>> = pose_rows(pose).iter().map(|row| row.to_vec()).collect();
    PyArray2::from_vec2(py, &rows).map_err(errors::refused)
}

fn swarm_key(given: &Bound<'_, PyAny>) -> PyResult<SwarmKey> {
    if let Ok(bytes) = given.cast::<PyBytes>() {
        let bytes: [u8; SwarmKey::BYTES] = bytes.as_bytes().try_into().map_err(|_| {
            ConfigError::new_err(format!("key: {} bytes, expected 32, or a text", bytes.as_bytes().len()))
        })?;
        return Ok(SwarmKey::from_bytes(bytes));
    }
    let text: String =
        given.extract().map_err(|_| ConfigError::new_err("key: expected 32 bytes, or a text"))?;
    text.parse().map_err(|error| errors::config(format!("key: {error}")))
}

fn milliseconds(what: &str, seconds: f64) -> PyResult<u32> {
    let ms = (seconds * 1e3).round();
    if (1.0..=1e8).contains(&ms) {
        return Ok(ms as u32);
    }
    Err(ConfigError::new_err(format!("{what} is {seconds}, expected 0.001 to 100,000 seconds")))
}

fn new_epoch() -> PyResult<u64> {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |time| time.as_secs());
    Ok(epoch(u32::try_from(seconds).unwrap_or(u32::MAX), u32::from_le_bytes(random()?)))
}

fn random<const N: usize>() -> PyResult<[u8; N]> {
    let mut bytes = [0; N];
    getrandom::fill(&mut bytes)
        .map_err(|error| Error::new_err(format!("the system gives no random bytes: {error}")))?;
    Ok(bytes)
}
