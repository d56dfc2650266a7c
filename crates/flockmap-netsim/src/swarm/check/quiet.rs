//! When nothing is missing anywhere, only periodic requests flow. Ended runs that `agreement` leaves out may
//! come to some robots after all agree: it is quiet when nothing of them has flowed for a while, at the
//! latest after the time in which all have to agree.

use super::Finding;
use flockmap::{Cast, Package, RobotId, SessionConfig};

const NAME: &str = "quiet";

/// What a robot sends from a moment on at which everybody has everything and knows it of everybody.
#[derive(Default)]
pub(in crate::swarm) struct Quiet {
    from: Option<i64>,
    requests: u64,
}

impl Quiet {
    /// How long after agreement it is quiet: everybody has got the last requests.
    pub(in crate::swarm) fn grace_micros(config: &SessionConfig) -> i64 {
        let period = period_micros(config);
        // An outsider may have made robots hear each other that do not.
        let forgotten =
            if config.swarm_key.is_some() { 1_000 * i64::from(config.peer_timeout_ms) } else { 0 };
        1_000_000 + forgotten + 1_000 * i64::from(config.active_for_ms) + 3 * period
    }

    pub(in crate::swarm) fn begin(&mut self, now: i64) {
        self.from = Some(now);
    }

    /// A datagram to everyone counts once.
    pub(in crate::swarm) fn sent(
        &mut self,
        config: &SessionConfig,
        now: i64,
        to: Option<RobotId>,
        packages: Option<&[Package]>,
    ) -> Option<Finding> {
        let since = now - self.from?;
        if let Some(packages) = packages {
            let what = packages.iter().map(|package| (package.header().stream, package.header().index));
            let found = format!("to {to:?}: packages {:?}", what.collect::<Vec<_>>());
            return Some(Finding::new(NAME, "requests only: nobody misses anything", found));
        }
        self.requests += 1;
        let shortest = 900 * i64::from(config.request_period_idle_ms.min(config.request_period_active_ms));
        let most = 2 + (since / shortest.max(1)) as u64;
        (self.requests > most).then(|| {
            let expected = format!("at most {most} requests in {:.3} s", since as f64 / 1e6);
            Finding::new(NAME, expected, self.requests.to_string())
        })
    }
}

/// Longest pause between two requests to everyone, in microseconds.
pub(in crate::swarm) fn period_micros(config: &SessionConfig) -> i64 {
    let period = i64::from(config.request_period_idle_ms.max(config.request_period_active_ms)) * 1_100;
    // Whole requests take a twelfth of a budget, each at most half a second of it, or 327 bytes; or a twenty-fourth, as
    // long as one comes within 5 s.
    let copies = if config.cast == Cast::Unicast { config.peers_max as i64 } else { 1 };
    let rates = [
        config.radio_bytes_per_s.map(|rate| i64::from(rate) / copies),
        config.link_bytes_per_s.map(i64::from),
    ];
    let pause = |rate: i64| {
        let twelfth = 12 * 1_100_000 * 327.max(rate / 2).min(1_228) / rate.max(1);
        twelfth.max((2 * twelfth).min(5_500_000))
    };
    rates.into_iter().flatten().map(pause).fold(period, i64::max)
}
