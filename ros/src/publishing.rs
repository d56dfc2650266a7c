//! All that is published, in a thread of its own: large maps make no scan wait.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use flockmap::{RobotId, Stamp};
use flockmap_io::ros::{Header, RosMessage, Time};
use flockmap_node::{Log, NodeHandle, RosSection};
use serde::Serialize;

use crate::clock::RosClock;
use crate::links::Links;
use crate::output::{Cloud, Diagnostics, Field, Grid, Outlet, Output, Robots, Shot, Tree};
use crate::scans::ScanCounts;
use crate::topics::{MAP, STATUS, Topics};

/// The outputs are looked at no more often than this.
const OUTPUT_PERIOD: Duration = Duration::from_millis(10);
/// One warning in so long.
const WARNING_PERIOD: Duration = Duration::from_secs(10);

/// All outputs that the configuration asks for.
pub(crate) fn outputs(
    topics: &mut Topics,
    section: &RosSection,
    own: RobotId,
) -> Result<Vec<Box<dyn Output>>> {
    let mut all: Vec<Box<dyn Output>> = Vec::new();
    let s = section;
    if s.near_period_s > 0.0 {
        let outlet = outlet(topics, "~/occupied_points", s.near_period_s)?;
        all.push(Box::new(Cloud::new(outlet, Some(s.near_range_m))));
    }
    if s.all_period_s > 0.0 {
        all.push(Box::new(Cloud::new(outlet(topics, "~/occupied_points_all", s.all_period_s)?, None)));
    }
    if s.grid_period_s > 0.0 {
        let updates = topics.publish("~/grid_updates", MAP)?;
        all.push(Box::new(Grid::new(outlet(topics, "~/grid", s.grid_period_s)?, updates, s.grid_band_m)));
    }
    if s.octomap_period_s > 0.0 {
        all.push(Box::new(Tree::new(outlet(topics, "~/octomap_binary", s.octomap_period_s)?)));
    }
    if s.field_period_s > 0.0 {
        let outlet = outlet(topics, "~/distance_field", s.field_period_s)?;
        all.push(Box::new(Field::new(outlet, s.field_range_m, s.field_distance_max_m)));
    }
    if s.robots_period_s > 0.0 {
        all.push(Box::new(Robots::new(outlet(topics, "~/robots", s.robots_period_s)?, own)));
    }
    Ok(all)
}

fn outlet<M>(topics: &mut Topics, name: &str, period_s: f64) -> Result<Outlet<M>>
where
    M: RosMessage + Serialize,
{
    let publisher = topics.publish(name, MAP)?;
    Ok(Outlet::new(topics.names().topic(name), publisher, topics.links(), period_s))
}

/// The same for `/diagnostics`.
pub(crate) fn diagnostics(topics: &mut Topics, section: &RosSection) -> Result<Option<Diagnostics>> {
    if section.diagnostics_period_s == 0.0 {
        return Ok(None);
    }
    let publisher = topics.publish("/diagnostics", STATUS)?;
    Ok(Some(Diagnostics::new(publisher, topics.names().node_path(), section.diagnostics_period_s)))
}

/// Publishes until the node has ended.
pub(crate) fn publish(
    node: &NodeHandle,
    clock: &RosClock,
    frame: &str,
    mut outputs: Vec<Box<dyn Output>>,
    mut diagnostics: Option<Diagnostics>,
    (links, counts): (&Links, &Mutex<ScanCounts>),
    log: &Log,
) {
    let mut warned: Option<Instant> = None;
    loop {
        let now = Instant::now();
        let mut faults = Vec::new();
        if outputs.iter().any(|output| output.due() <= now) {
            let Some((view, poses, own)) =
                node.with_robot(|robot, _| (robot.view(), robot.poses(), robot.own_stream()))
            else {
                return;
            };
            let sensor = poses.iter().find(|pose| pose.stream == own);
            let stamp = sensor.map_or_else(|| clock.now().map(Time::from), |pose| clock.to_ros(pose.seen));
            if let Some(stamp) = stamp {
                let position = sensor.map(|pose| pose.position);
                let header = Header { stamp, frame_id: frame.into() };
                let shot = Shot { view, header, poses, position };
                faults.extend(outputs.iter_mut().filter_map(|output| output.publish(&shot, now).err()));
            }
        }
        if let Some(diagnostics) = diagnostics.as_mut().filter(|diagnostics| diagnostics.due() <= now) {
            let Some(status) = node.status() else { return };
            let newest = *counts.lock().unwrap_or_else(PoisonError::into_inner);
            let header = Header::new(clock.now().unwrap_or(Stamp(0)), "");
            faults.extend(diagnostics.publish(header, &status, (&newest, links.incompatible()), now).err());
        }
        if let Some(fault) = faults.first()
            && warned.is_none_or(|last| now.saturating_duration_since(last) >= WARNING_PERIOD)
        {
            warned = Some(now);
            log.warn(fault);
        }
        let due =
            outputs.iter().map(|output| output.due()).chain(diagnostics.as_ref().map(Diagnostics::due)).min();
        let rest = due.map_or(OUTPUT_PERIOD, |due| due.saturating_duration_since(Instant::now()));
        std::thread::sleep(rest.clamp(OUTPUT_PERIOD, Duration::from_millis(200)));
        if node.has_ended() {
            return;
        }
    }
}
