//! The four kinds of the program, each until it is asked to end.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use flockmap_node::{Configuration, ConfiguredNode, Log, Signals, Summary};
use toml::{Table, Value};
use zenoh::{Session, Wait};

use crate::face::{Identity, Roles};
use crate::keys::{Keys, is_name};
use crate::link::Link;
use crate::members::{Common, Member, Members, ask_resolution, read, set, start_with};
use crate::{Archive, Bus, Gateway, Join, Station, Swarms, bus};

/// How often it is looked whether a node has ended by itself.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Streams and runs of a robot that an archive or a ground station has at most, where no configuration says it.
const STREAMS_MAX: i64 = 4_096;
const EPOCHS_MAX: i64 = 64;

/// What is open for each of them: a session with Zenoh, and the signals.
struct Program {
    runtime: tokio::runtime::Runtime,
    signals: Signals,
    session: Session,
    name: String,
    period: Duration,
    log: Log,
}

impl Program {
    fn open(kind: &str, bus: &Bus) -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let signals = {
            let _context = runtime.enter();
            Signals::new().context("cannot listen to signals")?
        };
        let period = Duration::try_from_secs_f64(bus.period_s).ok().filter(|period| *period >= LOOK_PERIOD);
        let period = period.with_context(|| format!("--period-s {}, expected 0.1 or more", bus.period_s))?;
        if let Some(name) = bus.name.as_ref().filter(|name| !is_name(name)) {
            bail!("--name {name}, expected 1 to 64 letters, digits, -, _ and .");
        }
        let session = bus::open(bus.zenoh.as_deref(), &bus.connect, &bus.listen)?;
        let name = bus.name.clone().unwrap_or_else(|| format!("{kind}-{}", session.zid()));
        let log = Log::to_stderr(&name);
        Ok(Self { runtime, signals, session, name, period, log })
    }

    fn identity(&self, swarm: u16, roles: Roles) -> Identity {
        Identity {
            session: self.session.clone(),
            keys: Keys { swarm },
            name: self.name.clone(),
            roles,
            period: self.period,
        }
    }

    /// Waits for a signal, or until `is_over`, which is looked at now and then.
    fn wait(&mut self, mut is_over: impl FnMut() -> bool) {
        let Self { runtime, signals, log, .. } = self;
        runtime.block_on(async {
            loop {
                tokio::select! {
                    name = signals.next() => return log.info(format!("{name}: ending")),
                    () = tokio::time::sleep(LOOK_PERIOD) => if is_over() { return },
                }
            }
        });
    }

    fn close(self) {
        // It ends with the program in any case.
        let _ = self.session.close().wait();
    }
}

pub(crate) fn gateway(options: &Gateway) -> Result<()> {
    let configuration = Configuration::read(&options.config)?;
    let mut program = Program::open("gateway", &options.bus)?;
    let swarm = configuration.config.session.swarm;
    let roles =
        Roles { puts: true, takes: options.take, answers: true, answers_everybody: false, on_radio: true };
    let log = Log::to_stderr(&configuration.config.robot_name());
    let start = |embedding| ConfiguredNode::start_with(configuration, embedding, log.clone());
    let member = start_with(program.identity(swarm, roles), start, &log)?;
    let node = Arc::clone(&member.node);
    program.wait(|| node.node.has_ended());
    drop(node);
    end_one(program, swarm, member, None)
}

pub(crate) fn archive(options: &Archive) -> Result<()> {
    let bytes_max = i64::try_from(options.bytes_max).unwrap_or(i64::MAX);
    let values = values_of(&options.swarms);
    let values = move |_, _| {
        let mut values = values.clone();
        set(&mut values, "store", "bytes_max", Value::Integer(bytes_max));
        // Layers are what it gives; a map nobody reads would take as much memory and time again.
        set(&mut values, "fusion", "mutes_others", Value::Boolean(true));
        values
    };
    let roles = Roles { puts: false, takes: true, answers: true, answers_everybody: true, on_radio: false };
    let store = Some(options.store.as_path());
    members("archive", &options.bus, &options.swarms, (roles, store), Arc::new(values))
}

pub(crate) fn station(options: Station) -> Result<()> {
    let Station { view, map, save, swarms, bus } = options;
    let values = values_of(&swarms);
    let values = move |swarm: u16, number: usize| {
        let mut values = values.clone();
        let of_swarm = |text: &str| absolute(&text.replace("{swarm}", &swarm.to_string()));
        if let Some(address) = view {
            set(&mut values, "view", "listen", nth_port(address, number));
        }
        if let Some(map) = &map {
            set(&mut values, "map_output", "listen_unix", Value::String(of_swarm(map)));
        }
        if let Some(save) = &save {
            set(&mut values, "output", "save_map_at_end", Value::String(of_swarm(save)));
        }
        values
    };
    let roles = Roles { puts: false, takes: true, answers: false, answers_everybody: false, on_radio: false };
    members("station", &bus, &swarms, (roles, None), Arc::new(values))
}

pub(crate) fn join(options: &Join) -> Result<()> {
    let Join { swarm, id, link, rate_kb_s, config, report, bus, .. } = options;
    if !is_name(link) {
        bail!("--link {link}, expected 1 to 64 letters, digits, -, _ and .");
    }
    let mut program = Program::open("join", bus)?;
    let own_bus =
        options.link_zenoh.is_none() && options.link_connect.is_empty() && options.link_listen.is_empty();
    let link_session = if own_bus {
        program.session.clone()
    } else {
        bus::open(options.link_zenoh.as_deref(), &options.link_connect, &options.link_listen)?
    };
    let mut values = Table::new();
    values.insert("id".into(), Value::Integer((*id).into()));
    values.insert("name".into(), Value::String(program.name.clone()));
    set(&mut values, "map", "range_m", Value::Float(1.0));
    set(&mut values, "session", "budget_kb_s", Value::Float(*rate_kb_s));
    if let Some(address) = options.metrics {
        set(&mut values, "metrics", "prometheus", nth_port(address, 0));
    }
    // The ends may be of different swarms.
    set(&mut values, "session", "swarm", Value::Integer(0));
    let resolution = loop {
        if let Ok(resolution) = ask_resolution(&program.session, Keys { swarm: *swarm }).recv() {
            break resolution;
        }
        let Program { runtime, signals, log, .. } = &mut program;
        log.info(format!("waits for a gateway or an archive of swarm {swarm}"));
        let is_ended = runtime.block_on(async {
            tokio::select! {
                _ = signals.next() => true,
                () = tokio::time::sleep(Duration::from_secs(2)) => false,
            }
        });
        if is_ended {
            return Ok(());
        }
    };
    set(&mut values, "map", "resolution_m", Value::Float(resolution.metres()));
    let configuration = read(config.as_deref(), &values)?;
    let log = Log::to_stderr(&configuration.config.robot_name());
    let roles = Roles { puts: true, takes: true, answers: true, answers_everybody: false, on_radio: true };
    let (link, over) = (link.clone(), link_session.clone());
    let open = move |_: &flockmap_node::NodeConfig, _: &Log| Ok(move || Link::open(&over, &link));
    let start = |embedding| ConfiguredNode::start_over(configuration, embedding, open, log.clone());
    let member = start_with(program.identity(*swarm, roles), start, &log)?;
    let node = Arc::clone(&member.node);
    program.wait(|| node.node.has_ended());
    drop(node);
    let result = end_one(program, *swarm, member, report.as_deref());
    if !own_bus {
        let _ = link_session.close().wait();
    }
    result
}

/// The values that the command line has for the node of each swarm.
fn values_of(swarms: &Swarms) -> Table {
    let mut values = Table::new();
    values.insert("id".into(), Value::Integer(swarms.id.into()));
    set(&mut values, "map", "range_m", Value::Float(1.0));
    if swarms.config.is_none() {
        set(&mut values, "session", "streams_max", Value::Integer(STREAMS_MAX));
        set(&mut values, "session", "epochs_max", Value::Integer(EPOCHS_MAX));
    }
    values
}

/// An archive or a ground station.
fn members(
    kind: &str,
    bus: &Bus,
    swarms: &Swarms,
    (roles, store): (Roles, Option<&Path>),
    values: Arc<dyn Fn(u16, usize) -> Table + Send + Sync>,
) -> Result<()> {
    let mut program = Program::open(kind, bus)?;
    let end_after = swarms.end_after_s.map(|seconds| {
        Duration::try_from_secs_f64(seconds).map_err(|_| anyhow!("--end-after-s {seconds}, expected seconds"))
    });
    let end_after = end_after.transpose()?;
    let (name, metrics) = (program.name.clone(), swarms.metrics);
    let named = move |swarm: u16, number: usize| {
        let mut values = values(swarm, number);
        values.insert("name".into(), Value::String(format!("{name} swarm {swarm}")));
        if let Some(address) = metrics {
            set(&mut values, "metrics", "prometheus", nth_port(address, number));
        }
        values
    };
    let common = Common {
        session: program.session.clone(),
        name: program.name.clone(),
        roles,
        period: program.period,
        swarms: swarms.wanted(),
        config: swarms.config.clone(),
        store: store.map(Path::to_owned),
        values: Arc::new(named),
    };
    let mut members = Members::new(common, program.log.clone());
    let (found, found_in) = channel();
    let tokens = members.find(found)?;
    if members.is_empty() {
        program.log.info("waits for a gateway or an archive");
    }
    let began = Instant::now();
    program.wait(|| {
        members.take_up(&found_in, Instant::now());
        // Whoever watches the program starts it again: that is better than a swarm that silently is not served.
        members.has_ended() || end_after.is_some_and(|after| began.elapsed() >= after)
    });
    drop(tokens);
    let (summaries, faults) = members.end();
    program.close();
    save_report(swarms.report.as_deref(), &summaries)?;
    if faults.is_empty() { Ok(()) } else { bail!(faults.join("; ")) }
}

fn end_one(program: Program, swarm: u16, member: Member, report: Option<&Path>) -> Result<()> {
    let summary = member.end();
    program.close();
    save_report(report, &BTreeMap::from([(swarm, summary?)]))
}

/// Writes the summaries, by swarm.
fn save_report(path: Option<&Path>, summaries: &BTreeMap<u16, Summary>) -> Result<()> {
    let text = serde_json::to_string_pretty(summaries)?;
    match path {
        Some(path) => {
            std::fs::write(path, text + "\n").with_context(|| format!("--report {}", path.display()))
        }
        None => {
            println!("{text}");
            Ok(())
        }
    }
}

/// The address with a port that is so many further on.
fn nth_port(mut address: SocketAddr, number: usize) -> Value {
    address.set_port(address.port().saturating_add(u16::try_from(number).unwrap_or(u16::MAX)));
    Value::String(address.to_string())
}

fn absolute(path: &str) -> String {
    std::path::absolute(path).map_or_else(|_| path.to_owned(), |path| path.display().to_string())
}
