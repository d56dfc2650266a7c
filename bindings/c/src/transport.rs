//! Datagrams and time. The caller owns sockets and clocks.

use flockmap_core::sync::wire::DATAGRAM_BYTES_MAX as WIRE_BYTES_MAX;
use flockmap_core::{Destination, Path, Stamp};

use crate::args::{Args, handle, one};
use crate::result::{Failure, Outcome, guard};
use crate::robot::{RobotHandle, lock};

/// Bytes of the largest datagram: the room that flockmap_robot_poll_transmit needs.
pub const DATAGRAM_BYTES_MAX: usize = 1200;

const _: () = assert!(DATAGRAM_BYTES_MAX == WIRE_BYTES_MAX);

/// Where a datagram goes.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct Transmit {
    /// The number of the address that it goes to, if has_path.
    pub path: u64,
    /// Bytes of it.
    pub length: usize,
    /// The robot that it is for, unless to_everyone.
    pub peer: u16,
    /// 1: it goes to everyone: the broadcast or multicast address, or each address that is known, beginning with
    /// another one each time, since a full queue takes the first only.
    pub to_everyone: u8,
    /// 1: it goes to one address, that from which the datagrams of `path` were heard. If neither is 1, the robot's
    /// datagrams were given without a path, and the caller knows where `peer` is.
    pub has_path: u8,
}

/// Takes in a datagram: what it brings is decoded, merged and fused before this returns.
///
/// `bytes`: the `length` bytes of the UDP payload, read and not kept; any bytes will do no harm. FLOCKMAP_ERROR_DATAGRAM:
/// damaged, foreign or forged; it is counted already, go on. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_handle_datagram(
    robot: *mut RobotHandle,
    now_us: i64,
    bytes: *const u8,
    length: usize,
) -> Outcome {
    guard("flockmap_robot_handle_datagram", || {
        // SAFETY: the caller's word, as of the header.
        let (robot, bytes) =
            unsafe { (handle(robot, "robot")?, Args::default().input(bytes, length, "bytes")?) };
        let taken = robot.lock()?.handle_datagram(Stamp(now_us), bytes);
        taken.map(|()| Outcome::Ok).map_err(|error| Failure::new(Outcome::ErrorDatagram, error))
    })
}

/// The same for a caller that sends to addresses, which should be every one with UDP: `path` is a number of the
/// caller's for the address that it came from (its place in a list). Nothing but a challenge goes to an address by
/// unicast before an answer came back from there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_handle_datagram_from(
    robot: *mut RobotHandle,
    now_us: i64,
    path: u64,
    bytes: *const u8,
    length: usize,
) -> Outcome {
    guard("flockmap_robot_handle_datagram_from", || {
        // SAFETY: the caller's word, as of the header.
        let (robot, bytes) =
            unsafe { (handle(robot, "robot")?, Args::default().input(bytes, length, "bytes")?) };
        let taken = robot.lock()?.handle_datagram_from(Stamp(now_us), Path(path), bytes);
        taken.map(|()| Outcome::Ok).map_err(|error| Failure::new(Outcome::ErrorDatagram, error))
    })
}

/// Lets time pass: closes the batch that is due, asks for what was lost. Call it when flockmap_robot_poll_timeout has
/// come; earlier does no harm. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_handle_timeout(robot: *mut RobotHandle, now_us: i64) -> Outcome {
    guard("flockmap_robot_handle_timeout", || {
        // SAFETY: the caller's word, as of the header.
        unsafe { lock(robot) }?.handle_timeout(Stamp(now_us));
        Ok(Outcome::Ok)
    })
}

/// When to call flockmap_robot_handle_timeout at the latest, on the robot's clock: `*due_us`, which may lie in the past.
/// FLOCKMAP_NONE: nothing is due before the next input. Ask again after every input. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_poll_timeout(robot: *const RobotHandle, due_us: *mut i64) -> Outcome {
    guard("flockmap_robot_poll_timeout", || {
        // SAFETY: the caller's word, as of the header.
        let (mut to, robot) = unsafe { (one(&mut Args::default(), due_us, "due_us")?, lock(robot)?) };
        let due = robot.poll_timeout();
        Ok(due.map_or(Outcome::None, |due| {
            to.set(0, due.0);
            Outcome::Ok
        }))
    })
}

/// The next datagram to send. Call it after every input until it is FLOCKMAP_NONE.
///
/// `bytes`: room for `capacity`, at least FLOCKMAP_DATAGRAM_BYTES_MAX, else it is FLOCKMAP_ERROR_BUFFER and nothing is
/// taken. `*transmit`: its length, and where it goes. What cannot be sent is lost, and repaired as all that is lost.
/// Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_poll_transmit(
    robot: *mut RobotHandle,
    now_us: i64,
    bytes: *mut u8,
    capacity: usize,
    transmit: *mut Transmit,
) -> Outcome {
    guard("flockmap_robot_poll_transmit", || {
        let mut args = Args::default();
        // SAFETY: the caller's word, as of the header.
        let (robot, mut to, mut transmit) = unsafe {
            (
                handle(robot, "robot")?,
                args.output(bytes, capacity, "bytes")?,
                one(&mut args, transmit, "transmit")?,
            )
        };
        if capacity < DATAGRAM_BYTES_MAX {
            let text = format!("room for {capacity} bytes, expected at least {DATAGRAM_BYTES_MAX}");
            return Err(Failure::new(Outcome::ErrorBuffer, text));
        }
        let Some(next) = robot.lock()?.poll_transmit(Stamp(now_us)) else { return Ok(Outcome::None) };
        let mut head = Transmit { length: next.bytes.len(), ..Transmit::default() };
        match next.to {
            Destination::Everyone => head.to_everyone = 1,
            Destination::Peer(peer) => head.peer = peer.0,
        }
        if let Some(Path(path)) = next.path {
            (head.path, head.has_path) = (path, 1);
        }
        transmit.set(0, head);
        to.fill(next.bytes);
        Ok(Outcome::Ok)
    })
}

/// Closes the batch now, with whatever has changed: before the end of a run. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_flush(robot: *mut RobotHandle, now_us: i64) -> Outcome {
    guard("flockmap_robot_flush", || {
        // SAFETY: the caller's word, as of the header.
        unsafe { lock(robot) }?.flush(Stamp(now_us));
        Ok(Outcome::Ok)
    })
}

/// `*voxels`: how many have changed and are still to be published. O(blocks with changes). Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockmap_robot_unpublished(
    robot: *const RobotHandle,
    voxels: *mut usize,
) -> Outcome {
    guard("flockmap_robot_unpublished", || {
        // SAFETY: the caller's word, as of the header.
        let (mut to, robot) = unsafe { (one(&mut Args::default(), voxels, "voxels")?, lock(robot)?) };
        to.set(0, robot.unpublished());
        Ok(Outcome::Ok)
    })
}
