//! The loop of a node: what comes in goes to the robot, what the robot has to send goes out.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use flockmap::{Event, Path, Robot, Stamp, Stream, SubmapError, SubmapId};
use tokio::sync::mpsc::{Receiver, UnboundedReceiver};

use crate::alone::Alone;
use crate::clock::StepWatch;
use crate::command::Command;
use crate::map_output::Outlet;
use crate::options::{NodeOptions, Observation};
use crate::recorder::Recorder;
use crate::sensor::Input;
use crate::status::{StatusLine, histogram};
use crate::store_writer::StoreWriter;
use crate::transport::is_unreachable;
use crate::warnings::Warnings;
use crate::{Histogram, Level, NodeCounters, NodeStatus, Timings, Transport};

/// Room for a datagram; a longer one is cut and then refused by its length.
const BUFFER_BYTES: usize = 2_048;

/// After an error of the socket.
const ERROR_PAUSE: Duration = Duration::from_millis(1);

/// A frame that is played later than this counts as late.
const LATE_MICROS: i64 = 100_000;

pub(crate) struct Driver<T> {
    options: NodeOptions,
    robot: Robot,
    store: Option<StoreWriter>,
    outlet: Option<Outlet>,
    recorder: Option<Recorder>,
    /// The highest epoch that was on disk at the start or was given to the store since.
    epoch_kept: u64,
    transport: T,
    /// The paths that the transport has.
    paths: Vec<Path>,
    inputs: Receiver<Input>,
    commands: UnboundedReceiver<Command>,
    /// No input will come any more. Never so with a sensor socket.
    inputs_ended: bool,
    stopped: bool,
    began: Instant,
    /// When something new came or went last.
    active: Instant,
    status_due: Instant,
    line: StatusLine,
    clock_steps: StepWatch,
    warnings: Warnings,
    /// Whether it was said that the own layer, and those of others, are full.
    said_full: [bool; 2],
    alone: Alone,
    counters: NodeCounters,
    timings: Timings,
    recent_age: Histogram,
}

impl<T: Transport> Driver<T> {
    pub(crate) fn new(
        options: NodeOptions,
        (robot, store): (Robot, Option<StoreWriter>),
        (outlet, recorder): (Option<Outlet>, Option<Recorder>),
        transport: T,
        inputs: Receiver<Input>,
        commands: UnboundedReceiver<Command>,
    ) -> Self {
        let now = Instant::now();
        let clock_steps = StepWatch::new(options.clock);
        // A rate needs some time to be one.
        let status_due = later(now, options.status_period.unwrap_or_default());
        Self {
            epoch_kept: robot.own_stream().epoch,
            options,
            robot,
            store,
            outlet,
            recorder,
            transport,
            paths: Vec::new(),
            inputs,
            commands,
            inputs_ended: false,
            stopped: false,
            began: now,
            active: now,
            status_due,
            line: StatusLine::default(),
            clock_steps,
            warnings: Warnings::default(),
            said_full: [false; 2],
            alone: Alone::new(now, T::HEARS_OTHERS),
            counters: NodeCounters::default(),
            timings: Timings::default(),
            recent_age: histogram(),
        }
    }

    /// Runs until the end; returns the robot and the last counters.
    pub(crate) async fn drive(mut self) -> (Robot, NodeStatus) {
        let mut buffer = vec![0; BUFFER_BYTES];
        while !self.is_over() {
            self.step(&mut buffer, None).await;
        }
        // The last changes go out, and what is lost of them is repaired, for a moment.
        self.inputs.close();
        self.flush();
        self.stopped = false;
        let until = later(Instant::now(), self.options.end.linger);
        self.pump().await;
        while Instant::now() < until && !self.stopped && !self.is_confirmed() {
            self.step(&mut buffer, Some(until)).await;
        }
        self.pump().await;
        if let Some(store) = &self.store {
            store.flush();
        }
        self.offer_map(true);
        if let Some(outlet) = &mut self.outlet {
            outlet.end();
        }
        if let Some(recorder) = &mut self.recorder {
            recorder.note_submaps(self.options.clock.now(), &self.robot);
            recorder.end();
        }
        self.say_status();
        match self.warnings.take_left_out() {
            0 => {}
            count => self.options.log.info(format!("{count} more warnings were not said one by one")),
        }
        let status = self.status();
        (self.robot, status)
    }

    /// Sends what is to be sent, then waits for one thing to happen and does it.
    async fn step(&mut self, buffer: &mut [u8], until: Option<Instant>) {
        self.pump().await;
        let wake = self.wake(until);
        let Self { transport, inputs, commands, inputs_ended, .. } = self;
        tokio::select! {
            received = transport.receive(buffer) => match received {
                Ok((length, path)) => self.take_datagram(path, &buffer[..length]),
                Err(error) => self.take_receive_error(&error).await,
            },
            input = inputs.recv(), if !*inputs_ended => match input {
                Some(input) => self.take_input(input),
                None => self.end_inputs(),
            },
            command = commands.recv() => match command {
                Some(Command::Robot(function)) => function(&mut self.robot, self.options.clock.now()),
                Some(Command::Status(answer)) => answer(self.status()),
                Some(Command::Stop) | None => self.stopped = true,
            },
            () = tokio::time::sleep_until(wake.into()) => {}
        }
    }

    /// Lets time pass for the robot, reports its events, and sends all it has to send.
    async fn pump(&mut self) {
        // Before anything else: what has just been merged is wanted soon.
        self.offer_map(false);
        let clock = self.options.clock;
        let now = clock.now();
        if self.robot.poll_timeout().is_some_and(|due| due <= now) {
            self.close_batches(now, Robot::handle_timeout);
        }
        self.send_paths();
        loop {
            let now = clock.now();
            let Some(transmit) = self.robot.poll_transmit(now) else { break };
            let sent = self.transport.send(&transmit).await;
            self.counters.datagrams_out += u64::from(sent.copies);
            self.counters.bytes_out += u64::from(sent.copies) * transmit.bytes.len() as u64;
            self.counters.send_failed += u64::from(sent.failed);
        }
        self.take_events(clock.now(), |_, _| {});
        if let Some(store) = &self.store {
            store.step(&self.robot);
        }
        if let Some(step) = self.clock_steps.poll() {
            self.counters.clock_steps += 1;
            self.options.log.warn(step);
        }
        let is_heard = self.robot.session().peers().next().is_some();
        if let Some(text) = self.alone.poll(Instant::now(), is_heard, &self.counters) {
            self.options.log.warn(text);
        }
        if let Some(period) = self.options.status_period
            && Instant::now() >= self.status_due
        {
            self.status_due = later(Instant::now(), period);
            self.say_status();
        }
    }

    /// Gives the map to its readers, if there are any and it is time, or at once.
    fn offer_map(&mut self, at_once: bool) {
        let counters = self.node_counters();
        let Self { outlet: Some(outlet), robot, options, .. } = self else { return };
        let now = options.clock.now();
        outlet.note_traffic(now, &counters);
        outlet.offer(robot, now, at_once, || crate::status::counters_of(&counters, robot));
    }

    /// Gives the transport the paths on which robots are reached, if they have changed. Before it receives
    /// again: it does not forget those.
    fn send_paths(&mut self) {
        let paths = || self.robot.session().paths().map(|(_, path)| path);
        if !paths().eq(self.paths.iter().copied()) {
            self.paths = paths().collect();
            self.transport.set_paths(&self.paths);
        }
    }

    /// Closes the batch with what has changed.
    fn flush(&mut self) {
        self.close_batches(self.options.clock.now(), Robot::flush);
    }

    fn close_batches(&mut self, now: Stamp, close: impl FnOnce(&mut Robot, Stamp)) {
        let began = Instant::now();
        close(&mut self.robot, now);
        let took = micros(began.elapsed());
        self.take_events(now, |timings, event| {
            if let Event::BatchClosed { .. } = event {
                timings.pack.saturating_record(took);
            }
        });
    }

    fn take_datagram(&mut self, path: Path, bytes: &[u8]) {
        self.counters.datagrams_in += 1;
        self.counters.bytes_in += bytes.len() as u64;
        let now = self.options.clock.now();
        let began = Instant::now();
        let result = self.robot.handle_datagram_from(now, path, bytes);
        let took = micros(began.elapsed());
        self.take_events(now, |timings, event| {
            if let Event::Merged { .. } = event {
                timings.receive_to_insert.saturating_record(took);
            }
        });
        if let Err(error) = result {
            self.counters.datagrams_refused += 1;
            self.warn(&error.to_string());
        }
    }

    async fn take_receive_error(&mut self, error: &std::io::Error) {
        if is_unreachable(error) {
            self.counters.unreachable += 1;
        } else {
            self.counters.receive_errors += 1;
            self.warn(&format!("cannot receive: {error}"));
            // A socket that keeps failing must not keep the machine busy.
            tokio::time::sleep(ERROR_PAUSE).await;
        }
    }

    fn take_input(&mut self, input: Input) {
        let now = self.options.clock.now();
        match input {
            Input::Frame(frame) => {
                self.active = Instant::now();
                self.counters.frames += 1;
                self.counters.points_dropped += frame.points_dropped;
                self.counters.frames_late += u64::from(now.micros_since(frame.scan.stamp) > LATE_MICROS);
                let began = Instant::now();
                let report = match self.robot.insert_scan(now, &frame.scan, &frame.t_map_sensor) {
                    Ok(report) => report,
                    Err(error) => return self.take_fault(format!("scan left out: {error}")),
                };
                self.timings.insert_scan.saturating_record(micros(began.elapsed()));
                if let Some(outlet) = &mut self.outlet {
                    outlet.note_scan(&frame.scan, &frame.t_map_sensor);
                }
                if let Some(observer) = &mut self.options.observer {
                    observer(now, &self.robot, Observation::Scan { scan: &frame.scan, report: &report });
                }
                if let Some(recorder) = &mut self.recorder {
                    recorder.note_submaps(frame.scan.stamp, &self.robot);
                    recorder.note_scan(frame);
                }
            }
            Input::States(states) => {
                self.active = Instant::now();
                self.counters.states += 1;
                let began = Instant::now();
                let report = match self.robot.insert_states(now, &states.update()) {
                    Ok(report) => report,
                    Err(error) => return self.take_fault(format!("states left out: {error}")),
                };
                self.timings.insert_states.saturating_record(micros(began.elapsed()));
                if let Some(observer) = &mut self.options.observer {
                    observer(now, &self.robot, Observation::States { report: &report });
                }
            }
            Input::Alignment(robot, pose) => {
                if let Err(error) = self.robot.set_alignment(robot, &pose) {
                    self.take_fault(format!("the alignment of {robot:?} stays as it was: {error}"));
                }
            }
            Input::Teammate(robot, position) => {
                if let Err(error) = self.robot.set_teammate(robot, position, now) {
                    self.take_fault(format!("where {robot:?} is was left out: {error}"));
                }
            }
            Input::BeginSubmap => {
                if let Err(error) = self.robot.begin_submap(now) {
                    self.take_fault(format!("no submap was begun: {error}"));
                }
            }
            Input::SubmapPose(number, pose) => {
                let newest = self.robot.submap();
                let submap = number.map_or(Some(newest), SubmapId::new);
                let moved = match submap {
                    Some(submap) => self.robot.set_submap_pose(now, submap, &pose),
                    None => Err(SubmapError::NotBegun {
                        wanted: number.unwrap_or_default(),
                        newest: newest.number(),
                    }),
                };
                if let Err(error) = moved {
                    self.take_fault(format!("the submap stays where it was: {error}"));
                }
            }
            Input::Fault(text) => self.take_fault(text),
            Input::Yielded(text) => {
                self.counters.sensor_yielded += 1;
                self.options.log.warn(text);
            }
            Input::Note(text) if text.is_empty() => {}
            Input::Note(text) => self.options.log.info(text),
        }
    }

    /// Counts something of the sensor that cannot be used, and says so.
    fn take_fault(&mut self, text: String) {
        self.counters.sensor_faults += 1;
        self.warn(&text);
    }

    fn end_inputs(&mut self) {
        self.inputs_ended = true;
        if self.counters.frames > 0 {
            self.flush();
            self.options.log.info(format!("sensor ended after {} scans", self.counters.frames));
        }
    }

    /// Reports the events of the robot to store, observer and log.
    fn take_events(&mut self, now: Stamp, mut time: impl FnMut(&mut Timings, &Event)) {
        while let Some(event) = self.robot.poll_event() {
            time(&mut self.timings, &event);
            match &event {
                Event::RunBegun(run) => self.keep_run(run.epoch),
                // Of many events the oldest are dropped.
                Event::BatchClosed { batch, .. } => self.keep_run(batch.stream.epoch),
                _ => {}
            }
            if let Some(store) = &self.store {
                store.note(&event);
            }
            if let Some(observer) = &mut self.options.observer {
                observer(now, &self.robot, Observation::Event(&event));
            }
            match event {
                Event::BatchClosed { .. } => self.active = Instant::now(),
                Event::Merged { stream, batch_end, changes, .. } => {
                    self.active = Instant::now();
                    // A chunk of a snapshot has many stamps.
                    if let Some(offset) = self.robot.session().clock_offset_micros(stream)
                        && !changes.is_empty()
                    {
                        let age = now.micros_since(batch_end).saturating_add(offset).max(0).unsigned_abs();
                        self.timings.age.saturating_record(age);
                        self.recent_age.saturating_record(age);
                    }
                }
                Event::Refused { stream, index, reason } => {
                    self.warn(&format!("package {index} of {stream:?} refused: {reason}"));
                }
                Event::CaughtUp { stream, upto } => {
                    self.active = Instant::now();
                    self.options.log.info(format!("caught up with {stream:?} up to package {upto}"));
                }
                Event::PeerSeen(stream) => self.options.log.info(format!("hears {stream:?}")),
                Event::PeerLost(stream) => self.options.log.info(format!("hears {stream:?} no more")),
                Event::RunBegun(run) => {
                    self.options.log.warn(format!(
                        "a run of this robot with a higher epoch than its own was heard of, from a time when its clock was ahead, or of another robot with the same id: \
                         it goes on as {run:?}, with all that it had published"
                    ));
                }
                Event::RunForgotten(run) => {
                    self.warn(&format!("the map of {run:?}, which has ended, is dropped for a newer one: raise streams_max or epochs_max to keep more"));
                }
                Event::Dropped { stream, .. } => self.say_full(stream),
                Event::Complete { stream } => {
                    self.options.log.info(format!("nothing of {stream:?} is lacking any more"));
                }
                Event::SameIdentity => {
                    self.warn("another robot uses the id of this one; give one of them another");
                }
                Event::NoncesExhausted => {
                    let text = "this run has sent all that can be sealed: nothing more goes out; start again";
                    self.options.log.error(text);
                }
                Event::EncodeFailed(error) => {
                    self.options.log.error(format!("own changes are lost to the others: {error}"));
                }
                _ => {}
            }
        }
    }

    /// Says once that layers are full.
    fn say_full(&mut self, stream: Stream) {
        let is_own = stream == self.robot.own_stream();
        if std::mem::replace(&mut self.said_full[usize::from(is_own)], true) {
            return;
        }
        let text = if is_own {
            "the own layer is full: what is farthest away and oldest is dropped from it for what is new. The own map \
             keeps it, but who joins late gets it only from team-mates. Raise own_layer_mb to keep more"
                .to_owned()
        } else {
            format!(
                "the layers of others are full: what is farthest away and oldest is dropped for what is new, first of \
                 {stream:?}. It is asked for again when there is room. Raise layers_mb to keep more"
            )
        };
        self.options.log.warn(text);
    }

    /// Keeps the run that was begun while flying, at the first event of it.
    fn keep_run(&mut self, epoch: u64) {
        if epoch > self.epoch_kept {
            self.epoch_kept = self.robot.own_stream().epoch;
            if let Some(store) = &mut self.store {
                store.note_run(&self.robot);
            }
        }
    }

    /// Says a warning, unless it or another one was said a moment ago.
    fn warn(&mut self, text: &str) {
        if let Some(text) = self.warnings.take(Instant::now(), text) {
            self.options.log.warn(text);
        }
    }

    fn wake(&self, until: Option<Instant>) -> Instant {
        let now = Instant::now();
        let robot = self.robot.poll_timeout().map(|due| self.options.clock.instant_of(due));
        let status = self.options.status_period.map(|_| self.status_due);
        let idle = now + Duration::from_secs(60);
        let alone = self.alone.poll_timeout();
        let outlet = self.outlet.as_ref().and_then(Outlet::poll_timeout);
        [robot, status, until, alone, outlet]
            .into_iter()
            .flatten()
            .chain(self.ends())
            .fold(idle, Instant::min)
    }

    /// When it ends by itself, as far as is known.
    fn ends(&self) -> impl Iterator<Item = Instant> {
        let after = self.options.end.after.map(|after| later(self.began, after));
        let quiet = self.options.end.when_quiet.filter(|_| self.inputs_ended);
        after.into_iter().chain(quiet.map(|quiet| later(self.active, quiet)))
    }

    fn is_over(&self) -> bool {
        let now = Instant::now();
        self.stopped || self.ends().any(|end| now >= end)
    }

    /// Whether every peer has confirmed all that was published, and what was relayed to it. That nothing is in
    /// flight is not enough: what counts as lost is not, until it is sent again.
    fn is_confirmed(&self) -> bool {
        let session = self.robot.session();
        let newest = session.store().newest_known(session.own());
        let satisfied = session.own_received_by_peers().filter(|(_, _, upto)| *upto >= newest).count();
        let is_all_out = !self.robot.is_republishing();
        is_all_out && satisfied == session.peers().count() && session.peers().all(|peer| peer.in_flight == 0)
    }

    /// The counters, with those of the threads.
    fn node_counters(&self) -> NodeCounters {
        let counters = self.outlet.as_ref().map_or(self.counters, |outlet| outlet.counters(self.counters));
        self.recorder.as_ref().map_or(counters, |recorder| recorder.counters(counters))
    }

    fn say_status(&mut self) {
        if self.options.status_period.is_some() {
            let age = std::mem::replace(&mut self.recent_age, histogram());
            let line = self.line.next(&self.status(), &age);
            self.options.log.say(Level::Status, line);
        }
    }

    fn status(&self) -> NodeStatus {
        NodeStatus {
            uptime: self.began.elapsed(),
            quiet_for: self.active.elapsed(),
            sensor_ended: self.inputs_ended,
            node: self.node_counters(),
            map_readers: self.outlet.as_ref().map_or(0, Outlet::readers),
            store: self.store.as_ref().map(StoreWriter::counters).unwrap_or_default(),
            beside: counted(&self.options.counters_beside),
            ..NodeStatus::new(&self.options.name, &self.robot, &self.timings)
        }
    }
}

fn counted(counters: &[(&'static str, Arc<AtomicU64>)]) -> BTreeMap<String, u64> {
    counters.iter().map(|(name, counter)| ((*name).to_owned(), counter.load(Ordering::Relaxed))).collect()
}

/// What is farther than years counts as that.
fn later(instant: Instant, by: Duration) -> Instant {
    instant + by.min(Duration::from_secs(1 << 30))
}

fn micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}
