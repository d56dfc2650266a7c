//! All options of a session.

use crate::SwarmKey;
use crate::store::StoreLimits;
use crate::wire::{DATAGRAM_BYTES_MAX, Salt};
use core::time::Duration;

/// How packages go out.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Cast {
    /// To each peer on its own. Each link is then counted, and paced, on its own.
    Unicast,
    /// To everyone at once, for a shared radio: one datagram serves all, and an answer heard from another robot
    /// is not given again.
    Broadcast,
}

/// Which of the packages that a peer misses goes first.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Order {
    /// The newest batch: what a planner needs now comes first, old gaps fill later.
    NewestFirst,
    /// The oldest batch, as a list walked from its front gives it.
    OldestFirst,
}

/// Who answers for packages of other origins.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Relay {
    /// The origin answers first. If the requester does not hear the origin, the robot with the lowest id of those
    /// that the requester hears answers at once; the next ones only for what stays missing for `relay_delay_ms`,
    /// each a further delay later. With up to 8 peers those who are known to lack it too are not waited for.
    Ranked,
    /// Everyone who holds a package answers at once (the paper, RACER): safe and wasteful.
    Always,
    /// Only origins answer.
    Never,
}

/// When a package that was sent and is still missing at the peer counts as lost.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum InFlight {
    /// When the peer has heard something sent later and waited for reordered datagrams, or, if it has heard
    /// nothing since, when the measured round trip has passed.
    RoundTrip,
    /// When it was already missing in the request before (Sec. IV-B of the paper: successive lists of missing
    /// indices are compared).
    PreviousRequest,
}

/// Options of a [`Session`](crate::Session). The default suits a swarm of up to some ten robots on Wi-Fi or a
/// mesh radio.
#[derive(Clone, PartialEq, Debug)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema))]
#[cfg_attr(feature = "serde", serde(default, deny_unknown_fields))]
pub struct SessionConfig {
    /// Robots of other swarms are ignored. Default 0.
    pub swarm: u16,
    /// The secret of the swarm: all that is sent is sealed with it, and only what it opens is believed.
    /// Default `None`: anybody in reach of the radio can read and change the map. Needs a
    /// [`salt`](Self::salt). Holds, against replays, 160 bytes for each robot id that a holder of the key
    /// used (10 MiB for all 65,536), 512 more for each peer.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub swarm_key: Option<SwarmKey>,
    /// With a key: random bytes, drawn anew for **every** run (`getrandom`), which make a key of its own for
    /// it: so no nonce comes twice, whatever the clock and the epoch are. All zero, as by default, is refused
    /// where there is a key.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub salt: Salt,
    /// Unicast or broadcast. Default unicast.
    pub cast: Cast,

    // When to ask.
    /// Pause between requests while packages flow, ± 10 %. Finds the lost end of a burst. Default 1,000.
    pub request_period_active_ms: u32,
    /// Pause between requests when nothing flows, ± 10 %. They keep peers known and clocks measured. Default
    /// 3,000.
    pub request_period_idle_ms: u32,
    /// Packages count as flowing for so long after the last one. Default 3,000.
    pub active_for_ms: u32,
    /// Ask at once when a gap in the indices is seen. Default yes.
    pub gap_requests: bool,
    /// How long to wait for reordered datagrams before a gap is taken for a loss; more where the round trip is
    /// seen to vary more. Used by both sides. Default 30.
    pub reorder_patience_ms: u32,
    /// Least pause between requests for gaps; doubles while a gap stays. Default 100.
    pub gap_request_pause_ms: u32,

    // What to answer.
    /// Send new packages at once to peers that are heard in both directions, and forward those of others,
    /// without waiting for a request. Default yes; the paper sends on request only.
    pub push: bool,
    /// Newest or oldest first. Default newest.
    pub order: Order,
    /// Who answers for others' packages. Default ranked.
    pub relay: Relay,
    /// For ranked relaying: how long a package has to stay missing before the next robot in line sends it.
    /// Default 2,000: longer than the origin needs for a repair.
    pub relay_delay_ms: u32,
    /// When something sent counts as lost. Default by the measured round trip.
    pub in_flight: InFlight,
    /// Round trip taken until one is measured. Default 300.
    pub round_trip_initial_ms: u32,
    /// Offer the snapshot instead of packages when at least so many bytes are missing and the state costs
    /// less. Default 65,536; `None`: only if a missing package is not stored any more.
    #[cfg_attr(
        feature = "serde",
        serde(rename = "snapshot_kb_min", with = "flockmap_grid::units::UnlessZero::<1_024, 0>")
    )]
    pub snapshot_bytes_min: Option<u32>,
    /// Send the snapshot when the missing indices span more than this (the paper's rule). Default `None`.
    #[cfg_attr(feature = "serde", serde(with = "flockmap_grid::units::UnlessZero::<1, 0>"))]
    pub snapshot_range_max: Option<u32>,

    // How much to send.
    /// Bytes that go out in any second over all links, datagrams sent to each peer counted each. At least 20.
    /// Default 2,000,000: unlimited sending overruns the socket buffers of receivers. `None`: no limit.
    ///
    /// Of 2,000 and more it holds in every single second. Below that a full datagram takes more than half a
    /// second's worth, and the limit is: in any T seconds at most 1,300 bytes (one full datagram) and the
    /// budget times T. What goes to every peer at once has to fit: the limit only holds if one request to
    /// each, at most 308 bytes (327 with a key), fits into the budget; below 2,000, into 1,300 bytes.
    ///
    /// Where the budget is small, requests are made shorter (half a second's worth) and rarer (a twenty-fourth of
    /// the budget over time as long as one comes within 5 s, else a twelfth; those for gaps an eighth), so that
    /// control leaves room for the map. Peers then wait for longer before they count this robot as gone.
    #[cfg_attr(
        feature = "serde",
        serde(rename = "budget_kb_s", with = "flockmap_grid::units::UnlessZero::<1_024, BYTES_PER_S_MIN>")
    )]
    pub radio_bytes_per_s: Option<u32>,
    /// Bytes that go out to one peer in any second (unicast), requests included. As `radio_bytes_per_s`, for each
    /// link. Default `None`: no limit.
    #[cfg_attr(
        feature = "serde",
        serde(
            rename = "link_budget_kb_s",
            with = "flockmap_grid::units::UnlessZero::<1_024, BYTES_PER_S_MIN>"
        )
    )]
    pub link_bytes_per_s: Option<u32>,
    /// Find what the radio carries, by how long what is sent and heard waits, and send no more; the budgets
    /// above remain limits. Begins with 250,000 bytes a second, doubles that as long as it is used and
    /// nothing waits, and goes down to 20; of packages no more are out than 8,000 bytes at first, before some peer
    /// has said what arrived. Default yes; the paper does not.
    pub congestion_control: bool,
    /// Repair obstacles of the last two seconds fast, where 5 % of what a peer is sent gets lost, at most 8 robots are
    /// heard, and the radio carries 16,000 bytes a second: some 30 ms after obstacles a probe of some 64 bytes shows what
    /// was sent, one for every 448 bytes; gaps are asked for twice in a round trip. From a third of losses on obstacles
    /// are sent twice, and gaps asked for four times in a round trip. Default yes; a robot without an obstacle period
    /// does without.
    pub fast_repair: bool,
    /// How much of a second's budget may go out at once; the rest is spread. 10 to 1,000. Default 50.
    pub burst_ms: u32,
    /// Bytes counted for each datagram beside its payload. Default 28: IPv4 and UDP headers.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub datagram_overhead_bytes: u32,
    /// Longest datagram made, in bytes of UDP payload; 1,181 to 1,200, with a key 1,199 to 1,200. Default 1,200.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub datagram_bytes_max: usize,

    // Limits on what others can make this robot hold.
    /// A peer not heard for so long is forgotten. Default 10,000.
    pub peer_timeout_ms: u32,
    /// Peers known at once. Default 32. Worst case per peer: 29 KiB for each of `streams_max` streams, 96
    /// bytes for each of `in_flight_max` packages (by broadcast 160, and 32 in each stream), and 46 KiB. All
    /// worst cases together: [`memory_max`](Self::memory_max).
    pub peers_max: usize,
    /// Streams of others known at once. Of more, ended runs are dropped, the one of which nothing new has
    /// come for longest ([`Event::StreamForgotten`](crate::Event::StreamForgotten)); the newest run of a
    /// robot that is heard never does. Default 64. Worst case 24 KiB each, beside what peers state of them.
    pub streams_max: usize,
    /// Runs kept of one origin; of more, the oldest is forgotten. Default 4.
    pub epochs_max: usize,
    /// Bytes of stored packages, with 400 bytes of bookkeeping for each. Default 64 MiB.
    #[cfg_attr(feature = "serde", serde(rename = "store_mb", with = "flockmap_grid::units::Mebibytes"))]
    pub store_bytes_max: usize,
    /// Packages sent to one peer and not yet confirmed; more wait. By broadcast up to as many again are noted
    /// that other peers were sent, and this one has heard. Default 4,096.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub in_flight_max: usize,
    /// Bytes of snapshot chunks kept for sending. A snapshot that a peer is receiving is not dropped for
    /// another: that one waits. Default 16 MiB.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub snapshot_bytes_max: usize,
    /// Snapshots received at once. Default 8. Worst case 8 KiB each; in a robot, which reads them side by
    /// side, 1.1 MB more.
    #[cfg_attr(feature = "serde", serde(skip))]
    pub transfers_max: usize,
}

/// Longest patience that follows from the round trip alone: the option may ask for more.
const PATIENCE_MAX: Duration = Duration::from_millis(500);

/// An option in milliseconds as a span.
pub(crate) const fn ms(count: u32) -> Duration {
    Duration::from_millis(count as u64)
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self {
            swarm: 0,
            swarm_key: None,
            salt: [0; 16],
            cast: Cast::Unicast,
            request_period_active_ms: 1_000,
            request_period_idle_ms: 3_000,
            active_for_ms: 3_000,
            gap_requests: true,
            reorder_patience_ms: 30,
            gap_request_pause_ms: 100,
            push: true,
            order: Order::NewestFirst,
            relay: Relay::Ranked,
            relay_delay_ms: 2_000,
            in_flight: InFlight::RoundTrip,
            round_trip_initial_ms: 300,
            snapshot_bytes_min: Some(65_536),
            snapshot_range_max: None,
            radio_bytes_per_s: Some(2_000_000),
            link_bytes_per_s: None,
            congestion_control: true,
            fast_repair: true,
            burst_ms: 50,
            datagram_overhead_bytes: 28,
            datagram_bytes_max: DATAGRAM_BYTES_MAX,
            peer_timeout_ms: 10_000,
            peers_max: 32,
            streams_max: 64,
            epochs_max: 4,
            store_bytes_max: 64 << 20,
            in_flight_max: 4_096,
            snapshot_bytes_max: 16 << 20,
            transfers_max: 8,
        }
    }
}

/// An option of a [`SessionConfig`] that cannot work.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("{option} is {got}, expected {expected}")]
pub struct ConfigError {
    /// Name of the option.
    pub option: &'static str,
    /// Its value.
    pub got: u64,
    /// What would work.
    pub expected: &'static str,
}

/// Least budget, and least rate that congestion control goes down to: a full datagram takes a minute of it.
pub const BYTES_PER_S_MIN: u32 = 20;

impl SessionConfig {
    /// The paper's own behaviour (Sec. IV-B): requests on a fixed period, packages only as answers to them, all
    /// holders answer, oldest first, successive requests compared, snapshot by the range of missing indices.
    /// The paper gives no values for the period and the range; 500 ms and 100 are ours.
    pub fn paper() -> Self {
        Self {
            request_period_active_ms: 500,
            request_period_idle_ms: 500,
            gap_requests: false,
            push: false,
            order: Order::OldestFirst,
            relay: Relay::Always,
            in_flight: InFlight::PreviousRequest,
            snapshot_bytes_min: None,
            snapshot_range_max: Some(100),
            congestion_control: false,
            fast_repair: false,
            ..Self::default()
        }
    }

    /// How long a missing package may still be in flight, behind later ones, before it counts as lost.
    pub(crate) fn patience(&self, variation: Duration) -> Duration {
        (2 * variation).min(PATIENCE_MAX).max(ms(self.reorder_patience_ms))
    }

    /// How long a relay with this rank waits for those before it.
    pub(crate) fn relay_delay(&self, rank: u32) -> Duration {
        ms(self.relay_delay_ms).saturating_mul(rank)
    }

    /// Checks that every option is in its range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let check = |option, ok: bool, got: u64, expected| {
            if ok { Ok(()) } else { Err(ConfigError { option, got, expected }) }
        };
        for (option, rate) in
            [("radio_bytes_per_s", self.radio_bytes_per_s), ("link_bytes_per_s", self.link_bytes_per_s)]
        {
            let rate = rate.unwrap_or(BYTES_PER_S_MIN);
            check(option, rate >= BYTES_PER_S_MIN, rate.into(), "at least 20, or no limit")?;
        }
        for (option, ms) in [
            ("request_period_active_ms", self.request_period_active_ms),
            ("request_period_idle_ms", self.request_period_idle_ms),
            ("gap_request_pause_ms", self.gap_request_pause_ms),
            ("peer_timeout_ms", self.peer_timeout_ms),
        ] {
            check(option, (10..=3_600_000).contains(&ms), ms.into(), "10 to 3,600,000")?;
        }
        check("burst_ms", (10..=1_000).contains(&self.burst_ms), self.burst_ms.into(), "10 to 1,000")?;
        for (option, count) in [
            ("peers_max", self.peers_max),
            ("streams_max", self.streams_max),
            ("epochs_max", self.epochs_max),
            ("in_flight_max", self.in_flight_max),
            ("transfers_max", self.transfers_max),
        ] {
            check(option, (1..=1 << 20).contains(&count), count as u64, "1 to 1,048,576")?;
        }
        let has_salt = self.swarm_key.is_none() || self.salt != [0; 16];
        check("salt", has_salt, 0, "16 random bytes, drawn anew for each run, where there is a swarm_key")?;
        let bytes = self.datagram_bytes_max;
        let (least, expected) = match self.swarm_key {
            None => (1_181, "1,181 to 1,200"),
            Some(_) => (1_199, "1,199 or 1,200 with a key"),
        };
        check("datagram_bytes_max", (least..=DATAGRAM_BYTES_MAX).contains(&bytes), bytes as u64, expected)
    }

    pub(crate) const fn store_limits(&self) -> StoreLimits {
        StoreLimits {
            streams_max: self.streams_max,
            epochs_max: self.epochs_max,
            bytes_max: self.store_bytes_max,
        }
    }
}
