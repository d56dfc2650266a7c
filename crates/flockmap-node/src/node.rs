//! One robot on a thread of its own, and the handle to it.

use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc as std_mpsc;
use std::thread::JoinHandle;
use std::time::Instant;

use flockmap::{Robot, Stamp};
use flockmap_view::{Source, ViewServer};
use tokio::sync::mpsc;

use crate::command::Command;
use crate::driver::Driver;
use crate::map_output::{MapReaders, Outlet};
use crate::options::NodeOptions;
use crate::recorder::Recorder;
use crate::sensor::{INPUTS_WAITING_MAX, Input, MessageLimits, Sensor, SensorSocket, play, serve};
use crate::store::{Store, StoreError, StoreLog};
use crate::store_writer::StoreWriter;
use crate::web::{NodeSource, serve_counters, serve_view};
use crate::{Clock, ConfigError, NodeStatus, Summary, Transport};

/// Why a node could not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// The robot's options cannot work.
    #[error(transparent)]
    Robot(#[from] flockmap::RobotError),
    /// The store cannot be used.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// An option of the node cannot work.
    #[error(transparent)]
    Option(#[from] ConfigError),
    /// The system refused something.
    #[error("cannot {what}: {error}")]
    System {
        /// What was asked of it.
        what: String,
        /// Its answer.
        error: io::Error,
    },
}

/// A robot at work.
#[derive(Debug)]
pub struct Node;

/// The addresses that the system chose, and where programs of this process find the node.
struct Addresses {
    sensor: Option<String>,
    map: Vec<String>,
    map_readers: Option<MapReaders>,
    prometheus: Option<SocketAddr>,
    view: Option<String>,
    view_source: Option<NodeSource>,
}

impl Node {
    /// Starts a robot on a thread of its own. `make_transport` is called there, within a tokio runtime.
    /// Returns when all sockets are open.
    ///
    /// # Errors
    /// An option that cannot work, or a socket that cannot be opened; nothing is left running.
    pub fn start<T: Transport>(
        options: NodeOptions,
        make_transport: impl FnOnce() -> io::Result<T> + Send + 'static,
    ) -> Result<NodeHandle, StartError> {
        let (name, clock) = (options.name.clone(), options.clock);
        let (commands, commands_in) = mpsc::unbounded_channel();
        let commands_weak = commands.downgrade();
        let (started, start) = std_mpsc::channel();
        let work = move || Self::work(options, make_transport, (commands_weak, commands_in), &started);
        let thread = std::thread::Builder::new().name(format!("node {name}")).spawn(work);
        let thread = thread.map_err(system("start a thread"))?;
        match start.recv() {
            Ok(addresses) => Ok(NodeHandle { name, clock, commands, thread, addresses }),
            Err(std_mpsc::RecvError) => match thread.join() {
                Ok(Err(error)) => Err(error),
                Ok(Ok(_)) => Err(died("ended before it had started")),
                Err(_) => Err(died("panicked")),
            },
        }
    }

    fn work<T: Transport>(
        mut options: NodeOptions,
        make_transport: impl FnOnce() -> io::Result<T>,
        (commands, commands_in): (mpsc::WeakUnboundedSender<Command>, mpsc::UnboundedReceiver<Command>),
        started: &std_mpsc::Sender<Addresses>,
    ) -> Result<Ended, StartError> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(system("start the runtime"))?;
        runtime.block_on(async move {
            let mut robot = Robot::new(options.robot.clone(), options.clock.now())?;
            let transport = make_transport().map_err(system("start the transport"))?;
            let sensor_socket = SensorSocket::open(&options.sensor)
                .await
                .map_err(system(format!("open the sensor socket {}", options.sensor.place())))?;
            let refused = |(what, error): (String, io::Error)| system(what)(error);
            let prometheus = options.prometheus.map(|address| serve_counters(address, commands.clone()));
            let prometheus = prometheus.transpose().map_err(refused)?;
            if options.record.is_some() {
                // The recorder is a reader too.
                options.map_output.get_or_insert_default().readers_max += 1;
            }
            let mut outlet = None;
            if let Some(output) = options.map_output.take() {
                let identity = (options.name.clone(), options.robot.id, options.robot.mapper.resolution);
                let beside = options.counters_beside.clone();
                let started = Outlet::start(output, identity, beside, commands.clone(), options.log.clone());
                outlet = Some(
                    started
                        .map_err(|(place, error)| system(format!("give the map out at {place}"))(error))?,
                );
            }
            let view_source = outlet.as_ref().map(|outlet| NodeSource {
                robot: options.robot.id,
                name: options.name.clone(),
                readers: outlet.map_readers(),
                series: outlet.series(),
            });
            let view = options.view.take().zip(view_source.clone());
            let view = view.map(|(view, source)| serve_view(view, source, commands.clone()));
            let view = view.transpose().map_err(refused)?;
            let mut recorder = None;
            if let Some((recording, outlet)) = options.record.take().zip(outlet.as_ref()) {
                let started = Recorder::start(
                    &recording,
                    &options.name,
                    options.clock,
                    outlet.map_readers(),
                    options.log.clone(),
                );
                recorder = Some(started.map_err(system("record the flight"))?);
            }
            // After all else that can stop the start: each leaves a segment.
            set_all(&mut robot, &options);
            let store = options.store.take();
            let store = store.map(|store| restore(store, &mut robot, &options)).transpose()?;
            let epoch_file = options.epoch_file.take();
            let store = (store.is_some() || epoch_file.is_some())
                .then(|| StoreWriter::start(store, epoch_file, options.log.clone()));
            let addresses = Addresses {
                sensor: sensor_socket.as_ref().map(|(socket, _)| socket.address()),
                map_readers: outlet.as_ref().map(Outlet::map_readers),
                map: outlet.as_ref().map(|outlet| outlet.addresses().to_vec()).unwrap_or_default(),
                prometheus: prometheus.as_ref().map(ViewServer::address),
                view: view.as_ref().map(ViewServer::url),
                view_source,
            };

            let (inputs, inputs_in) = mpsc::channel(INPUTS_WAITING_MAX);
            let sensor = std::mem::replace(&mut options.sensor, Sensor::None);
            start_sensor(sensor, sensor_socket, options.clock, inputs)?;
            let driver =
                Driver::new(options, (robot, store), (outlet, recorder), transport, inputs_in, commands_in);
            // The caller waits for this.
            let _ = started.send(addresses);
            let (robot, status) = driver.drive().await;
            // Readers have been told the end by now.
            drop((prometheus, view));
            Ok(Ended { summary: Summary::new(&robot, &status), robot, status })
        })
    }
}

/// Tells the robot what the options say of others. Before it is given anything of theirs, so that all of it comes to lie
/// where it belongs at once.
fn set_all(robot: &mut Robot, options: &NodeOptions) {
    for (origin, pose) in &options.alignments {
        if let Err(error) = robot.set_alignment(*origin, pose) {
            options.log.warn(format!("no alignment of {origin:?}: {error}"));
        }
    }
    for (origin, micros) in &options.clock_offsets {
        robot.set_clock_offset(*origin, Some(*micros));
    }
    for origin in &options.muted {
        robot.set_muted(*origin, true);
    }
}

/// Gives the robot what a store has, and says what that was.
fn restore(mut store: Store, robot: &mut Robot, options: &NodeOptions) -> Result<StoreLog, StartError> {
    let began = Instant::now();
    let restored = store.restore(robot, options.clock.now());
    let log = &options.log;
    let store = store.start(options.robot.epoch)?;
    if restored.packages > 0 {
        log.info(format!(
            "store: {} packages of former runs read, {} merged, in {:.2} s",
            restored.packages,
            restored.merged,
            began.elapsed().as_secs_f64()
        ));
    }
    if restored.torn_bytes > 0 {
        log.warn(format!(
            "store: the last run ended while it was writing: {} bytes that were half written are cut off",
            restored.torn_bytes
        ));
    }
    if restored.skipped_bytes > 0 || restored.unreadable > 0 || restored.damaged_segments > 0 {
        log.warn(format!(
            "store: {} damaged bytes, {} records of another version and {} damaged segments are left out; what they said is asked for",
            restored.skipped_bytes, restored.unreadable, restored.damaged_segments
        ));
    }
    Ok(store)
}

fn start_sensor(
    sensor: Sensor,
    socket: Option<(SensorSocket, MessageLimits)>,
    clock: Clock,
    inputs: mpsc::Sender<Input>,
) -> Result<(), StartError> {
    if let Some((socket, limits)) = socket {
        tokio::spawn(serve(socket, limits, clock, inputs));
        return Ok(());
    }
    match sensor {
        Sensor::Play { frames, submaps, speed, skip, begin } => {
            let speed = crate::config::speed("speed", speed)?;
            std::thread::Builder::new()
                .name("sensor".into())
                .spawn(move || play((frames, submaps), speed, skip, begin, &clock, &inputs))
                .map_err(system("start a thread"))?;
        }
        Sensor::Channel(mut frames) => {
            tokio::spawn(async move {
                while let Some(frame) = frames.recv().await {
                    if inputs.send(Input::Frame(frame)).await.is_err() {
                        return;
                    }
                }
            });
        }
        Sensor::None | Sensor::Tcp(..) | Sensor::Unix { .. } => {}
    }
    Ok(())
}

fn system(what: impl Into<String>) -> impl FnOnce(io::Error) -> StartError {
    move |error| StartError::System { what: what.into(), error }
}

fn died(how: &str) -> StartError {
    system("run the node")(io::Error::other(format!("its thread {how}")))
}

/// What is left of a node that has ended.
pub struct Ended {
    /// The robot, with its maps, as it was at the end.
    pub robot: Robot,
    /// The last counters.
    pub status: NodeStatus,
    /// The same as a plain summary, for reports.
    pub summary: Summary,
}

impl fmt::Debug for Ended {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ended").field("summary", &self.summary).finish_non_exhaustive()
    }
}

/// The handle to a running node. Dropping it stops the node.
pub struct NodeHandle {
    name: String,
    clock: Clock,
    commands: mpsc::UnboundedSender<Command>,
    thread: JoinHandle<Result<Ended, StartError>>,
    addresses: Addresses,
}

impl fmt::Debug for NodeHandle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("NodeHandle").field("name", &self.name).finish_non_exhaustive()
    }
}

impl NodeHandle {
    /// The name of the robot.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The clock of the node.
    pub const fn clock(&self) -> Clock {
        self.clock
    }

    /// Where sensor programs connect, if the node has such a socket.
    pub fn sensor_address(&self) -> Option<&str> {
        self.addresses.sensor.as_deref()
    }

    /// Where planners read the map: as `flockmap mirror` takes it.
    pub fn map_addresses(&self) -> &[String] {
        &self.addresses.map
    }

    /// Where readers of this process connect to the map, if the node has
    /// [`NodeOptions::map_output`](crate::NodeOptions::map_output).
    pub const fn map_readers(&self) -> Option<&MapReaders> {
        self.addresses.map_readers.as_ref()
    }

    /// What to open in a browser to see the map, if it is shown.
    pub fn view_url(&self) -> Option<&str> {
        self.addresses.view.as_deref()
    }

    /// The map for a view that shows several robots, if the node has
    /// [`NodeOptions::map_output`](crate::NodeOptions::map_output).
    pub fn view_source(&self) -> Option<Arc<dyn Source>> {
        let source = self.addresses.view_source.clone()?;
        Some(Arc::new(source))
    }

    /// Where counters are served, if they are.
    pub const fn prometheus_address(&self) -> Option<SocketAddr> {
        self.addresses.prometheus
    }

    /// Runs a function on the robot, between two steps of the node, and waits for the result: read maps, set
    /// alignments, close a batch. What it causes to be sent goes out after it. `None` if the node has ended.
    pub fn with_robot<R: Send + 'static>(
        &self,
        function: impl FnOnce(&mut Robot, Stamp) -> R + Send + 'static,
    ) -> Option<R> {
        let (answer, result) = std_mpsc::channel();
        let run = Box::new(move |robot: &mut Robot, now: Stamp| {
            // Nobody waits any more if this fails.
            let _ = answer.send(function(robot, now));
        });
        self.commands.send(Command::Robot(run)).ok()?;
        result.recv().ok()
    }

    /// The counters now. `None` if the node has ended.
    pub fn status(&self) -> Option<NodeStatus> {
        let (answer, result) = std_mpsc::channel();
        let send = Box::new(move |status| drop(answer.send(status)));
        self.commands.send(Command::Status(send)).ok()?;
        result.recv().ok()
    }

    /// Asks the node to end: it closes its batch, sends what is left, and lingers a moment. Asked again, it
    /// ends at once.
    pub fn stop(&self) {
        // Ended already is as good.
        let _ = self.commands.send(Command::Stop);
    }

    /// Whether the node has ended.
    pub fn has_ended(&self) -> bool {
        self.thread.is_finished()
    }

    /// Waits until the node has ended, without stopping it.
    pub async fn ended(&self) {
        self.commands.closed().await;
    }

    /// Waits until the node has ended, without stopping it, and returns what is left of it.
    ///
    /// # Errors
    /// If the thread of the node panicked.
    pub fn join(self) -> Result<Ended, StartError> {
        let Self { commands, thread, .. } = self;
        let result = thread.join();
        drop(commands);
        result.unwrap_or_else(|_| Err(died("panicked")))
    }
}
