//! The thread that follows the node and says to the apps what it sees.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use flockmap_feed::{Client, ClientError, Event, FeedError, Mirror, MirrorOptions, NodeHello};
use flockmap_grid::Stamp;
use flockmap_io::{FlightView, ViewOptions, ViewSink};

use crate::Options;
use crate::apps::{APPS_MAX, Apps};
use crate::channels::Channels;

/// A picture of the map is drawn so often at most.
const PICTURE_PERIOD: Duration = Duration::from_secs(1);
/// Pictures are looked for so often, where the node says nothing.
const WAIT: Duration = Duration::from_millis(100);

/// Follows the node until something is wrong that connecting again does not mend.
pub(crate) fn follow(options: &Options, channels: Channels, apps: Apps) -> anyhow::Result<()> {
    let client = new_client(options);
    Follower { options, channels, apps, client, shown: None, drawn: None, is_wished: false, is_told: false }
        .run()
}

fn new_client(options: &Options) -> Client {
    let Options { origins, scans, .. } = *options;
    let mirror = Mirror::new(MirrorOptions { origins, scans, links: true, ..Default::default() });
    Client::new(options.address.clone(), mirror)
}

struct Follower<'a> {
    options: &'a Options,
    channels: Channels,
    apps: Apps,
    client: Client,
    /// The name of the robot, and what is shown of it.
    shown: Option<(String, FlightView<usize>)>,
    /// When the map was drawn last.
    drawn: Option<Instant>,
    /// An app has nothing of the map yet.
    is_wished: bool,
    /// That there is no connection, or too many apps, is said once.
    is_told: bool,
}

impl Follower<'_> {
    fn run(mut self) -> anyhow::Result<()> {
        let mut were_too_many = false;
        loop {
            match self.client.next(WAIT) {
                Ok(Some(event)) => self.note(event)?,
                Ok(None) => self.channels.end_burst(),
                Err(error) => self.note_error(&error)?,
            }
            self.draw()?;
            let are_too_many = self.apps.are_too_many();
            if are_too_many && !were_too_many {
                eprintln!("more than {APPS_MAX} apps are connected: nothing is sent until one leaves");
            }
            were_too_many = are_too_many;
        }
    }

    fn note(&mut self, event: Event) -> anyhow::Result<()> {
        if event == Event::Hello
            && let Some(node) = self.client.mirror().node()
        {
            self.is_told = false;
            eprintln!(
                "connected to {} (robot {}), voxels of {} m",
                name_of(node),
                node.robot,
                node.resolution.metres()
            );
            let name = name_of(node);
            if self.shown.as_ref().is_none_or(|(shown, _)| *shown != name) {
                self.channels.clear();
                let view = ViewOptions { origins: self.options.origins, scans: self.options.scans };
                let view =
                    FlightView::new(&mut self.channels, &name, view).context("the server takes no topics")?;
                self.shown = Some((name, view));
            }
        }
        let Some((_, view)) = &mut self.shown else { return Ok(()) };
        view.note(&mut self.channels, self.client.mirror(), event, now())
            .context("the server takes no messages")
    }

    /// Draws the map if it has changed, or somebody has nothing of it.
    fn draw(&mut self) -> anyhow::Result<()> {
        if self.drawn.is_some_and(|drawn| drawn.elapsed() < PICTURE_PERIOD) || self.apps.are_too_many() {
            return Ok(());
        }
        let Some((_, view)) = &mut self.shown else { return Ok(()) };
        self.is_wished |= self.apps.take_wish();
        let mirror = self.client.mirror();
        let is_due = self.is_wished || (self.channels.has_watchers() && view.is_changed(mirror));
        if !is_due {
            return Ok(());
        }
        self.is_wished = false;
        self.drawn = Some(Instant::now());
        let now = now();
        for (channel, picture) in view.picture(mirror, now) {
            self.channels.message(channel, now, &picture)?;
        }
        Ok(())
    }

    fn note_error(&mut self, error: &ClientError) -> anyhow::Result<()> {
        let address = &self.options.address;
        match error {
            ClientError::Feed(FeedError::AnotherMap { .. }) => {
                eprintln!("{address}: {error}; begins anew with that one");
                self.channels.clear();
                self.client = new_client(self.options);
                self.shown = None;
            }
            // Connecting again leads to the same.
            ClientError::Feed(FeedError::BlocksFull(_)) => {
                anyhow::bail!("{address}: {error}: the map is too large to be shown; use larger voxels");
            }
            _ if self.is_told => {}
            _ if self.shown.is_none() => eprintln!(
                "{address}: {error}: expected a node that gives its map out there; it says so in its log when it starts \
                 with [map_output]. Trying again"
            ),
            _ => eprintln!("{address}: {error}; connecting again"),
        }
        self.is_told = true;
        Ok(())
    }
}

/// A robot without a name has one by its number, as in the program `flockmap`.
fn name_of(node: &NodeHello) -> String {
    if node.name.is_empty() { format!("robot{}", node.robot) } else { node.name.clone() }
}

/// The time of the messages: that of this machine, which is the one of whoever looks.
fn now() -> Stamp {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Stamp(i64::try_from(since.as_micros()).unwrap_or(i64::MAX))
}
