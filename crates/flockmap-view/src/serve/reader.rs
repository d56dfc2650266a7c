//! One reader: what it is sent, and what it may do.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use flockmap_feed::{Feed, FeedError, HELLO_BYTES_MAX, Message, Next, NodeHello, ReaderHello, Splitter};
use flockmap_grid::{BlockIndex, Stamp};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadHalf, WriteHalf};
use tokio::sync::watch;
use tokio::time::timeout;

use super::given::{BlocksNow, Given, Giver, Identity, Sent};
use super::tally::Tally;

/// For the hello to come.
const HELLO_TIME: Duration = Duration::from_secs(10);

/// A reader that takes nothing for so long is closed.
const UNTAKEN_MAX: Duration = Duration::from_secs(60);

/// A connection of any kind.
pub trait Connection: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Connection for T {}

/// Most blocks that are asked for at once with who saw them.
const ASKED_MAX: usize = 1_024;

/// How a reader ended.
#[derive(Debug)]
pub enum Closed {
    /// It went, or the node did.
    Gone,
    /// It never said what it wants.
    Silent,
    /// It did what it should not.
    Fault(String),
}

/// What serves one reader.
pub struct Reader {
    /// What the hello says.
    pub identity: Arc<Identity>,
    /// What is given out; `None` while nothing is. At its end the reader gets the rest, and is told.
    pub given: watch::Receiver<Option<Arc<Given>>>,
    /// Where it is counted.
    pub tally: Arc<Tally>,
    /// Who gives.
    pub giver: Arc<dyn Giver>,
}

impl From<io::Error> for Closed {
    fn from(_: io::Error) -> Self {
        Self::Gone
    }
}

impl Reader {
    /// Serves it until it, or who gives, goes. `has_said_hello` is set when it has.
    pub async fn serve(mut self, stream: Box<dyn Connection>, has_said_hello: Arc<AtomicBool>) -> Closed {
        let (mut from, mut to) = tokio::io::split(stream);
        let hello = match timeout(HELLO_TIME, read_hello(&mut from)).await {
            Err(_) => return Closed::Silent,
            Ok(Ok(hello)) => hello,
            Ok(Err(HelloError::Gone)) => return Closed::Gone,
            Ok(Err(HelloError::Feed(error))) => {
                // If that cannot be said, the reader is gone.
                let _ = self.write(&mut from, &mut to, &Message::End(error.to_string()).emit()).await;
                return Closed::Fault(error.to_string());
            }
        };
        has_said_hello.store(true, Ordering::Relaxed);
        let counted = self.tally.count(&hello);
        // Nothing is given while nobody is there.
        self.giver.wake();
        let closed = match self.feed(&hello, &mut from, &mut to).await {
            Ok(never) => match never {},
            Err(closed) => closed,
        };
        drop(counted);
        closed
    }

    async fn feed(
        &mut self,
        hello: &ReaderHello,
        from: &mut ReadHalf<Box<dyn Connection>>,
        to: &mut WriteHalf<Box<dyn Connection>>,
    ) -> Result<std::convert::Infallible, Closed> {
        let mut feed: Option<Feed> = None;
        let mut sent = Sent::default();
        loop {
            let given = self.given.borrow_and_update().clone();
            let Some(given) = given else {
                self.wait(from, to).await?;
                continue;
            };
            let Some(feed) = &mut feed else {
                let (begun, goes_on) = Feed::begin(hello, self.identity.feed, &given.map);
                let hello = self.hello(begun.origins(), goes_on);
                // What waits for a reader must not hold on to a view.
                drop(given);
                feed = Some(begun);
                self.write(from, to, &Message::Hello(hello).emit()).await?;
                continue;
            };
            let mut frames = given.before_the_map(hello, &mut sent);
            let next = if hello.no_map { Next::Nothing } else { feed.next(&given.map) };
            match next {
                Next::Nothing => {}
                Next::Anew(frame) => frames.extend(frame),
                Next::Blocks if feed.origins() => {
                    let (version, stamp) = (given.map.version(), given.stamp);
                    drop(given);
                    frames.extend(self.blocks_with_origins(feed, version, stamp).await?);
                    self.write(from, to, &frames).await?;
                    continue;
                }
                Next::Blocks => frames.extend(feed.blocks_of(&given.map, given.stamp)),
            }
            frames.extend(given.beside_the_map(hello, &mut sent));
            drop(given);
            if frames.is_empty() {
                self.wait(from, to).await?;
            } else {
                self.write(from, to, &frames).await?;
            }
        }
    }

    fn hello(&self, origins: bool, goes_on: bool) -> NodeHello {
        let Identity { robot, resolution, feed, name, frame } = &*self.identity;
        NodeHello {
            origins,
            goes_on,
            robot: *robot,
            resolution: *resolution,
            feed: *feed,
            name: name.clone(),
            frame: frame.clone(),
        }
    }

    /// Waits until there is something new. At the end of the node says so.
    async fn wait(
        &mut self,
        from: &mut ReadHalf<Box<dyn Connection>>,
        to: &mut WriteHalf<Box<dyn Connection>>,
    ) -> Result<(), Closed> {
        let changed = tokio::select! {
            changed = self.given.changed() => changed,
            closed = read_nothing(from) => return Err(closed),
        };
        if changed.is_err() {
            self.write(from, to, &Message::End("the node ends".into()).emit()).await?;
            to.shutdown().await?;
            return Err(Closed::Gone);
        }
        Ok(())
    }

    /// A frame of the next blocks as they are now, with who saw them. `version` and `stamp` are of the map from
    /// which they were picked.
    async fn blocks_with_origins(
        &self,
        feed: &mut Feed,
        version: u64,
        stamp: Stamp,
    ) -> Result<Vec<u8>, Closed> {
        let due: Vec<BlockIndex> = feed.due().take(ASKED_MAX).collect();
        let answer = self.giver.blocks_with_origins(due).await.ok_or(Closed::Gone)?;
        let BlocksNow { blocks, newest, now } = answer;
        Ok(feed.blocks(blocks, newest, if newest == version { stamp } else { now }))
    }

    /// Writes all, as long as the reader takes something now and then, and says nothing.
    async fn write(
        &self,
        from: &mut ReadHalf<Box<dyn Connection>>,
        to: &mut WriteHalf<Box<dyn Connection>>,
        bytes: &[u8],
    ) -> Result<(), Closed> {
        let write = async {
            let mut rest = bytes;
            while !rest.is_empty() {
                let Ok(written) = timeout(UNTAKEN_MAX, to.write(rest)).await else {
                    let seconds = UNTAKEN_MAX.as_secs();
                    return Err(Closed::Fault(format!("it took nothing for {seconds} s")));
                };
                let count = written?;
                if count == 0 {
                    return Err(Closed::Gone);
                }
                self.tally.note_bytes(count);
                rest = &rest[count..];
            }
            Ok(())
        };
        tokio::select! {
            biased;
            written = write => written,
            closed = read_nothing(from) => Err(closed),
        }
    }
}

/// Why there is no hello.
enum HelloError {
    Gone,
    Feed(FeedError),
}

/// Reads the hello, and not a byte more.
async fn read_hello(from: &mut ReadHalf<Box<dyn Connection>>) -> Result<ReaderHello, HelloError> {
    let mut splitter = Splitter::new(HELLO_BYTES_MAX);
    loop {
        let mut byte = [0];
        match from.read(&mut byte).await {
            Ok(1) => {}
            _ => return Err(HelloError::Gone),
        }
        if let Some((kind, body)) = splitter.next(&mut &byte[..]).map_err(HelloError::Feed)? {
            return ReaderHello::parse(kind, body).map_err(HelloError::Feed);
        }
    }
}

/// Waits for the end of what a reader says, which is nothing.
async fn read_nothing(from: &mut ReadHalf<Box<dyn Connection>>) -> Closed {
    match from.read(&mut [0; 64]).await {
        Ok(0) | Err(_) => Closed::Gone,
        Ok(_) => Closed::Fault("it said something after its hello, and a reader only reads".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_feed::{Event, Mirror, MirrorOptions, RunSubmaps};
    use flockmap_grid::{MapView, Resolution, RobotId, State, StateBlock, Stream, SubmapId};
    use tokio::io::{DuplexStream, duplex};
    use tokio::time::Instant;

    use super::super::given::BlocksFuture;

    /// Gives what is there already.
    struct Nobody;

    impl Giver for Nobody {
        fn wake(&self) {}

        fn blocks_with_origins(&self, _: Vec<BlockIndex>) -> BlocksFuture {
            Box::pin(async { None })
        }
    }

    /// A map of so many blocks.
    fn map(blocks: i32) -> MapView {
        let mut map = MapView::new(Resolution::from_metres(0.1).unwrap());
        let mut states = StateBlock::default();
        states.set(5, State::Occupied);
        (0..blocks).for_each(|x| map.set_block(BlockIndex::new(x, 0, 0), &states));
        map
    }

    fn given(map: MapView) -> Option<Arc<Given>> {
        let (poses, counts, links, scan, submaps, playback) = Default::default();
        Some(Arc::new(Given { map, stamp: Stamp(1), poses, counts, links, scan, submaps, playback }))
    }

    /// Time stands still but for what a test waits for.
    fn with_reader<T: Future<Output = ()>>(
        blocks: i32,
        test: impl FnOnce(DuplexStream, tokio::task::JoinHandle<Closed>, watch::Sender<Option<Arc<Given>>>) -> T,
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build();
        runtime.unwrap().block_on(async {
            let (ours, theirs) = duplex(1 << 12);
            let (give, given) = watch::channel(given(map(blocks)));
            let resolution = Resolution::from_metres(0.1).unwrap();
            let (name, frame) = (String::new(), String::new());
            let identity = Arc::new(Identity { robot: RobotId(1), resolution, feed: 1, name, frame });
            let reader = Reader { identity, given, tally: Arc::default(), giver: Arc::new(Nobody) };
            let task = tokio::spawn(reader.serve(Box::new(theirs), Arc::default()));
            test(ours, task, give).await;
        });
    }

    #[test]
    fn who_says_no_hello_is_closed_after_ten_seconds() {
        with_reader(1, |mut ours, task, _give| async move {
            let began = Instant::now();
            ours.write_all(&[31, 0]).await.unwrap();
            assert!(matches!(task.await.unwrap(), Closed::Silent));
            assert_eq!(began.elapsed().as_secs(), 10);
        });
    }

    #[test]
    fn who_takes_nothing_is_closed_after_a_minute_and_who_takes_little_is_not() {
        with_reader(2_000, |mut ours, task, _give| async move {
            ours.write_all(&ReaderHello::default().emit()).await.unwrap();
            let began = Instant::now();
            let mut some = [0; 1_000];
            for _ in 0..10 {
                tokio::time::sleep(Duration::from_secs(50)).await;
                ours.read_exact(&mut some).await.unwrap();
            }
            assert!(!task.is_finished());
            let last = began.elapsed();
            let Closed::Fault(text) = task.await.unwrap() else { panic!("no fault") };
            assert!(text.contains("took nothing for 60 s"), "{text}");
            assert!((began.elapsed() - last).as_secs() <= 60);
        });
    }

    #[test]
    fn the_rest_of_the_map_comes_before_the_end() {
        with_reader(700, |mut ours, task, give| async move {
            ours.write_all(&ReaderHello::default().emit()).await.unwrap();
            // The node ends before it has sent anything.
            give.send_replace(given(map(900)));
            drop(give);
            let (mut mirror, mut bytes, mut events) = (Mirror::default(), Vec::new(), Vec::new());
            ours.read_to_end(&mut bytes).await.unwrap();
            let mut rest = &bytes[..];
            while let Some(event) = mirror.push(&mut rest).unwrap() {
                events.push(event);
            }
            assert_eq!(events.last(), Some(&Event::End), "{events:?}");
            assert_eq!(mirror.map().unwrap().count(), (0, 900));
            assert!(mirror.is_complete() && matches!(task.await.unwrap(), Closed::Gone));
        });
    }

    #[test]
    fn a_map_that_has_come_as_a_whole_lies_as_the_submaps_that_were_told_last() {
        with_reader(1, |mut ours, task, give| async move {
            let options = MirrorOptions { submaps: true, ..MirrorOptions::default() };
            let mut mirror = Mirror::new(options);
            ours.write_all(&mirror.connect()).await.unwrap();
            let mut submaps = super::super::given::Numbered::default();
            // As many submaps as a hundredth of the blocks: the two change together.
            for count in [700, 1_500, 2_100] {
                let newest = SubmapId::new(count / 100).unwrap();
                let stream = Stream { origin: RobotId(1), epoch: 1 };
                submaps.replace(vec![RunSubmaps { stream, newest, poses: Vec::new(), left_out: 0 }]);
                let mut given = Arc::into_inner(given(map(i32::from(count))).unwrap()).unwrap();
                given.submaps = submaps.clone();
                give.send_replace(Some(Arc::new(given)));
                let is_whole =
                    |mirror: &Mirror| mirror.is_complete() && mirror.map().unwrap().count().1 >= 700;
                let mut bytes = [0; 1_000];
                while !is_whole(&mirror) || mirror.map().unwrap().count() != (0, count.into()) {
                    let read = ours.read(&mut bytes).await.unwrap();
                    let mut rest = &bytes[..read];
                    while let Some(event) = mirror.push(&mut rest).unwrap() {
                        // Submaps come first.
                        if matches!(event, Event::Blocks(_)) && is_whole(&mirror) {
                            let blocks = mirror.map().unwrap().count().1;
                            assert_eq!(mirror.submaps()[0].newest.number() as usize, blocks / 100);
                        }
                    }
                }
            }
            drop((give, ours));
            task.await.unwrap();
        });
    }
}
