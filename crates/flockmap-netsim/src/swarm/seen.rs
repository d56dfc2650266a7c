//! What is reported of a flight: its settings as text, and how often each kind of event was seen.

use super::report::Seen;
use super::settings::Settings;
use crate::{Burst, Link};
use flockmap::{Cast, Robot};

/// Adds what a run of a robot counted.
pub(super) fn add_counters(seen: &mut Seen, robot: &Robot) {
    let (s, r) = (robot.session().counters(), robot.counters());
    for (name, count) in [
        ("packages", r.packages),
        ("packages sent", s.sent),
        ("relayed", s.relayed),
        ("datagrams of repair symbols", s.coded_sent),
        ("mended by repair symbols", s.mended),
        ("suppressed, heard from another", s.suppressed),
        ("found lost and sent again", s.lost),
        ("filled a gap", s.repaired),
        ("requests for a gap", s.gap_requests),
        ("requests for a gap left to others", s.gaps_asked_by_others),
        ("arrived twice", s.duplicates),
        ("requests superseded", s.stale_requests),
        ("damaged and noticed", s.damaged),
        ("damaged by the sender and noticed", r.damaged),
        ("forged and noticed", s.forged + s.unsealed),
        ("replayed and noticed", s.replayed),
        ("of a former run", s.stale_epoch),
        ("waited for a base", s.waited),
        ("undecodable, snapshot needed", s.undecodable),
        ("snapshots asked for", s.snapshots_wanted),
        ("snapshots complete", s.caught_up),
        ("snapshots that were a piece", r.snapshot_pieces),
        ("chunks sent", s.chunks_sent),
        ("dropped from the store", robot.session().store().dropped()),
        ("waited for the budget", s.delayed_by_budget),
        ("waited for confirmations", s.delayed_by_window),
        ("batches independent", r.batches_independent),
        ("batches deferred for the budget", r.batches_deferred),
        ("batches in parts", r.batches_in_parts),
        ("rejected", s.rejected),
    ] {
        *seen.entry(name).or_default() += count;
    }
}

/// The settings that matter.
pub(super) fn settings(settings: &Settings) -> Vec<String> {
    let radio = &settings.radio;
    let Link { delay_micros, jitter_micros, loss, duplication, damage, burst } = radio.config.link;
    let mut line = format!(
        "radio {}: {:?}, {:.1} ms + {:.1} ms, {:.1} % lost, {:.1} % twice, {:.2} % damaged",
        settings.radio_name,
        radio.topology,
        delay_micros as f64 / 1e3,
        jitter_micros as f64 / 1e3,
        100.0 * loss,
        100.0 * duplication,
        100.0 * damage,
    );
    if let Some(Burst { good_ms, bad_ms, loss }) = burst {
        line += &format!(", {:.0} % lost for {bad_ms} ms every {} ms", 100.0 * loss, good_ms + bad_ms);
    }
    if let Some(rate) = radio.config.rate_bytes_per_s {
        let whose = if radio.config.is_shared { "for all" } else { "for each" };
        line += &format!(", {rate} bytes/s {whose}, queue of {} KiB", radio.config.queue_bytes_max >> 10);
    }
    let (robots, mapping) = (settings.members.len(), settings.mapping as f64 / 1e6);
    let cast = if settings.cast == Cast::Broadcast { "broadcast" } else { "unicast" };
    let damaged = 100.0 * settings.broken;
    let disks = settings.members.iter().filter(|member| member.has_disk).count();
    let clocks = if settings.clocks_given { "known exactly" } else { "measured" };
    let lines = [
        (true, format!("{robots} robots, {mapping} s of mapping, {cast}")),
        (true, line),
        (settings.key.is_some(), "a key, and an outsider who replays, changes and forges".to_owned()),
        (damaged > 0.0, format!("{damaged:.1} % of the datagrams of packages damaged by their sender")),
        (settings.has_paths, "robots hear by path".to_owned()),
        (disks > 0, format!("{disks} robots with a disk")),
        (true, format!("clocks {clocks}")),
    ];
    let lines = lines.into_iter().filter(|(holds, _)| *holds).map(|(_, line)| line);
    lines.chain(settings.notes.iter().cloned()).collect()
}
