//! Events of a robot, and what it counted.

use std::ffi::c_char;

use flockmap_core::{Event, Stream};

use crate::args::{Args, one};
use crate::result::{Outcome, guard};
use crate::robot::{RobotHandle, lock};

/// What an event is about: flockmap_event.kind. Later versions may have more.
#[repr(i32)]
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum EventKind {
    /// One that this version has no number for.
    Other = 0,
    /// An own batch was closed and is going out. `count`: voxels that changed; `index`: packages made of it.
    BatchClosed = 1,
    /// A package of another robot is in the fused map. `count`: voxels taken over; `index`: its number.
    Merged = 2,
    /// A package was not taken in, and is asked for again unless that is useless. `index`: its number; `text`: why.
    Refused = 3,
    /// Packages that never came are known from a snapshot.
    SnapshotContains = 4,
    /// All packages up to `index` are held now, by a snapshot.
    CaughtUp = 5,
    /// A robot was heard for the first time, or again, or in a new run.
    PeerSeen = 6,
    /// A robot has not been heard for a while.
    PeerLost = 7,
    /// An ended run of a robot was forgotten: there were too many.
    RunForgotten = 8,
    /// The own id was used with a higher epoch; this robot has begun anew above that, with `epoch`.
    RunBegun = 9,
    /// Another robot uses the own id. Give one of them another.
    SameIdentity = 10,
    /// With a swarm key: this run can send no more. Make a new robot.
    NoncesExhausted = 11,
    /// Own changes could not be coded. Please report it. `text`: why.
    EncodeFailed = 12,
    /// For want of room `count` blocks of a layer were dropped, or did not come in: the farthest and oldest.
    Dropped = 13,
    /// Of a stream of which something was lacking all has come.
    Complete = 14,
}

/// Bytes of the text of an event, with the 0 at its end.
pub const EVENT_TEXT_BYTES: usize = 256;

/// Something worth knowing. What does not belong to its kind is 0.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct EventRecord {
    /// Run of the robot that it is about.
    pub epoch: u64,
    /// See the kinds.
    pub count: u64,
    /// See the kinds.
    pub index: u32,
    /// One of flockmap_event_kind.
    pub kind: i32,
    /// Id of the robot that it is about.
    pub origin: u16,
    /// A text in UTF-8, "" for most kinds. Longer ones are cut.
    pub text: [c_char; EVENT_TEXT_BYTES],
}

/// The next event; FLOCKMAP_NONE if there is none. Need not be polled: what is not read is dropped, oldest first.
/// `event` is the caller's. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_poll_event(
    robot: *mut RobotHandle,
    event: *mut EventRecord,
) -> Outcome {
    guard("flockmap_robot_poll_event", || {
        // SAFETY: the caller's word, as of the header.
        let (mut to, mut robot) = unsafe { (one(&mut Args::default(), event, "event")?, lock(robot)?) };
        let Some(next) = robot.poll_event() else { return Ok(Outcome::None) };
        to.set(0, record(&next));
        Ok(Outcome::Ok)
    })
}

fn record(event: &Event) -> EventRecord {
    let of = |kind: EventKind, stream: Option<&Stream>, count: usize, index: u32, text: String| EventRecord {
        epoch: stream.map_or(0, |stream| stream.epoch),
        count: count as u64,
        index,
        kind: kind as i32,
        origin: stream.map_or(0, |stream| stream.origin.0),
        text: c_text(&text),
    };
    let plain = |kind, stream| of(kind, stream, 0, 0, String::new());
    match event {
        Event::BatchClosed { changes, packages, .. } => {
            of(EventKind::BatchClosed, None, changes.len(), packages.len() as u32, String::new())
        }
        Event::Merged { stream, index, taken, .. } => {
            of(EventKind::Merged, Some(stream), *taken, *index, String::new())
        }
        Event::Refused { stream, index, reason } => {
            of(EventKind::Refused, Some(stream), 0, *index, reason.to_string())
        }
        Event::SnapshotContains { stream, .. } => plain(EventKind::SnapshotContains, Some(stream)),
        Event::CaughtUp { stream, upto } => of(EventKind::CaughtUp, Some(stream), 0, *upto, String::new()),
        Event::PeerSeen(stream) => plain(EventKind::PeerSeen, Some(stream)),
        Event::PeerLost(stream) => plain(EventKind::PeerLost, Some(stream)),
        Event::RunForgotten(stream) => plain(EventKind::RunForgotten, Some(stream)),
        Event::RunBegun(stream) => plain(EventKind::RunBegun, Some(stream)),
        Event::SameIdentity => plain(EventKind::SameIdentity, None),
        Event::NoncesExhausted => plain(EventKind::NoncesExhausted, None),
        Event::EncodeFailed(error) => of(EventKind::EncodeFailed, None, 0, 0, error.to_string()),
        Event::Dropped { stream, blocks, .. } => {
            of(EventKind::Dropped, Some(stream), *blocks, 0, String::new())
        }
        Event::Complete { stream } => plain(EventKind::Complete, Some(stream)),
        _ => plain(EventKind::Other, None),
    }
}

/// The text, cut at a character if it must be, with a 0 behind it.
fn c_text(text: &str) -> [c_char; EVENT_TEXT_BYTES] {
    let end = (0..EVENT_TEXT_BYTES.min(text.len() + 1)).rev().find(|end| text.is_char_boundary(*end));
    let mut bytes = [0; EVENT_TEXT_BYTES];
    for (to, byte) in bytes.iter_mut().zip(text[..end.unwrap_or(0)].bytes()) {
        *to = if byte == 0 { b'?' as c_char } else { byte as c_char };
    }
    bytes
}

/// What a robot counted since it was made.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct Counters {
    /// Scans taken in.
    pub scans: u64,
    /// Of these: with a stamp ahead of the robot's clock.
    pub scans_ahead: u64,
    /// Updates with states of voxels taken in.
    pub states: u64,
    /// Points that were ignored: not finite, too near or too far out.
    pub points_ignored: u64,
    /// Points that were taken for team-mates.
    pub points_masked: u64,
    /// Blocks of the own map that were forgotten under map_bytes_max.
    pub blocks_forgotten: u64,
    /// Batches closed.
    pub batches: u64,
    /// Own voxels that changed, added up over batches.
    pub changes: u64,
    /// Own packages made.
    pub packages: u64,
    /// Bytes of these.
    pub package_bytes: u64,
    /// Packages of others merged.
    pub merged: u64,
    /// Packages of others that were damaged.
    pub damaged: u64,
    /// Packages of others for which there was no room.
    pub no_room: u64,
    /// Packages of others with voxels of another size: give all robots the same resolution.
    pub foreign_resolution: u64,
    /// Snapshots made for others.
    pub snapshots: u64,
    /// Events dropped since nobody polled them.
    pub events_dropped: u64,
    /// Datagrams that went out.
    pub datagrams_out: u64,
    /// Bytes of these, without headers of IP and UDP.
    pub bytes_out: u64,
    /// Own packages that were found lost.
    pub lost: u64,
    /// Packages of others that came after they had been lost once.
    pub repaired: u64,
    /// Datagrams that were damaged on the way.
    pub datagrams_damaged: u64,
    /// Datagrams that made no sense.
    pub datagrams_malformed: u64,
    /// Datagrams of other swarms.
    pub datagrams_foreign: u64,
    /// With a swarm key: datagrams that nobody with the key made.
    pub datagrams_forged: u64,
    /// Blocks of layers that were dropped for want of room, or did not come in.
    pub blocks_dropped: u64,
}

/// What a robot counted. `counters` is the caller's. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_counters(
    robot: *const RobotHandle,
    counters: *mut Counters,
) -> Outcome {
    guard("flockmap_robot_counters", || {
        // SAFETY: the caller's word, as of the header.
        let (mut to, robot) = unsafe { (one(&mut Args::default(), counters, "counters")?, lock(robot)?) };
        let (own, session) = (robot.counters(), robot.session().counters());
        to.set(
            0,
            Counters {
                scans: own.scans,
                scans_ahead: own.scans_ahead,
                states: own.states,
                points_ignored: own.points_ignored,
                points_masked: own.points_masked,
                blocks_forgotten: own.blocks_forgotten,
                batches: own.batches,
                changes: own.changes,
                packages: own.packages,
                package_bytes: own.package_bytes,
                merged: own.merged,
                damaged: own.damaged,
                no_room: own.no_room,
                foreign_resolution: own.foreign_resolution,
                snapshots: own.snapshots,
                events_dropped: own.events_dropped,
                blocks_dropped: own.blocks_dropped,
                datagrams_out: session.out().datagrams,
                bytes_out: session.out().bytes,
                lost: session.lost,
                repaired: session.repaired,
                datagrams_damaged: session.damaged,
                datagrams_malformed: session.malformed,
                datagrams_foreign: session.foreign_swarm,
                datagrams_forged: session.forged,
            },
        );
        Ok(Outcome::Ok)
    })
}
