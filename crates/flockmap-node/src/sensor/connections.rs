//! The programs that are connected, and who may be: silence keeps nobody out.

use std::future::Future;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Result, bail};
use flockmap::Stamp;
use tokio::io::{AsyncBufRead, AsyncBufReadExt, AsyncRead, AsyncReadExt, BufReader};
use tokio::sync::mpsc::Sender;
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{Instant, sleep, sleep_until, timeout};

use super::{Input, MessageError, MessageLimits, SensorMessage, StatesMessage};
use crate::Clock;

/// Programs that may be connected at once. Worst case held: the longest message for each.
const CONNECTIONS_MAX: usize = 8;

/// A connection must have sent nothing for so long to be closed for another program.
const SILENT_MIN: Duration = Duration::from_secs(5);

/// A program that finds all places taken is given so long for its first byte. One that only looked whether
/// somebody listens is gone by then, and nobody is closed for it.
const FIRST_ANSWER_MAX: Duration = Duration::from_secs(1);

/// After a connection could not be accepted.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// Where connections come from.
pub(crate) trait Listener: Send {
    type Stream: AsyncRead + Send + Unpin + 'static;

    fn accept(&mut self) -> impl Future<Output = io::Result<Self::Stream>> + Send;
}

/// Takes connections until nobody listens to `to` any more, which `None` says.
pub(crate) async fn serve(
    mut listener: impl Listener,
    limits: MessageLimits,
    clock: Clock,
    to: Sender<Input>,
) -> Option<()> {
    let mut places = Places::default();
    let mut count = 0u64;
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = to.closed() => return None,
        };
        let stream = match accepted {
            Ok(stream) => stream,
            Err(error) => {
                let fault = format!("sensor socket: cannot accept a connection: {error}");
                to.send(Input::Fault(fault)).await.ok()?;
                sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        count += 1;
        let name = format!("sensor connection {count}");
        let mut stream = BufReader::new(stream);
        if places.are_taken() && is_gone(&mut stream).await {
            continue;
        }
        places.make_room(&name, &to).await?;
        let silence = Silence::default();
        places.give(Reader { stream, silence, limits, clock, name }, to.clone());
    }
}

/// Whether a connection ends before its first byte.
async fn is_gone(stream: &mut (impl AsyncBufRead + Unpin)) -> bool {
    matches!(timeout(FIRST_ANSWER_MAX, stream.fill_buf()).await, Ok(Ok([]) | Err(_)))
}

/// The connections that are served.
#[derive(Default)]
struct Places {
    taken: Vec<Place>,
    tasks: JoinSet<()>,
}

struct Place {
    name: String,
    silence: Silence,
    task: AbortHandle,
}

impl Places {
    fn are_taken(&mut self) -> bool {
        while self.tasks.try_join_next().is_some() {}
        self.taken.retain(|place| !place.task.is_finished());
        self.taken.len() >= CONNECTIONS_MAX
    }

    /// Waits for a place: that a connection ends, or that one has been silent for long, which is closed then.
    /// `None`: the node has ended.
    async fn make_room(&mut self, name: &str, to: &Sender<Input>) -> Option<()> {
        let mut waits = false;
        while self.are_taken() {
            let silent = self.taken.iter().enumerate().filter_map(|(k, p)| Some((p.silence.since()?, k)));
            let longest = silent.min();
            let now = Instant::now();
            if let Some((since, k)) = longest
                && now >= since + SILENT_MIN
            {
                let place = self.taken.swap_remove(k);
                place.task.abort();
                let seconds = (now - since).as_secs();
                let text = format!(
                    "{} closed: all {CONNECTIONS_MAX} places were taken, it had said nothing for {seconds} s, and {name} wants in",
                    place.name
                );
                return to.send(Input::Yielded(text)).await.ok();
            }
            if !std::mem::replace(&mut waits, true) {
                let text = format!(
                    "{name} waits: all {CONNECTIONS_MAX} places are taken by programs that spoke in the last {} s",
                    SILENT_MIN.as_secs()
                );
                to.send(Input::Note(text)).await.ok()?;
                continue;
            }
            let due = longest.map_or(now, |(since, _)| since) + SILENT_MIN;
            tokio::select! {
                _ = self.tasks.join_next() => {}
                () = sleep_until(due) => {}
                () = to.closed() => return None,
            }
        }
        Some(())
    }

    fn give(&mut self, reader: Reader<impl AsyncRead + Send + Unpin + 'static>, to: Sender<Input>) {
        let (name, silence) = (reader.name.clone(), reader.silence.clone());
        silence.begin();
        let task = self.tasks.spawn(async move {
            let end = reader.read_messages(&to).await;
            // If this fails, the node has ended.
            let _ = to.send(end).await;
        });
        self.taken.push(Place { name, silence, task });
    }
}

/// Since when a program has said nothing; `None` while it is the node that is waited for.
#[derive(Clone, Default)]
struct Silence(Arc<Mutex<Option<Instant>>>);

impl Silence {
    fn begin(&self) {
        self.set(Some(Instant::now()));
    }

    fn since(&self) -> Option<Instant> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set(&self, since: Option<Instant>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = since;
    }
}

/// One connection.
struct Reader<S> {
    stream: S,
    silence: Silence,
    limits: MessageLimits,
    clock: Clock,
    name: String,
}

impl<S: AsyncRead + Unpin> Reader<S> {
    /// Reads messages until the connection ends; returns what there is to say about the end.
    async fn read_messages(mut self, to: &Sender<Input>) -> Input {
        let name = self.name.clone();
        let mut count = 0u64;
        loop {
            self.silence.begin();
            let bytes = self.read_message().await;
            self.silence.set(None);
            let bytes = match bytes {
                Ok(Some(bytes)) => bytes,
                Ok(None) => return Input::Note(format!("{name} ended after {count} messages")),
                Err(error) => return Input::Fault(format!("{name} closed: message {}: {error}", count + 1)),
            };
            count += 1;
            let input = match SensorMessage::parse(&bytes, &self.limits) {
                Err(error) => return Input::Fault(format!("{name} closed: message {count}: {error}")),
                Ok(SensorMessage::Alignment(robot, pose)) => Input::Alignment(robot, pose),
                Ok(SensorMessage::Teammate(robot, position)) => Input::Teammate(robot, position),
                Ok(SensorMessage::BeginSubmap) => Input::BeginSubmap,
                Ok(SensorMessage::SubmapPose(submap, pose)) => Input::SubmapPose(submap, pose),
                Ok(SensorMessage::Scan(mut frame)) => {
                    let stamp = self.on_the_node_s_clock(frame.scan.stamp, count);
                    stamp.map_or_else(Input::Fault, |stamp| {
                        frame.scan.stamp = stamp;
                        Input::Frame(frame)
                    })
                }
                Ok(SensorMessage::States(states)) => {
                    let stamp = self.on_the_node_s_clock(states.stamp, count);
                    stamp.map_or_else(Input::Fault, |stamp| Input::States(StatesMessage { stamp, ..states }))
                }
            };
            if to.send(input).await.is_err() {
                return Input::Note(String::new());
            }
        }
    }

    /// A stamp of the system clock shows how old a scan is now, and that holds on every clock. A scan from
    /// the future, within what is allowed, is of now. An error says that message `count` is dropped, and why.
    fn on_the_node_s_clock(&self, stamp: Stamp, count: u64) -> Result<Stamp, String> {
        let (now, system_now) = self.clock.now_and_system_now();
        if stamp == Stamp(0) {
            return Ok(now);
        }
        let off = stamp.micros_since(system_now);
        if off.unsigned_abs() > self.limits.stamp_error_max_micros.unsigned_abs() {
            return Err(format!(
                "{}: message {count} dropped: its stamp is off the system clock of this machine by {:.3} s, expected \
                 microseconds since 1970 within {:.3} s, or 0 for now",
                self.name,
                off as f64 / 1e6,
                self.limits.stamp_error_max_micros as f64 / 1e6
            ));
        }
        Ok(now.plus_micros(off.min(0)))
    }

    /// What follows the next length, or `None` at the end. Grows with what arrives, up to the longest message.
    async fn read_message(&mut self) -> Result<Option<Vec<u8>>> {
        let head = self.read_up_to(4).await?;
        let length = match head.first_chunk::<4>() {
            None if head.is_empty() => return Ok(None),
            None => bail!(MessageError::Truncated { got: head.len(), expected: 4 }),
            Some(length) => u32::from_le_bytes(*length) as usize,
        };
        if length > self.limits.bytes_max() {
            bail!(MessageError::Length { got: length as u64, max: self.limits.bytes_max() });
        }
        let bytes = self.read_up_to(length).await?;
        if bytes.len() < length {
            bail!(MessageError::Truncated { got: bytes.len(), expected: length });
        }
        Ok(Some(bytes))
    }

    /// So many bytes, or fewer at the end.
    async fn read_up_to(&mut self, length: usize) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        while bytes.len() < length {
            let rest = length - bytes.len();
            // Room for as much as has come, so that a length without content takes no memory.
            bytes.reserve_exact(rest.min(bytes.len().max(1_024)));
            let mut stream = (&mut self.stream).take(rest as u64);
            if stream.read_buf(&mut bytes).await? == 0 {
                break;
            }
            self.silence.begin();
        }
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicI64, Ordering};
    use std::time::{SystemTime, UNIX_EPOCH};

    use flockmap::{Pose, RobotId, Scan};
    use flockmap_io::Frame;
    use tokio::io::{AsyncWriteExt, DuplexStream, duplex};
    use tokio::sync::mpsc::{Receiver, UnboundedReceiver, UnboundedSender, channel, unbounded_channel};

    const LIMITS: MessageLimits = MessageLimits {
        scan_points_max: 100,
        states_max: 100,
        box_states_max: 100,
        stamp_error_max_micros: 10_000_000,
    };

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build().unwrap()
    }

    /// What a node with this clock gets of these bytes, the end of the connection last.
    fn inputs_on(clock: Clock, bytes: &[u8]) -> Vec<Input> {
        let (to, mut from) = channel(100);
        runtime().block_on(async {
            let (name, silence) = ("sensor".to_owned(), Silence::default());
            let end = Reader { stream: bytes, silence, limits: LIMITS, clock, name }.read_messages(&to).await;
            drop(to);
            let mut inputs = Vec::new();
            while let Some(input) = from.recv().await {
                inputs.push(input);
            }
            inputs.push(end);
            inputs
        })
    }

    fn inputs_of(bytes: &[u8]) -> Vec<Input> {
        inputs_on(Clock::new(), bytes)
    }

    fn scan(stamp: Stamp) -> Vec<u8> {
        let scan = Scan { stamp, points: vec![[1.0, 2.0, 3.0]], no_returns: Vec::new() };
        SensorMessage::Scan(Frame { scan, t_map_sensor: Pose::IDENTITY, points_dropped: 0 }).emit()
    }

    #[test]
    fn messages_come_through_and_a_clean_end_is_no_fault() {
        let mut bytes = scan(Stamp(0));
        bytes.extend(SensorMessage::Teammate(RobotId(2), [1.0; 3]).emit());
        bytes.extend(SensorMessage::Alignment(RobotId(2), Pose::IDENTITY).emit());
        let clock = Clock::new();
        let began = clock.now();
        let inputs = inputs_on(clock, &bytes);
        let [Input::Frame(frame), Input::Teammate(..), Input::Alignment(..), Input::Note(_)] =
            inputs.as_slice()
        else {
            panic!("{inputs:?}");
        };
        assert!((began..=clock.now()).contains(&frame.scan.stamp), "0 means now");
    }

    /// A system clock that stands at this time, whatever happens.
    static SYSTEM: AtomicI64 = AtomicI64::new(0);

    fn system() -> SystemTime {
        UNIX_EPOCH + Duration::from_micros(SYSTEM.load(Ordering::Relaxed).unsigned_abs())
    }

    #[test]
    fn a_step_of_the_system_clock_costs_at_most_the_scans_under_way() {
        const HOUR: i64 = 3_600_000_000;
        let began_at = 400_000 * HOUR;
        SYSTEM.store(began_at, Ordering::Relaxed);
        let clock = Clock::with_system_time(system);
        let before_all = clock.now();
        // Back to 1970, an hour ahead, and back again.
        for time in [began_at, 5_000_000, began_at + HOUR, began_at - HOUR, 900_000 * HOUR] {
            let under_way = SYSTEM.swap(time, Ordering::Relaxed);
            let newest = clock.now();
            let bytes = [scan(Stamp(under_way)), scan(Stamp(time - 2_000_000)), scan(Stamp(time))].concat();
            let inputs = inputs_on(clock, &bytes);
            let frames: Vec<Stamp> = inputs
                .iter()
                .filter_map(|i| if let Input::Frame(f) = i { Some(f.scan.stamp) } else { None })
                .collect();
            let [.., older, now] = frames[..] else { panic!("{time}: {inputs:?}") };
            // On the node's clock, as old as they are. The test may be slow, but then all of it is.
            let last = clock.now();
            assert!((newest..=last).contains(&now), "{time}: {now:?}");
            let range = newest.plus_micros(-2_000_000)..=last.plus_micros(-2_000_000);
            assert!(range.contains(&older), "{time}: {older:?}");
            let dropped = inputs.iter().filter(|i| matches!(i, Input::Fault(_))).count();
            assert_eq!(dropped, usize::from(time != began_at), "{time}: {inputs:?}");
        }
        assert!(before_all.0 >= began_at, "the node's clock has not moved with it");
    }

    #[test]
    fn a_scan_is_never_placed_in_the_future() {
        static AHEAD: AtomicI64 = AtomicI64::new(50_000_000);
        let system = || UNIX_EPOCH + Duration::from_micros(AHEAD.load(Ordering::Relaxed).unsigned_abs());
        let clock = Clock::with_system_time(system);
        for stamp in [50_000_001, 51_000_000, 60_000_000] {
            let inputs = inputs_on(clock, &scan(Stamp(stamp)));
            let [Input::Frame(frame), Input::Note(_)] = inputs.as_slice() else { panic!("{inputs:?}") };
            assert!(frame.scan.stamp <= clock.now(), "{stamp}");
        }
    }

    #[test]
    fn a_stamp_from_another_clock_is_refused_and_the_next_message_is_read() {
        for stamp in [7, i64::MIN, i64::MAX, Clock::new().now().0 + 20_000_000] {
            let inputs = inputs_of(&[scan(Stamp(stamp)), scan(Stamp(0))].concat());
            let [Input::Fault(fault), Input::Frame(_), Input::Note(_)] = inputs.as_slice() else {
                panic!("{inputs:?}");
            };
            assert!(fault.contains("message 1") && fault.contains("1970"), "{fault}");
        }
    }

    #[test]
    fn a_damaged_message_ends_the_connection_with_a_word() {
        let mut bytes = scan(Stamp(0));
        bytes.extend(b"GET / HTTP/1.1\r\n\r\n");
        let inputs = inputs_of(&bytes);
        let [Input::Frame(_), Input::Fault(fault)] = inputs.as_slice() else { panic!("{inputs:?}") };
        assert!(fault.contains("message 2") && fault.contains("length"), "{fault}");

        let whole = scan(Stamp(0));
        for cut in 1..whole.len() {
            let inputs = inputs_of(&whole[..cut]);
            let [Input::Fault(fault)] = inputs.as_slice() else { panic!("{cut}: {inputs:?}") };
            assert!(fault.contains("ended after"), "{fault}");
        }
    }

    #[test]
    fn a_length_alone_takes_no_memory() {
        let bytes = [vec![7; 3_000], vec![8; 100]].concat();
        let reader = |stream| {
            let silence = Silence::default();
            Reader { stream, silence, limits: LIMITS, clock: Clock::new(), name: String::new() }
        };
        runtime().block_on(async {
            let read = reader(bytes.as_slice()).read_up_to(1 << 30).await.unwrap();
            assert_eq!(read, bytes);
            assert!(read.capacity() <= 2 * 4_096, "{}", read.capacity());
            assert_eq!(reader(bytes.as_slice()).read_up_to(3_000).await.unwrap(), [7; 3_000]);
        });
    }

    /// Connections that a test makes.
    struct Door(UnboundedReceiver<DuplexStream>);

    impl Listener for Door {
        type Stream = DuplexStream;

        async fn accept(&mut self) -> io::Result<DuplexStream> {
            match self.0.recv().await {
                Some(stream) => Ok(stream),
                None => std::future::pending().await,
            }
        }
    }

    struct Programs {
        door: UnboundedSender<DuplexStream>,
        inputs: Receiver<Input>,
    }

    impl Programs {
        fn new() -> Self {
            let ((door, door_in), (to, inputs)) = (unbounded_channel(), channel(4));
            tokio::spawn(serve(Door(door_in), LIMITS, Clock::new(), to));
            Self { door, inputs }
        }

        fn connect(&self) -> DuplexStream {
            let (ours, theirs) = duplex(1 << 16);
            self.door.send(theirs).unwrap();
            ours
        }

        async fn next(&mut self) -> Input {
            timeout(Duration::from_secs(60), self.inputs.recv()).await.expect("something comes").unwrap()
        }

        /// The lines until the next scan.
        async fn lines_until_a_scan(&mut self) -> Vec<String> {
            let mut lines = Vec::new();
            loop {
                match self.next().await {
                    Input::Frame(_) => return lines,
                    Input::Note(text) | Input::Yielded(text) => lines.push(text),
                    other => panic!("{other:?}"),
                }
            }
        }
    }

    async fn say(program: &mut DuplexStream) {
        program.write_all(&scan(Stamp(0))).await.unwrap();
    }

    #[test]
    fn silent_programs_keep_nobody_out_and_the_log_says_who_gave_way() {
        runtime().block_on(async {
            let mut programs = Programs::new();
            // More than there are places for, and one of them within a message.
            let mut silent: Vec<DuplexStream> =
                (0..3 * CONNECTIONS_MAX).map(|_| programs.connect()).collect();
            silent[0].write_all(&[80, 0]).await.unwrap();
            let began = Instant::now();
            let mut speaker = programs.connect();
            say(&mut speaker).await;
            let lines = programs.lines_until_a_scan().await;
            assert!(
                lines.iter().any(|l| l.contains("connection 1 closed: all 8 places were taken")),
                "{lines:?}"
            );
            assert!(lines.iter().any(|l| l.contains("connection 9 waits")), "{lines:?}");
            let took = began.elapsed();
            assert!(took < Duration::from_secs(60), "{took:?} for {} silent ones", silent.len());
            assert_eq!(silent[0].read(&mut [0]).await.unwrap(), 0, "closed");
        });
    }

    #[test]
    fn nobody_who_speaks_is_closed_for_another() {
        runtime().block_on(async {
            let mut programs = Programs::new();
            let mut speakers: Vec<DuplexStream> = (0..CONNECTIONS_MAX).map(|_| programs.connect()).collect();
            let mut late = programs.connect();
            say(&mut late).await;
            let mut lines = Vec::new();
            for _ in 0..30 {
                sleep(SILENT_MIN - Duration::from_secs(1)).await;
                for speaker in &mut speakers {
                    say(speaker).await;
                    lines.extend(programs.lines_until_a_scan().await);
                }
            }
            let [line] = lines.as_slice() else { panic!("{lines:?}") };
            assert!(line.contains("connection 9 waits: all 8 places"), "{line}");
            // One ends: that is a place.
            drop(speakers.pop());
            let lines = programs.lines_until_a_scan().await;
            assert_eq!(lines, ["sensor connection 8 ended after 30 messages"]);
        });
    }

    #[test]
    fn a_program_within_a_long_message_is_not_silent() {
        runtime().block_on(async {
            let mut programs = Programs::new();
            let mut slow: Vec<DuplexStream> = (0..CONNECTIONS_MAX).map(|_| programs.connect()).collect();
            let mut late = programs.connect();
            say(&mut late).await;
            for byte in scan(Stamp(0)) {
                sleep(SILENT_MIN - Duration::from_secs(1)).await;
                for program in &mut slow {
                    program.write_all(&[byte]).await.unwrap();
                }
            }
            let lines = programs.lines_until_a_scan().await;
            let [line] = lines.as_slice() else { panic!("{lines:?}") };
            assert!(line.contains("connection 9 waits"), "{line}");
        });
    }

    #[test]
    fn a_program_that_the_node_keeps_waiting_is_not_silent() {
        runtime().block_on(async {
            let mut programs = Programs::new();
            let mut speakers: Vec<DuplexStream> = (0..CONNECTIONS_MAX).map(|_| programs.connect()).collect();
            // Nobody takes the scans: there is room for four, and every program has one that waits.
            for _ in 0..5 {
                for speaker in &mut speakers {
                    say(speaker).await;
                }
            }
            let mut late = programs.connect();
            say(&mut late).await;
            sleep(SILENT_MIN * 10).await;
            let mut scans = 0;
            while scans < 5 * CONNECTIONS_MAX {
                match programs.next().await {
                    Input::Frame(_) => scans += 1,
                    Input::Note(text) => assert!(text.contains("connection 9 waits"), "{text}"),
                    other => panic!("after {scans} scans: {other:?}"),
                }
            }
            // Now they are silent.
            let lines = programs.lines_until_a_scan().await;
            assert!(lines.iter().any(|line| line.contains("connection 9 wants in")), "{lines:?}");
        });
    }

    #[test]
    fn nobody_gives_way_to_one_that_only_looks() {
        runtime().block_on(async {
            let mut programs = Programs::new();
            let mut silent: Vec<DuplexStream> = (0..CONNECTIONS_MAX).map(|_| programs.connect()).collect();
            sleep(SILENT_MIN * 2).await;
            for _ in 0..3 {
                drop(programs.connect());
            }
            for program in &mut silent {
                say(program).await;
                assert!(programs.lines_until_a_scan().await.is_empty());
            }
        });
    }
}
