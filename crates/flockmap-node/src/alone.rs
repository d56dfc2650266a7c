//! A robot that hears nobody says so, and what to check.

use std::time::{Duration, Instant};

use crate::NodeCounters;

/// A robot that has heard nobody for so long since its start says so.
const PATIENCE: Duration = Duration::from_secs(10);

/// Looks whether anybody is heard. Says once that nobody is.
#[derive(Debug)]
pub(crate) struct Alone {
    due: Option<Instant>,
}

impl Alone {
    /// `hears_others`: on its radio somebody may be heard.
    pub(crate) fn new(began: Instant, hears_others: bool) -> Self {
        Self { due: hears_others.then(|| began + PATIENCE) }
    }

    /// When to look.
    pub(crate) const fn poll_timeout(&self) -> Option<Instant> {
        self.due
    }

    /// What there is to say now. `is_heard`: some robot of the swarm is, or was.
    pub(crate) fn poll(&mut self, now: Instant, is_heard: bool, counters: &NodeCounters) -> Option<String> {
        if is_heard {
            self.due = None;
        }
        self.due.filter(|due| now >= *due)?;
        self.due = None;
        let seconds = PATIENCE.as_secs();
        let NodeCounters { datagrams_in, datagrams_out, send_failed, unreachable, .. } = *counters;
        let sent = match (datagrams_out, send_failed) {
            (0, 0) => "Nothing was sent either: give peers, broadcast or multicast in [network]".into(),
            (0, failed) => format!(
                "None of {failed} datagrams could be sent: look at the network interface, and at the addresses in [network]"
            ),
            (_, _) if unreachable > 0 => {
                "At an address of [network] peers no program listens: is that robot on, and on that port?"
                    .into()
            }
            (sent, _) => format!(
                "{sent} datagrams were sent: do the addresses in [network] lead to the others, and does no firewall drop UDP on either side?"
            ),
        };
        Some(match datagrams_in {
            0 => format!("no other robot was heard for {seconds} s. {sent}"),
            received => format!(
                "no other robot was heard for {seconds} s, though {received} datagrams came: do all robots have the same [session] swarm and swarm_key, and each an id of its own?"
            ),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(seconds: u64, is_heard: bool, counters: NodeCounters) -> Option<String> {
        let began = Instant::now();
        let mut alone = Alone::new(began, true);
        let said = alone.poll(began + Duration::from_secs(seconds), is_heard, &counters);
        assert_eq!(alone.poll(began + Duration::from_secs(1_000), true, &counters), None, "once");
        said
    }

    #[test]
    fn a_robot_that_hears_nobody_says_what_to_check() {
        let none = NodeCounters::default();
        assert_eq!(after(9, false, none), None);
        assert_eq!(after(11, true, none), None);
        for (counters, says) in [
            (none, "give peers, broadcast or multicast in [network]"),
            (NodeCounters { send_failed: 7, ..none }, "None of 7 datagrams could be sent"),
            (NodeCounters { datagrams_out: 7, ..none }, "firewall"),
            (NodeCounters { datagrams_out: 7, unreachable: 3, ..none }, "no program listens"),
            (
                NodeCounters { datagrams_in: 5, datagrams_out: 7, ..none },
                "the same [session] swarm and swarm_key",
            ),
        ] {
            let said = after(11, false, counters).unwrap();
            assert!(said.contains(says), "{said}");
        }
    }
}
