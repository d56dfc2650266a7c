//! The radio of a plan: a preset of the simulator, or one that the user describes.

use flockmap_netsim::Burst;
use flockmap_netsim::swarm::{RadioNumbers, RadioPreset};

/// What of a radio counts for its load.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Radio {
    /// Bytes that it carries in a second, with IP and UDP headers.
    pub rate_bytes_per_s: f64,
    /// Share of datagrams that are lost, bursts included.
    pub loss: f64,
    /// Time that each datagram takes on the air beside its bytes, in seconds.
    pub airtime_overhead_s: f64,
    /// All robots share the rate; else each has it for itself.
    pub is_shared: bool,
    /// The preset whose rows of the table of swarms are used.
    pub preset: RadioPreset,
    /// It is that preset; else one like it.
    pub is_preset: bool,
}

/// Presets that a user's radio can be like: shared by all, everyone hears everyone.
const SHARED: [RadioPreset; 4] =
    [RadioPreset::Wifi, RadioPreset::WifiLossy, RadioPreset::WifiCongested, RadioPreset::Lora];

impl Radio {
    /// A preset.
    pub fn of_preset(preset: RadioPreset) -> Self {
        let RadioNumbers { config, .. } = preset.numbers();
        Self {
            rate_bytes_per_s: config.rate_bytes_per_s.map_or(f64::INFINITY, f64::from),
            loss: with_bursts(config.link.loss, config.link.burst),
            airtime_overhead_s: config.airtime_overhead_micros as f64 / 1e6,
            is_shared: config.is_shared,
            preset,
            is_preset: true,
        }
    }

    /// A radio of the user's own, which all robots share.
    pub fn of_figures(rate_bytes_per_s: f64, loss: f64, airtime_overhead_s: f64) -> Self {
        let presets = SHARED.map(Self::of_preset);
        let own = Self {
            rate_bytes_per_s,
            loss,
            airtime_overhead_s,
            is_shared: true,
            is_preset: false,
            ..presets[0]
        };
        let nearest = presets.into_iter().min_by(|a, b| own.distance(a).total_cmp(&own.distance(b)));
        Self { preset: nearest.map_or(own.preset, |nearest| nearest.preset), ..own }
    }

    /// How far two radios are from each other: a tenth of losses counts as a tenfold rate.
    fn distance(&self, other: &Self) -> f64 {
        let rate = (self.rate_bytes_per_s / other.rate_bytes_per_s).log10();
        let loss = (self.loss - other.loss) / 0.1;
        rate * rate + loss * loss
    }

    /// It loses clearly more than the preset that it is like, so that repairs cost more than the table says.
    pub fn loses_more_than_preset(&self) -> bool {
        self.loss > Self::of_preset(self.preset).loss + 0.02
    }

    /// Seconds on the air for so many bytes in datagrams of this mean size.
    pub fn airtime_s(&self, bytes: f64, datagram_bytes: f64) -> f64 {
        bytes / self.rate_bytes_per_s + bytes / datagram_bytes * self.airtime_overhead_s
    }
}

/// Share that is lost on the mean, over bursts and the time between.
fn with_bursts(loss: f64, burst: Option<Burst>) -> f64 {
    burst.map_or(loss, |burst| {
        let bad = f64::from(burst.bad_ms) / f64::from(burst.good_ms + burst.bad_ms).max(1.0);
        loss + (1.0 - loss) * burst.loss * bad
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_radio_of_the_users_own_is_like_the_preset_with_its_figures() {
        for preset in SHARED {
            let radio = Radio::of_preset(preset);
            let own = Radio::of_figures(radio.rate_bytes_per_s, radio.loss, radio.airtime_overhead_s);
            assert_eq!(own, Radio { is_preset: false, ..radio });
        }
        assert_eq!(Radio::of_figures(6_400.0, 0.05, 0.0).preset, RadioPreset::Lora);
        assert!(Radio::of_figures(6_400.0, 0.2, 0.0).loss > 0.1);
    }

    #[test]
    fn a_radio_that_loses_more_than_the_table_knows_is_seen() {
        assert!(!Radio::of_figures(750_000.0, 0.01, 0.0).loses_more_than_preset());
        assert!(Radio::of_figures(750_000.0, 0.5, 0.0).loses_more_than_preset());
    }
}
