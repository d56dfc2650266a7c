//! Table I: bandwidth on four explorations, all methods; and Fig. 6, the map over time.

use flockmap_cli::document::{Cell, DataTable, Part, Section, Verdict};
use flockmap_cli::measure::KB;
use flockmap_cli::numbers::{percent_short, thousands};
use flockmap_cli::report::Report;
use maud::html;

use super::figures::{TABLE_ONE, TableOneRow};
use super::flown::Flown;
use super::methods::{self, MethodRow, MethodRows};
use super::settings::mapper;
use super::team::{self, RACER_CODE, Team};

const ABOUT_STACK: &str = "What Flockmap really puts on the wire with the codec `flock`: datagrams of at most 1,200 bytes with all headers, requests and \
     repairs, over a perfect radio.";

/// Bits that RACER spends on a voxel: an address of 32 and a state of 8.
const RACER_BITS: f64 = 40.0;

/// One row of the table, measured.
pub struct Measured {
    pub paper: TableOneRow,
    pub methods: MethodRows,
    /// The run of our own stack, with pictures.
    pub stack: Option<Report>,
}

/// Measures all rows. What Ctrl-C kept from being measured is left out.
pub fn measure(flights: &[Flown], seed: u64, quick: bool, threads: usize) -> anyhow::Result<Vec<Measured>> {
    let flown = |row: &TableOneRow| flights.iter().find(|flown| flown.scene == row.scene);
    let rows: Vec<(TableOneRow, &Flown)> =
        TABLE_ONE.into_iter().filter_map(|row| Some((row, flown(&row)?))).collect();
    let teams = rows.iter().map(|&(row, flown)| {
        anyhow::Ok(Team {
            name: format!("Table I row {}", row.number),
            title: row.name(),
            about_stack: ABOUT_STACK,
            mapper: mapper(row.resolution_m, row.range_m)?,
            robots: row.scene.robots(),
            open: Box::new(move || flown.sources(row.range_m)),
            relayed_s: methods::relayed_s(quick),
            // Ten scans a second.
            is_within: |number, _, seconds| number < (seconds * 10.0) as usize,
        })
    });
    let teams = teams.collect::<anyhow::Result<Vec<_>>>()?;
    let measured = rows.iter().zip(team::measure(&teams, seed, threads)?);
    Ok(measured
        .filter_map(|((row, _), measured)| {
            let team::Measured { methods, stack } = measured?;
            Some(Measured { paper: *row, methods, stack })
        })
        .collect())
}

/// The table beside the paper's, each row with all methods, and why figures differ.
pub fn section(measured: &[Measured]) -> Section {
    let mut parts = vec![Part::Words(
        "Robots explore, each from what it sees and what it has received, and are recorded; every method then gets the same record. \
         The volume ratio is the one to compare: the paper's averages divide its two methods by different lengths of time."
            .to_owned(),
    )];
    parts.push(Part::Table(beside(measured)));
    parts.push(Part::Points(why(measured)));
    for row in measured {
        let name =
            format!("Row {}: {}, {} robots", row.paper.number, row.paper.name(), row.paper.scene.robots());
        parts.push(Part::Figure(html! { h3 { (name) } (row.methods.bars()) }));
        let note = format!(
            "{name}, {:.0} s of each robot, {} voxels changed in all.",
            row.methods.seconds / row.paper.scene.robots() as f64,
            thousands(row.methods.changed_voxels)
        );
        let table = row.methods.table(format!("table1_row{}", row.paper.number));
        parts.push(Part::Table(table.with_note(note)));
    }
    if let Some(first) = measured.first() {
        parts.push(Part::Points(about(&first.methods.rows)));
    }
    Section::new("table1", "Table I: bandwidth on four explorations", parts)
}

/// Each method in a sentence.
pub fn about(rows: &[MethodRow]) -> Vec<String> {
    let mut points = vec![
        "Total bytes: of all robots, each message once for each of the other robots (unicast), with its own headers; IP and UDP apart. \
         KB = 1,024 bytes. Average: mean of the robots over the record; max: largest second of any robot. Agreement: voxels that are right \
         at a receiver when everything has arrived."
            .to_owned(),
    ];
    points.extend(rows.iter().map(|row| format!("`{}`: {}", row.name, row.about)));
    points
}

/// Why the ratios are what they are, and why they are not the paper's.
fn why(measured: &[Measured]) -> Vec<String> {
    let mut points = vec![
        "The ratio is the 40 bits that `racer` spends on a change by the bits that `paper` spends. These follow from how densely changes fill their \
         box: of a sparse box most codes say \"unchanged\", and these cost too (Fig. 5)."
            .to_owned(),
    ];
    for row in measured {
        let Some(ratio) = row.methods.ratio("racer", "paper") else { continue };
        let wanted = row.paper.volume_ratio();
        let bits = row.methods.get("paper").map_or(f64::NAN, |r| row.methods.bits(r));
        let first_touch = row.methods.ratio(RACER_CODE, "racer");
        let batches = first_touch.map_or(String::new(), |share| {
            format!(" RACER as its code does it sends {share:.2} times the bytes of `racer`: fewer voxels (first touch only), but headers, announcements and resends.")
        });
        points.push(format!(
            "Row {}: {ratio:.1} here, {wanted:.1} in the paper; `paper` spends {bits:.1} bits a change here and would have to spend {:.1} to come to the paper's \
             ratio.{batches}",
            row.paper.number,
            RACER_BITS / wanted
        ));
    }
    points.push(
        "Where our saving is larger than the paper's (rows 2 to 4) its scans must have been sparser or its changes fewer a batch than ours: the same 0.5 s of a \
         flight that has little new to see cost a package of the same box for few voxels. The paper names neither LiDAR nor world, so that we cannot say which. \
         It also describes RACER in two ways, as sending newly observed voxels and as sending all changes of state; `racer` here is the latter, `racer-code` the former."
            .to_owned(),
    );
    points
}

/// Two lines for each row: here, and in the paper.
fn beside(measured: &[Measured]) -> DataTable {
    /// What is said of one place of measuring.
    struct Line<'a> {
        paper: &'a TableOneRow,
        place: &'static str,
        ratio: Option<f64>,
        bits: Option<f64>,
        changed_share: Option<f64>,
        /// MB, average and largest KB/s of paper, then of racer.
        traffic: [[Option<f64>; 3]; 2],
    }
    let mut lines = Vec::new();
    for Measured { paper, methods, .. } in measured {
        let of = |name: &str| {
            let row = methods.get(name);
            let mb = |r: &MethodRow| r.total_bytes as f64 / paper.scene.robots() as f64 / KB / KB;
            [row.map(mb), row.map(|r| r.avg_kb_s), row.map(|r| r.max_kb_s)]
        };
        lines.push(Line {
            paper,
            place: "here",
            ratio: methods.ratio("racer", "paper"),
            bits: methods.get("paper").map(|r| methods.bits(r)),
            // `raw` spends two bits on each voxel of the box.
            changed_share: methods.get("raw").map(|r| 2.0 / methods.bits(r)),
            traffic: [of("paper"), of("racer")],
        });
        let ratio = paper.volume_ratio();
        lines.push(Line {
            paper,
            place: "in the paper",
            ratio: Some(ratio),
            bits: Some(RACER_BITS / ratio),
            changed_share: None,
            traffic: [paper.paper, paper.racer].map(|[avg, max, mb]| [mb, avg, max].map(Some)),
        });
    }
    let table = DataTable::of(
        "table1",
        &lines,
        &[
            ("row", "row", &|l| Cell::Whole(l.paper.number.into())),
            ("scene", "scene, voxel, range", &|l| Cell::text(l.paper.name())),
            ("robots", "robots", &|l| Cell::count(l.paper.scene.robots())),
            ("where", "measured", &|l| Cell::text(l.place)),
            ("volume_ratio", "racer / paper, volume", &|l| Cell::maybe(l.ratio, 2)),
            ("paper_bits_per_changed_voxel", "paper, bits a change", &|l| Cell::maybe(l.bits, 2)),
            ("changed_share_of_box", "share of box changed", &|l| Cell::maybe(l.changed_share, 2)),
            ("paper_mb_per_robot", "paper MB", &|l| Cell::maybe(l.traffic[0][0], 2)),
            ("racer_mb_per_robot", "racer MB", &|l| Cell::maybe(l.traffic[1][0], 2)),
            ("paper_avg_kb_s", "paper avg KB/s", &|l| Cell::maybe(l.traffic[0][1], 2)),
            ("racer_avg_kb_s", "racer avg KB/s", &|l| Cell::maybe(l.traffic[1][1], 2)),
            ("paper_max_kb_s", "paper max KB/s", &|l| Cell::maybe(l.traffic[0][2], 2)),
            ("racer_max_kb_s", "racer max KB/s", &|l| Cell::maybe(l.traffic[1][2], 2)),
        ],
    );
    table.with_note(
        "MB: mean of the robots; the paper does not say whether its totals are of one robot or of all, which the ratio does not depend on. Bits a \
         change in the paper: the 40 bits of `racer` by the ratio.",
    )
}

/// The map of each robot over time, own and received.
pub fn fig6(measured: &[Measured]) -> Option<Section> {
    let row = measured.iter().find(|row| row.stack.is_some())?;
    let report = row.stack.as_ref()?;
    let parts = vec![
        Part::Words(format!(
            "{}: the fused map of each robot after a third, two thirds and all of the exploration. Violet: seen by the robot itself; \
             green: received from its team-mate.",
            row.paper.name()
        )),
        Part::Figure(report.maps()),
    ];
    Some(Section::new("fig6", "Fig. 6: the map over time", parts))
}

/// Whether row 1 is where the paper says, and every lossless method is.
pub fn verdicts(measured: &[Measured]) -> Vec<Verdict> {
    let mut verdicts = Vec::new();
    if let Some(row) = measured.iter().find(|row| row.paper.number == 1)
        && let Some(ratio) = row.methods.ratio("racer", "paper")
    {
        let wanted = row.paper.volume_ratio();
        let near = (0.7..=1.3).contains(&(ratio / wanted));
        let not = if near { "" } else { "not " };
        let words = format!(
            "Table I row 1: `racer` needs {ratio:.1} times the bytes of `paper`; {wanted:.1} in the paper ({not}within 30 %)."
        );
        verdicts.push(Verdict::good_or_note(near, words));
    }
    let stale: Vec<String> = measured
        .iter()
        .filter_map(|row| Some((row.paper.number, row.methods.get(RACER_CODE)?.agreement)))
        .map(|(number, share)| format!("{} in row {number}", percent_short(share)))
        .collect();
    if !stale.is_empty() {
        let stale = stale.join(", ");
        let words = "`racer-code` ends with voxels that are stale or were never sent. Right at the end";
        verdicts.push(Verdict::Note(format!("{words}: {stale}.")));
    }
    let broken: Vec<String> = measured
        .iter()
        .flat_map(|row| row.methods.rows.iter().map(move |method| (row.paper.number, method)))
        .filter(|(_, method)| !method.is_as_promised)
        .map(|(number, method)| format!("{} in row {number}", method.name))
        .collect();
    if !measured.is_empty() {
        let words = if broken.is_empty() {
            "Every lossless method ends with every voxel right, in every row of Table I.".to_owned()
        } else {
            format!("NOT LOSSLESS: {}. This is a fault of flockmap, please report it.", broken.join(", "))
        };
        verdicts.push(Verdict::good_if(broken.is_empty(), words));
    }
    verdicts
}
