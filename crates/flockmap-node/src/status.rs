//! The counters of a node: as values, as one line, and as Prometheus text.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::time::Duration;

use flockmap::sync::{Counters, PeerInfo};
use flockmap::{Robot, RobotCounters, Stream};
use serde::Serialize;
use serde_json::Value;

use crate::store::StoreCounters;

/// What a node counted, beside its robot and its session. Bytes are those of UDP payloads.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize)]
#[non_exhaustive]
pub struct NodeCounters {
    /// Datagrams received.
    pub datagrams_in: u64,
    /// Bytes of these.
    pub bytes_in: u64,
    /// Datagrams handed to the system, each copy counted.
    pub datagrams_out: u64,
    /// Bytes of these.
    pub bytes_out: u64,
    /// Copies that could not be sent.
    pub send_failed: u64,
    /// Times that receiving failed.
    pub receive_errors: u64,
    /// Times that the network reported a robot as off (ICMP).
    pub unreachable: u64,
    /// Datagrams that the session refused; its own counters say why.
    pub datagrams_refused: u64,
    /// Scans that came from the sensor.
    pub frames: u64,
    /// Of these: inserted more than 100 ms after their stamp.
    pub frames_late: u64,
    /// Messages with states of voxels that came from the sensor.
    pub states: u64,
    /// Points that the reader of the record left out, since they are not finite.
    pub points_dropped: u64,
    /// Faults of the sensor: damaged messages, frames that could not be read, stamps from another clock,
    /// poses and positions that are none.
    pub sensor_faults: u64,
    /// Silent sensor connections that were closed, since another program wanted in and there was no place.
    pub sensor_yielded: u64,
    /// Times that the system clock was stepped, or the machine slept. The node's clock goes on.
    pub clock_steps: u64,
    /// Readers of the map for whom there was no place, or who never said what they want.
    pub map_readers_refused: u64,
    /// Readers of the map that were closed, since they sent what they should not, or took nothing for long.
    pub map_readers_closed: u64,
    /// Bytes of the map that were given out.
    pub map_bytes_out: u64,
    /// Bytes of the record of the flight that are safe from the end of the program.
    pub record_bytes: u64,
    /// Scans that are not in it: the disk did not keep up, or the record has ended.
    pub record_scans_left_out: u64,
    /// 1 if it has ended before the flight: it reached its size, or the disk failed.
    pub record_stopped: u64,
}

/// Durations in microseconds; what is read back is off by a thousandth at most.
pub type Histogram = hdrhistogram::Histogram<u64>;

/// How long things took, in microseconds.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Timings {
    /// Inserting a scan.
    pub insert_scan: Histogram,
    /// Inserting states of voxels.
    pub insert_states: Histogram,
    /// The paper's `t_pack`: from the start of closing a batch until its packages are ready.
    pub pack: Histogram,
    /// The paper's `t_recv2insert`: from a datagram until what it brings is in the fused map.
    pub receive_to_insert: Histogram,
    /// From the newest scan in a package of another robot until it is in the fused map, by the measured clock
    /// offset.
    pub age: Histogram,
}

impl Default for Timings {
    fn default() -> Self {
        let [insert_scan, insert_states, pack, receive_to_insert, age] = [(); 5].map(|()| histogram());
        Self { insert_scan, insert_states, pack, receive_to_insert, age }
    }
}

/// A histogram without durations.
pub(crate) fn histogram() -> Histogram {
    Histogram::new_with_max(3_600_000_000, 3).expect("three digits and an hour are allowed")
}

/// What a node has of one stream.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct StreamStatus {
    /// The stream.
    pub stream: Stream,
    /// Packages received.
    pub received: u64,
    /// Packages that are known to exist and not received.
    pub missing: u64,
    /// The highest index that is known to exist.
    pub newest: u32,
    /// Voxels in its layer.
    pub voxels: usize,
    /// Whether something of it was dropped for want of room, here or where it came from, and is lacking.
    pub is_in_part: bool,
}

/// What a robot has dropped, since it may know only so many streams and so many runs of each robot.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize)]
pub struct GivenUp {
    /// Ended runs that were forgotten, with their maps.
    pub runs_forgotten: u64,
    /// Packages and lists of streams for which there was no room, each time counted.
    pub streams_refused: u64,
    /// Blocks of layers that were dropped for want of room, or did not come in: the farthest and oldest.
    pub blocks_dropped: u64,
}

/// A node at one moment.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct NodeStatus {
    /// Name of the robot.
    pub name: String,
    /// Its stream.
    pub own: Stream,
    /// Since the node began.
    pub uptime: Duration,
    /// Since something new came or went: a scan, an own batch, a package of another robot.
    pub quiet_for: Duration,
    /// Whether no scan will come any more.
    pub sensor_ended: bool,
    /// Free and occupied voxels of the fused map.
    pub map_voxels: (usize, usize),
    /// Readers of the map.
    pub map_readers: usize,
    /// Robots heard.
    pub peers: Vec<PeerInfo>,
    /// Streams known, the own one among them.
    pub streams: Vec<StreamStatus>,
    /// Counters of the node.
    pub node: NodeCounters,
    /// Counters of the robot.
    pub robot: RobotCounters,
    /// Counters of the session.
    pub session: Counters,
    /// Counters of the store; all 0 without one.
    pub store: StoreCounters,
    /// Counters of the program around the node, [`NodeOptions::counters_beside`](crate::NodeOptions::counters_beside).
    pub beside: BTreeMap<String, u64>,
    /// How long things took.
    pub timings: Timings,
}

/// The counters that have names of the program's own.
const BESIDE: &str = "beside";

impl NodeStatus {
    /// What the robot says; of the node, that it has just begun.
    pub(crate) fn new(name: &str, robot: &Robot, timings: &Timings) -> Self {
        let (session, fusion) = (robot.session(), robot.fusion());
        let of_stream = |stream| {
            let missing = session.store().missing(stream);
            StreamStatus {
                stream,
                received: session.received(stream).map_or(0, |received| received.count()),
                missing: missing.map(|(low, high)| u64::from(high - low) + 1).sum(),
                newest: session.store().newest_known(stream),
                voxels: fusion.layer(stream).map_or(0, flockmap::grid::Layer::len),
                is_in_part: fusion.is_in_part(stream),
            }
        };
        Self {
            name: name.to_owned(),
            own: robot.own_stream(),
            uptime: Duration::ZERO,
            quiet_for: Duration::ZERO,
            sensor_ended: false,
            map_voxels: robot.map().count(),
            map_readers: 0,
            peers: session.peers().collect(),
            streams: session.streams().map(of_stream).collect(),
            node: NodeCounters::default(),
            robot: *robot.counters(),
            session: *session.counters(),
            store: StoreCounters::default(),
            beside: BTreeMap::new(),
            timings: timings.clone(),
        }
    }

    /// Packages received and missing, over all streams.
    pub fn packages(&self) -> (u64, u64) {
        let sum = |of: fn(&StreamStatus) -> u64| self.streams.iter().map(of).sum();
        (sum(|s| s.received), sum(|s| s.missing))
    }

    /// What this robot has dropped for want of room. Anything but 0: raise `streams_max` or `epochs_max`, or
    /// `layers_mb` and `own_layer_mb`.
    pub const fn given_up(&self) -> GivenUp {
        let Counters { streams_forgotten, too_many_streams, .. } = self.session;
        let blocks_dropped = self.robot.blocks_dropped;
        GivenUp { runs_forgotten: streams_forgotten, streams_refused: too_many_streams, blocks_dropped }
    }

    /// All counters by name, of the node, the robot, the session, the store, and the program around them.
    pub(crate) fn counters(&self) -> [(&'static str, BTreeMap<String, u64>); 5] {
        [
            ("node", named(&self.node)),
            ("robot", named(&self.robot)),
            ("session", named(&self.session)),
            ("store", named(&self.store)),
            (BESIDE, self.beside.clone()),
        ]
    }

    /// Everything as Prometheus text (format 0.0.4), each line labelled with the name of the robot.
    pub fn prometheus(&self) -> String {
        let robot = escape(&self.name);
        let mut out = String::with_capacity(8_192);
        let mut metric = |kind: &str, name: &str, samples: Vec<(String, f64)>| {
            // Writing to a string cannot fail.
            let _ = writeln!(out, "# TYPE flockmap_{name} {kind}");
            for (labels, value) in samples {
                let _ = writeln!(out, "flockmap_{name}{{robot=\"{robot}\"{labels}}} {value}");
            }
        };
        let one = |value: f64| vec![(String::new(), value)];
        for (prefix, counters) in self.counters() {
            let prefix = if prefix == BESIDE { String::new() } else { format!("{prefix}_") };
            for (name, count) in counters {
                metric("counter", &format!("{prefix}{name}_total"), one(count as f64));
            }
        }
        metric("gauge", "uptime_seconds", one(self.uptime.as_secs_f64()));
        metric("gauge", "store_disk_bytes", one(self.store.disk_bytes as f64));
        metric("gauge", "store_off", one(f64::from(u8::from(self.store.is_off))));
        metric("gauge", "map_readers", one(self.map_readers as f64));
        metric("gauge", "peers", one(self.peers.len() as f64));
        let (free, occupied) = self.map_voxels;
        let states = [("free", free), ("occupied", occupied)];
        let labelled = states.map(|(state, n)| (format!(",state=\"{state}\""), n as f64));
        metric("gauge", "map_voxels", labelled.to_vec());

        let by_stream = |value: &dyn Fn(&StreamStatus) -> f64| {
            let label =
                |s: &StreamStatus| format!(",origin=\"{}\",epoch=\"{}\"", s.stream.origin, s.stream.epoch);
            self.streams.iter().map(|s| (label(s), value(s))).collect()
        };
        metric("gauge", "packages_held", by_stream(&|s| s.received as f64));
        metric("gauge", "packages_missing", by_stream(&|s| s.missing as f64));
        metric("gauge", "layer_voxels", by_stream(&|s| s.voxels as f64));
        metric("gauge", "layer_in_part", by_stream(&|s| f64::from(u8::from(s.is_in_part))));

        let by_peer = |value: &dyn Fn(&PeerInfo) -> Option<f64>| {
            let label = |p: &PeerInfo| format!(",peer=\"{}\"", p.stream.origin);
            self.peers.iter().filter_map(|p| Some((label(p), value(p)?))).collect()
        };
        metric("gauge", "peer_round_trip_seconds", by_peer(&|p| Some(p.round_trip?.as_secs_f64())));
        metric("gauge", "peer_clock_offset_seconds", by_peer(&|p| Some(p.clock_offset_micros? as f64 / 1e6)));
        metric("counter", "peer_bytes_in_total", by_peer(&|p| Some(p.traffic_in.bytes as f64)));

        for (name, histogram) in self.timings.all() {
            let name = format!("{name}_seconds");
            // The samples of a summary have names of their own, so this is written by hand.
            let _ = writeln!(out, "# TYPE flockmap_{name} summary");
            for quantile in [0.5, 0.9, 0.99] {
                let value = histogram.value_at_quantile(quantile) as f64 / 1e6;
                let _ = writeln!(out, "flockmap_{name}{{robot=\"{robot}\",quantile=\"{quantile}\"}} {value}");
            }
            let (sum, count) = (histogram.mean() * histogram.len() as f64 / 1e6, histogram.len());
            let _ = writeln!(out, "flockmap_{name}_sum{{robot=\"{robot}\"}} {sum}");
            let _ = writeln!(out, "flockmap_{name}_count{{robot=\"{robot}\"}} {count}");
        }
        out
    }
}

impl Timings {
    pub(crate) const fn all(&self) -> [(&'static str, &Histogram); 5] {
        [
            ("insert_scan", &self.insert_scan),
            ("insert_states", &self.insert_states),
            ("t_pack", &self.pack),
            ("t_recv2insert", &self.receive_to_insert),
            ("age", &self.age),
        ]
    }
}

/// The line of counters; rates are over the time since the line before.
#[derive(Debug, Default)]
pub(crate) struct StatusLine {
    before: Option<(Duration, u64, u64)>,
}

impl StatusLine {
    pub(crate) fn next(&mut self, status: &NodeStatus, age: &Histogram) -> String {
        let NodeStatus { node, .. } = status;
        let (at, bytes_in, bytes_out) = self.before.unwrap_or_default();
        let seconds = (status.uptime.saturating_sub(at)).as_secs_f64().max(1e-3);
        let rate = |now: u64, then: u64| now.saturating_sub(then) as f64 / 1_024.0 / seconds;
        let (rate_in, rate_out) = (rate(node.bytes_in, bytes_in), rate(node.bytes_out, bytes_out));
        self.before = Some((status.uptime, node.bytes_in, node.bytes_out));
        let (received, missing) = status.packages();
        let (free, occupied) = status.map_voxels;
        let store = if status.store.is_off { " | STORE OFF" } else { "" };
        let record = if node.record_stopped > 0 { " | RECORD OFF" } else { "" };
        let given_up = match status.given_up() {
            GivenUp { runs_forgotten: 0, streams_refused: 0, .. } => String::new(),
            GivenUp { runs_forgotten, streams_refused, .. } => {
                format!(" | GIVEN UP {runs_forgotten} runs, {streams_refused} refused")
            }
        };
        let full = match status.robot.blocks_dropped {
            0 => String::new(),
            blocks => format!(" | FULL, {blocks} far and old blocks dropped"),
        };
        let age = match age.len() {
            0 => "–".to_owned(),
            _ => format!("{:.2} s", age.value_at_quantile(0.5) as f64 / 1e6),
        };
        format!(
            "peers {} | in {rate_in:.1} out {rate_out:.1} KB/s | {} batches | packages {received} received {missing} missing | \
             map {} voxels, {occupied} occupied | age {age}{store}{record}{given_up}{full}",
            status.peers.len(),
            status.robot.batches,
            free + occupied,
        )
    }
}

/// A label of Prometheus.
fn escape(label: &str) -> String {
    label.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

/// What of a node is counted without going through its map: as in Prometheus, without `flockmap_` and `_total`.
pub(crate) fn counters_of(node: &NodeCounters, robot: &Robot) -> Vec<(String, u64)> {
    let rooms = [
        ("node", named(node)),
        ("robot", named(robot.counters())),
        ("session", named(robot.session().counters())),
    ];
    let with_room = |(room, counters): (&str, BTreeMap<String, u64>)| {
        let of_room = counters.into_iter().map(|(name, value)| (format!("{room}_{name}"), value));
        of_room.collect::<Vec<_>>()
    };
    rooms.into_iter().flat_map(with_room).collect()
}

/// Counters by name; of traffic the datagrams, and the bytes under a name of their own.
fn named(counters: &impl Serialize) -> BTreeMap<String, u64> {
    let mut named = BTreeMap::new();
    let mut add = |name: String, count: &Value| named.insert(name, count.as_u64().unwrap_or_default());
    if let Ok(Value::Object(fields)) = serde_json::to_value(counters) {
        for (name, count) in fields {
            if let Value::Object(traffic) = &count {
                add(format!("{name}_bytes"), &traffic["bytes"]);
                add(name, &traffic["datagrams"]);
            } else {
                add(name, &count);
            }
        }
    }
    named
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Resolution, RobotConfig, RobotId, Stamp};

    fn status(name: &str) -> NodeStatus {
        let config = RobotConfig::new(RobotId(3), Resolution::from_metres(0.1).unwrap(), 7.0);
        let robot = Robot::new(config, Stamp(0)).unwrap();
        let node = NodeCounters { bytes_in: 2_048, bytes_out: 10_240, ..NodeCounters::default() };
        let mut timings = Timings::default();
        timings.pack.saturating_record(1_500);
        let second = Duration::from_secs(2);
        NodeStatus { uptime: second, quiet_for: second, node, ..NodeStatus::new(name, &robot, &timings) }
    }

    #[test]
    fn no_counter_is_left_out() {
        let names_of = |debug: String| -> Vec<String> {
            let fields = debug.split(['{', ',']).filter_map(|part| part.trim().split_once(':'));
            fields.map(|(name, _)| name.to_owned()).collect()
        };
        let check = |debug: String, named: BTreeMap<String, u64>| {
            for name in names_of(debug)
                .iter()
                .filter(|n| !["datagrams", "bytes", "disk_bytes", "is_off"].contains(&n.as_str()))
            {
                assert!(named.contains_key(name), "{name} is left out");
            }
        };
        let s = status("r");
        check(format!("{:?}", s.node), named(&s.node));
        check(format!("{:?}", s.robot), named(&s.robot));
        check(format!("{:?}", s.session), named(&s.session));
        // What was restored is named so.
        let store =
            format!("{:?}", s.store).replace("merged", "restored_merged").replace("packages", "restored");
        check(store, named(&s.store));
        // These of the store are gauges.
        let text = s.prometheus();
        for gauge in ["store_disk_bytes", "store_off"] {
            assert!(text.contains(&format!("# TYPE flockmap_{gauge} gauge")), "{gauge} is left out");
        }
    }

    #[test]
    fn the_line_tells_rates_since_the_line_before() {
        let mut line = StatusLine::default();
        let mut now = status("r");
        let first = line.next(&now, &histogram());
        assert!(first.contains("peers 0 | in 1.0 out 5.0 KB/s | 0 batches"), "{first}");
        assert!(first.ends_with("age –"), "{first}");
        now.uptime = Duration::from_secs(3);
        now.node.bytes_in += 4_096;
        let mut age = histogram();
        age.saturating_record(250_000);
        let second = line.next(&now, &age);
        assert!(second.contains("in 4.0 out 0.0 KB/s"), "{second}");
        assert!(second.ends_with("age 0.25 s"), "{second}");
        (now.session.streams_forgotten, now.session.too_many_streams) = (3, 12);
        let third = line.next(&now, &age);
        assert!(third.ends_with("age 0.25 s | GIVEN UP 3 runs, 12 refused"), "{third}");
        now.robot.blocks_dropped = 7;
        let fourth = line.next(&now, &age);
        assert!(fourth.ends_with("12 refused | FULL, 7 far and old blocks dropped"), "{fourth}");
        let expected = GivenUp { runs_forgotten: 3, streams_refused: 12, blocks_dropped: 7 };
        assert_eq!(now.given_up(), expected);
    }

    #[test]
    fn prometheus_text_is_well_formed() {
        let text = status("a \"b\"\\c").prometheus();
        let mut typed = std::collections::BTreeSet::new();
        for line in text.lines() {
            if let Some(rest) = line.strip_prefix("# TYPE ") {
                let (name, kind) = rest.split_once(' ').unwrap();
                assert!(["counter", "gauge", "summary"].contains(&kind), "{line}");
                assert!(typed.insert(name.to_owned()), "{name} twice");
                continue;
            }
            let (name, rest) = line.split_once('{').unwrap();
            let (labels, value) = rest.rsplit_once("} ").unwrap();
            let family = name.trim_end_matches("_sum").trim_end_matches("_count");
            assert!(typed.contains(name) || typed.contains(family), "{line}");
            assert!(labels.starts_with(r#"robot="a \"b\"\\c""#), "{line}");
            assert!(value.parse::<f64>().is_ok(), "{line}");
        }
        assert!(text.contains("flockmap_node_bytes_in_total{"));
        assert!(
            text.contains("flockmap_t_pack_seconds_sum{robot=\"a \\\"b\\\"\\\\c\"} 0.0015"),
            "t_pack in seconds"
        );
    }
}
