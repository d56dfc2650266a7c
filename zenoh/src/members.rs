//! The swarms of an archive or a ground station: each has a node of its own here, started when somebody holds its packages,
//! or when something of it is on disk.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

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
    said_full: bool,
}

impl Members {
    pub(crate) fn new(common: Common, log: Log) -> Self {
        Self { common, log, running: BTreeMap::new(), said_full: false }
    }

    /// Looks for swarms: those on disk at once, then whoever is found. The swarm of each holder that comes is sent; an error
    /// is one of what was found on disk.
    pub(crate) fn find(&mut self, found: Sender<u16>) -> Result<Vec<Subscriber<()>>> {
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

    fn find_holders(&self, place: &str, found: Sender<u16>) -> Result<Subscriber<()>> {
        let log = self.log.clone();
        let tokens = self.common.session.liveliness().declare_subscriber(place).history(true);
        let tokens = tokens.callback(move |token| {
            let Some((swarm, version, name)) = parse_holder(token.key_expr().as_str()) else { return };
            if token.kind() != SampleKind::Put {
                return;
            }
            if version == FORMAT_VERSION {
                // Nobody looks any more if this fails.
                let _ = found.send(swarm);
            } else {
                log.warn(format!(
                    "{name} of swarm {swarm} has version {version} of the format, and this program {FORMAT_VERSION}"
                ));
            }
        });
        tokens.wait().map_err(|error| anyhow!("cannot look for swarms: {error}"))
    }

    /// Takes up a swarm of which a holder was found, if it is wanted and not here yet.
    pub(crate) fn take_up(&mut self, swarm: u16) {
        if self.running.contains_key(&swarm) || !self.is_wanted(swarm) {
            return;
        }
        if self.running.len() >= SWARMS_MAX {
            if !std::mem::replace(&mut self.said_full, true) {
                self.log.warn(format!("swarm {swarm} and others are left out: there are {SWARMS_MAX} here; --swarm says which are wanted"));
            }
            return;
        }
        let Some(resolution) = ask_resolution(&self.common.session, Keys { swarm }) else {
            // It comes with the next holder.
            return;
        };
        if let Err(error) = self.start(swarm, resolution) {
            self.log.warn(format!("swarm {swarm} is left out: {error:#}"));
        }
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
    let face = Face::start(identity, &node, watched, log)?;
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

/// The voxels of a swarm, as somebody says who holds packages of it.
pub(crate) fn ask_resolution(session: &Session, keys: Keys) -> Option<Resolution> {
    let (answers, answers_in) = channel();
    let get = session.get(keys.held_of_all()).target(QueryTarget::All).consolidation(ConsolidationMode::None);
    let get = get.allowed_destination(Locality::Remote).timeout(ANSWER_TIMEOUT);
    let get = get.callback(move |reply| {
        if let Ok(sample) = reply.result()
            && sample.payload().len() <= HELD_BYTES_MAX
            && let Ok(held) = serde_json::from_slice::<Held>(&sample.payload().to_bytes())
        {
            // One answer is enough.
            let _ = answers.send(held.resolution());
        }
    });
    get.wait().ok()?;
    answers_in.iter().flatten().next()
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
