//! Table I: bandwidth on four explorations, all methods; and Fig. 6, the map over time.

use flockmap::SessionConfig;
use flockmap_sim::Link;

use super::figures::{CHANGES_MAX, T_L_S, TABLE_ONE, TableOneRow};
use super::flown::Flown;
use super::jobs::{self, Job};
use super::methods::{self, MethodRow, MethodRows};
use super::stack::{self, Stack, StackPlan};
use super::{Flights, cycle, mapper};
use crate::codec_run::{CodecRun, Outcome};
use crate::document::{Cell, DataTable, Part, Section};
use crate::html::escape;
use crate::measure::KB;
use crate::progress::Progress;
use crate::report::Report;

/// The name of our own stack's row.
pub const STACK: &str = "flockmap, whole stack";
const ABOUT_STACK: &str = "What Flockmap really puts on the wire with the codec `paper`: datagrams of at most 1,200 bytes with all headers, requests and \
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

enum Piece {
    Codec(Outcome),
    Stack(Box<Stack>),
}

/// Measures all rows. What Ctrl-C kept from being measured is left out.
pub fn measure(flights: &Flights, seed: u64, threads: usize) -> anyhow::Result<Vec<Measured>> {
    let rows: Vec<(TableOneRow, &Flown)> =
        TABLE_ONE.into_iter().filter_map(|row| Some((row, flights.get(row.scene)?))).collect();
    // The longest first, so that no core is left with one at the end.
    let mut order: Vec<(usize, Option<usize>)> = Vec::new();
    for number in 0..rows.len() {
        order.push((number, None));
    }
    for (number, (row, _)) in rows.iter().enumerate() {
        order.extend((0..row.robots).map(|robot| (number, Some(robot))));
    }
    let pieces = order.iter().map(|&(number, robot)| {
        let (row, flown) = rows[number];
        match robot {
            None => Job::new(format!("Table I row {}, whole stack", row.number), move || {
                stack_of(&row, flown, seed).map(|stack| Piece::Stack(Box::new(stack)))
            }),
            Some(robot) => Job::new(format!("Table I row {}, robot {}", row.number, robot + 1), move || {
                codecs(flown, robot, row.resolution_m, row.range_m, T_L_S, &methods::all()).map(Piece::Codec)
            }),
        }
    });
    let pieces = jobs::run(threads, pieces.collect())?;
    let mut done: Vec<(Vec<Outcome>, Option<Stack>)> = rows.iter().map(|_| (Vec::new(), None)).collect();
    for ((number, _), piece) in order.iter().zip(pieces) {
        match piece {
            Some(Piece::Codec(outcome)) => done[*number].0.push(outcome),
            Some(Piece::Stack(stack)) => done[*number].1 = Some(*stack),
            None => {}
        }
    }
    let measured = rows.iter().zip(done).filter(|((row, _), (robots, _))| robots.len() == row.robots);
    Ok(measured
        .map(|((row, _), (robots, stack))| {
            let mut methods = MethodRows::of_robots(&robots, row.robots - 1);
            methods.rows.extend(stack.as_ref().map(|stack| stack.row(STACK, ABOUT_STACK)));
            Measured { paper: *row, methods, stack: stack.map(|stack| stack.report) }
        })
        .collect())
}

/// All methods on the record of one robot.
pub fn codecs(
    flown: &Flown,
    robot: usize,
    resolution_m: f64,
    range_m: f64,
    t_l_s: f64,
    methods: &[flockmap_baselines::Method],
) -> anyhow::Result<Outcome> {
    let mapper = mapper(resolution_m, range_m)?;
    let receivers = flown.scene.robots() - 1;
    let mut run = CodecRun::new(mapper, cycle(t_l_s, CHANGES_MAX), methods, receivers);
    let source = flown.sources(range_m)?.swap_remove(robot);
    let mut progress = Progress::new("scans", source.frames_expected);
    run.record(source.frames, || progress.step())?;
    Ok(run.finish())
}

fn stack_of(row: &TableOneRow, flown: &Flown, seed: u64) -> anyhow::Result<Stack> {
    let plan = StackPlan {
        title: row.name(),
        mapper: mapper(row.resolution_m, row.range_m)?,
        cycle: cycle(T_L_S, CHANGES_MAX),
        session: SessionConfig::default(),
        link: Link::default(),
        seed,
    };
    stack::run(&plan, flown.sources(row.range_m)?)
}

/// The table beside the paper's, each row with all methods, and why figures differ.
pub fn section(measured: &[Measured]) -> Section {
    let mut parts = vec![Part::Words(
        "Robots explore, each from what it sees and what it has received, and are recorded; every method then gets the same record. \
         The volume ratio is the one to compare: the paper's averages divide its two methods by different lengths of time."
            .to_owned(),
    )];
    parts.push(Part::Table(beside(measured)));
    for row in measured {
        parts.push(Part::Html(format!(
            "<h3>Row {}: {}, {} robots</h3>",
            row.paper.number,
            escape(&row.paper.name()),
            row.paper.robots
        )));
        parts.push(Part::Html(row.methods.bars()));
        let mut table = row.methods.table(format!("table1_row{}", row.paper.number));
        table.note = format!(
            "Row {}: {}, {} robots, {:.0} s of each robot, {} voxels changed in all.",
            row.paper.number,
            row.paper.name(),
            row.paper.robots,
            row.methods.seconds / row.paper.robots as f64,
            crate::table::thousands(row.methods.changed_voxels)
        );
        parts.push(Part::Table(table));
    }
    if let Some(first) = measured.first() {
        parts.push(Part::Points(about(&first.methods.rows)));
    }
    Section { id: "table1", title: "Table I: bandwidth on four explorations".to_owned(), parts }
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

/// Two lines for each row: here, and in the paper.
fn beside(measured: &[Measured]) -> DataTable {
    let mut table = DataTable::new(
        "table1",
        &[
            ("row", "row"),
            ("scene", "scene, voxel, range"),
            ("robots", "robots"),
            ("where", "measured"),
            ("volume_ratio", "racer / paper, volume"),
            ("paper_bits_per_changed_voxel", "paper, bits a change"),
            ("changed_share_of_box", "share of box changed"),
            ("paper_mb_per_robot", "paper MB"),
            ("racer_mb_per_robot", "racer MB"),
            ("paper_avg_kb_s", "paper avg KB/s"),
            ("racer_avg_kb_s", "racer avg KB/s"),
            ("paper_max_kb_s", "paper max KB/s"),
            ("racer_max_kb_s", "racer max KB/s"),
        ],
    );
    for row in measured {
        let number = |value: Option<f64>| value.map_or(Cell::Missing, |value| Cell::Number(value, 2));
        let of = |name: &str, value: &dyn Fn(&MethodRow) -> f64| number(row.methods.get(name).map(value));
        let mb = |r: &MethodRow| r.total_bytes as f64 / row.paper.robots as f64 / KB / KB;
        let head = |place: &str| {
            [
                Cell::Whole(u64::from(row.paper.number)),
                Cell::text(row.paper.name()),
                Cell::Whole(row.paper.robots as u64),
                Cell::text(place),
            ]
        };
        let here = [
            number(row.methods.ratio("racer", "paper")),
            of("paper", &|r| row.methods.bits(r)),
            // `raw` spends two bits on each voxel of the box.
            number(row.methods.get("raw").map(|r| 2.0 / row.methods.bits(r))),
            of("paper", &mb),
            of("racer", &mb),
            of("paper", &|r| r.avg_kb_s),
            of("racer", &|r| r.avg_kb_s),
            of("paper", &|r| r.max_kb_s),
            of("racer", &|r| r.max_kb_s),
        ];
        table.row(head("here").into_iter().chain(here));
        let paper = &row.paper;
        let there = [
            Cell::Number(paper.volume_ratio(), 2),
            Cell::Number(RACER_BITS / paper.volume_ratio(), 2),
            Cell::Missing,
            Cell::Number(paper.paper.total_mb, 2),
            Cell::Number(paper.racer.total_mb, 2),
            Cell::Number(paper.paper.avg_kb_s, 2),
            Cell::Number(paper.racer.avg_kb_s, 2),
            Cell::Number(paper.paper.max_kb_s, 2),
            Cell::Number(paper.racer.max_kb_s, 2),
        ];
        table.row(head("in the paper").into_iter().chain(there));
    }
    table.note = "MB: mean of the robots; the paper does not say whether its totals are of one robot or of all, which the ratio does not depend on. Bits a \
                  change in the paper: the 40 bits of `racer` by the ratio."
        .to_owned();
    table
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
        Part::Html(crate::html::map_pictures(report)),
    ];
    Some(Section { id: "fig6", title: "Fig. 6: the map over time".to_owned(), parts })
}

/// Whether row 1 is where the paper says, and every lossless method is.
pub fn verdicts(measured: &[Measured]) -> Vec<(bool, String)> {
    let mut verdicts = Vec::new();
    if let Some(row) = measured.iter().find(|row| row.paper.number == 1)
        && let Some(ratio) = row.methods.ratio("racer", "paper")
    {
        let wanted = row.paper.volume_ratio();
        let near = (0.7..=1.3).contains(&(ratio / wanted));
        verdicts.push((
            near,
            format!(
                "Table I row 1: `racer` needs {ratio:.1} times the bytes of `paper`; {wanted:.1} in the paper ({}within 30 %).",
                if near { "" } else { "not " }
            ),
        ));
    }
    let broken: Vec<String> = measured
        .iter()
        .flat_map(|row| row.methods.rows.iter().map(move |method| (row.paper.number, method)))
        .filter(|(_, method)| !method.is_as_promised)
        .map(|(number, method)| format!("{} in row {number}", method.name))
        .collect();
    if measured.is_empty() {
    } else if broken.is_empty() {
        verdicts.push((
            true,
            "Every lossless method ends with every voxel right, in every row of Table I.".to_owned(),
        ));
    } else {
        verdicts.push((
            false,
            format!("NOT LOSSLESS: {}. This is a fault of flockmap, please report it.", broken.join(", ")),
        ));
    }
    verdicts
}
