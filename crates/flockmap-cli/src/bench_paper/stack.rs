//! The whole stack in virtual time: robots, sessions, datagrams, everything on the wire counted.

use flockmap::grid::MapperConfig;
use flockmap::{Codec, CycleConfig, RobotConfig, RobotId, SessionConfig};
use flockmap_netsim::{Link, RadioConfig};

use super::methods::MethodRow;
use crate::measure::Sent;
use crate::report::{Report, Settings};
use crate::sources::Source;
use crate::swarm;

/// What is run.
pub struct StackPlan {
    pub title: String,
    pub mapper: MapperConfig,
    pub cycle: CycleConfig,
    pub codec: Codec,
    pub session: SessionConfig,
    pub link: Link,
    pub seed: u64,
}

/// What came of it.
pub struct Stack {
    pub report: Report,
    /// UDP payload of each robot over time.
    pub traffic: Vec<Traffic>,
}

/// What one robot sent and received.
pub struct Traffic {
    pub sent: Sent,
    pub received: Sent,
}

/// Runs robots with unicast through their records.
pub fn run(plan: &StackPlan, sources: Vec<Source>) -> anyhow::Result<Stack> {
    let StackPlan { title, mapper, cycle, codec, session, link, seed } = plan;
    let base = RobotConfig {
        mapper: mapper.clone(),
        cycle: *cycle,
        codec: *codec,
        session: session.clone(),
        seed: *seed,
        ..RobotConfig::new(RobotId(1), mapper.resolution, mapper.range_m)
    };
    let radio = RadioConfig { seed: *seed, link: *link, ..RadioConfig::default() };
    let run = swarm::run(sources, |id| RobotConfig { id, ..base.clone() }, radio)?;
    let settings = Settings {
        resolution_m: mapper.resolution.metres(),
        range_m: mapper.range_m,
        t_l_s: f64::from(cycle.t_l_ms) / 1e3,
        t_l_occupied_s: None,
        d: cycle.changes_max,
        mapper: "rog-map".to_owned(),
        codec: base.codec.to_string(),
        cast: "unicast",
        radio: format!(
            "{} % of datagrams lost, {} ms delay, up to {} ms jitter",
            link.loss * 100.0,
            link.delay_micros as f64 / 1e3,
            link.jitter_micros as f64 / 1e3
        ),
        seed: *seed,
    };
    let report = run.report(title.clone(), settings)?;
    let traffic = run
        .members
        .iter()
        .map(|member| Traffic {
            sent: member.measures.sent.clone(),
            received: member.measures.received.clone(),
        })
        .collect();
    Ok(Stack { report, traffic })
}

impl Stack {
    /// As a row among methods.
    pub fn row(&self, name: &str, about: &str) -> MethodRow {
        let (sum, robots) = (&self.report.sum, &self.report.robots);
        MethodRow {
            name: name.to_owned(),
            about: about.to_owned(),
            total_bytes: sum.total_bytes,
            paper_bytes: 0,
            changed_voxels: 0,
            ip_udp_bytes: sum.ip_udp_bytes,
            avg_kb_s: sum.avg_kb_s / robots.len().max(1) as f64,
            max_kb_s: robots.iter().map(|robot| robot.bytes.max_kb_s).fold(0.0, f64::max),
            agreement: self.report.agreement_all,
            is_lossless: true,
            is_as_promised: self.report.is_good(),
            encode_ms: Some(self.report.t_pack.mean_ms),
            decode_ms: None,
        }
    }
}
