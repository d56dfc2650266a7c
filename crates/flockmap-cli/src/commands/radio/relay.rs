//! Sockets between robots. Each robot appears to the others at one of them; what arrives there goes through
//! the air and on to the robot.

use std::io::ErrorKind;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use anyhow::Context;
use flockmap::Stamp;

use super::air::Air;

/// Datagrams that were read and wait to be put on the air; of more, the system drops some.
pub const WAITING_MAX: usize = 4_096;

/// Who waits for a datagram looks up so often.
pub const LOOK_EVERY: Duration = Duration::from_millis(100);

/// A robot whose queue is full for so long loses the datagram.
const SEND_WAIT_MAX: Duration = Duration::from_millis(2);

/// Longer datagrams than any of Flockmap pass too, up to here.
const BUFFER_BYTES: usize = 65_536;

/// From an address to the port of a robot.
pub struct Datagram {
    from: SocketAddr,
    to: usize,
    bytes: Vec<u8>,
}

/// Robots 1 to N, and the air between them.
pub struct Relay {
    pub air: Air,
    pub robots: Vec<SocketAddr>,
    /// At which each robot appears to the others.
    sockets: Vec<Arc<UdpSocket>>,
    began: Instant,
    /// Datagrams from an address that is no robot's.
    pub from_strangers: u64,
    /// Datagrams that the system did not take.
    pub send_failed: u64,
}

impl Relay {
    /// Opens a port for each robot. What arrives there goes to `inputs`; whoever reads them gives datagrams
    /// to [`Self::take`].
    ///
    /// # Errors
    /// A port cannot be opened.
    pub fn open<I: From<Datagram> + Send + 'static>(
        robots: Vec<SocketAddr>,
        ports: &[SocketAddr],
        air: Air,
        inputs: &SyncSender<I>,
    ) -> anyhow::Result<Self> {
        let mut sockets = Vec::with_capacity(robots.len());
        for (number, port) in (1..=robots.len()).zip(ports) {
            let socket = UdpSocket::bind(port)
                .with_context(|| format!("cannot open {port} for robot {number}; another --listen?"))?;
            socket.set_write_timeout(Some(SEND_WAIT_MAX))?;
            let socket = Arc::new(socket);
            read_datagrams(Arc::clone(&socket), number, inputs.clone())?;
            sockets.push(socket);
        }
        Ok(Self { air, robots, sockets, began: Instant::now(), from_strangers: 0, send_failed: 0 })
    }

    /// Where the robots appear to the others.
    pub fn ports(&self) -> std::io::Result<Vec<SocketAddr>> {
        self.sockets.iter().map(|socket| socket.local_addr()).collect()
    }

    /// Since it was opened.
    pub fn elapsed(&self) -> Duration {
        self.began.elapsed()
    }

    /// Delivers all that has come through the air by now.
    pub fn deliver_due(&mut self) {
        let now = stamp(self.elapsed());
        while let Some(delivery) = self.air.deliver_due(now) {
            let [from, to] = [delivery.from, delivery.to].map(|id| usize::from(id.0) - 1);
            let is_sent = sends(&self.sockets[from], &delivery.bytes, self.robots[to]);
            self.send_failed += u64::from(!is_sent);
        }
    }

    /// How long to wait for input, if nothing else is due before `until`.
    pub fn wait(&self, until: Option<Stamp>) -> Duration {
        let now = stamp(self.elapsed());
        let next = [self.air.next_due(), until].into_iter().flatten().min();
        let until_next = next.map(|due| due.micros_since(now).max(0) as u64);
        until_next.map_or(LOOK_EVERY, |micros| Duration::from_micros(micros).min(LOOK_EVERY))
    }

    /// Puts on the air what has arrived.
    pub fn take(&mut self, Datagram { from, to, bytes }: Datagram) {
        match self.robots.iter().position(|robot| *robot == from).map(|at| at + 1) {
            Some(robot) if robot != to => self.air.send(stamp(self.elapsed()), robot, to, &bytes),
            _ => {
                self.from_strangers += 1;
                if self.from_strangers == 1 {
                    eprintln!(
                        "warning: a datagram from {from} to the port of robot {to} is from none of the others: the command line \
                         names another address for its robot. It is dropped, and so are more of the kind"
                    );
                }
            }
        }
    }
}

/// Whether the system took the datagram. That an earlier one found nobody is reported here too, and is no
/// fault of this one.
fn sends(socket: &UdpSocket, bytes: &[u8], to: SocketAddr) -> bool {
    (0..2).any(|_| socket.send_to(bytes, to).is_ok())
}

/// Reads what arrives at the port of a robot, for as long as the program runs.
fn read_datagrams<I: From<Datagram> + Send + 'static>(
    socket: Arc<UdpSocket>,
    to: usize,
    sender: SyncSender<I>,
) -> std::io::Result<()> {
    let read = move || {
        let mut buffer = vec![0; BUFFER_BYTES];
        loop {
            match socket.recv_from(&mut buffer) {
                Ok((length, from)) => {
                    let bytes = buffer[..length].to_vec();
                    if sender.send(Datagram { from, to, bytes }.into()).is_err() {
                        return;
                    }
                }
                // A robot that is off: the system reports it of an earlier datagram.
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => {}
                Err(_) => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    };
    std::thread::Builder::new().name(format!("robot {to}")).spawn(read).map(drop)
}

/// A time on the clock of the radio.
pub fn stamp(since_start: Duration) -> Stamp {
    Stamp(i64::try_from(since_start.as_micros()).unwrap_or(i64::MAX))
}
