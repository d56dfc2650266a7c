//! What each holder said last that it holds.

use std::collections::BTreeMap;
use std::sync::Arc;

use flockmap::RobotId;

use crate::held::{Held, HeldStream};

/// Clocks that are said to differ by more are left out: 200 years.
const CLOCK_MICROS_MAX: u64 = 200 * 366 * 86_400 * 1_000_000;

/// The claim of one holder.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Claim {
    /// Side of a voxel in micrometres.
    pub(crate) resolution_um: u32,
    /// Its runs, as many as count. Who says the same shares them.
    pub(crate) runs: Arc<[HeldStream]>,
    /// The digest, if it is that of what was told.
    digest: Option<String>,
    on_radio: bool,
    /// Its clock minus the own one, in microseconds.
    ahead: i64,
    /// The clocks in `runs` are by its own one.
    has_clocks: bool,
}

/// An answer to the question what is held.
pub(crate) struct Answer {
    pub(crate) name: String,
    pub(crate) held: Held,
    /// The holder's clock minus the own one, in microseconds.
    pub(crate) ahead: i64,
}

/// The claims of all holders.
#[derive(Debug, Default)]
pub(crate) struct Claims(BTreeMap<String, Claim>);

impl Claims {
    /// The digests of what need not be told again, as the question has them. Others than those that fit what they were
    /// told with are not among them: under such a one anybody could hide what somebody else holds. Nor are those of
    /// which nobody is left whose clocks are known.
    pub(crate) fn known(&self) -> String {
        let claims = self.0.values().filter(|claim| claim.has_clocks);
        let mut digests: Vec<&str> = claims.filter_map(|claim| claim.digest.as_deref()).collect();
        digests.sort_unstable();
        digests.dedup();
        digests.join(",")
    }

    /// Takes answers in place of what was said before. Of each at most `runs_max` runs count: more than that have no
    /// place here.
    pub(crate) fn replace(&mut self, answers: Vec<Answer>, runs_max: usize) {
        let former = std::mem::take(&mut self.0);
        for Answer { name, held, ahead } in answers {
            let Held { digest, on_radio, resolution_um, streams, .. } = &held;
            let is_told = !streams.is_empty();
            // The clocks of somebody else are by somebody else's clock.
            let own = former.get(&name).filter(|claim| claim.digest.as_ref() == Some(digest));
            let known = own.or_else(|| former.values().find(|claim| claim.digest.as_ref() == Some(digest)));
            let (runs, digest, has_clocks) = match known.filter(|_| !is_told) {
                Some(known) => {
                    (Arc::clone(&known.runs), known.digest.clone(), own.is_some_and(|own| own.has_clocks))
                }
                None => {
                    let digest = held.has_true_digest().then(|| digest.clone());
                    (streams.iter().take(runs_max).cloned().collect(), digest, true)
                }
            };
            let (resolution_um, on_radio) = (*resolution_um, *on_radio);
            self.0.insert(name, Claim { resolution_um, runs, digest, on_radio, ahead, has_clocks });
        }
    }

    /// What a holder holds.
    pub(crate) fn get(&self, name: &str) -> Option<&Claim> {
        self.0.get(name)
    }

    /// The holders, first those that hear the robots themselves.
    pub(crate) fn names(&self) -> Vec<String> {
        let mut names: Vec<&String> = self.0.keys().collect();
        names.sort_by_key(|name| self.0.get(*name).is_some_and(|claim| !claim.on_radio));
        names.into_iter().cloned().collect()
    }

    /// The clocks of robots minus the own one, in microseconds. Of each robot one, always by the same rule: who hears
    /// the robots has measured them, and of several of those the first by name is taken.
    pub(crate) fn clocks(&self) -> BTreeMap<RobotId, i64> {
        let mut clocks = BTreeMap::new();
        for name in self.names() {
            let Some(claim) = self.0.get(&name).filter(|claim| claim.has_clocks) else { continue };
            // Of several runs of a robot the newest one counts.
            let mut said: BTreeMap<RobotId, (u64, i64)> = BTreeMap::new();
            for run in claim.runs.iter() {
                let Some(micros) = run.clock_us.map(|micros| micros.saturating_add(claim.ahead)) else {
                    continue;
                };
                if micros.unsigned_abs() <= CLOCK_MICROS_MAX {
                    let newest = said.entry(RobotId(run.origin)).or_insert((run.epoch, micros));
                    *newest = (*newest).max((run.epoch, micros));
                }
            }
            for (robot, (_, micros)) in said {
                clocks.entry(robot).or_insert(micros);
            }
        }
        clocks
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(origin: u16, epoch: u64, clock_us: i64) -> HeldStream {
        HeldStream { origin, epoch, held: "1-5".into(), clock_us: Some(clock_us) }
    }

    fn held(streams: Vec<HeldStream>) -> Held {
        Held::new(100_000, streams)
    }

    fn answer(name: &str, held: &Held, ahead: i64) -> Answer {
        Answer { name: name.into(), held: held.clone(), ahead }
    }

    /// The same for who knows it.
    fn short(held: &Held) -> Held {
        held.clone().unless_known(&held.digest)
    }

    #[test]
    fn what_was_told_under_a_digest_need_not_be_told_again_by_anybody() {
        let (mut claims, full) = (Claims::default(), held(vec![run(1, 1, 7), run(2, 1, 8)]));
        claims.replace(vec![answer("a", &full, 0)], 10);
        assert_eq!(claims.known(), full.digest);
        claims.replace(vec![answer("a", &short(&full), 0), answer("b", &short(&full), 0)], 10);
        for name in ["a", "b"] {
            assert_eq!(claims.get(name).unwrap().runs[..], full.streams[..], "{name}");
        }
        assert!(Arc::ptr_eq(&claims.get("a").unwrap().runs, &claims.get("b").unwrap().runs));
        assert_eq!(claims.known(), full.digest);
        // Who does not answer is not known any more. Now nobody's clocks are: they are to be told.
        claims.replace(vec![answer("b", &short(&full), 0)], 10);
        assert_eq!((claims.names(), claims.known()), (vec!["b".to_owned()], String::new()));
        assert_eq!(claims.get("b").unwrap().runs.len(), 2);
        claims.replace(vec![answer("b", &full, 0)], 10);
        assert_eq!((claims.clocks().len(), claims.known()), (2, full.digest));
    }

    #[test]
    fn a_false_digest_hides_nothing() {
        let (mut claims, true_one) = (Claims::default(), held(vec![run(1, 1, 7)]));
        let mut liar = held(vec![run(9, 9, 9)]);
        liar.digest.clone_from(&true_one.digest);
        claims.replace(vec![answer("liar", &liar, 0)], 10);
        // It is not named, so that the others tell all that they hold.
        assert_eq!(claims.known(), "");
        claims.replace(vec![answer("liar", &liar, 0), answer("a", &true_one, 0)], 10);
        claims.replace(vec![answer("liar", &liar, 0), answer("a", &short(&true_one), 0)], 10);
        assert_eq!(claims.get("a").unwrap().runs[..], true_one.streams[..]);
        assert_eq!(claims.known(), true_one.digest);
        // A digest may be any text: no question is made of it.
        liar.digest = format!("{};as=snapshot", "x".repeat(1_000_000));
        claims.replace(vec![answer("liar", &liar, 0)], 10);
        assert_eq!(claims.known(), "");
    }

    #[test]
    fn of_a_claim_as_many_runs_count_as_have_a_place() {
        let mut claims = Claims::default();
        let many = held((0..1_000).map(|epoch| run(3, epoch, 0)).collect());
        claims.replace(vec![answer("a", &many, 0)], 64);
        assert_eq!(claims.get("a").unwrap().runs.len(), 64);
        claims.replace(vec![answer("a", &short(&many), 0)], 64);
        assert_eq!(claims.get("a").unwrap().runs.len(), 64);
    }

    #[test]
    fn clocks_are_taken_from_who_hears_the_robots_and_by_his_own_clock() {
        let mut claims = Claims::default();
        let archive = held(vec![run(1, 1, 900), run(3, 1, 30)]);
        let gateway = Held { on_radio: true, ..held(vec![run(1, 1, 5), run(1, 2, 6), run(2, 1, 20)]) };
        claims.replace(vec![answer("archive", &archive, 0), answer("gateway", &gateway, 1_000)], 10);
        let expected: BTreeMap<_, _> =
            [(1, 1_006), (2, 1_020), (3, 30)].map(|(id, us)| (RobotId(id), us)).into();
        assert_eq!(claims.clocks(), expected);
        // Another gateway holds the same: its own clock differs, and it has told no clocks by it.
        let both = vec![answer("another", &short(&gateway), 77), answer("gateway", &short(&gateway), 1_000)];
        claims.replace(both, 10);
        assert_eq!(claims.clocks().get(&RobotId(1)), Some(&1_006));
        claims.replace(vec![answer("another", &short(&gateway), 77)], 10);
        assert_eq!(claims.clocks(), BTreeMap::new());
        // What no clock can show is left out.
        let far = held(vec![run(1, 1, i64::MAX), run(2, 1, i64::MIN)]);
        claims.replace(vec![answer("a", &far, i64::MAX)], 10);
        assert_eq!(claims.clocks(), [(RobotId(2), -1)].into());
    }
}
