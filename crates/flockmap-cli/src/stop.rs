//! Ctrl-C: the first asks for a clean end, the second ends at once.

use std::sync::atomic::{AtomicBool, Ordering};

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// Exit code of a run that was ended by Ctrl-C, as shells have it: 128 + SIGINT.
pub const EXIT_CODE: u8 = 130;

/// Listens to Ctrl-C and SIGTERM from now on.
pub fn listen() {
    let handler = || {
        if REQUESTED.swap(true, Ordering::SeqCst) {
            std::process::exit(i32::from(EXIT_CODE));
        }
        eprintln!("\nending; the result so far follows (Ctrl-C again ends at once)");
    };
    if let Err(error) = ctrlc::set_handler(handler) {
        eprintln!("warning: Ctrl-C will end the program at once: {error}");
    }
}

/// Forgets the wish: it was meant for something that has ended.
pub fn forget() {
    REQUESTED.store(false, Ordering::SeqCst);
}

/// Whether the user wants an end.
pub fn requested() -> bool {
    REQUESTED.load(Ordering::SeqCst)
}
