//! What is done is said on stderr, a line a step; and Ctrl-C ends it.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

/// Exit code of a run that was ended by Ctrl-C, as shells have it: 128 + SIGINT.
pub const STOPPED: u8 = 130;

static STOP: AtomicBool = AtomicBool::new(false);

/// Listens to Ctrl-C and SIGTERM from now on.
pub fn listen() {
    let handler = || {
        if STOP.swap(true, Ordering::SeqCst) {
            std::process::exit(i32::from(STOPPED));
        }
        eprintln!("\nending; nothing is written (Ctrl-C again ends at once)");
    };
    if let Err(error) = ctrlc::set_handler(handler) {
        eprintln!("warning: Ctrl-C will end the program at once: {error}");
    }
}

/// Whether the user wants an end.
pub fn is_stopped() -> bool {
    STOP.load(Ordering::SeqCst)
}

/// An error if the user wants an end.
pub fn go_on() -> anyhow::Result<()> {
    anyhow::ensure!(!is_stopped(), "stopped");
    Ok(())
}

/// Steps of one kind, done in any order by any thread.
pub struct Steps {
    what: &'static str,
    total: usize,
    done: AtomicUsize,
    start: Instant,
}

impl Steps {
    pub fn new(what: &'static str, total: usize) -> Self {
        Self { what, total, done: AtomicUsize::new(0), start: Instant::now() }
    }

    /// One more is done.
    pub fn done(&self, step: &str) {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        let seconds = self.start.elapsed().as_secs();
        eprintln!("{}: {done} of {} after {seconds} s ({step})", self.what, self.total);
    }
}
