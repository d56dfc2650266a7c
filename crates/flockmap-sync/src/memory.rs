//! The most that a session can be made to hold, reckoned from its options.

use crate::inbox::{CHUNKS_WAITING_MAX, WAITING_BYTES_MAX};
use crate::store::RECEIVED_INTERVALS_MAX;
use crate::wire::DATAGRAM_BYTES_MAX;
use crate::{Cast, SessionConfig};

/// Bytes of an interval of indices.
const INTERVAL: usize = 8;
/// A list that was joined from two has room for both, and a queue may have room for twice what it holds.
const GROWTH: usize = 2;
/// What is known of a stream beside the list of held indices: undecodable indices (64 intervals), whom what
/// is lacking was had from (256), what went out to everyone (256 intervals), places in maps.
const STREAM: usize = 3_072 + GROWTH * 256 * INTERVAL;
/// What is known of a peer beside its views: what its last request said (up to eight times its bytes), the
/// queue (256 items), runs that had no place, its pacer, its clock.
const PEER: usize = 8 * DATAGRAM_BYTES_MAX + 36_864;
/// What a peer states of one stream: seven lists of at most 256 intervals.
const VIEW: usize = 7 * GROWTH * 256 * INTERVAL + 512;
/// A package that was sent and not yet confirmed.
const IN_FLIGHT: usize = 48 * GROWTH;
/// Its interval among those that need not be sent.
const RECEIVED_OR_IN_FLIGHT: usize = INTERVAL * GROWTH;
/// Where a peer that fell silent was reached; and that with the budget of the link to it.
const SILENT: usize = 2 * 128;
const SILENT_LINK: usize = 2_048 + SILENT;
/// With a key, what is known of the counters of every robot that was ever heard, 2¹⁶ of them; and the window
/// of a peer.
const HEARD: usize = (1 << 16) * 160;
const WINDOW: usize = 2 * (256 + 16);
/// Events that nobody took, and packages that wait for a verdict: so many.
const EVENTS: usize = 4_096;
/// A package in memory, beside its bytes.
const PACKAGE: usize = 200;
/// Rejected packages that are remembered: so many, in a map.
const BACKED_OFF: usize = 1_024 * 100;
/// What went out to everyone lately (256 items), and what the radio is found to carry.
const RADIO: usize = 64 << 10;
/// Coded repair by broadcast: repair symbols that were received, the block of which some are sent, and what is there
/// while they are solved for.
const CODED: usize = (256 << 10) + (256 << 10) + (32 << 20);
/// What one input makes and lets go again: a request with all its lists, a plan of what to send.
const WORK: usize = 512 << 10;

impl SessionConfig {
    /// The most bytes that a [`Session`](crate::Session) with these options holds on the heap, whatever it
    /// receives and however late its events are taken: the sum of the worst cases that the limits state. As
    /// asked of the allocator, which may add some. What the driver keeps (layers) is not in it. The default:
    /// 181 MB, of which 64 MiB are the store, 52 MB what 32 peers may state of 64 streams, 13 MB what is in
    /// flight to them, by broadcast 300 MB; honest peers take a hundredth of these two.
    pub const fn memory_max(&self) -> usize {
        let streams = self.streams_max + 1;
        let received = RECEIVED_INTERVALS_MAX * INTERVAL;
        let in_flight = match self.cast {
            Cast::Unicast => self.in_flight_max * (IN_FLIGHT + RECEIVED_OR_IN_FLIGHT),
            // What everyone hears is noted for everyone, up to twice the limit. Of more the oldest is
            // forgotten, but in each view it counts as on its way until the peer's next request.
            Cast::Broadcast => 2 * self.in_flight_max * (IN_FLIGHT + streams * RECEIVED_OR_IN_FLIGHT),
        };
        let peer = PEER + streams * VIEW + in_flight;
        let silent = self.peers_max * if self.link_bytes_per_s.is_some() { SILENT_LINK } else { SILENT };
        let replays = if self.swarm_key.is_some() { HEARD + self.peers_max * WINDOW } else { 0 };
        // Of every stream the plan for a peer takes up the best 256 packages, and a request its list of held
        // indices.
        let work = WORK + streams * (256 * 32 + 2 * received);
        self.store_bytes_max
            // What is held, and what was held when a snapshot was asked for.
            + streams * (2 * received + STREAM)
            + self.peers_max * peer
            + silent
            + replays
            + self.transfers_max * (received + 256)
            // Chunks are about as long as a datagram, and so are packages.
            + self.snapshot_bytes_max / DATAGRAM_BYTES_MAX * (DATAGRAM_BYTES_MAX + 2 * PACKAGE)
            + EVENTS * (DATAGRAM_BYTES_MAX + PACKAGE + 64)
            + WAITING_BYTES_MAX
            + self.transfers_max * CHUNKS_WAITING_MAX * (DATAGRAM_BYTES_MAX + 2 * PACKAGE)
            + BACKED_OFF
            + RADIO
            + if matches!(self.cast, Cast::Broadcast) { CODED } else { 0 }
            + work
    }
}
