//! Scans from any program, over TCP or a Unix socket.

use std::io;
use std::sync::Arc;

use flockmap::Stamp;
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::sync::mpsc::Sender;

use super::{Input, MessageError, MessageLimits, Sensor, SensorMessage};
use crate::Clock;

/// Programs that may be connected at once; more wait. Worst case held: the longest message for each.
const CONNECTIONS_MAX: usize = 4;

/// A socket where sensor programs connect.
pub(crate) enum SensorSocket {
    Tcp(TcpListener, MessageLimits),
    #[cfg(unix)]
    Unix(tokio::net::UnixListener, MessageLimits, UnlinkAtEnd),
}

/// Removes the file of a Unix socket.
#[cfg(unix)]
pub(crate) struct UnlinkAtEnd(std::path::PathBuf);

#[cfg(unix)]
impl Drop for UnlinkAtEnd {
    fn drop(&mut self) {
        // Gone already is as good.
        let _ = std::fs::remove_file(&self.0);
    }
}

impl SensorSocket {
    /// Opens the socket that `sensor` names; `None` if it names none. Within a tokio runtime.
    pub(crate) async fn open(sensor: &Sensor) -> io::Result<Option<Self>> {
        match sensor {
            Sensor::Tcp(address, limits) => Ok(Some(Self::Tcp(TcpListener::bind(address).await?, *limits))),
            #[cfg(unix)]
            Sensor::Unix(path, limits) => {
                use std::os::unix::fs::FileTypeExt;
                // A socket that a killed node left behind.
                if std::fs::symlink_metadata(path).is_ok_and(|m| m.file_type().is_socket()) {
                    std::fs::remove_file(path)?;
                }
                let listener = tokio::net::UnixListener::bind(path)?;
                Ok(Some(Self::Unix(listener, *limits, UnlinkAtEnd(path.clone()))))
            }
            #[cfg(not(unix))]
            Sensor::Unix(..) => {
                Err(io::Error::new(io::ErrorKind::Unsupported, "no Unix sockets here; use TCP"))
            }
            _ => Ok(None),
        }
    }

    /// Where programs can connect.
    pub(crate) fn address(&self) -> String {
        match self {
            Self::Tcp(listener, _) => listener.local_addr().map_or_else(|e| e.to_string(), |a| a.to_string()),
            #[cfg(unix)]
            Self::Unix(_, _, path) => path.0.display().to_string(),
        }
    }

    /// Takes connections until nobody listens to `to` any more.
    pub(crate) async fn serve(self, clock: Clock, to: Sender<Input>) {
        let room = Arc::new(Semaphore::new(CONNECTIONS_MAX));
        let mut count = 0u64;
        loop {
            let Ok(permit) = Arc::clone(&room).acquire_owned().await else { return };
            let accepted = tokio::select! {
                accepted = self.accept() => accepted,
                () = to.closed() => return,
            };
            let (stream, limits) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    let fault = format!("sensor socket: cannot accept a connection: {error}");
                    if to.send(Input::Fault(fault)).await.is_err() {
                        return;
                    }
                    tokio::time::sleep(std::time::Duration::from_millis(200)).await;
                    continue;
                }
            };
            count += 1;
            let (name, to) = (format!("sensor connection {count}"), to.clone());
            tokio::spawn(async move {
                let end = read_messages(stream, limits, clock, &name, &to).await;
                // If this fails, the node has ended.
                let _ = to.send(end).await;
                drop(permit);
            });
        }
    }

    async fn accept(&self) -> io::Result<(Box<dyn AsyncRead + Send + Unpin>, MessageLimits)> {
        match self {
            Self::Tcp(listener, limits) => {
                let (stream, _) = listener.accept().await?;
                Ok((Box::new(stream), *limits))
            }
            #[cfg(unix)]
            Self::Unix(listener, limits, _) => {
                let (stream, _) = listener.accept().await?;
                Ok((Box::new(stream), *limits))
            }
        }
    }
}

/// Reads messages until the connection ends; returns what there is to say about the end.
async fn read_messages(
    mut stream: impl AsyncRead + Unpin,
    limits: MessageLimits,
    clock: Clock,
    name: &str,
    to: &Sender<Input>,
) -> Input {
    let mut count = 0u64;
    loop {
        let bytes = match read_message(&mut stream, &limits).await {
            Ok(Some(bytes)) => bytes,
            Ok(None) => return Input::Note(format!("{name} ended after {count} messages")),
            Err(error) => return Input::Fault(format!("{name} closed: message {}: {error}", count + 1)),
        };
        count += 1;
        let input = match SensorMessage::parse(&bytes, &limits) {
            Err(error) => return Input::Fault(format!("{name} closed: message {count}: {error}")),
            Ok(SensorMessage::Alignment(robot, pose)) => Input::Alignment(robot, pose),
            Ok(SensorMessage::Teammate(robot, position)) => Input::Teammate(robot, position),
            Ok(SensorMessage::Scan(mut frame)) => {
                let now = clock.now();
                if frame.scan.stamp == Stamp(0) {
                    frame.scan.stamp = now;
                }
                let off = frame.scan.stamp.micros_since(now);
                if off.unsigned_abs() > limits.stamp_error_max_micros.unsigned_abs() {
                    Input::Fault(format!(
                        "{name}: message {count} dropped: its stamp is off this machine's clock by {:.3} s, expected \
                         microseconds since 1970 within {:.3} s, or 0 for now",
                        off as f64 / 1e6,
                        limits.stamp_error_max_micros as f64 / 1e6
                    ))
                } else {
                    Input::Frame(frame)
                }
            }
        };
        if to.send(input).await.is_err() {
            return Input::Note(String::new());
        }
    }
}

/// What follows the next length, or `None` at the end. Grows with what arrives, up to the longest message.
async fn read_message(
    stream: &mut (impl AsyncRead + Unpin),
    limits: &MessageLimits,
) -> Result<Option<Vec<u8>>, String> {
    let mut head = Vec::with_capacity(4);
    read_up_to(stream, 4, &mut head).await?;
    let length = match head.first_chunk::<4>() {
        None if head.is_empty() => return Ok(None),
        None => return Err(MessageError::Truncated { got: head.len(), expected: 4 }.to_string()),
        Some(length) => u32::from_le_bytes(*length) as usize,
    };
    if length > limits.bytes_max() {
        return Err(MessageError::Length { got: length as u64, max: limits.bytes_max() }.to_string());
    }
    let mut bytes = Vec::new();
    read_up_to(stream, length, &mut bytes).await?;
    if bytes.len() < length {
        return Err(MessageError::Truncated { got: bytes.len(), expected: length }.to_string());
    }
    Ok(Some(bytes))
}

async fn read_up_to(
    stream: &mut (impl AsyncRead + Unpin),
    length: usize,
    into: &mut Vec<u8>,
) -> Result<(), String> {
    stream.take(length as u64).read_to_end(into).await.map(drop).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap::{Pose, RobotId, Scan};
    use flockmap_io::Frame;

    const LIMITS: MessageLimits = MessageLimits { scan_points_max: 100, stamp_error_max_micros: 1_000_000 };

    /// What a node gets of these bytes, the end of the connection last.
    fn inputs_of(bytes: &[u8]) -> Vec<Input> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let (to, mut from) = tokio::sync::mpsc::channel(100);
        runtime.block_on(async {
            let clock = Clock::at(Stamp(50_000_000));
            let end = read_messages(bytes, LIMITS, clock, "sensor", &to).await;
            drop(to);
            let mut inputs = Vec::new();
            while let Some(input) = from.recv().await {
                inputs.push(input);
            }
            inputs.push(end);
            inputs
        })
    }

    fn scan(stamp: i64) -> Vec<u8> {
        let scan = Scan { stamp: Stamp(stamp), points: vec![[1.0, 2.0, 3.0]], no_returns: Vec::new() };
        SensorMessage::Scan(Frame { scan, t_map_sensor: Pose::IDENTITY, points_dropped: 0 }).emit()
    }

    #[test]
    fn messages_come_through_and_a_clean_end_is_no_fault() {
        let mut bytes = scan(50_500_000);
        bytes.extend(scan(0));
        bytes.extend(SensorMessage::Teammate(RobotId(2), [1.0; 3]).emit());
        bytes.extend(SensorMessage::Alignment(RobotId(2), Pose::IDENTITY).emit());
        let inputs = inputs_of(&bytes);
        let [Input::Frame(a), Input::Frame(b), Input::Teammate(..), Input::Alignment(..), Input::Note(_)] =
            inputs.as_slice()
        else {
            panic!("{inputs:?}");
        };
        assert_eq!(a.scan.stamp, Stamp(50_500_000));
        assert!(b.scan.stamp >= Stamp(50_000_000), "0 means now");
    }

    #[test]
    fn a_stamp_from_another_clock_is_refused_and_the_next_message_is_read() {
        let inputs = inputs_of(&[scan(7), scan(0)].concat());
        let [Input::Fault(fault), Input::Frame(_), Input::Note(_)] = inputs.as_slice() else {
            panic!("{inputs:?}");
        };
        assert!(fault.contains("message 1") && fault.contains("1970"), "{fault}");
    }

    #[test]
    fn a_damaged_message_ends_the_connection_with_a_word() {
        let mut bytes = scan(0);
        bytes.extend(b"GET / HTTP/1.1\r\n\r\n");
        let inputs = inputs_of(&bytes);
        let [Input::Frame(_), Input::Fault(fault)] = inputs.as_slice() else { panic!("{inputs:?}") };
        assert!(fault.contains("message 2") && fault.contains("length"), "{fault}");

        let whole = scan(0);
        for cut in 1..whole.len() {
            let inputs = inputs_of(&whole[..cut]);
            let [Input::Fault(fault)] = inputs.as_slice() else { panic!("{cut}: {inputs:?}") };
            assert!(fault.contains("ended after"), "{fault}");
        }
    }
}
