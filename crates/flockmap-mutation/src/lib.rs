//! Faults put in on purpose, to prove that the checkers of the swarm simulator find them. For tests only.
//!
//! Each fault breaks one thing in one line, where [`is`] asks for it. Without the feature `active`, which no
//! shipped program has, [`is`] is a constant `false` and nothing remains of it.

#![forbid(unsafe_code)]

/// A fault.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[non_exhaustive]
pub enum Mutation {
    /// A layer takes over every observation, however old.
    StampCompareDropped,
    /// What was sent is not noted as in flight.
    LedgerIgnored,
    /// A decoded package is not compared with its check.
    CheckSkipped,
    /// The byte budget never makes anything wait.
    BudgetIgnored,
    /// A robot reports all of which it has heard as received, so a gap is never filled.
    GapNeverAsked,
    /// A package counts as received before it is merged, and is not.
    AcceptedUnmerged,
    /// A snapshot counts as received when its first chunk has come.
    SnapshotReceivedTooEarly,
    /// More is in flight to a peer than the limit allows.
    WindowIgnored,
    /// The store grows beyond its limit.
    StoreLimitIgnored,
    /// What layers take over does not reach the fused map.
    FusionSkipped,
    /// What a peer reports as received is not noted, so it is sent again when it counts as lost.
    HoldingsIgnored,
    /// A session wants to be called again at once, always.
    TimeStandsStill,
    /// A batch leaves out its last block.
    BlockLeftOut,
    /// A nonce is used for every datagram.
    NonceRepeated,
    /// A sealed datagram counts however often it comes.
    ReplayAccepted,
    /// No run that has ended is forgotten for one that flies.
    LiveBackedOff,
    /// A robot that hears of a run of its own id with a higher epoch goes on as it is.
    BeginAnewIgnored,
    /// Every run has the same epoch.
    EpochRepeated,
    /// Every run has the same salt.
    SaltRepeated,
    /// A path is used at once, before an answer came back through it.
    PathUnasked,
    /// A peer is asked on a new path as often as it is heard there.
    PathAskedAtOnce,
    /// What was received beyond a gap is never offered as a snapshot.
    GapStatesWithheld,
    /// A payload may ask for any work.
    WorkUnlimited,
    /// Each request begins with the same robot: what does not fit behind it is never named.
    OriginsNotInOrder,
    /// What comes late is taken over where something newer may have been dropped.
    LateTakenOver,
    /// A snapshot of a layer of which something was dropped passes for a whole one.
    DropUnsaid,
    /// What was dropped stays in the fused map.
    DroppedShown,
    /// What was lacking is not asked for when there is room again.
    RestUnasked,
    /// A piece of a state passes for all of it.
    PieceUnsaid,
    /// Where a submap lies is taken in once, and not when it is moved again.
    SubmapSetOnce,
    /// What moved to another submap stays in the fused map where it was.
    MovedShown,
}

impl Mutation {
    /// All of them.
    pub const ALL: [Self; 31] = [
        Self::StampCompareDropped,
        Self::LedgerIgnored,
        Self::CheckSkipped,
        Self::BudgetIgnored,
        Self::GapNeverAsked,
        Self::AcceptedUnmerged,
        Self::SnapshotReceivedTooEarly,
        Self::WindowIgnored,
        Self::StoreLimitIgnored,
        Self::FusionSkipped,
        Self::HoldingsIgnored,
        Self::TimeStandsStill,
        Self::BlockLeftOut,
        Self::NonceRepeated,
        Self::ReplayAccepted,
        Self::LiveBackedOff,
        Self::BeginAnewIgnored,
        Self::EpochRepeated,
        Self::SaltRepeated,
        Self::PathUnasked,
        Self::PathAskedAtOnce,
        Self::GapStatesWithheld,
        Self::WorkUnlimited,
        Self::OriginsNotInOrder,
        Self::LateTakenOver,
        Self::DropUnsaid,
        Self::DroppedShown,
        Self::RestUnasked,
        Self::PieceUnsaid,
        Self::SubmapSetOnce,
        Self::MovedShown,
    ];
}

#[cfg(feature = "active")]
thread_local! {
    static ACTIVE: core::cell::Cell<Option<Mutation>> = const { core::cell::Cell::new(None) };
}

/// Puts in a fault, or takes it out, on this thread.
#[cfg(feature = "active")]
pub fn set(mutation: Option<Mutation>) {
    ACTIVE.set(mutation);
}

/// Whether this fault is put in on this thread.
#[cfg(feature = "active")]
#[inline]
pub fn is(mutation: Mutation) -> bool {
    ACTIVE.get() == Some(mutation)
}

/// Whether this fault is put in: never.
#[cfg(not(feature = "active"))]
#[inline(always)]
pub const fn is(_: Mutation) -> bool {
    false
}
