//! A robot at work, with its sockets and threads.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use flockmap::{RobotId, Stamp, SubmapId};
use flockmap_node::{ConfiguredNode, Log};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors::{self, ClosedError, ConfigError, Error};
use crate::given::{self, pose};
use crate::map_view::MapView;
use crate::shared::Shared;
use crate::values::to_python;

/// How long the node is waited for between two looks at Ctrl-C.
const LOOK: Duration = Duration::from_millis(50);

/// A node: what `flockmap node --config` runs, in this process. It starts at once, on threads of its own.
///
/// As a context manager it is stopped at the end, also on Ctrl-C: it closes its batch, sends what is left, and writes the files
/// of `[output]`. A node that is let go of without `stop` ends too, and writes nothing.
#[pyclass(frozen, module = "flockmap", name = "Node", weakref)]
pub(crate) struct Node {
    name: String,
    sensor_address: Option<String>,
    map_addresses: Vec<String>,
    node: Shared<ConfiguredNode>,
}

#[pymethods]
impl Node {
    /// Starts the node of a configuration file (`crates/flockmap-node/robot.example.toml` shows all keys). Returns when all
    /// its sockets are open.
    ///
    /// quiet: its log is dropped; else it goes to stderr.
    #[new]
    #[pyo3(signature = (path, *, quiet=false))]
    fn new(py: Python<'_>, path: PathBuf, quiet: bool) -> PyResult<Self> {
        let log = quiet.then(Log::silent);
        let node = py.detach(|| ConfiguredNode::start(&path, log));
        let node = node.map_err(|error| ConfigError::new_err(format!("{error:#}")))?;
        let handle = &node.node;
        Ok(Self {
            name: handle.name().to_owned(),
            sensor_address: handle.sensor_address().map(str::to_owned),
            map_addresses: handle.map_addresses().to_vec(),
            node: Shared::new("node", node),
        })
    }

    /// The name of the robot.
    #[getter]
    fn name(&self) -> &str {
        &self.name
    }

    /// Where sensor programs connect; None if the node has no such socket.
    #[getter]
    fn sensor_address(&self) -> Option<&str> {
        self.sensor_address.as_deref()
    }

    /// Where planners read the map, as Mirror takes it.
    #[getter]
    fn map_addresses(&self) -> Vec<String> {
        self.map_addresses.clone()
    }

    /// The fused map at this moment. Outlives the node.
    fn view(&self, py: Python<'_>) -> PyResult<MapView> {
        self.ask(py, |node| node.with_robot(|robot, _| robot.view())).map(MapView)
    }

    /// The counters now: a dict with `map_free`, `map_occupied`, `uptime`, `quiet_for` (seconds), `sensor_ended`, `map_readers`,
    /// `peers` (ids of the robots heard), `missing` (packages known to exist and not received), and `counters` by part.
    fn status<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let status = self.ask(py, |node| node.status())?;
        let dict = PyDict::new(py);
        dict.set_item("name", &status.name)?;
        dict.set_item("epoch", status.own.epoch)?;
        dict.set_item("uptime", status.uptime.as_secs_f64())?;
        dict.set_item("quiet_for", status.quiet_for.as_secs_f64())?;
        dict.set_item("sensor_ended", status.sensor_ended)?;
        dict.set_item("map_free", status.map_voxels.0)?;
        dict.set_item("map_occupied", status.map_voxels.1)?;
        dict.set_item("map_readers", status.map_readers)?;
        let peers: Vec<u16> = status.peers.iter().map(|peer| peer.stream.origin.0).collect();
        dict.set_item("peers", peers)?;
        dict.set_item("missing", status.streams.iter().map(|stream| stream.missing).sum::<u64>())?;
        let counters = PyDict::new(py);
        counters.set_item("node", to_python(py, &status.node)?)?;
        counters.set_item("robot", to_python(py, &status.robot)?)?;
        counters.set_item("session", to_python(py, &status.session)?)?;
        dict.set_item("counters", counters)?;
        Ok(dict)
    }

    /// Says how a robot's frame lies in this one's: (4, 4) float64. May change at any time.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    fn set_alignment(&self, py: Python<'_>, origin: u16, T_own_origin: &Bound<'_, PyAny>) -> PyResult<()> {
        let pose = pose("T_own_origin", T_own_origin)?;
        let set = self.ask(py, move |node| {
            node.with_robot(move |robot, _: Stamp| robot.set_alignment(RobotId(origin), &pose))
        })?;
        set.map_err(errors::pose)
    }

    /// Begins the next submap of this run and returns its number: what is seen from now on moves with it.
    fn begin_submap(&self, py: Python<'_>) -> PyResult<u16> {
        let begun = self.ask(py, |node| node.with_robot(|robot, now| robot.begin_submap(now)))?;
        begun.map(SubmapId::number).map_err(errors::refused)
    }

    /// Says how a submap of this run lies in the map now: (4, 4) float64, as Robot.set_submap_pose has it.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    fn set_submap_pose(&self, py: Python<'_>, submap: u16, T_map_submap: &Bound<'_, PyAny>) -> PyResult<()> {
        let (submap, pose) = (given::submap(submap)?, pose("T_map_submap", T_map_submap)?);
        let set = self.ask(py, move |node| {
            node.with_robot(move |robot, now| robot.set_submap_pose(now, submap, &pose))
        })?;
        set.map_err(errors::pose)
    }

    /// Whether the node has ended.
    fn has_ended(&self, py: Python<'_>) -> PyResult<bool> {
        self.node.with(py, |node| node.node.has_ended())
    }

    /// Waits until the node has ended by itself, or so many seconds; then whether it has. Ctrl-C is heard.
    #[pyo3(signature = (timeout=None))]
    fn wait(&self, py: Python<'_>, timeout: Option<f64>) -> PyResult<bool> {
        if timeout.is_some_and(|seconds| !(0.0..=1e9).contains(&seconds)) {
            return Err(Error::new_err("timeout: expected 0 to 1,000,000,000 seconds, or None"));
        }
        let until = timeout.map(|seconds| Instant::now() + Duration::from_secs_f64(seconds));
        loop {
            py.check_signals()?;
            if self.has_ended(py)? {
                return Ok(true);
            }
            let left = until.map_or(LOOK, |until| until.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return Ok(false);
            }
            py.detach(|| std::thread::sleep(left.min(LOOK)));
        }
    }

    /// Ends the node, waits for it, writes the files of `[output]`, and returns the summary as a dict. Calls after this raise
    /// ClosedError.
    fn stop<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let node = self.node.take(py)?.ok_or_else(|| self.node.closed())?;
        let ended = py.detach(|| {
            node.node.stop();
            node.join()
        });
        let (ended, saved) = ended.map_err(|error| Error::new_err(format!("{error:#}")))?;
        let summary = to_python(py, &ended.summary)?;
        py.detach(|| drop(ended));
        saved.map_err(errors::file)?;
        Ok(summary)
    }

    fn __enter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyAny>) -> PyResult<()> {
        match self.stop(py) {
            Err(error) if error.is_instance_of::<ClosedError>(py) => Ok(()),
            stopped => stopped.map(|_| ()),
        }
    }

    fn __repr__(&self) -> String {
        format!("Node({:?})", self.name)
    }
}

impl Node {
    /// Asks the running node.
    fn ask<R: Send>(
        &self,
        py: Python<'_>,
        ask: impl FnOnce(&flockmap_node::NodeHandle) -> Option<R> + Send,
    ) -> PyResult<R> {
        let answer = self.node.with(py, |node| ask(&node.node))?;
        answer.ok_or_else(|| ClosedError::new_err("this node has ended: stop() gives its summary"))
    }
}
