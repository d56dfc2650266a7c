//! Progress of long work, on stderr: a bar on a terminal, otherwise a plain line every few seconds.

use std::cell::RefCell;
use std::io::IsTerminal;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{LazyLock, Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

const LINE_EVERY: Duration = Duration::from_secs(5);

/// Bars of several threads below each other.
static BARS: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);

thread_local! {
    /// What the thread is at, said before everything that its progress says.
    static WITHIN: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Does something; all progress that begins meanwhile on this thread says what it is a part of.
pub fn within<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let before = WITHIN.replace(what.to_owned());
    let result = work();
    WITHIN.set(before);
    result
}

/// A line on stderr, above all bars.
pub fn line(words: &str) {
    if std::io::stderr().is_terminal() {
        BARS.suspend(|| eprintln!("{words}"));
    } else {
        eprintln!("{words}");
    }
}

/// Progress towards a number of steps, for as many threads as work on them.
pub struct Progress {
    within: String,
    total: u64,
    done: AtomicU64,
    bar: Option<ProgressBar>,
    line: Mutex<Line>,
}

/// What is said where there is no bar.
struct Line {
    what: String,
    last: Instant,
}

impl Progress {
    /// `total` 0: unknown.
    pub fn new(what: &str, total: u64) -> Self {
        let within = WITHIN
            .with_borrow(|within| if within.is_empty() { String::new() } else { format!("{within}: ") });
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = BARS.add(ProgressBar::new(total));
            let template = if total > 0 {
                "{msg} {bar:30} {pos}/{len} {elapsed} (left: {eta})"
            } else {
                "{msg} {pos} {elapsed}"
            };
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style);
            }
            bar.set_message(format!("{within}{what}"));
            bar
        });
        let line = Mutex::new(Line { what: what.to_owned(), last: Instant::now() });
        Self { within, total, done: AtomicU64::new(0), bar, line }
    }

    /// One step more.
    pub fn step(&self) {
        self.add(1);
    }

    /// So many steps more.
    pub fn add(&self, steps: u64) {
        self.show(self.done.fetch_add(steps, Ordering::Relaxed) + steps);
    }

    /// So many steps are done.
    pub fn set(&self, done: u64) {
        self.done.store(done, Ordering::Relaxed);
        self.show(done);
    }

    fn show(&self, done: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(done);
            return;
        }
        let mut line = self.line.lock().unwrap_or_else(PoisonError::into_inner);
        if line.last.elapsed() >= LINE_EVERY {
            line.last = Instant::now();
            let of = if self.total > 0 { format!(" of {}", self.total) } else { String::new() };
            eprintln!("{}{}: {done}{of}", self.within, line.what);
        }
    }

    /// Changes what the bar, or the next line, says.
    pub fn say(&self, what: String) {
        if let Some(bar) = &self.bar {
            bar.set_message(format!("{}{what}", self.within));
        }
        self.line.lock().unwrap_or_else(PoisonError::into_inner).what = what;
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
