//! The bytes of any second stay within the budget, as `SessionConfig` states it: for the radio, and for each
//! link. Seconds are those of the robot's own clock.

use super::Finding;
use flockmap::{RobotId, SessionConfig, Stamp};
use std::collections::{BTreeMap, VecDeque};

const NAME: &str = "budget";
/// Below this the limit is one full datagram and the budget times the time.
const THIN_BYTES_PER_S: u32 = 2_000;
const FULL_DATAGRAM: i64 = 1_300;
/// Longest request that a small budget does not shorten.
const REQUEST_BYTES: usize = 327;

/// What one robot sent in the last second.
#[derive(Default)]
pub(in crate::swarm) struct Budget {
    radio: Window,
    links: BTreeMap<RobotId, Window>,
}

#[derive(Default)]
struct Window {
    sent: VecDeque<(Stamp, usize)>,
    sum: usize,
    /// Of a small budget: bytes · 10⁶ above what has flowed off.
    level: i64,
    at: Option<Stamp>,
}

impl Budget {
    /// Bytes go out, counted for each receiver. `to`: each receiver that the session counts, with the bytes
    /// to it.
    pub(in crate::swarm) fn sent(
        &mut self,
        config: &SessionConfig,
        now: Stamp,
        bytes: usize,
        to: &[RobotId],
    ) -> Option<Finding> {
        let copies = to.len().max(1);
        let all = bytes * copies;
        let radio = config.radio_bytes_per_s;
        let radio = radio.and_then(|rate| self.radio.add("radio_bytes_per_s", rate, now, all, copies));
        radio.or_else(|| {
            let (rate, links) = (config.link_bytes_per_s?, &mut self.links);
            let mut to = to.iter();
            to.find_map(|to| links.entry(*to).or_default().add("link_bytes_per_s", rate, now, bytes, 1))
        })
    }
}

impl Window {
    /// What is wrong after so many bytes more. `copies`: peers to whom one request has to fit, or nothing is
    /// promised.
    fn add(&mut self, option: &str, rate: u32, now: Stamp, bytes: usize, copies: usize) -> Option<Finding> {
        let at_once = if rate < THIN_BYTES_PER_S { FULL_DATAGRAM as usize } else { rate as usize };
        let is_promised = copies * REQUEST_BYTES <= at_once;
        if rate < THIN_BYTES_PER_S {
            let since = self.at.map_or(0, |at| now.micros_since(at));
            self.at = Some(now);
            self.level = (self.level - since * i64::from(rate)).max(0) + bytes as i64 * 1_000_000;
            let over = self.level - FULL_DATAGRAM * 1_000_000;
            // A microsecond is the grain of the clock.
            return (is_promised && over > i64::from(rate)).then(|| {
                let expected = format!("{option}: in T seconds at most {FULL_DATAGRAM} + {rate} · T bytes");
                Finding::new(NAME, expected, format!("{} bytes more", over / 1_000_000))
            });
        }
        while let Some((_, old)) = self.sent.pop_front_if(|(at, _)| now.micros_since(*at) >= 1_000_000) {
            self.sum -= old;
        }
        self.sent.push_back((now, bytes));
        self.sum += bytes;
        (is_promised && self.sum > rate as usize).then(|| {
            let found = format!("{} bytes in the second before {now:?}", self.sum);
            Finding::new(NAME, format!("{option}: at most {rate} bytes in any second"), found)
        })
    }
}
