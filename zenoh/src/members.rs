//! The swarms of an archive or a ground station: each has a node of its own here, started when somebody holds its
//! packages, or when something of it is on disk.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use flockmap::Resolution;
use flockmap::codec::FORMAT_VERSION;
use flockmap_node::{Configuration, ConfiguredNode, Embedding, Log, NoRadio, Summary};
use toml::{Table, Value};
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::{Locality, SampleKind};
use zenoh::{Session, Wait};

use crate::counters::Counters;
use crate::face::{Face, Identity, Roles, Watched};
use crate::held::{HELD_BYTES_MAX, Held};
use crate::keys::{Keys, holders_of, parse_holder};
use crate::newcomers::{Newcomers, Sighting};
use crate::puts::{Noted, observer};

/// Swarms at once.
const SWARMS_MAX: usize = 16;
/// How long somebody is waited for who says what voxels a swarm has.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

/// What all nodes of an archive or a ground station have in common.
#[derive(Clone)]
pub(crate) struct Common {
    pub(crate) session: Session,
    pub(crate) name: String,
    pub(crate) roles: Roles,
    pub(crate) period: Duration,
    /// These swarms alone; all that are found, if empty.
    pub(crate) swarms: BTreeSet<u16>,
    /// A configuration of a node whose values count for each.
    pub(crate) config: Option<PathBuf>,
    /// Each swarm has a folder in it.
    pub(crate) store: Option<PathBuf>,
    /// Values beside those of the configuration, for a swarm that is the n-th one here.
    pub(crate) values: Arc<dyn Fn(u16, usize) -> Table + Send + Sync>,
}

/// A node with what it is towards Zenoh.
pub(crate) struct Member {
    pub(crate) node: Arc<ConfiguredNode>,
    pub(crate) face: Face,
}

impl Member {
    /// Ends it, and says what there was.
    pub(crate) fn end(self) -> Result<Summary> {
        let Self { node, face } = self;
        node.node.stop();
        while !node.node.has_ended() {
            std::thread::sleep(Duration::from_millis(5));
        }
        face.end();
        let node = Arc::into_inner(node).context("a node is still in use")?;
        let (ended, saved) = node.join()?;
        saved?;
        Ok(ended.summary)
    }
}

/// The swarms.
pub(crate) struct Members {
    common: Common,
    log: Log,
    running: BTreeMap<u16, Member>,
    newcomers: Newcomers,
    /// What is answered to whoever asks for the voxels of a newcomer.
    answers: BTreeMap<u16, Receiver<Resolution>>,
    said_full: bool,
}

impl Members {
    pub(crate) fn new(common: Common, log: Log) -> Self {
        Self {
            common,
            log,
            running: BTreeMap::new(),
            newcomers: Newcomers::default(),
            answers: BTreeMap::new(),
            said_full: false,
        }
    }

    /// Looks for swarms: those on disk at once, then whoever is found. Each holder that comes or goes is sent; an error
    /// is one of what was found on disk.
    pub(crate) fn find(&mut self, found: Sender<Sighting>) -> Result<Vec<Subscriber<()>>> {
        for (swarm, resolution) in self.on_disk()? {
            if self.is_wanted(swarm) {
                self.start(swarm, resolution)?;
            }
        }
        // Who may look at some swarms only may not ask for all.
        let wanted: Vec<Option<u16>> = self.common.swarms.iter().copied().map(Some).collect();
        let wanted = if wanted.is_empty() { vec![None] } else { wanted };
        wanted.into_iter().map(|swarm| self.find_holders(&holders_of(swarm), found.clone())).collect()
    }

    fn find_holders(&self, place: &str, found: Sender<Sighting>) -> Result<Subscriber<()>> {
        let (log, said) = (self.log.clone(), Mutex::new(BTreeSet::new()));
        let tokens = self.common.session.liveliness().declare_subscriber(place).history(true);
        let tokens = tokens.callback(move |token| {
            let Some((swarm, version, name)) = parse_holder(token.key_expr().as_str()) else { return };
            let is_there = token.kind() == SampleKind::Put;
            if version == FORMAT_VERSION {
                // Nobody looks any more if this fails.
                let _ = found.send(Sighting { swarm, name: name.to_owned(), is_there });
            } else if is_there && said.lock().unwrap_or_else(PoisonError::into_inner).insert(version) {
                // Once for each version, whoever comes and goes.
                log.warn(format!(
                    "{name} of swarm {swarm} has version {version} of the format, and this program {FORMAT_VERSION}"
                ));
            }
        });
        tokens.wait().map_err(|error| anyhow!("cannot look for swarms: {error}"))
    }

    /// Takes up the swarms of which holders were found, as far as they are wanted and not here yet. Never waits: to be
    /// called again and again.
    pub(crate) fn take_up(&mut self, found: &Receiver<Sighting>, now: Instant) {
        for sighting in found.try_iter() {
            if self.is_wanted(sighting.swarm) && !self.running.contains_key(&sighting.swarm) {
                self.newcomers.note(sighting);
            }
        }
        while let Some(swarm) = self.newcomers.due(now) {
            if self.running.len() >= SWARMS_MAX {
                self.leave_out(swarm);
            } else {
                self.answers.insert(swarm, ask_resolution(&self.common.session, Keys { swarm }));
            }
        }
        let asked: Vec<u16> = self.answers.keys().copied().collect();
        for swarm in asked {
            match self.answers.get(&swarm).map(Receiver::try_recv) {
                Some(Ok(resolution)) => {
                    self.answers.remove(&swarm);
                    self.newcomers.forget(swarm);
                    self.take_up_one(swarm, resolution);
                }
                Some(Err(TryRecvError::Disconnected)) => {
                    self.answers.remove(&swarm);
                    self.newcomers.note_silence(swarm, now);
                }
                Some(Err(TryRecvError::Empty)) | None => {}
            }
        }
    }

    fn take_up_one(&mut self, swarm: u16, resolution: Resolution) {
        if self.running.len() >= SWARMS_MAX {
            self.leave_out(swarm);
        } else if let Err(error) = self.start(swarm, resolution) {
            self.log.warn(format!("swarm {swarm} is left out: {error:#}"));
        }
    }

    fn leave_out(&mut self, swarm: u16) {
        self.newcomers.forget(swarm);
        if !std::mem::replace(&mut self.said_full, true) {
            self.log.warn(format!(
                "swarm {swarm} and others are left out: there are {SWARMS_MAX} here; --swarm says which are wanted"
            ));
        }
    }

    /// Whether the node of a swarm has ended by itself.
    pub(crate) fn has_ended(&self) -> bool {
        self.running.values().any(|member| member.node.node.has_ended())
    }

    fn is_wanted(&self, swarm: u16) -> bool {
        self.common.swarms.is_empty() || self.common.swarms.contains(&swarm)
    }

    /// The swarms whose stores are on disk, and their voxels: of a swarm that had several kinds, those used last.
    fn on_disk(&self) -> Result<BTreeMap<u16, Resolution>> {
        let Some(folder) = &self.common.store else { return Ok(BTreeMap::new()) };
        let cannot = || format!("--store {}", folder.display());
        std::fs::create_dir_all(folder).with_context(cannot)?;
        let mut found = BTreeMap::new();
        for entry in std::fs::read_dir(folder).with_context(cannot)? {
            let entry = entry.with_context(cannot)?;
            if let Some((swarm, resolution)) = entry.file_name().to_str().and_then(parse_folder) {
                let used = entry.metadata().and_then(|metadata| metadata.modified()).ok();
                let newest = found.entry(swarm).or_insert((used, resolution));
                *newest = (*newest).max((used, resolution));
            }
        }
        Ok(found.into_iter().map(|(swarm, (_, resolution))| (swarm, resolution)).collect())
    }

    fn start(&mut self, swarm: u16, resolution: Resolution) -> Result<()> {
        let member = start(&self.common, swarm, resolution, self.running.len())?;
        self.running.insert(swarm, member);
        Ok(())
    }

    /// Ends all, and says what there was. An error of one does not keep the others from their end.
    pub(crate) fn end(self) -> (BTreeMap<u16, Summary>, Vec<String>) {
        let (mut summaries, mut faults) = (BTreeMap::new(), Vec::new());
        self.running.values().for_each(|member| member.node.node.stop());
        for (swarm, member) in self.running {
            match member.end() {
                Ok(summary) => drop(summaries.insert(swarm, summary)),
                Err(error) => faults.push(format!("swarm {swarm}: {error:#}")),
            }
        }
        (summaries, faults)
    }

    /// Whether none is running.
    pub(crate) fn is_empty(&self) -> bool {
        self.running.is_empty()
    }
}

/// The folder of a swarm's store: `swarm-7-100000um`.
fn folder_name(swarm: u16, resolution: Resolution) -> String {
    format!("swarm-{swarm}-{}um", resolution.micrometres())
}

fn parse_folder(name: &str) -> Option<(u16, Resolution)> {
    let (swarm, micrometres) = name.strip_prefix("swarm-")?.strip_suffix("um")?.split_once('-')?;
    Some((swarm.parse().ok()?, Resolution::from_micrometres(micrometres.parse().ok()?)?))
}

/// Starts the node of a swarm, without a radio, and what it is towards Zenoh.
fn start(common: &Common, swarm: u16, resolution: Resolution, number: usize) -> Result<Member> {
    let mut values = (common.values)(swarm, number);
    set(&mut values, "map", "resolution_m", Value::Float(resolution.metres()));
    set(&mut values, "session", "swarm", Value::Integer(swarm.into()));
    if let Some(folder) = &common.store {
        let folder = std::path::absolute(folder.join(folder_name(swarm, resolution)))?;
        set(&mut values, "store", "path", Value::String(folder.display().to_string()));
    }
    let configuration = read(common.config.as_deref(), &values)?;
    let log = Log::to_stderr(&configuration.config.robot_name());
    let identity = Identity {
        session: common.session.clone(),
        keys: Keys { swarm },
        name: common.name.clone(),
        roles: common.roles,
        period: common.period,
    };
    let open = |_: &flockmap_node::NodeConfig, _: &Log| Ok(|| Ok(NoRadio));
    start_with(
        identity,
        |embedding| ConfiguredNode::start_over(configuration, embedding, open, log.clone()),
        &log,
    )
}

/// Starts a node as is said, and what it is towards Zenoh.
pub(crate) fn start_with(
    identity: Identity,
    start: impl FnOnce(Embedding) -> Result<ConfiguredNode>,
    log: &Log,
) -> Result<Member> {
    let (noted, counters) = (Noted::default(), Counters::default());
    let (observer, puts) = observer(noted.clone(), counters.clone());
    let observer = identity.roles.puts.then_some(observer);
    let embedding = Embedding { observer, counters: counters.for_node(), ..Embedding::default() };
    let node = Arc::new(start(embedding)?);
    let watched = Watched { puts, noted, counters };
    let face = Face::start(&identity, &node, watched, log)?;
    Ok(Member { node, face })
}

/// A configuration with values in place of those of a file, or beside them.
pub(crate) fn read(file: Option<&Path>, values: &Table) -> Result<Configuration> {
    Ok(Configuration::read_with(file, values, "the command line")?)
}

/// Sets a value in a section.
pub(crate) fn set(table: &mut Table, section: &str, key: &str, value: Value) {
    let section = table.entry(section).or_insert_with(|| Value::Table(Table::new()));
    if let Value::Table(section) = section {
        section.insert(key.into(), value);
    }
}

/// Asks for the voxels of a swarm whoever holds packages of it. Does not wait: what is answered can be received, until
/// nobody answers any more.
pub(crate) fn ask_resolution(session: &Session, keys: Keys) -> Receiver<Resolution> {
    let (answers, answers_in) = channel();
    let get = session.get(keys.held_of_all()).target(QueryTarget::All).consolidation(ConsolidationMode::None);
    let get = get.allowed_destination(Locality::Remote).timeout(ANSWER_TIMEOUT);
    let get = get.callback(move |reply| {
        if let Ok(sample) = reply.result()
            && sample.payload().len() <= HELD_BYTES_MAX
            && let Ok(held) = serde_json::from_slice::<Held>(&sample.payload().to_bytes())
            && let Some(resolution) = held.resolution()
        {
            // One answer is enough.
            let _ = answers.send(resolution);
        }
    });
    // A question that could not be asked is one that nobody answers.
    drop(get.wait());
    answers_in
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_says_the_swarm_and_its_voxels() {
        let resolution = Resolution::from_micrometres(100_000).unwrap();
        assert_eq!(folder_name(7, resolution), "swarm-7-100000um");
        assert_eq!(parse_folder("swarm-7-100000um"), Some((7, resolution)));
        for other in ["swarm-7", "swarm-7-0um", "swarm-65536-100000um", "lost+found", "swarm-7-100000"] {
            assert_eq!(parse_folder(other), None, "{other}");
        }
    }
}
