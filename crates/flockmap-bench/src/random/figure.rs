//! The figure: tables and charts of what was drawn.

use flockmap::codec::Codec;
use flockmap_cli::chart::{self, Axis, COLOURS, Line, Scale};
use flockmap_cli::document::{Cell, DataTable, Part, Section};
use maud::{Markup, html};

use super::draw::{Figure, Map3, Plan, Point, RACER_ADDRESSES};

/// Name of the table of all points.
pub const TABLE: &str = "fig5";

/// The figure as a section of a report: table and charts.
pub fn section(figure: &Figure, plan: &Plan) -> Section {
    let mut parts = vec![Part::Words(format!(
        "Of maps of four sizes a share of the voxels changes, drawn at random, half of them to Free and half to Occupied; mean of {} draws. \
         No order of voxels and no coder can go below the entropy limit, (h(r) + r) bits a voxel. In real maps changes lie together, and \
         that is what the other tables measure.",
        plan.draws
    ))];
    parts.push(Part::Figure(html! { div.charts { @for map in &figure.maps { (chart(map)) } } }));
    parts.push(Part::Table(crossings(figure)));
    parts.push(Part::Table(table(figure)));
    parts.push(Part::Points(vec![
        format!(
            "Whole packages with their header of up to {} bytes; no IP and UDP. The box is always the whole map, as in the paper.",
            figure.header_bytes_max
        ),
        "`racer, addresses only` is what the paper's figure draws: the shortest address (2, 3, 3, 4 bytes) for each changed voxel, no state. \
         `racer, short address + state` adds the byte of state without which the address says nothing. `racer` is what is really sent: 4 + 1 bytes."
            .to_owned(),
        "The paper does not print its map sizes, only the bytes of their addresses; it sees its method plateau, and cost more than \
         RACER's addresses only below a share of 0.01 (2 bytes), 0.001 (3 bytes) and 0.0005 (3 and 4 bytes)."
            .to_owned(),
    ]));
    Section::new("fig5", "Fig. 5: changes drawn at random", parts)
}

fn table(figure: &Figure) -> DataTable {
    let points: Vec<(&Map3, &Point)> =
        figure.maps.iter().flat_map(|map| map.points.iter().map(move |point| (map, point))).collect();
    let mut table = DataTable::of(
        TABLE,
        &points,
        &[
            ("size", "map", &|(map, _)| Cell::text(map.size.map(|side| side.to_string()).join("×"))),
            ("address_bytes", "address B", &|(map, _)| Cell::Whole(map.address_bytes.into())),
            ("changed_ratio", "share changed", &|(_, point)| Cell::Number(point.ratio, 4)),
            ("changed_voxels", "voxels changed", &|(_, point)| Cell::Whole(point.changed)),
            ("entropy_limit_bytes", "limit, bytes", &|(_, point)| Cell::Number(point.limit_bytes, 0)),
        ],
    );
    if let Some((_, first)) = points.first() {
        table.columns.extend(first.methods.iter().map(|cost| (cost.name, cost.name)));
    }
    for (row, (_, point)) in table.rows.iter_mut().zip(&points) {
        row.extend(point.methods.iter().map(|cost| Cell::Number(cost.mean_bytes, 0)));
    }
    let note = "Mean bytes of a package. Smallest and largest of the draws are in the JSON.";
    DataTable { is_long: true, ..table.with_note(note) }
}

/// The paper's "one order of magnitude at a high changed voxel ratio", and where its method stops costing more.
fn crossings(figure: &Figure) -> DataTable {
    let cost = |point: &Point, name: &str| {
        point.methods.iter().find(|cost| cost.name == name).map_or(f64::NAN, |cost| cost.mean_bytes)
    };
    let ours = |point: &Point| cost(point, Codec::Paper.name());
    // The first ratio from which on it never costs more.
    let cheaper_from = |map: &Map3| {
        let dear = map.points.iter().rposition(|point| ours(point) > cost(point, RACER_ADDRESSES));
        map.points.get(dear.map_or(0, |at| at + 1)).map(|point| point.ratio)
    };
    let saving = |map: &Map3| {
        let last = map.points.last().filter(|point| point.ratio == 1.0)?;
        Some(cost(last, RACER_ADDRESSES) / ours(last))
    };
    let over = |map: &Map3| map.points.iter().map(|p| ours(p) / p.limit_bytes).fold(0.0, f64::max);
    let maps: Vec<(&Map3, Option<f64>)> = figure
        .maps
        .iter()
        .enumerate()
        .map(|(number, map)| (map, [0.01, 0.001, 0.0005, 0.0005].get(number).copied()))
        .collect();
    DataTable::of(
        "fig5_crossing",
        &maps,
        &[
            ("size", "map", &|(map, _)| Cell::text(map.size.map(|side| side.to_string()).join("×"))),
            ("address_bytes", "address B", &|(map, _)| Cell::Whole(map.address_bytes.into())),
            ("paper_cheaper_from_ratio", "paper cheaper from share", &|(map, _)| {
                Cell::maybe(cheaper_from(map), 4)
            }),
            ("paper_says_from_ratio", "the paper's figure", &|(_, says)| Cell::maybe(*says, 4)),
            ("saving_at_all_changed", "addresses / paper at share 1", &|(map, _)| {
                Cell::maybe(saving(map), 2)
            }),
            ("largest_paper_over_limit", "most that paper is over the limit", &|(map, _)| {
                Cell::Number(over(map), 2)
            }),
        ],
    )
}

fn chart(map: &Map3) -> Markup {
    let names = map.points.first().map_or(&[][..], |point| &point.methods).iter().map(|cost| cost.name);
    let line = |(number, (name, class)): (usize, (&'static str, &'static str))| {
        let points = map.points.iter().map(|p| (p.ratio, p.methods[number].mean_bytes)).collect();
        Line { name, class, points }
    };
    let mut lines: Vec<Line<'_>> = names.zip(COLOURS.into_iter().cycle()).enumerate().map(line).collect();
    let points = map.points.iter().map(|p| (p.ratio, p.limit_bytes)).collect();
    lines.push(Line { name: "entropy limit", class: "limit", points });
    let svg = chart::lines(
        Axis { label: "share of voxels that changed", scale: Scale::Log },
        Axis { label: "bytes of a package", scale: Scale::Log },
        &lines,
    );
    let size = map.size.map(|side| side.to_string()).join(" × ");
    html! { div { h3 { (size) " voxels: addresses of " (map.address_bytes) " bytes" } (svg) } }
}
