//! A mirror over a socket, with the standard library alone.

use core::fmt;
use core::str::FromStr;
use core::time::Duration;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::path::PathBuf;
use std::time::Instant;

use crate::FeedError;
use crate::mirror::{Event, Mirror};

/// A node that says nothing for so long is gone: it counts something each second.
const SILENCE_MAX: Duration = Duration::from_secs(10);

/// For a connection to be made.
const CONNECT_MAX: Duration = Duration::from_secs(5);

/// Before connecting again, at first, and at most: each time twice as long.
const PAUSES: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(5)];

/// Bytes that are read at once.
const READ_BYTES: usize = 1 << 16;

/// Where a node gives its map out.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Address {
    /// Host and port.
    Tcp(String),
    /// The file of a Unix socket.
    Unix(PathBuf),
}

/// What is no address.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("expected `unix:PATH` or `HOST:PORT`")]
pub struct AddressError;

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        if let Some(path) = text.strip_prefix("unix:") {
            return if path.is_empty() { Err(AddressError) } else { Ok(Self::Unix(path.into())) };
        }
        let (host, port) = text.rsplit_once(':').ok_or(AddressError)?;
        let is_port = port.parse::<u16>().is_ok_and(|port| port > 0);
        if host.is_empty() || !is_port { Err(AddressError) } else { Ok(Self::Tcp(text.to_owned())) }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => f.write_str(address),
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
        }
    }
}

/// Why a client has no connection.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ClientError {
    /// The system said so.
    #[error("{0}")]
    System(#[from] io::Error),
    /// What came is no feed, or not this map's.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// The node ended it.
    #[error("the node ended the feed: {0}")]
    Ended(String),
    /// The other side went away without a word.
    #[error("the connection ended")]
    Closed,
    /// Nothing came for long.
    #[error("nothing came for {} s", SILENCE_MAX.as_secs())]
    Silent,
}

/// A mirror that follows a node, and connects again when it has to. Blocks; drive it from a thread of its own,
/// and give views of [`Mirror::map`] to others.
///
/// ```no_run
/// use std::time::Duration;
/// use flockmap_feed::{Client, Mirror};
///
/// let mut client = Client::new("unix:/run/flockmap/map.sock".parse()?, Mirror::default());
/// loop {
///     match client.next(Duration::from_millis(100)) {
///         Ok(_) => {} // something came, or the time is over
///         Err(error) => eprintln!("{error}; connecting again"),
///     }
///     if let Some(map) = client.mirror().map() {
///         println!("{:?}", map.state_at([1.0, 2.0, 0.5]));
///     }
/// }
/// # Ok::<(), flockmap_feed::AddressError>(())
/// ```
pub struct Client {
    address: Address,
    mirror: Mirror,
    link: Option<Link>,
    /// When to connect again, and how long the next pause is.
    again: Instant,
    pause: Duration,
    bytes_in: u64,
    rate_max: Option<u32>,
}

struct Link {
    stream: Stream,
    buffer: Vec<u8>,
    /// What of it was read and not taken yet.
    unread: core::ops::Range<usize>,
    heard: Instant,
}

enum Stream {
    Tcp(TcpStream),
    #[cfg(unix)]
    Unix(std::os::unix::net::UnixStream),
}

impl Client {
    /// A client that has no connection yet: [`Self::next`] makes it.
    pub fn new(address: Address, mirror: Mirror) -> Self {
        Self {
            address,
            mirror,
            link: None,
            again: Instant::now(),
            pause: PAUSES[0],
            bytes_in: 0,
            rate_max: None,
        }
    }

    /// Reads no more than so many bytes in a second, 1 at least: for a link that others need too.
    #[must_use]
    pub fn at_most(mut self, bytes_per_second: u32) -> Self {
        self.rate_max = Some(bytes_per_second.max(1));
        self
    }

    /// The mirror.
    pub const fn mirror(&self) -> &Mirror {
        &self.mirror
    }

    /// Bytes read so far, over all connections.
    pub const fn bytes_in(&self) -> u64 {
        self.bytes_in
    }

    /// Whether there is a connection.
    pub const fn is_connected(&self) -> bool {
        self.link.is_some()
    }

    /// Ends the connection, if there is one. The next call of [`Self::next`] makes another.
    pub fn disconnect(&mut self) {
        self.link = None;
        self.again = Instant::now();
    }

    /// Waits up to so long for the next frame, connecting first if need be. `None`: the time is over. Making a
    /// connection may take 5 s more for each address of a host.
    ///
    /// # Errors
    /// Why there is no connection any more, or none can be made. The mirror stays as it is, and the next call
    /// tries again, 0.2 to 5 s after the last time.
    pub fn next(&mut self, wait: Duration) -> Result<Option<Event>, ClientError> {
        let until = Instant::now() + wait;
        if self.link.is_none() {
            let pause = self.again.saturating_duration_since(Instant::now());
            std::thread::sleep(pause.min(wait));
            if pause > wait {
                return Ok(None);
            }
        }
        let result = self.try_next(until);
        match result {
            Ok(Some(Event::Hello)) => self.pause = PAUSES[0],
            Ok(_) => {}
            Err(_) => {
                self.link = None;
                self.again = Instant::now() + self.pause;
                self.pause = PAUSES[1].min(self.pause * 2);
            }
        }
        result
    }

    fn try_next(&mut self, until: Instant) -> Result<Option<Event>, ClientError> {
        if self.link.is_none() {
            let mut stream = Stream::connect(&self.address)?;
            stream.write_all(&self.mirror.connect())?;
            self.link =
                Some(Link { stream, buffer: vec![0; READ_BYTES], unread: 0..0, heard: Instant::now() });
        }
        let Some(link) = &mut self.link else { return Ok(None) };
        let mut has_read = false;
        loop {
            let mut unread = &link.buffer[link.unread.clone()];
            let event = self.mirror.push(&mut unread)?;
            link.unread.start = link.unread.end - unread.len();
            if event == Some(Event::End) {
                return Err(ClientError::Ended(self.mirror.end().unwrap_or_default().to_owned()));
            }
            if event.is_some() {
                return Ok(event);
            }
            if has_read && Instant::now() >= until {
                return Ok(None);
            }
            has_read = true;
            let Some(count) = link.read(until, self.rate_max)? else { return Ok(None) };
            self.bytes_in += count as u64;
        }
    }
}

impl Link {
    /// Reads what is there, or waits for it. `None`: the time is over.
    fn read(&mut self, until: Instant, rate_max: Option<u32>) -> Result<Option<usize>, ClientError> {
        // A timeout of 0 is none to the system.
        let wait = until.saturating_duration_since(Instant::now()).max(Duration::from_millis(1));
        // A twentieth of a second's at once.
        let room = rate_max.map_or(READ_BYTES, |rate| (rate as usize / 20).clamp(1, READ_BYTES));
        let count = match self.stream.read(&mut self.buffer[..room], wait) {
            Ok(0) => return Err(ClientError::Closed),
            Ok(count) => count,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                let is_silent = self.heard.elapsed() >= SILENCE_MAX;
                return if is_silent { Err(ClientError::Silent) } else { Ok(None) };
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => 0,
            Err(error) => return Err(error.into()),
        };
        if let Some(rate) = rate_max {
            std::thread::sleep(Duration::from_secs_f64(count as f64 / f64::from(rate)));
        }
        self.heard = Instant::now();
        self.unread = 0..count;
        Ok(Some(count))
    }
}

impl Stream {
    fn connect(address: &Address) -> io::Result<Self> {
        match address {
            Address::Tcp(name) => {
                let mut last = io::Error::new(ErrorKind::NotFound, format!("{name} has no address"));
                for address in name.to_socket_addrs()? {
                    match TcpStream::connect_timeout(&address, CONNECT_MAX) {
                        Ok(stream) => return Ok(Self::Tcp(stream)),
                        Err(error) => last = error,
                    }
                }
                Err(last)
            }
            #[cfg(unix)]
            Address::Unix(path) => std::os::unix::net::UnixStream::connect(path).map(Self::Unix),
            #[cfg(not(unix))]
            Address::Unix(_) => Err(io::Error::new(ErrorKind::Unsupported, "no Unix sockets here; use TCP")),
        }
    }

    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self {
            Self::Tcp(stream) => stream.write_all(bytes),
            #[cfg(unix)]
            Self::Unix(stream) => stream.write_all(bytes),
        }
    }

    fn read(&mut self, buffer: &mut [u8], wait: Duration) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.set_read_timeout(Some(wait)).and_then(|()| stream.read(buffer)),
            #[cfg(unix)]
            Self::Unix(stream) => stream.set_read_timeout(Some(wait)).and_then(|()| stream.read(buffer)),
        }
    }
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client").field("address", &self.address).finish_non_exhaustive()
    }
}
