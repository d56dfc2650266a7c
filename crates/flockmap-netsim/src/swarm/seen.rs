//! What is told of a flight: its settings in words, and how often each kind of event was seen.

use super::settings::Settings;
use flockmap::{Cast, Robot};
use std::collections::BTreeMap;

/// Adds what a run of a robot counted.
pub(super) fn add_counters(seen: &mut BTreeMap<&'static str, u64>, robot: &Robot) {
    let (s, r) = (robot.session().counters(), robot.counters());
    for (name, count) in [
        ("packages", r.packages),
        ("packages sent", s.sent),
        ("relayed", s.relayed),
        ("suppressed, heard from another", s.suppressed),
        ("found lost and sent again", s.lost),
        ("filled a gap", s.repaired),
        ("requests for a gap", s.gap_requests),
        ("arrived twice", s.duplicates),
        ("requests superseded", s.stale_requests),
        ("damaged and noticed", s.damaged),
        ("damaged by the sender and noticed", r.damaged),
        ("forged and noticed", s.forged + s.unsealed),
        ("replayed and noticed", s.replayed),
        ("of a former run", s.stale_epoch),
        ("waited for a reference", s.waited),
        ("given up for a snapshot", s.undecodable),
        ("snapshots asked for", s.snapshots_wanted),
        ("snapshots complete", s.caught_up),
        ("chunks sent", s.chunks_sent),
        ("dropped from the store", robot.session().store().dropped()),
        ("waited for the budget", s.delayed_by_budget),
        ("waited for confirmations", s.delayed_by_window),
        ("batches told alone", r.batches_independent),
        ("batches deferred for the budget", r.batches_deferred),
        ("batches told in parts", r.batches_in_parts),
        ("rejected", s.rejected),
    ] {
        *seen.entry(name).or_default() += count;
    }
}

/// The settings that matter.
pub(super) fn settings(settings: &Settings) -> Vec<String> {
    let radio = &settings.radio;
    let mut words = vec![format!(
        "{} robots, {} s of mapping, {}",
        settings.members.len(),
        settings.mapping as f64 / 1e6,
        if settings.cast == Cast::Broadcast { "broadcast" } else { "unicast" },
    )];
    let mut line = format!(
        "radio {}: {:?}, {:.1} ms + {:.1} ms, {:.1} % lost, {:.1} % twice, {:.2} % damaged",
        settings.radio_name,
        radio.topology,
        radio.delay_micros as f64 / 1e3,
        radio.jitter_micros as f64 / 1e3,
        100.0 * radio.loss,
        100.0 * radio.duplication,
        100.0 * radio.damage,
    );
    if let Some(burst) = radio.burst {
        line += &format!(
            ", {:.0} % lost for {} ms every {} ms",
            100.0 * burst.loss,
            burst.bad_ms,
            burst.good_ms + burst.bad_ms
        );
    }
    if let Some(rate) = radio.rate_bytes_per_s {
        let whose = if radio.is_shared { "for all" } else { "for each" };
        line += &format!(", {rate} bytes/s {whose}, queue of {} KiB", radio.queue_bytes_max >> 10);
    }
    words.push(line);
    if settings.key.is_some() {
        words.push("a key, and an outsider who replays, changes and forges".to_owned());
    }
    if settings.broken > 0.0 {
        words.push(format!(
            "{:.1} % of the datagrams of packages damaged by their sender",
            100.0 * settings.broken
        ));
    }
    if settings.has_paths {
        words.push("robots hear by path".to_owned());
    }
    let disks = settings.members.iter().filter(|member| member.has_disk).count();
    if disks > 0 {
        words.push(format!("{disks} robots with a disk"));
    }
    words.push(match settings.clocks_given {
        true => "clocks known exactly".to_owned(),
        false => "clocks measured".to_owned(),
    });
    words.extend(settings.words.iter().cloned());
    words
}
