//! The report of a run for people.

use maud::{Markup, html};

use super::fused::Shared;
use super::{Baseline, Bytes, Report, RobotReport, words};
use crate::chart::{self, Axis, Bar, Line, Scale};
use crate::document::{DataTable, Document, Part, Section, Verdict, terms};
use crate::map_figure;
use crate::measure::KB;
use crate::numbers::{kb, percent, thousands};

/// Of layers that are not equal, so many are named.
const WRONG_SHOWN: usize = 6;

impl Report {
    /// Its tables, charts and pictures.
    pub fn document(&self) -> Document {
        let s = &self.settings;
        let obstacle_period = s.obstacle_period_s.map_or(String::new(), |t| format!(" (obstacles {t} s)"));
        Document {
            title: format!(
                "{}{}",
                self.title,
                if self.interrupted { " (partial: ended by Ctrl-C)" } else { "" }
            ),
            about: format!(
                "{} m voxels, {} m range, publish period {} s{obstacle_period}, batch limit {}, mapper {}, codec {}, {}; {}",
                s.resolution_m,
                s.range_m,
                s.publish_period_s,
                thousands(s.batch_limit as u64),
                s.mapper,
                s.codec,
                s.cast,
                s.radio
            ),
            verdicts: self.verdicts(),
            is_plain: true,
            sections: vec![
                Section::new("headline", "", vec![Part::Figure(self.headline())]),
                Section::new("time-line", "Bytes over the radio", vec![Part::Figure(self.time_line())]),
                Section::new(
                    "maps",
                    "Maps from above",
                    vec![Part::Figure(self.own_and_fused()), Part::Figure(self.maps())],
                ),
                Section::new("bytes", "Bytes", vec![Part::Table(self.bytes())]),
                Section::new("age", "Age", vec![Part::Table(self.ages())]),
                Section::new("time", "Time", vec![Part::Table(self.times())]),
                Section::new("layers", "Layers", vec![Part::Table(self.known()), Part::Table(self.layers())]),
                Section::new("fused", "Fused maps", vec![Part::Table(self.fused())]),
                Section::new("settings", "Settings", vec![Part::Table(self.settings())]),
            ],
            pictures: self.picture_files(),
            ..Document::default()
        }
    }

    /// How it ended, and what is not as it must be.
    fn verdicts(&self) -> Vec<Verdict> {
        let agreement = format!("agreement {}: {}", percent(self.agreement_all), self.verdict());
        let fused = &self.fused;
        let note = fused.share.map(|share| {
            let known = format!("fused maps: {} of the voxels that two robots know are equal", percent(share));
            let seen = fused.share_of_seen.map_or_else(
                || "none of them was seen by both".to_owned(),
                |share| format!("{} of those that both saw themselves", percent(share)),
            );
            let why = "Layers, what was received of each other, must be equal; fused maps need not be: where both saw a voxel, each \
                       trusts the newest observation, its own before it is published.";
            match share >= 1.0 {
                true => Verdict::Good(format!("{known}; {seen}.")),
                false => Verdict::Note(format!("{known}; {seen}. {why}")),
            }
        });
        [Verdict::good_if(self.is_good(), agreement)].into_iter().chain(note).collect()
    }

    fn verdict(&self) -> String {
        let settled = match self.settle_s {
            Some(seconds) => format!("everything had arrived {seconds:.2} s after the last scan"),
            None if self.interrupted => {
                "ended early by Ctrl-C; not everything had arrived by then".to_owned()
            }
            None => "not everything had arrived when the run ended".to_owned(),
        };
        if self.is_good() {
            return format!("every robot holds every other's map, voxel by voxel; {settled}");
        }
        let wrong = self.agreement.iter().filter(|p| !p.is_equal() || p.packages_held != p.packages);
        let wrong: Vec<String> = wrong
            .map(|p| {
                format!(
                    "robot {} of robot {}: {} of {} voxels equal, stamps {}, {} of {} packages",
                    p.receiver,
                    p.origin,
                    thousands(p.equal),
                    thousands(p.voxels),
                    if p.stamps_equal { "equal" } else { "differ" },
                    p.packages_held,
                    p.packages
                )
            })
            .collect();
        let more = wrong.len().saturating_sub(WRONG_SHOWN);
        let more = if more > 0 { format!("; and {more} more") } else { String::new() };
        format!("{settled}. {}{more}", wrong[..wrong.len().min(WRONG_SHOWN)].join("; "))
    }

    fn headline(&self) -> Markup {
        let s = &self.settings;
        let figures = [
            (
                percent(self.agreement_all),
                "agreement of what robots received with what was published".to_owned(),
            ),
            (
                format!("{} KB/s", kb(self.sum.wire_avg_kb_s * KB)),
                "on the wire, all robots together, on average".to_owned(),
            ),
            (format!("× {:.1}", self.racer.ratio), "as many bytes by RACER's method".to_owned()),
            (format!("× {:.1}", self.paper_whole.ratio), "as many bytes by the paper's method".to_owned()),
            (
                format!("{:.2} s", self.age_occupied.median_s),
                format!(
                    "age of obstacles when they arrive, median ({:.2} s for 99 of 100)",
                    self.age_occupied.p99_s
                ),
            ),
            (
                format!("{:.2} ms", self.t_recv2insert.mean_ms),
                format!("from datagram to map (the paper: {:.2} ms)", self.paper_t_recv2insert_ms),
            ),
        ];
        html! {
            p {
                "Each of " (self.robots.len()) " robots maps what its own LiDAR sees, in cubes of " (s.resolution_m) " m, and every "
                (s.publish_period_s) " s sends the others what changed. The radio: " (s.radio) ". What is lost is noticed, asked for "
                "and sent again, so that every robot ends with what all of them saw."
            }
            div.cards { @for (figure, words) in figures { div.card { b { (figure) } span { (words) } } } }
            (terms(&words::of_headline(s)))
        }
    }

    fn time_line(&self) -> Markup {
        // The last second is a part of one: it would look like a drop.
        let seconds = (self.record_s.floor() as usize).max(2);
        let whole = |values: &'_ [f64]| values[..values.len().min(seconds)].to_vec();
        let lines = [
            Line::per_second("Flockmap, with repairs", "ours", &whole(&self.kb_per_second)),
            Line::per_second("the paper's method, sent once", "paper", &whole(&self.paper_kb_per_second)),
            Line::per_second("RACER's method, sent once", "racer", &whole(&self.racer_kb_per_second)),
        ];
        let bar = |name: &str, class, bytes: &Bytes| Bar {
            name: name.to_owned(),
            class,
            value: bytes.wire_bytes() as f64,
            text: format!("{} KB", kb(bytes.wire_bytes() as f64)),
        };
        let bars = [
            bar("Flockmap", "ours", &self.sum),
            bar("the paper", "paper", &self.paper_whole.bytes),
            bar("RACER", "racer", &self.racer.bytes),
        ];
        let x = Axis { label: "time in s", scale: Scale::Linear };
        // So that lines a factor of ten apart can both be read. A second with nothing lies at its low end.
        let y = Axis { label: "KB on the wire in each second, all robots together", scale: Scale::Log };
        html! {
            p.note { "The whole run, all robots together, with IP and UDP headers:" }
            (chart::bars(&bars))
            p.note {
                "Over time. The axis is logarithmic: equal steps upwards are equal factors. Flockmap's line holds requests and the "
                "repair of what this radio lost; the other two would go out once, over a radio that loses nothing."
            }
            (chart::lines(x, y, &lines))
        }
    }

    /// What the first robot saw, and what it knows.
    fn own_and_fused(&self) -> Markup {
        html! {
            p.legend {
                span.entry { span.key.own {} "seen by the robot itself" } " "
                span.entry { span.key.received {} "received from others" } " "
                span.entry { span.key.self {} "path of the robot whose map it is" } " "
                span.entry { span.key.mate {} "paths of the others" } " "
                "Strong colours are obstacles 0.4 to 2.5 m above the ground, the stronger the higher; weak ones are free space."
            }
            @if !self.own_and_fused.is_empty() {
                div.maps.two { @for figure in &self.own_and_fused { (figure.markup()) } }
            }
        }
    }

    fn picture_files(&self) -> Vec<(&'static str, String)> {
        if self.own_and_fused.is_empty() {
            return Vec::new();
        }
        let legend = [
            "Violet: seen by robot 1 itself. Green: received from others. Strong colours: obstacles. Lines: where the robots flew."
                .to_owned(),
            format!("{} KB/s over the radio, all robots together. {}.", kb(self.sum.wire_avg_kb_s * KB), self.settings.radio),
        ];
        vec![("maps.svg", map_figure::svg_file(&self.title, &legend, &self.own_and_fused))]
    }

    /// The map of each robot at several moments.
    pub fn maps(&self) -> Markup {
        html! {
            @for pictures in &self.pictures {
                h3 { "Map of " (pictures.robot) }
                div.maps { @for figure in &pictures.moments { (figure.markup()) } }
            }
            @if self.pictures.len() < self.robots.len() {
                p { "The first " (self.pictures.len()) " of " (self.robots.len()) " robots are drawn." }
            }
        }
    }

    fn bytes(&self) -> DataTable {
        let row = |name: String, bytes: &Bytes, counts: [String; 4]| {
            let [requests, packages, resent, relayed] = counts;
            let [total, ip_udp] = [bytes.total_bytes, bytes.ip_udp_bytes].map(thousands);
            let [avg, max] = [bytes.wire_avg_kb_s, bytes.wire_max_kb_s].map(|kb_s| kb(kb_s * KB));
            [name, total, ip_udp, avg, max, requests, packages, resent, relayed]
        };
        let counts = |r: &RobotReport| [r.requests, r.packages_sent, r.resent, r.relayed];
        let mut rows: Vec<[String; 9]> =
            self.robots.iter().map(|r| row(r.name.clone(), &r.bytes, counts(r).map(thousands))).collect();
        let total = |number: usize| self.robots.iter().map(|r| counts(r)[number]).sum::<u64>();
        let totals = [0, 1, 2, 3].map(total);
        rows.push(row("all robots".to_owned(), &self.sum, totals.map(thousands)));
        let baseline = |name: String, of: &Baseline| row(name, &of.bytes, Default::default());
        rows.push(baseline(format!("RACER (× {:.1})", self.racer.ratio), &self.racer));
        rows.push(baseline(format!("the paper (× {:.2})", self.paper_whole.ratio), &self.paper_whole));
        let headings = [
            "sent", "payload", "IP + UDP", "avg KB/s", "max KB/s", "requests", "packages", "resent",
            "relayed",
        ];
        let table =
            DataTable::unnamed(headings, rows).with_note(self.bytes_note()).with_terms(words::of_bytes());
        DataTable { sum: Some(self.robots.len()), ..table }
    }

    /// What the bytes count.
    fn bytes_note(&self) -> String {
        let copies = match (self.settings.cast, self.robots.len()) {
            ("broadcast", _) => "broadcast: sent once for all".to_owned(),
            (_, 2) => "unicast".to_owned(),
            (_, n) => {
                format!("unicast: each of the {} others gets its own copy, from the rivals too", n - 1)
            }
        };
        let sum = |of: fn(&RobotReport) -> u64| self.robots.iter().map(of).sum::<u64>();
        let (deferred, in_parts) = (sum(|r| r.batches_deferred), sum(|r| r.batches_in_parts));
        let budget = match deferred + in_parts {
            0 => String::new(),
            _ => format!(
                " For want of budget, {} of {} batches waited and {} held only what was nearest; the rest came later.",
                thousands(deferred),
                thousands(sum(|r| r.batches)),
                thousands(in_parts)
            ),
        };
        let submaps = match [sum(|r| r.submaps_begun), sum(|r| r.submap_poses)] {
            [0, 0] => String::new(),
            [begun, moved] => format!(
                " Submaps: {} begun beside the first of each robot, moved {} times; packages of {} bytes say so.",
                thousands(begun),
                thousands(moved),
                thousands(sum(|r| r.submap_package_bytes))
            ),
        };
        format!(
            "Bytes, with requests, repairs and all headers; KB/s with the 28 bytes of IP and UDP of each datagram. KB = 1,024 bytes. \
             Average over {:.1} s from first to last scan; max: largest window of one second. {copies}. RACER: 5 bytes for each of the \
             same changes and 52 for each 200 of them. The paper: each batch as one package. Both sent once, without requests or \
             repairs, as if nothing were lost.{budget}{submaps}",
            self.record_s
        )
    }

    fn ages(&self) -> DataTable {
        let rows = [("obstacles", self.age_occupied), ("free space", self.age_free)].map(|(name, age)| {
            let [median, p99, max] = [age.median_s, age.p99_s, age.max_s].map(|s| format!("{s:.3}"));
            [name.to_owned(), thousands(age.voxels), median, p99, max]
        });
        let headings = ["age of what arrived", "voxels", "median s", "99 % s", "largest s"];
        DataTable::unnamed(headings, rows)
            .with_note("From the scan that showed a voxel to its place in another robot's map.")
            .with_terms(words::of_ages())
    }

    fn times(&self) -> DataTable {
        let steps = [
            ("map a scan", self.t_map, None),
            ("t_pack", self.t_pack, Some(self.paper_t_pack_ms)),
            ("t_recv2insert", self.t_recv2insert, Some(self.paper_t_recv2insert_ms)),
        ];
        let rows = steps.map(|(name, time, paper)| {
            let ms = |ms: f64| format!("{ms:.2}");
            let count = thousands(time.count as u64);
            [name.to_owned(), count, ms(time.mean_ms), ms(time.p99_ms), paper.map_or(String::new(), ms)]
        });
        DataTable::unnamed(["time, one core", "count", "mean ms", "99 % ms", "paper ms"], rows).with_note(
            "On one core of this machine. t_pack: batch closed to packages ready. t_recv2insert: datagram to fused map.",
        )
        .with_terms(words::of_times())
    }

    /// What each robot knows.
    fn known(&self) -> DataTable {
        let rows = self.robots.iter().map(|r| {
            let layers = r.layers.iter().map(|l| format!("{}: {}", l.origin, thousands(l.voxels as u64)));
            let layers = layers.collect::<Vec<_>>().join(", ");
            let [free, occupied] = [r.map.free, r.map.occupied].map(|voxels| thousands(voxels as u64));
            [r.name.clone(), free, occupied, layers]
        });
        DataTable::unnamed(["map", "free", "occupied", "layers held"], rows)
            .with_note("Voxels of each robot's fused map, and of each layer that it holds (robot: voxels).")
    }

    /// Each layer beside the original.
    fn layers(&self) -> DataTable {
        let rows = self.agreement.iter().map(|pair| {
            let name = if pair.receiver == pair.origin {
                format!("robot {} of itself", pair.receiver)
            } else {
                format!("robot {} of robot {}", pair.receiver, pair.origin)
            };
            let packages = format!("{} of {}", thousands(pair.packages_held), thousands(pair.packages));
            [name, thousands(pair.voxels), percent(pair.agreement), packages]
        });
        let table = DataTable::unnamed(["layer", "voxels", "equal", "packages"], rows).with_note(
            "What each robot has received of each, beside what that robot published and what its own map says.",
        );
        DataTable { is_long: true, ..table.with_terms(words::of_layers()) }
    }

    /// The fused maps of every two robots.
    fn fused(&self) -> DataTable {
        let row = |name: String, s: &Shared| {
            let [all, of_seen] =
                [s.share(), s.share_of_seen()].map(|s| s.map_or_else(|| "–".to_owned(), percent));
            [name, thousands(s.known), all, thousands(s.seen), of_seen]
        };
        let pairs = self.fused.pairs.iter();
        let mut rows: Vec<_> = pairs
            .map(|pair| row(format!("{} and {}", pair.robots[0], pair.robots[1]), &pair.shared))
            .collect();
        let sum = (rows.len() > 1).then_some(rows.len());
        rows.extend(sum.map(|_| row("all pairs".to_owned(), &self.fused.all)));
        let headings = ["robots", "both know", "equal", "both saw", "equal of these"];
        let table = DataTable::unnamed(headings, rows).with_terms(words::of_fused());
        DataTable { is_long: true, sum, ..table }
    }

    fn settings(&self) -> DataTable {
        let rows = words::of_settings(&self.settings, self.record_s);
        DataTable { is_long: true, ..DataTable::unnamed(["option", "value", "what it is"], rows) }
    }
}
