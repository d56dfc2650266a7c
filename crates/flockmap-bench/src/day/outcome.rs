//! What came of a day, and how it is printed.

use flockmap::grid::Layer;
use flockmap_cli::document::DataTable;
use flockmap_cli::measure::TimeSummary;
use flockmap_cli::numbers::thousands;
use serde::Serialize;

use super::resident::Resident;
use super::same::Difference;
use super::swarm::Member;
use crate::calls::meter::{Call, Meter};

/// All of it.
#[derive(Default, Serialize, Debug)]
pub struct Outcome {
    pub metres: u32,
    pub is_interrupted: bool,
    /// Before anybody joined late, each held all that the others had published.
    pub is_agreed: bool,
    /// The late joiner last.
    pub robots: Vec<RobotRow>,
    pub times: Vec<TimesRow>,
    pub calls: Vec<CallsRow>,
    pub stages: Vec<StageRow>,
    pub joiner: Option<JoinerRow>,
}

/// What a robot holds.
#[derive(Serialize, Debug)]
pub struct RobotRow {
    pub robot: u16,
    pub km: f64,
    pub voxels: usize,
    pub voxels_of_others: usize,
    pub bytes: usize,
    /// With what they add to the fused map, as the cap counts them.
    pub bytes_of_others: usize,
    pub blocks_dropped: u64,
    pub is_full: bool,
    /// All its layers are those of their origins. `None`: not compared.
    pub is_same: Option<bool>,
}

/// Processor time on a part of the flight, of all robots.
#[derive(Serialize, Debug)]
pub struct TimesRow {
    pub part: &'static str,
    pub packing: TimeSummary,
    pub inserting: TimeSummary,
}

/// The longest calls of a robot during one piece of work.
#[derive(Serialize, Debug)]
pub struct CallsRow {
    pub work: &'static str,
    pub robot: u16,
    pub insert_scan_ms: Option<f64>,
    pub handle_timeout_ms: Option<f64>,
    pub handle_datagram_ms: Option<f64>,
}

/// What it took until a stage was reached.
#[derive(Serialize, Debug)]
pub struct StageRow {
    pub stage: &'static str,
    pub virtual_s: f64,
    pub wall_s: f64,
    /// `None`: the system does not say it.
    pub resident: Option<Resident>,
}

/// The robot that joined late.
#[derive(Serialize, Debug)]
pub struct JoinerRow {
    /// All packages of all robots, and of these all that anybody has.
    pub holds_all: bool,
    /// Until it held all, or until the last time that something new came.
    pub virtual_s: f64,
    pub processor_s: f64,
    pub bytes: u64,
    pub datagrams: u64,
    /// That were made for it, some maybe in vain.
    pub snapshots: u64,
    pub streams: Vec<StreamRow>,
    /// `None`: not compared, since not all layers are whole.
    pub map: Option<MapRow>,
}

/// What it holds of one robot.
#[derive(Serialize, Debug)]
pub struct StreamRow {
    pub robot: u16,
    /// Without a gap from the first one on.
    pub packages: u32,
    pub packages_published: u32,
    pub voxels: usize,
    pub voxels_left: usize,
    /// Nobody has all of it.
    pub is_dropped: bool,
    /// `None`: not compared.
    pub difference: Option<Difference>,
}

/// Its fused map beside that of robot 1.
#[derive(Serialize, Debug)]
pub struct MapRow {
    pub difference: Difference,
    /// Voxels that robot 1 has published and taken back or forgotten since.
    pub kept: u64,
    /// Blocks that robot 1 has forgotten of its own map.
    pub blocks_forgotten: u64,
}

impl RobotRow {
    pub fn of(member: &Member) -> Self {
        let (robot, own) = (&member.robot, member.own_layer());
        Self {
            robot: member.id(),
            // A scan is made every 0.4 m.
            km: robot.counters().scans as f64 * 0.4e-3,
            voxels: own.map_or(0, Layer::len),
            voxels_of_others: member.voxels_of_others(),
            bytes: own.map_or(0, Layer::memory_bytes),
            bytes_of_others: robot.fusion().memory_bytes_of_others(robot.mapper()),
            blocks_dropped: robot.counters().blocks_dropped,
            is_full: robot.is_full(),
            is_same: None,
        }
    }
}

impl CallsRow {
    pub fn of(work: &'static str, robot: u16, meter: &Meter) -> Self {
        let longest = |call| meter.0.get(&call).map(|taken| taken.longest.as_secs_f64() * 1e3);
        Self {
            work,
            robot,
            insert_scan_ms: longest(Call::InsertScan),
            handle_timeout_ms: longest(Call::HandleTimeout),
            handle_datagram_ms: longest(Call::HandleDatagram),
        }
    }
}

impl StreamRow {
    /// `None`: not compared.
    pub fn is_same(&self) -> Option<bool> {
        let Difference { lacking, beyond, different } = self.difference?;
        // Of what its robot has dropped, packages may still have come.
        let is_beyond = beyond > 0 && !self.is_dropped;
        Some(self.packages == self.packages_published && lacking + different == 0 && !is_beyond)
    }
}

impl JoinerRow {
    /// `None`: not compared.
    pub fn has_same_layers(&self) -> Option<bool> {
        self.streams.iter().map(StreamRow::is_same).try_fold(true, |all, is_same| Some(all & is_same?))
    }

    fn is_good(&self) -> bool {
        self.holds_all
            && self.has_same_layers() == Some(true)
            && self.map.as_ref().is_none_or(|map| map.difference.is_none())
    }
}

impl Outcome {
    /// Whether nothing is lacking and all is the same.
    pub fn is_good(&self) -> bool {
        !self.is_interrupted
            && self.is_agreed
            && self.robots.iter().all(|row| row.is_same == Some(true))
            && self.joiner.as_ref().is_none_or(JoinerRow::is_good)
    }

    pub fn print(&self) {
        if self.is_interrupted {
            println!("partial: ended by Ctrl-C\n");
        }
        let all = [robots(&self.robots), times(&self.times), calls(&self.calls), stages(&self.stages)];
        print!("{}", all.map(|table| table.to_string()).join("\n"));
        if !self.is_agreed {
            println!("\n  THE ROBOTS THAT FLEW DO NOT AGREE: some hold less than others have published.");
        }
        if let Some(joiner) = &self.joiner {
            println!("\n{}\n{}", joined(&joiner.streams), words(joiner));
        }
    }
}

fn none() -> String {
    "–".to_owned()
}

fn yes(is_so: bool) -> String {
    if is_so { "yes" } else { "no" }.to_owned()
}

fn mib(bytes: usize) -> String {
    format!("{:.1}", bytes as f64 / f64::from(1 << 20))
}

fn robots(rows: &[RobotRow]) -> DataTable {
    let per_voxel = |bytes: usize, voxels: usize| match voxels {
        0 => none(),
        _ => format!("{:.3}", bytes as f64 / voxels as f64),
    };
    DataTable::of_text(
        rows,
        &[
            ("robot", &|row| row.robot.to_string()),
            ("km", &|row| format!("{:.2}", row.km)),
            ("own voxels", &|row| thousands(row.voxels as u64)),
            ("of others", &|row| thousands(row.voxels_of_others as u64)),
            ("own layer MiB", &|row| mib(row.bytes)),
            ("of others MiB", &|row| mib(row.bytes_of_others)),
            ("own B/voxel", &|row| per_voxel(row.bytes, row.voxels)),
            ("of others B/voxel", &|row| per_voxel(row.bytes_of_others, row.voxels_of_others)),
            ("dropped", &|row| thousands(row.blocks_dropped)),
            ("full", &|row| yes(row.is_full)),
            ("same", &|row| row.is_same.map_or_else(none, yes)),
        ],
    )
}

fn times(rows: &[TimesRow]) -> DataTable {
    let ms = |of: &TimeSummary, ms: f64| if of.count > 0 { format!("{ms:.2}") } else { none() };
    DataTable::of_text(
        rows,
        &[
            ("processor time", &|row| row.part.to_owned()),
            ("batches", &|row| thousands(row.packing.count as u64)),
            ("t_pack median ms", &|row| ms(&row.packing, row.packing.median_ms)),
            ("99 % ms", &|row| ms(&row.packing, row.packing.p99_ms)),
            ("datagrams", &|row| thousands(row.inserting.count as u64)),
            ("t_recv2insert median ms", &|row| ms(&row.inserting, row.inserting.median_ms)),
            ("99 % ms", &|row| ms(&row.inserting, row.inserting.p99_ms)),
        ],
    )
}

fn calls(rows: &[CallsRow]) -> DataTable {
    let ms = |ms: Option<f64>| ms.map_or_else(none, |ms| format!("{ms:.1}"));
    DataTable::of_text(
        rows,
        &[
            ("longest call", &|row| row.work.to_owned()),
            ("robot", &|row| row.robot.to_string()),
            ("insert_scan ms", &|row| ms(row.insert_scan_ms)),
            ("handle_timeout ms", &|row| ms(row.handle_timeout_ms)),
            ("handle_datagram ms", &|row| ms(row.handle_datagram_ms)),
        ],
    )
}

fn stages(rows: &[StageRow]) -> DataTable {
    let bytes = |bytes: Option<u64>| bytes.map_or_else(none, |bytes| mib(bytes as usize));
    DataTable::of_text(
        rows,
        &[
            ("stage", &|row| row.stage.to_owned()),
            ("virtual s", &|row| format!("{:.1}", row.virtual_s)),
            ("time gone by s", &|row| format!("{:.1}", row.wall_s)),
            ("resident MiB", &|row| bytes(row.resident.map(|all| all.now))),
            ("most MiB", &|row| bytes(row.resident.map(|all| all.most))),
        ],
    )
}

fn joined(rows: &[StreamRow]) -> DataTable {
    let voxels = |row: &StreamRow, of: fn(&Difference) -> u64| match &row.difference {
        Some(difference) => thousands(of(difference)),
        None => none(),
    };
    DataTable::of_text(
        rows,
        &[
            ("late joiner has of robot", &|row| row.robot.to_string()),
            ("packages", &|row| thousands(row.packages.into())),
            ("published", &|row| thousands(row.packages_published.into())),
            ("voxels", &|row| thousands(row.voxels as u64)),
            ("there", &|row| thousands(row.voxels_left as u64)),
            ("lacking", &|row| voxels(row, |all| all.lacking)),
            ("beyond", &|row| voxels(row, |all| all.beyond)),
            ("different", &|row| voxels(row, |all| all.different)),
            ("same", &|row| row.is_same().map_or_else(none, yes)),
        ],
    )
}

/// What the tables do not say of the late joiner.
fn words(joiner: &JoinerRow) -> String {
    let JoinerRow { holds_all, virtual_s, processor_s, bytes, datagrams, snapshots, streams, map } = joiner;
    let outcome = if *holds_all { "It held all" } else { "IT DOES NOT HOLD ALL; the last that was new came" };
    let mut text = format!(
        "  {outcome} after {virtual_s:.1} s of virtual time and {processor_s:.1} s of its processor time, with {} \
         bytes in {} datagrams. Snapshots made for it: {}.",
        thousands(*bytes),
        thousands(*datagrams),
        thousands(*snapshots)
    );
    for row in streams.iter().filter(|row| row.is_same() != Some(true)) {
        let StreamRow { robot, packages, packages_published, voxels, voxels_left, .. } = row;
        text += &format!(
            "\n  Of robot {robot} it lacks {} of {} packages, and has {} of {} voxels.",
            thousands(packages_published.saturating_sub(*packages).into()),
            thousands((*packages_published).into()),
            thousands(*voxels as u64),
            thousands(*voxels_left as u64)
        );
    }
    let Some(MapRow { difference, kept, blocks_forgotten }) = map else {
        return text + "\n  Its fused map is not compared: not all layers are whole.";
    };
    text += &match difference {
        same if same.is_none() => "\n  Its fused map is that of robot 1.".to_owned(),
        Difference { lacking, beyond, different } => format!(
            "\n  ITS FUSED MAP IS NOT THAT OF ROBOT 1: {} voxels are lacking, {} beyond it, {} different.",
            thousands(*lacking),
            thousands(*beyond),
            thousands(*different)
        ),
    };
    if *kept > 0 {
        text += &format!(
            "\n  It keeps {} voxels that robot 1 has published, and since taken back, or forgotten with {} blocks.",
            thousands(*kept),
            thousands(*blocks_forgotten)
        );
    }
    text
}
