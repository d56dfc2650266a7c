//! What may be asked of a flight; all else is drawn from the seed.

use super::RadioPreset;
use flockmap::Cast;

/// A flight of a swarm. Whatever is `None` is drawn from the seed.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct SwarmOptions {
    /// Decides everything that is drawn.
    pub seed: u64,
    /// Robots, 2 to 200.
    pub robots: Option<usize>,
    /// The radio.
    pub radio: Option<RadioPreset>,
    /// Seconds of mapping, more than 0, at most 3,600.
    pub seconds: Option<f64>,
    /// To each peer on its own, or to all at once.
    pub cast: Option<Cast>,
    /// Bytes that each robot may send in a second, in all; [`BUDGET_MIN`](super::BUDGET_MIN) or more.
    pub budget_bytes_per_s: Option<u32>,
    /// No crashes, partitions, half-open links, tight limits or mixed settings: the radio alone.
    pub is_calm: bool,
    /// The flight is over when all agree, or so many seconds after links healed; then nobody asks whether
    /// they had to. For tables.
    pub until_agreement_s: Option<u32>,
}

impl SwarmOptions {
    /// Everything drawn from the seed.
    pub fn new(seed: u64) -> Self {
        Self { seed, ..Self::default() }
    }

    /// The command that flies it again.
    pub fn command(&self) -> String {
        let mut command = format!("flockmap sim swarm --seed {}", self.seed);
        let mut add = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                command += &format!(" --{name} {value}");
            }
        };
        add("robots", self.robots.map(|robots| robots.to_string()));
        add("radio", self.radio.map(|radio| radio.to_string()));
        add("seconds", self.seconds.map(|seconds| seconds.to_string()));
        add("cast", self.cast.map(|cast| format!("{cast:?}").to_lowercase()));
        add("budget", self.budget_bytes_per_s.map(|budget| budget.to_string()));
        command + if self.is_calm { " --calm" } else { "" }
    }
}
