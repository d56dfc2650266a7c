//! Progress of long work, on stderr: a bar on a terminal, otherwise a plain line every few seconds.

use std::cell::RefCell;
use std::io::IsTerminal;
use std::sync::LazyLock;
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

/// Progress towards a number of steps.
pub struct Progress {
    within: String,
    what: String,
    total: u64,
    done: u64,
    bar: Option<ProgressBar>,
    last_line: Instant,
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
        Self { within, what: what.to_owned(), total, done: 0, bar, last_line: Instant::now() }
    }

    /// One step more.
    pub fn step(&mut self) {
        self.set(self.done + 1);
    }

    /// So many steps are done.
    pub fn set(&mut self, done: u64) {
        self.done = done;
        if let Some(bar) = &self.bar {
            bar.set_position(done);
        } else if self.last_line.elapsed() >= LINE_EVERY {
            self.last_line = Instant::now();
            if self.total > 0 {
                eprintln!("{}{}: {} of {}", self.within, self.what, done, self.total);
            } else {
                eprintln!("{}{}: {}", self.within, self.what, done);
            }
        }
    }

    /// Changes what the bar, or the next line, says.
    pub fn say(&mut self, what: String) {
        if let Some(bar) = &self.bar {
            bar.set_message(format!("{}{what}", self.within));
        }
        self.what = what;
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
