//! The table of `flockmap plan-radio --table`: how many robots of each kind each shared radio carries.

use flockmap_cli::numbers::thousands;
use flockmap_cli::radio_plan::{Question, Radio, RobotKind, SwarmCosts};
use flockmap_netsim::swarm::RadioPreset;

use super::words::ROBOTS_SHOWN;

const RADIOS: [RadioPreset; 4] =
    [RadioPreset::Wifi, RadioPreset::WifiLossy, RadioPreset::WifiCongested, RadioPreset::Lora];
/// Voxels and range in metres.
const KINDS: [(f64, f64); 4] = [(0.1, 7.0), (0.2, 7.0), (0.2, 30.0), (0.4, 30.0)];
const PERIODS_S: [f64; 2] = [0.5, 1.0];

/// The table, as Markdown.
pub fn table() -> anyhow::Result<String> {
    let names = RADIOS.map(|radio| format!("`{radio}`")).join(" | ");
    let mut text = format!("| voxels, range, period | a robot maps | {names} |\n");
    text += &format!("|---|---|{}\n", "---|".repeat(RADIOS.len()));
    for (resolution_m, range_m) in KINDS {
        for period_s in PERIODS_S {
            let kind = RobotKind { scene: None, resolution_m, range_m, period_s, obstacle_period_s: None };
            let carried = RADIOS.into_iter().map(|radio| carried(radio, kind));
            let carried = carried.collect::<anyhow::Result<Vec<_>>>()?.join(" | ");
            let bytes = thousands(kind.map_cost().bytes_per_s.round() as u64);
            text +=
                &format!("| {resolution_m} m, {range_m} m, {period_s} s | {bytes} bytes/s | {carried} |\n");
        }
    }
    Ok(text)
}

/// How many robots; beyond the table of swarms only that they are more.
fn carried(radio: RadioPreset, kind: RobotKind) -> anyhow::Result<String> {
    let radio = Radio::of_preset(radio);
    let question = Question { radio, robots: 2, kind, map_bytes_per_s: None, is_unicast: false };
    let (most, known) = (question.robots_most()?, SwarmCosts::of(radio.preset)?.robots_most());
    Ok(match most {
        0 => "–".to_owned(),
        most if most > ROBOTS_SHOWN => format!("{known}, likely over {ROBOTS_SHOWN}"),
        most if most > known => format!("{known}, likely {most}"),
        most => most.to_string(),
    })
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_document_has_the_table_as_it_is_printed() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/radios.md");
        let (document, table) = (std::fs::read_to_string(path).unwrap(), super::table().unwrap());
        assert!(
            document.contains(&table),
            "docs/radios.md has another table than `flockmap plan-radio --table`:\n{table}"
        );
    }
}
