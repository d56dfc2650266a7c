//! `report.html`: one page with everything in it, for any browser, also a phone's.

use std::path::Path;

use anyhow::Context;

use crate::chart::{self, Line};
use crate::json_file;
use crate::report::{Bytes, Report};
use crate::table::{kb, percent, thousands};

const STYLE: &str = include_str!("report.css");

/// Writes `report.html` and `report.json` into a folder, which is made if it is not there.
pub fn write(folder: &Path, report: &Report) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    json_file::write(&folder.join("report.json"), report)?;
    let path = folder.join("report.html");
    std::fs::write(&path, page(report)).with_context(|| format!("cannot write {}", path.display()))?;
    println!("\n  report: {}", path.display());
    Ok(())
}

/// The page.
fn page(report: &Report) -> String {
    let title = escape(&report.title);
    let mut page = head(&title);
    let verdict_class = if report.is_good() { "good" } else { "bad" };
    page += &format!("<p class=\"verdict {verdict_class}\">{}</p>", escape(&report.verdict()));
    if report.interrupted {
        page += "<p class=\"verdict bad\">Partial: ended by Ctrl-C.</p>";
    }
    page += &headline(report);
    page += "<section><h2>Bytes over time</h2><p class=\"note\">KB that all robots together sent in each second; the axis is logarithmic.</p>";
    // The last second is a part of one: it would look like a drop.
    let whole =
        |values: &'_ [f64]| values[..values.len().min((report.record_s.floor() as usize).max(2))].to_vec();
    page += &chart::kb_per_second(&[
        Line::per_second("Flockmap, all robots", "ours", &whole(&report.kb_per_second)),
        Line::per_second("RACER, the same changes", "racer", &whole(&report.racer_kb_per_second)),
    ]);
    page += "</section>";
    page += &maps(report);
    page += &bytes_section(report);
    page += &other_sections(report);
    page += &foot(&report.command);
    page
}

/// All of a page before its first section. The title must be fit for HTML.
pub fn head(title: &str) -> String {
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta name=\"color-scheme\" content=\"light dark\"><title>Flockmap: {title}</title><style>{STYLE}</style></head><body><main>\
         <header><h1>Flockmap</h1><p class=\"title\">{title}</p></header>"
    )
}

/// All of a page after its last section.
pub fn foot(command: &str) -> String {
    format!(
        "<footer><p>Made by <code>{}</code></p><p>flockmap {}</p></footer></main></body></html>\n",
        escape(command),
        env!("CARGO_PKG_VERSION")
    )
}

fn headline(report: &Report) -> String {
    let figures = [
        (percent(report.agreement_all), "voxels equal, over all pairs of robots".to_owned()),
        (format!("{} KB/s", kb(report.sum.avg_kb_s * 1024.0)), "sent by all robots, average".to_owned()),
        (format!("{} KB/s", kb(report.sum.max_kb_s * 1024.0)), "in the largest second".to_owned()),
        (format!("× {:.1}", report.racer.ratio), "as many bytes RACER would have sent".to_owned()),
        (
            format!("{:.2} s", report.age_occupied.median_s),
            format!("age of obstacles when they arrive, median ({:.2} s at 99 %)", report.age_occupied.p99_s),
        ),
        (
            format!("{:.2} ms", report.t_recv2insert.mean_ms),
            format!("from datagram to map (paper: {:.2} ms)", report.paper_t_recv2insert_ms),
        ),
    ];
    let cards = figures.map(|(figure, text)| {
        format!("<div class=\"card\"><b>{}</b><span>{}</span></div>", escape(&figure), escape(&text))
    });
    format!("<div class=\"cards\">{}</div>", cards.concat())
}

/// A report's maps, robot by robot.
pub fn map_pictures(report: &Report) -> String {
    let mut html = String::new();
    for pictures in &report.pictures {
        html += &format!("<h3>{}</h3><div class=\"maps\">", escape(&pictures.robot));
        for (seconds, picture) in &pictures.moments {
            let size = |pixels: u32| f64::from(pixels) * picture.pixel_m;
            html += &format!(
                "<figure><img alt=\"Map of {} after {seconds:.0} s\" width=\"{}\" height=\"{}\" src=\"{}\"><figcaption>after {seconds:.0} s; \
                 {:.0} × {:.0} m, a pixel is {:.2} m</figcaption></figure>",
                escape(&pictures.robot),
                picture.width,
                picture.height,
                picture.data_url(),
                size(picture.width),
                size(picture.height),
                picture.pixel_m
            );
        }
        html += "</div>";
    }
    if report.pictures.len() < report.robots.len() {
        html += &format!(
            "<p>The first {} of {} robots are drawn.</p>",
            report.pictures.len(),
            report.robots.len()
        );
    }
    html
}
fn maps(report: &Report) -> String {
    let mut html = String::from(
        "<section><h2>Maps from above</h2><p class=\"legend\"><span class=\"key own\"></span>seen by the robot itself \
         <span class=\"key received\"></span>received from the others · dark: obstacles 0.4 to 2.5 m above the ground, darker is higher · \
         pale: free</p>",
    );
    html += &map_pictures(report);
    html + "</section>"
}

fn bytes_section(report: &Report) -> String {
    let mut rows = String::new();
    let bytes = |b: &Bytes| {
        [
            thousands(b.total_bytes),
            thousands(b.ip_udp_bytes),
            kb(b.avg_kb_s * 1024.0),
            kb(b.max_kb_s * 1024.0),
        ]
    };
    let blank = ["", "", ""].map(str::to_owned);
    for r in &report.robots {
        let counts = [r.requests, r.packages_sent, r.resent].map(thousands);
        rows += &row(&r.name, bytes(&r.bytes).into_iter().chain(counts), "");
    }
    rows += &row("all robots", bytes(&report.sum).into_iter().chain(blank.clone()), "sum");
    let racer = format!("RACER (× {:.1})", report.racer.ratio);
    rows += &row(&racer, bytes(&report.racer.bytes).into_iter().chain(blank.clone()), "");
    let paper = format!("paper, whole packages (× {:.2})", report.paper_whole.ratio);
    rows += &row(&paper, bytes(&report.paper_whole.bytes).into_iter().chain(blank), "");
    let heads = [
        "sent by",
        "total bytes",
        "IP + UDP, bytes",
        "average KB/s",
        "largest KB/s",
        "requests",
        "packages",
        "resent",
    ];
    format!(
        "<section><h2>Bytes</h2>{}<p class=\"note\">{}</p></section>",
        table(&heads, &rows),
        escape(&report.bytes_note())
    )
}

fn other_sections(report: &Report) -> String {
    let mut rows = String::new();
    for (name, age) in [("obstacles", report.age_occupied), ("free space", report.age_free)] {
        let figures = [age.median_s, age.p99_s, age.max_s].map(|s| format!("{s:.3}"));
        rows += &row(name, [thousands(age.voxels)].into_iter().chain(figures), "");
    }
    let mut html = format!(
        "<section><h2>Age</h2>{}<p class=\"note\">From the scan that showed a voxel to its place in another robot's map.</p></section>",
        table(&["voxels of", "number", "median, s", "99 %, s", "largest, s"], &rows)
    );
    rows = String::new();
    for (name, time, paper) in report.times() {
        let paper = paper.map_or_else(|| "–".to_owned(), |ms| format!("{ms:.2}"));
        let cells = [
            thousands(time.count as u64),
            format!("{:.2}", time.mean_ms),
            format!("{:.2}", time.p99_ms),
            paper,
        ];
        rows += &row(name, cells, "");
    }
    html += &format!(
        "<section><h2>Time</h2>{}<p class=\"note\">On one core of this machine. t_pack: cycle closed to packages ready. t_recv2insert: datagram to \
         fused map.</p></section>",
        table(&["step", "number", "mean, ms", "99 %, ms", "paper, ms"], &rows)
    );
    rows = String::new();
    for pair in &report.agreement {
        let name = if pair.receiver == pair.origin {
            format!("robot {} of itself", pair.receiver)
        } else {
            format!("robot {} of robot {}", pair.receiver, pair.origin)
        };
        let packages = format!("{} of {}", thousands(pair.packages_held), thousands(pair.packages));
        rows += &row(&name, [thousands(pair.voxels), percent(pair.agreement), packages], "");
    }
    html += &format!(
        "<section><h2>Layers</h2>{}<p class=\"note\">What each robot holds of each, beside what that robot told and what its own map says.</p></section>",
        table(&["layer", "voxels", "equal", "packages"], &rows)
    );
    let s = &report.settings;
    let t_l_occupied = s.t_l_occupied_s.map_or_else(|| "as free space".to_owned(), |t| format!("{t} s"));
    let settings = [
        ("voxel side", format!("{} m", s.resolution_m)),
        ("range", format!("{} m", s.range_m)),
        ("t_l", format!("{} s", s.t_l_s)),
        ("t_l of obstacles", t_l_occupied),
        ("d", format!("{} voxels", thousands(s.d as u64))),
        ("mapper", s.mapper.clone()),
        ("codec", s.codec.clone()),
        ("sending", s.cast.to_owned()),
        ("radio", s.radio.clone()),
        ("seed", s.seed.to_string()),
        ("first to last scan", format!("{:.1} s", report.record_s)),
    ];
    rows = settings.map(|(name, value)| row(name, [value], "")).concat();
    html + &format!("<section><h2>Settings</h2>{}</section>", table(&["option", "value"], &rows))
}

/// A table that scrolls inside its own box.
pub fn table(heads: &[&str], rows: &str) -> String {
    let heads: String = heads.iter().map(|head| format!("<th>{head}</th>")).collect();
    format!("<div class=\"scroll\"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>")
}

fn row(name: &str, cells: impl IntoIterator<Item = String>, class: &str) -> String {
    let cells: String = cells.into_iter().map(|cell| format!("<td>{}</td>", escape(&cell))).collect();
    format!("<tr class=\"{class}\"><th>{}</th>{cells}</tr>", escape(name))
}

/// Text as it may stand in HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_break_the_page() {
        assert_eq!(escape("<b>\"&"), "&lt;b&gt;&quot;&amp;");
    }
}
