//! The whole stack in virtual time: robots, sessions, datagrams, everything on the wire counted.

use flockmap::{Preset, RobotConfig};
use flockmap_cli::measure::SentBytes;
use flockmap_cli::report::{Report, Settings};
use flockmap_cli::sources::Source;
use flockmap_cli::swarm;
use flockmap_netsim::{Link, RadioConfig};

use super::methods::MethodRow;

/// What came of it.
pub struct Stack {
    pub report: Report,
    /// UDP payload that each robot sent and received over time.
    pub traffic: Vec<[SentBytes; 2]>,
}

/// Runs robots with unicast through their records.
pub fn run(title: String, robot: &RobotConfig, link: Link, sources: Vec<Source>) -> anyhow::Result<Stack> {
    let radio = RadioConfig { seed: robot.seed, link, ..RadioConfig::default() };
    let run = swarm::run(sources, |id| RobotConfig { id, ..robot.clone() }, radio)?;
    let radio = format!(
        "{} % of datagrams lost, {} ms delay, up to {} ms jitter",
        link.loss * 100.0,
        link.delay_micros as f64 / 1e3,
        link.jitter_micros as f64 / 1e3
    );
    let report = Report::new(&run, title, Settings::new(robot, Preset::RogMap, &radio))?;
    let traffic =
        run.members.into_iter().map(|member| [member.measures.sent.payload, member.measures.received]);
    Ok(Stack { report, traffic: traffic.collect() })
}

impl Stack {
    /// As a row among methods.
    pub fn row(&self, name: &str, about: &str) -> MethodRow {
        let (sum, robots) = (&self.report.sum, &self.report.robots);
        MethodRow {
            name: name.to_owned(),
            about: about.to_owned(),
            total_bytes: sum.total_bytes,
            ip_udp_bytes: sum.ip_udp_bytes,
            avg_kb_s: sum.avg_kb_s / robots.len().max(1) as f64,
            max_kb_s: robots.iter().map(|robot| robot.bytes.max_kb_s).fold(0.0, f64::max),
            agreement: self.report.agreement_all,
            is_lossless: true,
            is_as_promised: self.report.is_good(),
            encode_ms: Some(self.report.t_pack.mean_ms),
            ..MethodRow::default()
        }
    }
}
