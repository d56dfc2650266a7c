//! A Unix socket as a file: nobody's live one is taken, and only those whom the configuration names may connect.

use std::fs::{self, File, Permissions, TryLockError};
use std::io::{self, ErrorKind};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use socket2::{Domain, SockAddr, Socket, Type};
use tokio::net::{UnixListener, UnixStream};

use crate::advice::with;

/// Connections that the system keeps for us until they are taken.
const BACKLOG: i32 = 128;

/// Another node that starts or ends in the same folder is waited for: so many times, so long each.
const LOCK_TRIES: u32 = 100;
const LOCK_PAUSE: Duration = Duration::from_millis(20);

/// A socket that listens at a path.
pub(crate) struct UnixSocket {
    // Before the listener, for its inode is not given to another file as long as that is open.
    file: SocketFile,
    listener: UnixListener,
}

impl UnixSocket {
    /// Listens at a path, whose file gets the permissions `mode`; it never has others. A socket that nobody
    /// listens at any more is replaced. `key` is the option that names the path. Within a tokio runtime.
    ///
    /// # Errors
    /// Somebody listens there: it says who. Or there is something else, or the path cannot be used: it says
    /// why, and what to do.
    pub(crate) fn bind(key: &str, path: &Path, mode: u32) -> io::Result<Self> {
        if SocketAddr::from_pathname(path).is_err() {
            let bytes = path.as_os_str().len();
            let text =
                format!("the path has {bytes} bytes, and Linux allows 107: name a shorter one in {key}");
            return Err(io::Error::new(ErrorKind::InvalidInput, text));
        }
        // Two nodes that start at once must not both find the place empty.
        let _lock = lock_folder_of(key, path)?;
        make_room(key, path)?;
        let socket = with_mode(Socket::new(Domain::UNIX, Type::STREAM, None)?, mode)?;
        socket.bind(&SockAddr::unix(path)?).map_err(|error| cannot_write(key, path, error))?;
        let file = SocketFile { path: path.to_owned(), identity: identity(path)? };
        // What the umask took away is given back. Nobody can connect yet: it does not listen.
        if fs::symlink_metadata(path)?.mode() & 0o777 != mode {
            fs::set_permissions(path, Permissions::from_mode(mode))?;
        }
        socket.listen(BACKLOG)?;
        socket.set_nonblocking(true)?;
        let listener = UnixListener::from_std(OwnedFd::from(socket).into())?;
        Ok(Self { file, listener })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.file.path
    }

    pub(crate) async fn accept(&self) -> io::Result<UnixStream> {
        Ok(self.listener.accept().await?.0)
    }
}

/// The file of a socket that is open. It is removed at the end, if it is still the same file.
struct SocketFile {
    path: PathBuf,
    /// Device and inode.
    identity: (u64, u64),
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        // Without the lock nobody but a node that replaces the file in this very moment is in danger.
        let _lock = lock_folder_of("", &self.path);
        if identity(&self.path).is_ok_and(|now| now == self.identity) {
            // Gone already is as good.
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn identity(path: &Path) -> io::Result<(u64, u64)> {
    let file = fs::symlink_metadata(path)?;
    Ok((file.dev(), file.ino()))
}

/// Removes a socket that nobody listens at, and nothing else.
fn make_room(key: &str, path: &Path) -> io::Result<()> {
    let there = match fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(cannot_write(key, path, error)),
        Ok(there) => there.file_type(),
    };
    if !there.is_socket() {
        let what = match there {
            kind if kind.is_dir() => "a folder",
            kind if kind.is_symlink() => "a symbolic link",
            _ => "a file that is no socket",
        };
        let text = format!("{what} is there: remove it, or name another path in {key}");
        return Err(io::Error::new(ErrorKind::AlreadyExists, text));
    }
    let socket = Socket::new(Domain::UNIX, Type::STREAM, None)?;
    // A listener whose queue is full would let us wait.
    socket.set_nonblocking(true)?;
    let who = match socket.connect(&SockAddr::unix(path)?) {
        // A node that was killed left it behind.
        Err(error) if error.kind() == ErrorKind::ConnectionRefused => {
            return fs::remove_file(path).map_err(|error| cannot_write(key, path, error));
        }
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        Err(error) if error.kind() == ErrorKind::PermissionDenied => {
            let advice = format!(
                "the socket of another user is there, and whether somebody listens cannot be seen: stop the node of that user and remove the file, or name another path in {key}"
            );
            return Err(with(error, advice));
        }
        Ok(()) => listener_of(socket),
        // Also where it is of another type, or has no room for us now, somebody has it.
        Err(_) => None,
    };
    let who = who.unwrap_or_else(|| "a program".into());
    let text = format!("{who} listens there: stop it, or name another path in {key}");
    Err(io::Error::new(ErrorKind::AddrInUse, text))
}

/// Which process listens at the other end.
fn listener_of(socket: Socket) -> Option<String> {
    let stream = UnixStream::from_std(OwnedFd::from(socket).into()).ok()?;
    // 0: it lives in another container.
    let pid = stream.peer_cred().ok()?.pid().filter(|&pid| pid > 0)?;
    let name = fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
    Some(match name.trim() {
        "" => format!("process {pid}"),
        name => format!("process {pid} ({name})"),
    })
}

/// Gives the permissions to a socket that has no file yet: Linux makes the file with them, less what the
/// umask takes.
fn with_mode(socket: Socket, mode: u32) -> io::Result<Socket> {
    let socket = File::from(OwnedFd::from(socket));
    // Where the system knows no such thing, the file gets them before anybody can connect.
    let _ = socket.set_permissions(Permissions::from_mode(mode));
    Ok(OwnedFd::from(socket).into())
}

/// Holds the folder of a path against other nodes. `None` where the file system has no locks.
fn lock_folder_of(key: &str, path: &Path) -> io::Result<Option<File>> {
    let folder = folder_of(path);
    let file = File::open(folder).map_err(|error| cannot_write(key, path, error))?;
    for _ in 0..LOCK_TRIES {
        match file.try_lock() {
            Ok(()) => return Ok(Some(file)),
            Err(TryLockError::Error(_)) => return Ok(None),
            Err(TryLockError::WouldBlock) => std::thread::sleep(LOCK_PAUSE),
        }
    }
    let text =
        format!("another program keeps {} locked: name a path in a folder of its own", folder.display());
    Err(io::Error::new(ErrorKind::ResourceBusy, text))
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."))
}

fn cannot_write(key: &str, path: &Path, error: io::Error) -> io::Error {
    let folder = folder_of(path);
    let shown = folder.display();
    match error.kind() {
        ErrorKind::NotFound => with(
            error,
            format_args!(
                "there is no folder {shown}: make it first (mkdir -p {shown}), or name another path in {key}"
            ),
        ),
        ErrorKind::NotADirectory => {
            with(error, format_args!("{shown} is no folder: name another path in {key}"))
        }
        ErrorKind::PermissionDenied => with(
            error,
            format_args!(
                "this user may not make files in {shown}: give it the folder, or name another path in {key}"
            ),
        ),
        _ => error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixListener as StdListener;

    const KEY: &str = "[sensor] listen_unix";

    /// A folder of its own, and a runtime to bind in.
    struct Place(PathBuf, tokio::runtime::Runtime);

    impl Place {
        fn new(name: &str) -> Self {
            let folder = std::env::temp_dir().join(format!("flockmap-unix-{name}-{}", std::process::id()));
            fs::create_dir_all(&folder).unwrap();
            Self(folder, tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap())
        }

        fn path(&self) -> PathBuf {
            self.0.join("sensor.sock")
        }

        fn bind(&self, mode: u32) -> io::Result<UnixSocket> {
            let _context = self.1.enter();
            UnixSocket::bind(KEY, &self.path(), mode)
        }

        fn refusal(&self) -> String {
            self.bind(0o600).err().unwrap().to_string()
        }
    }

    impl Drop for Place {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    fn mode_of(path: &Path) -> u32 {
        fs::symlink_metadata(path).unwrap().mode() & 0o777
    }

    #[test]
    fn the_mode_is_the_configured_one_whatever_the_umask() {
        let place = Place::new("mode");
        for mode in [0o600, 0o660, 0o666, 0o620] {
            let socket = place.bind(mode).unwrap();
            assert_eq!(mode_of(&place.path()), mode, "{mode:o}");
            drop(socket);
            assert!(!place.path().exists());
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_file_never_has_more_permissions_than_it_should() {
        // What is seen between making the file and the rest of the work.
        let place = Place::new("narrow");
        let socket = with_mode(Socket::new(Domain::UNIX, Type::STREAM, None).unwrap(), 0o600).unwrap();
        socket.bind(&SockAddr::unix(place.path()).unwrap()).unwrap();
        assert_eq!(mode_of(&place.path()) & !0o600, 0);
    }

    #[test]
    fn a_live_socket_is_not_taken_and_the_error_says_who_has_it() {
        let place = Place::new("live");
        let first = place.bind(0o600).unwrap();
        let before = identity(&place.path()).unwrap();
        let error = place.refusal();
        assert!(error.contains(&format!("process {} ", std::process::id())), "{error}");
        assert!(error.contains("stop it") && error.contains("[sensor] listen_unix"), "{error}");
        assert_eq!(identity(&place.path()).unwrap(), before);
        drop(first);
        drop(place.bind(0o600).unwrap());
    }

    #[test]
    fn a_live_socket_whose_queue_is_full_is_not_taken() {
        let place = Place::new("full");
        let socket = Socket::new(Domain::UNIX, Type::STREAM, None).unwrap();
        socket.bind(&SockAddr::unix(place.path()).unwrap()).unwrap();
        socket.listen(0).unwrap();
        let mut waiting = Vec::new();
        for _ in 0..4 {
            let client = Socket::new(Domain::UNIX, Type::STREAM, None).unwrap();
            client.set_nonblocking(true).unwrap();
            let _ = client.connect(&SockAddr::unix(place.path()).unwrap());
            waiting.push(client);
        }
        assert!(place.refusal().contains("listens there"));
        assert!(place.path().exists());
    }

    #[test]
    fn a_stale_socket_is_replaced_and_nothing_else_is() {
        let place = Place::new("stale");
        drop(StdListener::bind(place.path()).unwrap());
        drop(place.bind(0o600).unwrap());

        fs::write(place.path(), "precious").unwrap();
        assert!(place.refusal().contains("a file that is no socket"));
        assert_eq!(fs::read(place.path()).unwrap(), b"precious");
        fs::remove_file(place.path()).unwrap();
        fs::create_dir(place.path()).unwrap();
        assert!(place.refusal().contains("a folder is there"));
        fs::remove_dir(place.path()).unwrap();
        let other = place.0.join("other.sock");
        drop(StdListener::bind(&other).unwrap());
        std::os::unix::fs::symlink(&other, place.path()).unwrap();
        assert!(place.refusal().contains("a symbolic link"));
        assert!(other.exists());
    }

    #[test]
    fn a_file_that_is_another_s_by_now_is_left_at_the_end() {
        let place = Place::new("another");
        let first = place.bind(0o600).unwrap();
        fs::remove_file(place.path()).unwrap();
        let second = StdListener::bind(place.path()).unwrap();
        drop(first);
        assert!(place.path().exists(), "it is the second's");
        drop(second);
        drop(place.bind(0o600).unwrap());
        assert!(!place.path().exists(), "it is its own");
    }

    #[test]
    fn of_many_that_start_at_once_one_gets_the_path() {
        let place = Place::new("race");
        // Each finds a socket that nobody listens at, and would like to replace it.
        drop(StdListener::bind(place.path()).unwrap());
        let path = place.path();
        let barrier = std::sync::Barrier::new(8);
        let bind = || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            let _context = runtime.enter();
            barrier.wait();
            let socket = UnixSocket::bind(KEY, &path, 0o600);
            // None lets go before all have tried.
            barrier.wait();
            socket.is_ok()
        };
        let got = std::thread::scope(|scope| {
            let threads = [(); 8].map(|()| scope.spawn(bind));
            threads.map(|thread| usize::from(thread.join().unwrap())).iter().sum::<usize>()
        });
        assert_eq!(got, 1);
    }

    #[test]
    fn a_node_waits_for_another_that_is_taking_its_path_in_the_same_folder() {
        let place = Place::new("lock");
        let folder = File::open(&place.0).unwrap();
        folder.lock().unwrap();
        let error = place.refusal();
        assert!(error.contains("locked") && error.contains("a folder of its own"), "{error}");
        assert!(!place.path().exists());
        folder.unlock().unwrap();
        place.bind(0o600).unwrap();
    }

    #[test]
    fn a_path_that_cannot_be_is_named_with_what_to_do() {
        let place = Place::new("path");
        let _context = place.1.enter();
        let error = |path: PathBuf| UnixSocket::bind(KEY, &path, 0o600).err().unwrap().to_string();
        let text = error(place.0.join("x".repeat(120)));
        assert!(text.contains("107") && text.contains("shorter"), "{text}");
        let text = error(place.0.join("missing/sensor.sock"));
        assert!(text.contains("missing") && text.contains("mkdir -p"), "{text}");
        fs::write(place.0.join("file"), "").unwrap();
        let text = error(place.0.join("file/sensor.sock"));
        assert!(text.contains("file is no folder"), "{text}");
    }
}
