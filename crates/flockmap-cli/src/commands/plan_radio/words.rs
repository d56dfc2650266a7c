//! What `flockmap plan-radio` says, for people and for programs.

use flockmap_cli::document::DataTable;
use flockmap_cli::numbers::thousands;
use flockmap_cli::radio_plan::{Ages, Change, Changed, LOAD_MAX, Plan, Question, Radio, SwarmCosts};
use serde_json::{Value, json};

/// Columns of a line for people.
const WIDTH: usize = 110;
/// Robots beyond which a number says nothing: nothing was measured there.
pub const ROBOTS_SHOWN: usize = 100;

/// The account for people. `most`: robots that the radio carries.
pub fn text(question: &Question, plan: &Plan, most: usize, changes: &[Change]) -> anyhow::Result<String> {
    let rows_to = SwarmCosts::of(question.radio.preset)?.robots_most();
    let mut text = format!("{}\n\n{}\n", radio(&question.radio), figures(question, plan));
    let mut say = |sentences: String| text += &wrapped(&sentences);
    say(map(question, plan));
    say(air(question, plan, rows_to));
    say(verdict(question, plan, most, rows_to));
    if plan.fits() {
        say(ages(question, plan, rows_to));
    } else {
        say(lag(plan));
        say(advice(question, changes)?);
    }
    Ok(text)
}

fn percent(share: f64) -> String {
    if share < 0.1 {
        format!("{:.1} %", 100.0 * share)
    } else {
        format!("{} %", thousands((100.0 * share).round() as u64))
    }
}

fn bytes(bytes: f64) -> String {
    thousands(bytes.round() as u64)
}

fn radio(radio: &Radio) -> String {
    let Radio { rate_bytes_per_s, loss, airtime_overhead_s, is_shared, preset, is_preset } = *radio;
    let name = if is_preset { preset.name() } else { "your radio" };
    let whose = if is_shared { "for all robots together" } else { "for each robot" };
    let air = if airtime_overhead_s > 0.0 {
        format!(", {} ms of air more for each datagram", airtime_overhead_s * 1e3)
    } else {
        String::new()
    };
    format!("{name}: {} bytes/s {whose}, {} of datagrams lost{air}", bytes(rate_bytes_per_s), percent(loss))
}

fn figures(question: &Question, plan: &Plan) -> DataTable {
    let robots = question.robots as f64;
    let [packages, requests] = [plan.packages_bytes_per_s(), plan.requests_bytes_per_s()];
    let row = |what: &str, one: f64| [what.to_owned(), bytes(one), bytes(one * robots)];
    let load = if question.radio.is_shared { [plan.load / robots, plan.load] } else { [plan.load; 2] };
    let [one, all] = load.map(percent);
    let rows = [
        row("map: its own packages", plan.map.bytes_per_s),
        row("the same in datagrams, with headers", plan.map.datagrams_bytes_per_s() * plan.copies as f64),
        row("with repairs", packages),
        row("requests", requests),
        row(
            &format!("all on the air, {:.2} times the map", (packages + requests) / plan.map.bytes_per_s),
            packages + requests,
        ),
        ["of the radio's time".to_owned(), one, all],
    ];
    DataTable::unnamed(["bytes a second", "a robot", "all robots"], rows)
}

fn map(question: &Question, plan: &Plan) -> String {
    let kind = &question.kind;
    if question.map_bytes_per_s.is_some() {
        return "What a robot maps is your figure.".to_owned();
    }
    let obstacles = kind.obstacle_period_s.map_or(String::new(), |s| format!(", obstacles each {s} s"));
    let mut text = format!(
        "What a robot maps was measured in the generated world `{}`, where it sees new ground all the time: \
         voxels of {} m, range {} m, a batch each {} s{obstacles}.",
        plan.map.scene, kind.resolution_m, kind.range_m, kind.period_s
    );
    if !plan.map.outside.is_empty() {
        text += &format!(
            " Not measured: {}; the figure goes on from the nearest ones and may be far off.",
            plan.map.outside.join(", ")
        );
    }
    text
}

fn air(question: &Question, plan: &Plan, rows_to: usize) -> String {
    let Question { radio, robots, .. } = question;
    let mut text = format!(
        "With headers, packages take {:.2} times the map; with repairs {:.2} times that, and a robot's requests \
         {} bytes/s, by the rows of {} in tests/tables/swarms.txt.",
        plan.map.datagrams_bytes_per_s() / plan.map.bytes_per_s,
        plan.swarm.repairs,
        bytes(plan.swarm.requests_bytes_per_s),
        radio.preset
    );
    if !radio.is_preset {
        text += &format!(" Yours is most like {}", self::radio(&Radio::of_preset(radio.preset)));
        text += if radio.loses_more_than_preset() {
            "; yours loses more, and will need more repairs."
        } else {
            "."
        };
    }
    if !plan.swarm.is_inside {
        text += &format!(" They end at {rows_to} robots: what {robots} take is extrapolated.");
    }
    if question.is_unicast {
        text += &format!(" Each datagram goes out in {} copies; the rows are by broadcast.", plan.copies);
    }
    text
}

fn verdict(question: &Question, plan: &Plan, most: usize, rows_to: usize) -> String {
    let fits = if plan.fits() { "It fits" } else { "It does not fit" };
    let name = if question.radio.is_preset { question.radio.preset.name() } else { "Your radio" };
    let carries = match most {
        0 => "no two robots".to_owned(),
        most if most > ROBOTS_SHOWN => format!("more than {ROBOTS_SHOWN} robots"),
        most => format!("{most} robots"),
    };
    let extrapolated = if most > rows_to { " (extrapolated)" } else { "" };
    format!(
        "{fits}: {} of the radio. A plan takes at most {} on the mean, as the map grows faster in some seconds. \
         {name} carries {carries} of this kind{extrapolated}.",
        percent(plan.load),
        percent(LOAD_MAX)
    )
}

fn ages(question: &Question, plan: &Plan, rows_to: usize) -> String {
    let Some([least, most]) = plan.swarm.ages_s else {
        return format!(
            "Ages to expect: not known, the rows of {} end at {rows_to} robots.",
            question.radio.preset
        );
    };
    let range = |of: fn(&Ages) -> f64| {
        let (low, high) = (of(&least), of(&most));
        if high - low < 0.005 { format!("{high:.2} s") } else { format!("{low:.2} to {high:.2} s") }
    };
    let mut text = format!(
        "Ages to expect, from the end of a batch to its place in another robot's map: half of the voxels {}, \
         99 of 100 {} at most. Before that a voxel waits for its batch, up to {} s.",
        range(|ages| ages.median),
        range(|ages| ages.p99),
        question.kind.period_s
    );
    if least != most {
        text += " The greater figures are of flights that filled the radio: there are no rows of so many robots \
                 that did not.";
    }
    text
}

fn lag(plan: &Plan) -> String {
    match plan.lag() {
        None => "On the mean the radio carries it; where the map grows fast it falls behind, and catches up later."
            .to_owned(),
        Some(lag) => format!(
            "The map that others have lags, obstacles least, since they go first: after a minute of flight it is {} s \
             behind, and all agree likely {} to {} s after that minute; of a longer flight in proportion.",
            bytes(lag.behind_s),
            bytes(lag.agreement_s[0]),
            bytes(lag.agreement_s[1])
        ),
    }
}

fn advice(question: &Question, changes: &[Change]) -> anyhow::Result<String> {
    let kind = &question.kind;
    let say = |change: &Change| {
        let (what, from, unit) = match change.what {
            Changed::Resolution => ("coarser voxels", kind.resolution_m, "m"),
            Changed::Range => ("a shorter range", kind.range_m, "m"),
            Changed::Period => ("a longer period", kind.period_s, "s"),
        };
        let Change { to, load, .. } = *change;
        match load <= LOAD_MAX {
            true => format!("{what}, {to} {unit} in place of {from} ({})", percent(load)),
            false => format!("not {what} alone, {to} {unit} leaves {}", percent(load)),
        }
    };
    let mut ways: Vec<String> = changes.iter().map(say).collect();
    if question.is_unicast {
        let broadcast = Plan::of(&Question { is_unicast: false, ..question.clone() })?;
        ways.push(format!("by broadcast it is {}", percent(broadcast.load)));
    }
    if ways.is_empty() {
        return Ok(
            "Voxels, range and period are at the end of what was measured: fewer robots, or another radio."
                .to_owned(),
        );
    }
    Ok(format!("What to change: {}.", ways.join("; ")))
}

/// Sentences as a paragraph of indented lines.
fn wrapped(sentences: &str) -> String {
    let mut text = String::new();
    let mut column = WIDTH;
    for word in sentences.split_whitespace() {
        let length = word.chars().count();
        if column + 1 + length > WIDTH {
            text += if text.is_empty() { "  " } else { "\n  " };
            column = 2 + length;
        } else {
            text.push(' ');
            column += 1 + length;
        }
        text += word;
    }
    text + "\n"
}

/// The same for programs.
pub fn json(question: &Question, plan: &Plan, most: usize, changes: &[Change]) -> Value {
    let Question { radio, robots, kind, .. } = question;
    let changes = changes.iter().map(|change| {
        let what = match change.what {
            Changed::Resolution => "resolution_m",
            Changed::Range => "range_m",
            Changed::Period => "period_s",
        };
        json!({"what": what, "to": change.to, "load": change.load, "fits": change.load <= LOAD_MAX})
    });
    let ages = plan.swarm.ages_s.map(
        |[least, most]| json!({"median_s": [least.median, most.median], "p99_s": [least.p99, most.p99]}),
    );
    let lag = plan.lag().map(
        |lag| json!({"behind_s_after_a_minute": lag.behind_s, "agreement_s_after_a_minute": lag.agreement_s}),
    );
    json!({
        "radio": {
            "name": radio.is_preset.then(|| radio.preset.name()), "rows_of": radio.preset.name(),
            "rate_bytes_per_s": radio.rate_bytes_per_s, "loss": radio.loss, "shared": radio.is_shared,
            "airtime_overhead_s": radio.airtime_overhead_s,
        },
        "robots": robots,
        "kind": {
            "scene": plan.map.scene.to_string(), "resolution_m": kind.resolution_m, "range_m": kind.range_m,
            "period_s": kind.period_s, "obstacle_period_s": kind.obstacle_period_s,
        },
        "copies": plan.copies,
        "map_bytes_per_s": plan.map.bytes_per_s,
        "map_is_given": question.map_bytes_per_s.is_some(),
        "not_measured": plan.map.outside,
        "datagrams_bytes_per_s": plan.map.datagrams_bytes_per_s(),
        "repairs": plan.swarm.repairs,
        "robots_are_in_the_table": plan.swarm.is_inside,
        "packages_bytes_per_s": plan.packages_bytes_per_s(),
        "requests_bytes_per_s": plan.requests_bytes_per_s(),
        "load": plan.load,
        "load_most": LOAD_MAX,
        "fits": plan.fits(),
        "robots_most": most,
        "ages": ages.filter(|_| plan.fits()),
        "lag": lag,
        "changes": changes.collect::<Value>(),
    })
}
