//! What may be asked of a flight; all else is drawn from the seed.

use super::RadioPreset;
use core::fmt::Write;
use flockmap::Cast;

/// A flight of a swarm. Whatever is `None` is drawn from the seed.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SwarmOptions {
    /// Decides everything that is left to chance.
    pub seed: u64,
    /// Robots, 2 to 200.
    pub robots: Option<usize>,
    /// The radio.
    pub radio: Option<RadioPreset>,
    /// Seconds of mapping, more than 0, at most 3,600.
    pub seconds: Option<f64>,
    /// To each peer on its own, or to all at once.
    pub cast: Option<Cast>,
    /// Bytes that each robot may send in a second, in all; 500 or more.
    pub budget_bytes_per_s: Option<u32>,
    /// No crashes, partitions, half-open links, tight limits or mixed settings: the radio alone.
    pub is_calm: bool,
    /// The flight is over when all agree, or so many seconds after links healed; then nobody asks whether they had to. For tables.
    pub until_agreement_s: Option<u32>,
}

impl SwarmOptions {
    /// Everything drawn from the seed.
    pub const fn new(seed: u64) -> Self {
        Self {
            seed,
            robots: None,
            radio: None,
            seconds: None,
            cast: None,
            budget_bytes_per_s: None,
            is_calm: false,
            until_agreement_s: None,
        }
    }

    /// The command that flies it again.
    pub fn command(&self) -> String {
        let mut command = format!("flockmap sim swarm --seed {}", self.seed);
        if let Some(robots) = self.robots {
            let _ = write!(command, " --robots {robots}");
        }
        if let Some(radio) = self.radio {
            let _ = write!(command, " --radio {radio}");
        }
        if let Some(seconds) = self.seconds {
            let _ = write!(command, " --seconds {seconds}");
        }
        match self.cast {
            Some(Cast::Unicast) => command += " --cast unicast",
            Some(Cast::Broadcast) => command += " --cast broadcast",
            None => {}
        }
        if let Some(budget) = self.budget_bytes_per_s {
            let _ = write!(command, " --budget {budget}");
        }
        if self.is_calm {
            command += " --calm";
        }
        command
    }
}
