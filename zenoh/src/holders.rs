//! The holders of a swarm of which there is a sign of life.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Holders that are known at once; of more, those that come are not asked.
pub(crate) const HOLDERS_MAX: usize = 64;

/// Their names. Copies share them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Holders(Arc<Mutex<Names>>);

#[derive(Debug, Default)]
struct Names {
    there: BTreeSet<String>,
    /// Those of them that came since they were last looked at.
    came: BTreeSet<String>,
}

impl Holders {
    /// Notes that one has come, or gone. Whether that is news.
    pub(crate) fn set(&self, name: &str, is_there: bool) -> bool {
        let mut names = self.lock();
        if !is_there {
            names.came.remove(name);
            return names.there.remove(name);
        }
        if names.there.contains(name) || names.there.len() >= HOLDERS_MAX {
            return false;
        }
        names.came.insert(name.to_owned());
        names.there.insert(name.to_owned())
    }

    /// Whether there is one beside this.
    pub(crate) fn has_others(&self, own: &str) -> bool {
        self.lock().there.iter().any(|name| name != own)
    }

    /// All that are there, and those of them that came since this was last called.
    pub(crate) fn look(&self) -> (BTreeSet<String>, BTreeSet<String>) {
        let mut names = self.lock();
        (names.there.clone(), std::mem::take(&mut names.came))
    }

    fn lock(&self) -> MutexGuard<'_, Names> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn who_goes_and_comes_again_is_seen_as_new() {
        let holders = Holders::default();
        assert!(holders.set("a", true) && !holders.set("a", true) && holders.set("b", true));
        assert_eq!(holders.look(), (names(&["a", "b"]), names(&["a", "b"])));
        assert_eq!(holders.look(), (names(&["a", "b"]), names(&[])));
        assert!(holders.set("a", false) && !holders.set("a", false));
        assert_eq!(holders.look(), (names(&["b"]), names(&[])));
        assert!(holders.set("a", true));
        assert_eq!(holders.look(), (names(&["a", "b"]), names(&["a"])));
        assert!(holders.has_others("a"));
        holders.set("b", false);
        assert!(!holders.has_others("a"));
    }

    #[test]
    fn a_flood_of_tokens_is_not_remembered() {
        let holders = Holders::default();
        for number in 0..3 * HOLDERS_MAX {
            assert_eq!(holders.set(&format!("flood{number}"), true), number < HOLDERS_MAX);
        }
        let (there, came) = holders.look();
        assert_eq!((there.len(), came.len()), (HOLDERS_MAX, HOLDERS_MAX));
    }
}
