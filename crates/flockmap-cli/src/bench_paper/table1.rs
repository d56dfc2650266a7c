//! Table I: bandwidth on four explorations, all methods; and Fig. 6, the map over time.

use flockmap::grid::MapperConfig;
use flockmap::{Codec, SessionConfig};
use flockmap_baselines::racer_code::{RacerCast, RacerConfig};
use flockmap_netsim::{Link, RadioConfig};

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
use crate::member::IP_UDP_BYTES;
use crate::progress::Progress;
use crate::report::Report;
use crate::rival_swarm;
use crate::sources::Source;
use crate::table::percent_short;

/// The name of our own stack's row.
pub const STACK: &str = "flockmap, whole stack";
/// The name of RACER's own session's row.
const RACER_CODE: &str = "racer-code";
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

enum Piece {
    Codec(Outcome),
    Stack(Box<Stack>),
    Rival(MethodRow),
    Relay(Outcome),
}

/// What one job measures.
#[derive(Clone, Copy)]
enum Part1 {
    Stack,
    Rival,
    /// All methods that code cycles on the record of this robot.
    Robot(usize),
    /// Those that relay scans.
    Relay(usize),
}

/// Measures all rows. What Ctrl-C kept from being measured is left out.
pub fn measure(flights: &Flights, seed: u64, quick: bool, threads: usize) -> anyhow::Result<Vec<Measured>> {
    let rows: Vec<(TableOneRow, &Flown)> =
        TABLE_ONE.into_iter().filter_map(|row| Some((row, flights.get(row.scene)?))).collect();
    // The longest first, so that no core is left with one at the end.
    let mut order: Vec<(usize, Part1)> = (0..rows.len()).map(|number| (number, Part1::Stack)).collect();
    order.extend((0..rows.len()).map(|number| (number, Part1::Rival)));
    for (number, (row, _)) in rows.iter().enumerate() {
        order.extend((0..row.robots).map(|robot| (number, Part1::Robot(robot))));
        order.extend((0..row.robots).map(|robot| (number, Part1::Relay(robot))));
    }
    let pieces = order.iter().map(|&(number, part)| {
        let (row, flown) = rows[number];
        let name = |part: &str| format!("Table I row {}, {part}", row.number);
        match part {
            Part1::Stack => Job::new(name("whole stack"), move || {
                stack_of(&row, flown, seed).map(|stack| Piece::Stack(Box::new(stack)))
            }),
            Part1::Rival => {
                Job::new(name("racer-code"), move || rival_of(&row, flown, seed).map(Piece::Rival))
            }
            Part1::Robot(robot) => Job::new(name(&format!("robot {}", robot + 1)), move || {
                codecs(flown, robot, row.resolution_m, row.range_m, None, &methods::all()).map(Piece::Codec)
            }),
            Part1::Relay(robot) => {
                Job::new(name(&format!("scans relayed, robot {}", robot + 1)), move || {
                    let seconds = Some(methods::relayed_s(quick));
                    codecs(flown, robot, row.resolution_m, row.range_m, seconds, &methods::relays())
                        .map(Piece::Relay)
                })
            }
        }
    });
    let pieces = jobs::run(threads, pieces.collect())?;
    let mut done: Vec<Done> = rows.iter().map(|_| Done::default()).collect();
    for ((number, _), piece) in order.iter().zip(pieces) {
        match piece {
            Some(Piece::Codec(outcome)) => done[*number].robots.push(outcome),
            Some(Piece::Stack(stack)) => done[*number].stack = Some(*stack),
            Some(Piece::Relay(outcome)) => done[*number].relays.push(outcome),
            Some(Piece::Rival(row)) => done[*number].rival = Some(row),
            None => {}
        }
    }
    let measured = rows.iter().zip(done).filter(|((row, _), done)| done.robots.len() == row.robots);
    Ok(measured
        .map(|((row, _), done)| {
            let mut methods = MethodRows::of_robots(&done.robots, row.robots - 1);
            if done.relays.len() == row.robots {
                let relays = MethodRows::of_robots(&done.relays, row.robots - 1);
                methods.add_relays(relays, methods::relayed_s(quick));
            }
            methods.add(done.rival);
            methods.add(done.stack.as_ref().map(|stack| stack.row(STACK, ABOUT_STACK)));
            Measured { paper: *row, methods, stack: done.stack.map(|stack| stack.report) }
        })
        .collect())
}

/// What is measured of a row so far.
#[derive(Default)]
struct Done {
    robots: Vec<Outcome>,
    relays: Vec<Outcome>,
    rival: Option<MethodRow>,
    stack: Option<Stack>,
}

/// These methods on the record of one robot, or on its first so many seconds.
pub fn codecs(
    flown: &Flown,
    robot: usize,
    resolution_m: f64,
    range_m: f64,
    seconds: Option<f64>,
    methods: &[flockmap_baselines::Method],
) -> anyhow::Result<Outcome> {
    let mapper = mapper(resolution_m, range_m)?;
    let receivers = flown.scene.robots() - 1;
    let mut run = CodecRun::new(mapper, cycle(T_L_S, CHANGES_MAX), methods, receivers);
    let source = flown.sources(range_m)?.swap_remove(robot);
    let frames = seconds.map_or(source.frames_expected, |s| source.frames_expected.min((s * 10.0) as u64));
    let mut progress = Progress::new("scans", frames);
    run.record(source.frames.take(frames as usize), || progress.step())?;
    Ok(run.finish())
}

fn stack_of(row: &TableOneRow, flown: &Flown, seed: u64) -> anyhow::Result<Stack> {
    let plan = StackPlan {
        title: row.name(),
        mapper: mapper(row.resolution_m, row.range_m)?,
        cycle: cycle(T_L_S, CHANGES_MAX),
        codec: Codec::Flock,
        session: SessionConfig::default(),
        link: Link::default(),
        seed,
    };
    stack::run(&plan, flown.sources(row.range_m)?)
}

/// RACER's own session on the same frames.
pub fn rival_run(mapper: &MapperConfig, sources: Vec<Source>, seed: u64) -> anyhow::Result<MethodRow> {
    let robots = sources.len() as u16;
    let config =
        |id| RacerConfig { cast: RacerCast::Unicast, ..RacerConfig::new(id, robots, mapper.clone()) };
    let run = rival_swarm::run(sources, config, RadioConfig { seed, ..RadioConfig::default() })?;
    let agreement = run.agreement();
    let total_bytes: u64 = run.members.iter().map(|member| member.sent.total()).sum();
    let seconds = run.last_scan.seconds().max(1e-3);
    let percent = |voxels: u64| voxels as f64 * 100.0 / agreement.compared.known.max(1) as f64;
    Ok(MethodRow {
        name: RACER_CODE.to_owned(),
        about: format!(
            "RACER as its code does it, over a perfect radio: chunks of 200 voxels with 52 bytes of fields each, announcements every 0.1 s, a voxel told \
             once and never again, states frozen when first sent. At the end {:.2} % of the voxels are stale and {:.2} % were never sent.",
            percent(agreement.stale),
            percent(agreement.missing)
        ),
        total_bytes,
        paper_bytes: 0,
        changed_voxels: 0,
        ip_udp_bytes: run.members.iter().map(|member| member.datagrams).sum::<u64>() * IP_UDP_BYTES,
        avg_kb_s: total_bytes as f64 / KB / seconds / f64::from(robots.max(1)),
        max_kb_s: run.members.iter().map(|member| member.sent.largest_second()).max().unwrap_or(0) as f64
            / KB,
        agreement: agreement.compared.share(),
        is_lossless: false,
        is_as_promised: true,
        encode_ms: None,
        decode_ms: None,
    })
}

fn rival_of(row: &TableOneRow, flown: &Flown, seed: u64) -> anyhow::Result<MethodRow> {
    rival_run(&mapper(row.resolution_m, row.range_m)?, flown.sources(row.range_m)?, seed)
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
        let cycles = first_touch.map_or(String::new(), |share| {
            format!(" RACER as its code does it sends {share:.2} times the bytes of `racer`: fewer voxels (first touch only), but headers, announcements and resends.")
        });
        points.push(format!(
            "Row {}: {ratio:.1} here, {wanted:.1} in the paper; `paper` spends {bits:.1} bits a change here and would have to spend {:.1} to come to the paper's \
             ratio.{cycles}",
            row.paper.number,
            RACER_BITS / wanted
        ));
    }
    points.push(
        "Where our saving is larger than the paper's (rows 2 to 4) its scans must have been sparser or its changes fewer a cycle than ours: the same 0.5 s of a \
         flight that has little new to see cost a package of the same box for few voxels. The paper names neither LiDAR nor world, so that we cannot say which. \
         It also describes RACER in two ways, as sending newly observed voxels and as sending all changes of state; `racer` here is the latter, `racer-code` the former."
            .to_owned(),
    );
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
    let stale: Vec<String> = measured
        .iter()
        .filter_map(|row| Some((row.paper.number, row.methods.get(RACER_CODE)?.agreement)))
        .map(|(number, share)| format!("{} in row {number}", percent_short(share)))
        .collect();
    if !stale.is_empty() {
        verdicts.push((
            true,
            format!(
                "`racer-code` ends with voxels that are stale or were never sent. Right at the end: {}.",
                stale.join(", ")
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
