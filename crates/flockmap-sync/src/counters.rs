//! What a session counted.

/// Datagrams and their bytes, with the overhead of each datagram (`datagram_overhead_bytes`) counted in.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct Traffic {
    /// Datagrams.
    pub datagrams: u64,
    /// Bytes, overhead included.
    pub bytes: u64,
}

impl Traffic {
    pub(crate) const fn add(&mut self, datagrams: u64, bytes_each: usize) {
        self.datagrams += datagrams;
        self.bytes += datagrams * bytes_each as u64;
    }
}

/// All that a session counted since it began. Nothing is dropped without a count here.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct Counters {
    /// Requests sent. A datagram to everyone by unicast counts once for each known peer.
    pub requests_out: Traffic,
    /// Datagrams of packages sent.
    pub packages_out: Traffic,
    /// Requests received.
    pub requests_in: Traffic,
    /// Datagrams of packages received.
    pub packages_in: Traffic,

    /// Challenges and answers sent, to find out whether a robot is to be reached at an address.
    pub paths_out: Traffic,
    /// Addresses through which an answer came back.
    pub paths_validated: u64,

    /// Own packages published.
    pub published: u64,
    /// Packages sent, each time counted; by broadcast once for all.
    pub sent: u64,
    /// Of these: packages of other origins.
    pub relayed: u64,
    /// Probes sent: short requests soon after obstacles, where losses are high.
    pub probes: u64,
    /// Packages with obstacles that were to go out a second time before anything was known of the first.
    pub repeated: u64,
    /// Datagrams of repair symbols sent.
    pub coded_sent: u64,
    /// Packages found from repair symbols.
    pub mended: u64,
    /// Blocks of packages of which the repair symbols were false, so that all of them were dropped.
    pub mending_failed: u64,
    /// Chunks of snapshots sent.
    pub chunks_sent: u64,
    /// Packages that a peer confirmed by a request.
    pub confirmed: u64,
    /// Packages found lost by a request; they are sent again.
    pub lost: u64,
    /// By broadcast: packages heard from one robot and so noted as in flight to another, who need not get them
    /// from here.
    pub suppressed: u64,
    /// Requests that went out because of a gap.
    pub gap_requests: u64,
    /// Requests that were due because packages were missing, and waited since others had just asked for all of them.
    pub gaps_asked_by_others: u64,
    /// Times that the byte budget made something wait.
    pub delayed_by_budget: u64,
    /// Times that sending to a peer waited because too much was unconfirmed.
    pub delayed_by_window: u64,

    /// Packages and chunks that were delivered as events.
    pub received: u64,
    /// Times that a package or chunk had to wait for what it builds on.
    pub waited: u64,
    /// Of these: dropped for want of room, and asked for again.
    pub waiting_dropped: u64,
    /// Packages accepted by the driver.
    pub accepted: u64,
    /// Of these: packages that came later than a higher index of their stream, so filled a gap.
    pub repaired: u64,
    /// Chunks accepted by the driver.
    pub chunks_accepted: u64,
    /// Snapshots received completely.
    pub caught_up: u64,
    /// Snapshots of which the driver needed all chunks again.
    pub snapshots_restarted: u64,
    /// Snapshots of which some chunks had come, dropped: nothing more came of them for long, or there was no
    /// room. They begin anew.
    pub transfers_dropped: u64,
    /// Packages and chunks received again.
    pub duplicates: u64,
    /// Packages and chunks that the driver rejected.
    pub rejected: u64,
    /// Packages that the driver gave up, since what they were coded against is gone: replaced by a snapshot.
    pub undecodable: u64,
    /// Packages of the own stream that came back.
    pub own_returned: u64,

    /// Datagrams that are damaged, of a wrong length, or not from Flockmap.
    pub damaged: u64,
    /// Datagrams of another wire version or of an unknown kind.
    pub foreign_version: u64,
    /// Datagrams of another swarm.
    pub foreign_swarm: u64,
    /// Sealed datagrams that the own key does not open: damaged, forged, or of a robot with another key.
    pub forged: u64,
    /// Genuine datagrams that were there already, or so late that nobody can know.
    pub replayed: u64,
    /// Sealed datagrams of a run of which no request had come yet, so that they could not be opened. Its
    /// packages come again.
    pub unknown_run: u64,
    /// Datagrams that are not sealed, where this robot has a key.
    pub unsealed: u64,
    /// Sealed datagrams, where this robot has no key.
    pub sealed_without_key: u64,
    /// Datagrams with a right check and a wrong content: the sender is faulty.
    pub malformed: u64,
    /// Own datagrams heard back.
    pub own_heard: u64,
    /// Signs that another robot uses the own id, or that the own epoch was used before.
    pub same_identity: u64,
    /// Times that a run of the own id with a higher epoch was heard of, so that a new run had to begin.
    pub epoch_too_low: u64,
    /// Datagrams of a former run of a peer.
    pub stale_epoch: u64,
    /// Requests that arrived after a newer one of the same peer, or twice.
    pub stale_requests: u64,
    /// Datagrams of peers for whom there was no room.
    pub too_many_peers: u64,
    /// Ended runs that were forgotten, since there were too many streams or too many runs of one robot: their
    /// maps are gone here.
    pub streams_forgotten: u64,
    /// Packages and lists of streams for which there was no room, or of runs that are too old.
    pub too_many_streams: u64,
    /// Packages refused because they would tear too many gaps; they are asked for again.
    pub too_fragmented: u64,
    /// Packages not delivered because the driver did not drain its events; they are asked for again.
    pub events_overflowed: u64,
    /// Chunks not taken because too many snapshots are received at once; they are sent again.
    pub too_many_transfers: u64,
    /// Snapshots asked of the driver.
    pub snapshots_wanted: u64,
    /// Snapshots that the driver gave and that could not be used: wrong stream, numbering or size.
    pub snapshots_unusable: u64,
}

impl Counters {
    /// Everything sent.
    pub const fn out(&self) -> Traffic {
        Traffic {
            datagrams: self.requests_out.datagrams + self.packages_out.datagrams + self.paths_out.datagrams,
            bytes: self.requests_out.bytes + self.packages_out.bytes + self.paths_out.bytes,
        }
    }
}
