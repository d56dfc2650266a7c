//! Plays a recording to one browser: it is given the map of one time after another.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use flockmap_feed::{Link, NodeCounts, Playback, RobotPose, RunSubmaps};
use flockmap_grid::{BlockIndex, MapView, Stamp};
use tokio::io::DuplexStream;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep_until};

use crate::serve::{BlocksFuture, BlocksNow, Given, Giver, Numbered, Reader, Tally};
use crate::{Control, Recording, Series, Source};

/// The time goes on in steps of this while it plays.
const TICK: Duration = Duration::from_millis(50);

/// Of a recording that grows, the browser is told so often at least how far it has come.
const SAY_EVERY: Duration = Duration::from_millis(250);

/// How fast a recording may be played.
const SPEEDS: [f32; 2] = [0.1, 100.0];

impl Source for Arc<Recording> {
    fn id(&self) -> u16 {
        self.identity().robot.0
    }

    fn name(&self) -> String {
        self.identity().name.clone()
    }

    fn connect(&self, stream: DuplexStream, controls: mpsc::Receiver<Control>) {
        tokio::spawn(play(Self::clone(self), stream, controls));
    }

    fn series(&self) -> Option<Arc<Series>> {
        Recording::series(self)
    }
}

/// Serves one browser until it goes.
async fn play(recording: Arc<Recording>, stream: DuplexStream, mut controls: mpsc::Receiver<Control>) {
    let mut grown = recording.grown();
    let (_, grows) = *grown.borrow_and_update();
    let shown = Arc::new(Shown { recording: Arc::clone(&recording), moment: Mutex::default() });
    let (give, given) = watch::channel(None);
    let (identity, tally) = (recording.player_identity(), Arc::<Tally>::default());
    let reader = Reader { identity, given, tally, giver: Arc::<Shown>::clone(&shown) };
    let reading = tokio::spawn(reader.serve(Box::new(stream), Arc::<AtomicBool>::default()));
    let mut player = Player::new(recording, shown, grows);
    loop {
        if player.is_news {
            give.send_replace(player.give());
        }
        let tick = player.tick();
        tokio::select! {
            () = give.closed() => break,
            () = sleep_until(tick), if player.plays => player.go_on(Instant::now()),
            changed = grown.changed() => {
                // Who records has gone.
                if changed.is_err() {
                    break;
                }
                let (_, grows) = *grown.borrow_and_update();
                player.grow(grows);
            }
            control = controls.recv() => match control {
                Some(control) => player.take(control),
                // The browser has gone.
                None => break,
            }
        }
    }
    drop(give);
    // It ends by itself: there is nothing more to read.
    let _ = reading.await;
}

/// What is shown, for who asks who saw it.
struct Shown {
    recording: Arc<Recording>,
    /// The moment, and the version of the map that it has.
    moment: Mutex<(usize, u64)>,
}

impl Giver for Shown {
    fn wake(&self) {}

    fn blocks_with_origins(&self, due: Vec<BlockIndex>) -> BlocksFuture {
        let (moment, newest) = *self.moment.lock().unwrap_or_else(PoisonError::into_inner);
        let blocks = due.into_iter().map(|index| self.recording.block_at(moment, index)).collect();
        let now = self.recording.stamp_of(moment).unwrap_or_default();
        Box::pin(async move { Some(BlocksNow { blocks, newest, now }) })
    }
}

struct Player {
    recording: Arc<Recording>,
    shown: Arc<Shown>,
    map: MapView,
    /// Of which moment the map is.
    moment: Option<usize>,
    at: Stamp,
    speed: f32,
    plays: bool,
    grows: bool,
    /// Until when time has gone on.
    ticked: Instant,
    /// When something was given last.
    gave: Instant,
    is_news: bool,
    poses: Numbered<Vec<RobotPose>>,
    links: Numbered<Vec<Link>>,
    submaps: Numbered<Vec<RunSubmaps>>,
    counts: Numbered<NodeCounts>,
    playback: Numbered<Option<Playback>>,
}

impl Player {
    fn new(recording: Arc<Recording>, shown: Arc<Shown>, grows: bool) -> Self {
        let now = Instant::now();
        Self {
            map: MapView::new(recording.identity().resolution),
            at: recording.span().map_or(Stamp(i64::MIN), |(begin, _)| begin),
            recording,
            shown,
            moment: None,
            speed: 1.0,
            plays: true,
            grows,
            ticked: now,
            gave: now,
            is_news: true,
            poses: Numbered::default(),
            links: Numbered::default(),
            submaps: Numbered::default(),
            counts: Numbered::default(),
            playback: Numbered::default(),
        }
    }

    /// When time goes on.
    fn tick(&self) -> Instant {
        self.ticked + TICK
    }

    /// Time goes on to now.
    fn go_on(&mut self, now: Instant) {
        let micros = (now - self.ticked).as_secs_f64() * f64::from(self.speed) * 1e6;
        self.ticked = now;
        let Some((_, end)) = self.recording.span() else { return };
        let before = self.at;
        self.at = self.at.plus_micros(micros as i64).min(end);
        // Where it still grows, it waits there for more.
        self.plays = self.grows || self.at < end;
        self.is_news = self.at != before || !self.plays;
    }

    /// There are more moments, or there will be none.
    fn grow(&mut self, grows: bool) {
        self.is_news |= self.moment.is_none() || self.grows != grows || self.gave.elapsed() >= SAY_EVERY;
        self.grows = grows;
    }

    fn take(&mut self, control: Control) {
        self.go_on_if_playing();
        self.is_news = true;
        match control {
            Control::SeekUs(micros) => self.at = Stamp(micros),
            Control::Speed(speed) if speed.is_finite() => self.speed = speed.clamp(SPEEDS[0], SPEEDS[1]),
            Control::Speed(_) => {}
            Control::Play(plays) => {
                let is_over = self.recording.span().is_some_and(|(_, end)| self.at >= end);
                if plays && is_over && !self.grows {
                    self.at = Stamp(i64::MIN);
                }
                self.plays = plays;
            }
        }
    }

    fn go_on_if_playing(&mut self) {
        let now = Instant::now();
        if self.plays {
            self.go_on(now);
        }
        self.ticked = now;
    }

    /// What the browser is given now; nothing before there is a first moment.
    fn give(&mut self) -> Option<Arc<Given>> {
        self.is_news = false;
        let (begin, end) = self.recording.span()?;
        self.gave = Instant::now();
        self.at = self.at.clamp(begin, end);
        let moment = self.recording.moment_at(self.at);
        if self.moment != Some(moment) {
            self.recording.change(&mut self.map, self.moment, moment);
            self.moment = Some(moment);
            let beside = self.recording.beside_at(moment);
            self.poses.share(beside.poses);
            self.links.share(beside.links);
            self.submaps.share(beside.submaps);
            self.counts.share(beside.counts);
            let shown = (moment, self.map.version());
            *self.shown.moment.lock().unwrap_or_else(PoisonError::into_inner) = shown;
        }
        let (at, speed, plays, grows) = (self.at, self.speed, self.plays, self.grows);
        self.playback.replace(Some(Playback { begin, end, at, speed, plays, grows }));
        Some(Arc::new(Given {
            map: self.map.clone(),
            stamp: self.recording.stamp_of(moment).unwrap_or_default(),
            poses: self.poses.clone(),
            counts: self.counts.clone(),
            links: self.links.clone(),
            submaps: self.submaps.clone(),
            scan: Numbered::default(),
            playback: self.playback.clone(),
        }))
    }
}
