//! What is remembered of the questions to holders: what may be on its way, who brought nothing, and who never answers.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use flockmap::Stream;

/// What is lacking for no longer may be on its way.
const PATIENCE: Duration = Duration::from_millis(900);
/// A run of which a holder brought nothing is asked for again after twice so long, and twice as long each time.
const FRUITLESS: Duration = Duration::from_secs(10);
const FRUITLESS_MAX: Duration = Duration::from_secs(600);
/// A holder that did not answer so many times in a row is given up for a while.
const SILENCES: u32 = 2;
/// For so long first, and twice as long each time.
const SILENT: Duration = Duration::from_secs(60);
const SILENT_MAX: Duration = Duration::from_secs(600);

/// Whether a holder is to be asked for a run.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Ask {
    /// Now. What brought nothing as packages may be told by a snapshot.
    Now { as_snapshot: bool },
    /// Something may be on its way.
    Soon,
    /// It brought nothing a while ago.
    Later,
}

/// What came of a question.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Outcome {
    /// Something that was lacking.
    Brought,
    /// An answer, and nothing that was lacking in it.
    Nothing,
    /// No answer.
    Silence,
}

/// What is remembered: of the holders that are there, and for each of the runs that it claims.
#[derive(Debug, Default)]
pub(crate) struct Asked {
    /// Since when something of a run is lacking that somebody holds: of runs of which something is held here.
    lacking_since: BTreeMap<Stream, Instant>,
    holders: BTreeMap<String, Record>,
}

/// How a holder has answered so far.
#[derive(Debug, Default)]
struct Record {
    /// How often it brought nothing of a run, and when it is asked again.
    fruitless: BTreeMap<Stream, (u32, Instant)>,
    /// How often it did not answer since it last did, and until when it is given up.
    silences: u32,
    given_up_until: Option<Instant>,
}

impl Asked {
    /// Forgets who is not there any more, and who came anew.
    pub(crate) fn keep_holders(&mut self, there: &BTreeSet<String>, came: &BTreeSet<String>) {
        self.holders.retain(|name, _| there.contains(name) && !came.contains(name));
    }

    /// Forgets runs that a holder does not claim any more.
    pub(crate) fn keep_claimed(&mut self, name: &str, claimed: impl Iterator<Item = Stream>) {
        if let Some(record) = self.holders.get_mut(name).filter(|record| !record.fruitless.is_empty()) {
            let claimed: BTreeSet<Stream> = claimed.collect();
            record.fruitless.retain(|stream, _| claimed.contains(stream));
        }
    }

    /// Forgets since when something is lacking of all runs but these.
    pub(crate) fn keep_lacking(&mut self, lacking: &BTreeSet<Stream>) {
        self.lacking_since.retain(|stream, _| lacking.contains(stream));
    }

    /// How often a holder did not answer since it last did: who did is asked first.
    pub(crate) fn silences(&self, name: &str) -> u32 {
        self.holders.get(name).map_or(0, |record| record.silences)
    }

    /// Whether a holder is given up for now.
    pub(crate) fn is_given_up(&self, name: &str, now: Instant) -> bool {
        let until = self.holders.get(name).and_then(|record| record.given_up_until);
        until.is_some_and(|until| now < until)
    }

    /// Whether a holder is asked for what is lacking of a run. `has_some`: something of it is held here.
    pub(crate) fn ask(&mut self, name: &str, stream: Stream, has_some: bool, now: Instant) -> Ask {
        if has_some {
            let since = *self.lacking_since.entry(stream).or_insert(now);
            if now.saturating_duration_since(since) < PATIENCE {
                return Ask::Soon;
            }
        }
        match self.holders.get(name).and_then(|record| record.fruitless.get(&stream)) {
            Some((_, again)) if now < *again => Ask::Later,
            fruitless => Ask::Now { as_snapshot: fruitless.is_some() },
        }
    }

    /// Notes that a holder claims no more of a run than is held here.
    pub(crate) fn note_whole(&mut self, name: &str, stream: Stream) {
        if let Some(record) = self.holders.get_mut(name) {
            record.fruitless.remove(&stream);
        }
    }

    /// Notes what came of a question. Whether the holder is given up with this.
    pub(crate) fn note(&mut self, name: &str, stream: Stream, outcome: Outcome, now: Instant) -> bool {
        let record = self.holders.entry(name.to_owned()).or_default();
        if outcome == Outcome::Silence {
            record.silences = record.silences.saturating_add(1);
            let is_given_up = record.silences >= SILENCES;
            let times = record.silences.saturating_sub(SILENCES);
            record.given_up_until = is_given_up.then(|| now + doubled(SILENT, times, SILENT_MAX));
            return is_given_up;
        }
        (record.silences, record.given_up_until) = (0, None);
        if outcome == Outcome::Brought {
            record.fruitless.remove(&stream);
        } else {
            let (times, again) = record.fruitless.entry(stream).or_insert((0, now));
            // The first time, at once: as a snapshot.
            *again =
                now + if *times == 0 { Duration::ZERO } else { doubled(FRUITLESS, *times, FRUITLESS_MAX) };
            *times = times.saturating_add(1);
        }
        false
    }
}

fn doubled(first: Duration, times: u32, most: Duration) -> Duration {
    (first * (1 << times.min(6))).min(most)
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::RobotId;

    const NOW: Ask = Ask::Now { as_snapshot: false };
    const SNAPSHOT: Ask = Ask::Now { as_snapshot: true };

    fn run(epoch: u64) -> Stream {
        Stream { origin: RobotId(1), epoch }
    }

    fn names(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    fn seconds(seconds: f64) -> Duration {
        Duration::from_secs_f64(seconds)
    }

    #[test]
    fn what_may_be_on_its_way_is_waited_for_but_a_run_that_is_new_is_asked_for_at_once() {
        let (mut asked, start) = (Asked::default(), Instant::now());
        assert_eq!(asked.ask("a", run(1), false, start), NOW);
        assert_eq!(asked.ask("a", run(2), true, start), Ask::Soon);
        assert_eq!(asked.ask("a", run(2), true, start + seconds(0.8)), Ask::Soon);
        assert_eq!(asked.ask("a", run(2), true, start + seconds(1.0)), NOW);
        // Another holder that holds no more than is held here does not make it wait anew.
        asked.note_whole("b", run(2));
        asked.keep_lacking(&[run(2)].into());
        assert_eq!(asked.ask("a", run(2), true, start + seconds(1.1)), NOW);
        // It was whole for a moment.
        asked.keep_lacking(&[].into());
        assert_eq!(asked.ask("a", run(2), true, start + seconds(1.2)), Ask::Soon);
    }

    #[test]
    fn who_brings_nothing_is_asked_for_a_snapshot_then_ever_more_seldom() {
        let (mut asked, mut now) = (Asked::default(), Instant::now());
        assert_eq!(asked.ask("a", run(1), false, now), NOW);
        asked.note("a", run(1), Outcome::Nothing, now);
        assert_eq!(asked.ask("a", run(1), false, now), SNAPSHOT);
        for pause in [20.0, 40.0, 80.0, 160.0, 320.0, 600.0, 600.0] {
            asked.note("a", run(1), Outcome::Nothing, now);
            assert_eq!(asked.ask("a", run(1), false, now + seconds(pause - 0.1)), Ask::Later, "{pause}");
            now += seconds(pause);
            assert_eq!(asked.ask("a", run(1), false, now), SNAPSHOT, "{pause}");
        }
        // That is about this run of this holder alone, and until it brings something.
        assert_eq!(asked.ask("a", run(2), false, now), NOW);
        assert_eq!(asked.ask("b", run(1), false, now), NOW);
        asked.note("a", run(1), Outcome::Brought, now);
        assert_eq!(asked.ask("a", run(1), false, now), NOW);
    }

    #[test]
    fn who_never_answers_is_given_up_and_asked_again_later() {
        let (mut asked, mut now) = (Asked::default(), Instant::now());
        assert!(!asked.note("a", run(1), Outcome::Silence, now));
        assert!(!asked.is_given_up("a", now));
        for pause in [60.0, 120.0, 240.0, 480.0, 600.0, 600.0] {
            assert!(asked.note("a", run(1), Outcome::Silence, now));
            assert!(asked.is_given_up("a", now + seconds(pause - 0.1)), "{pause}");
            assert!(!asked.is_given_up("b", now));
            now += seconds(pause);
            assert!(!asked.is_given_up("a", now), "{pause}");
        }
        // One answer, and it is as any other.
        asked.note("a", run(1), Outcome::Nothing, now);
        assert_eq!(asked.silences("a"), 0);
        assert!(!asked.note("a", run(1), Outcome::Silence, now));
    }

    #[test]
    fn who_comes_anew_is_asked_at_once() {
        let (mut asked, now) = (Asked::default(), Instant::now());
        for _ in 0..4 {
            asked.note("a", run(1), Outcome::Silence, now);
            asked.note("b", run(1), Outcome::Silence, now);
        }
        asked.keep_holders(&names(&["a", "b"]), &names(&["b"]));
        assert!(asked.is_given_up("a", now) && !asked.is_given_up("b", now));
        assert_eq!((asked.silences("a"), asked.silences("b")), (4, 0));
    }

    #[test]
    fn nothing_is_remembered_of_what_is_not_claimed_any_more() {
        let (mut asked, now) = (Asked::default(), Instant::now());
        for epoch in 0..1_000 {
            asked.ask("liar", run(epoch), epoch % 2 == 0, now);
            asked.note("liar", run(epoch), Outcome::Nothing, now);
        }
        asked.keep_claimed("liar", (990..2_000).map(run));
        assert_eq!(asked.holders["liar"].fruitless.len(), 10);
        asked.keep_lacking(&[run(8), run(9)].into());
        assert_eq!(asked.lacking_since.len(), 1);
        asked.keep_holders(&names(&["a"]), &names(&[]));
        assert!(asked.holders.is_empty());
    }
}
