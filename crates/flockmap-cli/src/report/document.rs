//! The report of a run for people.

use maud::{Markup, html};

use super::{Baseline, Bytes, Report, RobotReport};
use crate::chart::{self, Axis, Line, Scale};
use crate::document::{DataTable, Document, Part, Section};
use crate::measure::KB;
use crate::numbers::{kb, percent, thousands};

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
                "{} m voxels, {} m range, publish period {} s{obstacle_period}, d {}, mapper {}, codec {}, {}; {}",
                s.resolution_m,
                s.range_m,
                s.publish_period_s,
                thousands(s.d as u64),
                s.mapper,
                s.codec,
                s.cast,
                s.radio
            ),
            verdicts: self.verdicts(),
            is_plain: true,
            sections: vec![
                Section::new("headline", "", vec![Part::Figure(self.headline())]),
                Section::new("time-line", "Bytes over time", vec![Part::Figure(self.time_line())]),
                Section::new(
                    "maps",
                    "Maps from above",
                    vec![Part::Figure(legend()), Part::Figure(self.maps())],
                ),
                Section::new("bytes", "Bytes", vec![Part::Table(self.bytes())]),
                Section::new("age", "Age", vec![Part::Table(self.ages())]),
                Section::new("time", "Time", vec![Part::Table(self.times())]),
                Section::new("layers", "Layers", vec![Part::Table(self.known()), Part::Table(self.layers())]),
                Section::new("settings", "Settings", vec![Part::Table(self.settings())]),
            ],
            ..Document::default()
        }
    }

    /// How it ended, and what is not as it must be.
    fn verdicts(&self) -> Vec<(bool, String)> {
        let agreement = format!("agreement {}: {}", percent(self.agreement_all), self.verdict());
        let wrong = self.agreement.iter().filter(|p| !p.is_equal() || p.packages_held != p.packages);
        let wrong = wrong.map(|p| {
            let words = format!(
                "robot {} of robot {}: {} of {} voxels equal, stamps {}, {} of {} packages",
                p.receiver,
                p.origin,
                thousands(p.equal),
                thousands(p.voxels),
                if p.stamps_equal { "equal" } else { "differ" },
                p.packages_held,
                p.packages
            );
            (false, words)
        });
        [(self.is_good(), agreement)].into_iter().chain(wrong).collect()
    }

    fn verdict(&self) -> String {
        let settled = match self.settle_s {
            Some(seconds) => format!("everything had arrived {seconds:.2} s after the last scan"),
            None if self.interrupted => {
                return "ended early by Ctrl-C; not everything had arrived by then".to_owned();
            }
            None => "not everything had arrived when the run ended".to_owned(),
        };
        if self.is_good() {
            format!("every robot holds every other's map, voxel by voxel; {settled}")
        } else {
            format!("NOT GOOD; {settled}")
        }
    }

    fn headline(&self) -> Markup {
        let figures = [
            (percent(self.agreement_all), "voxels equal, over all pairs of robots".to_owned()),
            (format!("{} KB/s", kb(self.sum.avg_kb_s * KB)), "sent by all robots, average".to_owned()),
            (format!("{} KB/s", kb(self.sum.max_kb_s * KB)), "in the largest second".to_owned()),
            (format!("× {:.1}", self.racer.ratio), "as many bytes RACER would have sent".to_owned()),
            (
                format!("{:.2} s", self.age_occupied.median_s),
                format!(
                    "age of obstacles when they arrive, median ({:.2} s at 99 %)",
                    self.age_occupied.p99_s
                ),
            ),
            (
                format!("{:.2} ms", self.t_recv2insert.mean_ms),
                format!("from datagram to map (paper: {:.2} ms)", self.paper_t_recv2insert_ms),
            ),
        ];
        html! {
            div.cards { @for (figure, words) in figures { div.card { b { (figure) } span { (words) } } } }
        }
    }

    fn time_line(&self) -> Markup {
        // The last second is a part of one: it would look like a drop.
        let seconds = (self.record_s.floor() as usize).max(2);
        let whole = |values: &'_ [f64]| values[..values.len().min(seconds)].to_vec();
        let lines = [
            Line::per_second("Flockmap, all robots", "ours", &whole(&self.kb_per_second)),
            Line::per_second("RACER, the same changes", "racer", &whole(&self.racer_kb_per_second)),
        ];
        let x = Axis { label: "time in s", scale: Scale::Linear };
        // So that lines a factor of ten apart can both be read. A second with nothing lies at its low end.
        let y = Axis { label: "KB sent in each second", scale: Scale::Log };
        html! {
            p.note { "KB that all robots together sent in each second; the axis is logarithmic." }
            (chart::svg(x, y, &lines))
        }
    }

    /// The map of each robot at several moments.
    pub fn maps(&self) -> Markup {
        html! {
            @for pictures in &self.pictures {
                h3 { (pictures.robot) }
                div.maps {
                    @for (seconds, picture) in &pictures.moments {
                        @let size = |pixels: u32| f64::from(pixels) * picture.pixel_m;
                        figure {
                            img alt={ "Map of " (pictures.robot) " after " (format!("{seconds:.0}")) " s" }
                                width=(picture.width) height=(picture.height) src=(picture.data_url());
                            figcaption {
                                (format!(
                                    "after {seconds:.0} s; {:.0} × {:.0} m, a pixel is {:.2} m",
                                    size(picture.width),
                                    size(picture.height),
                                    picture.pixel_m
                                ))
                            }
                        }
                    }
                }
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
            let [avg, max] = [bytes.avg_kb_s, bytes.max_kb_s].map(|kb_s| kb(kb_s * KB));
            [name, total, ip_udp, avg, max, requests, packages, resent, relayed]
        };
        let counts = |r: &RobotReport| [r.requests, r.packages_sent, r.resent, r.relayed];
        let mut rows: Vec<[String; 9]> =
            self.robots.iter().map(|r| row(r.name.clone(), &r.bytes, counts(r).map(thousands))).collect();
        let total = |number: usize| self.robots.iter().map(|r| counts(r)[number]).sum::<u64>();
        let totals = [0, 1, 2, 3].map(total);
        rows.push(row("all robots".to_owned(), &self.sum, totals.map(thousands)));
        let baseline = |name: String, of: &Baseline| row(name, &of.bytes, Default::default());
        rows.push(baseline(format!("racer (×{:.1})", self.racer.ratio), &self.racer));
        rows.push(baseline(format!("paper whole (×{:.2})", self.paper_whole.ratio), &self.paper_whole));
        let headings = [
            "sent",
            "total bytes",
            "+ IP/UDP",
            "avg KB/s",
            "max KB/s",
            "requests",
            "packages",
            "resent",
            "relayed",
        ];
        let table = DataTable::unnamed(headings, rows).with_note(self.bytes_note());
        DataTable { sum: Some(self.robots.len()), ..table }
    }

    /// What the bytes count.
    fn bytes_note(&self) -> String {
        let copies = match (self.settings.cast, self.robots.len()) {
            ("broadcast", _) => "broadcast: sent once for all".to_owned(),
            (_, 2) => "unicast".to_owned(),
            (_, n) => {
                format!("unicast: each of the {} others gets its own copy, for racer and paper too", n - 1)
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
        format!(
            "UDP payload with requests, repairs and all headers; 28 bytes of IP and UDP for each datagram apart. KB = 1,024 bytes. Average \
             over {:.1} s from first to last scan; max: largest window of one second. {copies}. racer: 5 bytes for each of the same changes \
             and 52 for each 200 of them, sent once, no requests, no repairs. paper whole: each batch as one package, likewise.{budget}",
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
    }

    /// What each robot knows.
    fn known(&self) -> DataTable {
        let rows = self.robots.iter().map(|r| {
            let layers = r.layers.iter().map(|l| format!("{}: {}", l.origin, thousands(l.voxels as u64)));
            let layers = layers.collect::<Vec<_>>().join(", ");
            let [free, occupied] = [r.map.free, r.map.occupied].map(|voxels| thousands(voxels as u64));
            [r.name.clone(), free, occupied, layers]
        });
        DataTable::unnamed(["map", "free", "occupied", "layers held (robot: voxels)"], rows)
            .with_note("Voxels of each robot's fused map, and of each layer that it holds.")
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
        DataTable { is_long: true, ..table }
    }

    fn settings(&self) -> DataTable {
        let s = &self.settings;
        let obstacle_period =
            s.obstacle_period_s.map_or_else(|| "as free space".to_owned(), |t| format!("{t} s"));
        let rows = [
            ("voxel side", format!("{} m", s.resolution_m)),
            ("range", format!("{} m", s.range_m)),
            ("publish period", format!("{} s", s.publish_period_s)),
            ("obstacle period", obstacle_period),
            ("d", format!("{} voxels", thousands(s.d as u64))),
            ("mapper", s.mapper.clone()),
            ("codec", s.codec.clone()),
            ("sending", s.cast.to_owned()),
            ("radio", s.radio.clone()),
            ("seed", s.seed.to_string()),
            ("first to last scan", format!("{:.1} s", self.record_s)),
        ];
        let rows = rows.map(|(name, value)| [name.to_owned(), value]);
        DataTable { is_long: true, ..DataTable::unnamed(["option", "value"], rows) }
    }
}

/// What the colours of the pictures mean.
fn legend() -> Markup {
    html! {
        p.legend {
            span.key.own {} "seen by the robot itself " span.key.received {} "received from the others · dark: obstacles 0.4 to \
             2.5 m above the ground, darker is higher · pale: free"
        }
    }
}
