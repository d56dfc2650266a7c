//! How the node is, as a `diagnostic_msgs/DiagnosticArray`.

use std::time::{Duration, Instant};

use flockmap_io::ros::{DiagnosticArray, DiagnosticStatus, Header, KeyValue};
use flockmap_node::NodeStatus;
use ros2_client::Publisher;

use crate::scans::ScanCounts;

/// Three parts of the node speak: the scans, the map, and the link to the team.
pub(crate) struct Diagnostics {
    publisher: Publisher<DiagnosticArray>,
    /// Full name of the node.
    node: String,
    period: Duration,
    due: Instant,
    before: Option<(Instant, ScanCounts, u64, u64)>,
}

impl Diagnostics {
    pub(crate) fn new(publisher: Publisher<DiagnosticArray>, node: String, period_s: f64) -> Self {
        let (period, due) = (Duration::from_secs_f64(period_s), Instant::now());
        Self { publisher, node, period, due, before: None }
    }

    pub(crate) const fn due(&self) -> Instant {
        self.due
    }

    pub(crate) fn publish(
        &mut self,
        header: Header,
        status: &NodeStatus,
        (scans, incompatible): (&ScanCounts, u64),
        now: Instant,
    ) -> Result<(), String> {
        if now < self.due {
            return Ok(());
        }
        self.due = now + self.period;
        let (out, into) = (status.node.bytes_out, status.node.bytes_in);
        let before = self.before.replace((now, *scans, out, into));
        let (then, scans_before, out_before, in_before) = before.unwrap_or((now, *scans, out, into));
        let seconds = now.saturating_duration_since(then).as_secs_f64().max(1e-3);
        let message = DiagnosticArray {
            header,
            status: vec![
                self.scans(scans, &scans_before, incompatible),
                self.map(status),
                self.link(status, [out - out_before, into - in_before].map(|bytes| bytes as f64 / seconds)),
            ],
        };
        self.publisher.publish(message).map_err(|error| format!("diagnostics were not published: {error}"))
    }

    fn scans(&self, scans: &ScanCounts, before: &ScanCounts, incompatible: u64) -> DiagnosticStatus {
        let (level, message) = if scans.without_pose > before.without_pose {
            (DiagnosticStatus::ERROR, "scans have no poses: look at tf, or at [ros] poses and map_frame")
        } else if scans.damaged > before.damaged {
            (DiagnosticStatus::ERROR, "scans are damaged or too large")
        } else if scans.off_time > before.off_time {
            (DiagnosticStatus::ERROR, "stamps of scans are off the time of ROS: use_sim_time and /clock?")
        } else if scans.crowded_out > before.crowded_out {
            (DiagnosticStatus::WARN, "scans come faster than their poses")
        } else if scans.clouds == before.clouds {
            (DiagnosticStatus::WARN, "no scans")
        } else {
            (DiagnosticStatus::OK, "scans are mapped")
        };
        let values = [
            ("clouds received", scans.clouds),
            ("clouds mapped", scans.mapped),
            ("left out: no pose", scans.without_pose),
            ("left out: damaged or too large", scans.damaged),
            ("left out: too many waited", scans.crowded_out),
            ("left out: time jumped back", scans.of_another_time),
            ("left out: stamp off the time", scans.off_time),
            ("points that are no numbers", scans.points_dropped),
            ("poses received", scans.poses),
            ("poses that are none, or of a frame too many", scans.poses_damaged),
            ("publishers and subscribers whose QoS does not fit", incompatible),
        ];
        self.status("scans", level, message, values.map(|(key, value)| (key, value.to_string())))
    }

    fn map(&self, status: &NodeStatus) -> DiagnosticStatus {
        let (free, occupied) = status.map_voxels;
        let values = [
            ("occupied voxels", occupied.to_string()),
            ("free voxels", free.to_string()),
            ("inserting a scan, median in ms", millis(&status.timings.insert_scan)),
        ];
        self.status("map", DiagnosticStatus::OK, "the map is kept", values)
    }

    fn link(&self, status: &NodeStatus, [out, into]: [f64; 2]) -> DiagnosticStatus {
        let (_, missing) = status.packages();
        let (level, message) = if status.peers.is_empty() {
            (DiagnosticStatus::WARN, "no team-mate is heard")
        } else if missing > 0 {
            (DiagnosticStatus::OK, "parts of team-mates' maps are missing and asked for")
        } else {
            (DiagnosticStatus::OK, "all that team-mates have said is there")
        };
        let values = [
            ("team-mates heard", status.peers.len().to_string()),
            ("packages missing", missing.to_string()),
            ("sent, KB/s", format!("{:.2}", out / 1e3)),
            ("received, KB/s", format!("{:.2}", into / 1e3)),
            ("datagrams refused", status.node.datagrams_refused.to_string()),
            ("datagrams not sent", status.node.send_failed.to_string()),
        ];
        self.status("link", level, message, values)
    }

    fn status<const N: usize>(
        &self,
        part: &str,
        level: u8,
        message: &str,
        values: [(&str, String); N],
    ) -> DiagnosticStatus {
        let pair = |(key, value): (&str, String)| KeyValue { key: key.into(), value };
        DiagnosticStatus {
            level,
            name: format!("{}: {part}", self.node),
            message: message.into(),
            hardware_id: self.node.clone(),
            values: values.into_iter().map(pair).collect(),
        }
    }
}

fn millis(histogram: &flockmap_node::Histogram) -> String {
    format!("{:.1}", histogram.value_at_quantile(0.5) as f64 / 1e3)
}
