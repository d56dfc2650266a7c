//! Progress of long work, on stderr: a bar on a terminal, otherwise a plain line every few seconds.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

const LINE_EVERY: Duration = Duration::from_secs(5);

/// Progress towards a number of steps.
pub struct Progress {
    what: String,
    total: u64,
    done: u64,
    bar: Option<ProgressBar>,
    last_line: Instant,
}

impl Progress {
    /// `total` 0: unknown.
    pub fn new(what: &str, total: u64) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(total);
            let template = if total > 0 {
                "{msg} {bar:30} {pos}/{len} {elapsed} (left: {eta})"
            } else {
                "{msg} {pos} {elapsed}"
            };
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style);
            }
            bar.set_message(what.to_owned());
            bar
        });
        Self { what: what.to_owned(), total, done: 0, bar, last_line: Instant::now() }
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
                eprintln!("{}: {} of {}", self.what, done, self.total);
            } else {
                eprintln!("{}: {}", self.what, done);
            }
        }
    }

    /// Changes what the bar, or the next line, says.
    pub fn say(&mut self, what: String) {
        if let Some(bar) = &self.bar {
            bar.set_message(what.clone());
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
