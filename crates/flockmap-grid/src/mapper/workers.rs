//! Threads that work on a scan together.

use rayon_core::{ThreadPool, ThreadPoolBuilder};

/// Threads beside the one that calls; none, unless asked. They sleep between scans: threads that are made for each scan
/// are often put on the core of the one that makes them, and wait until it is done.
#[derive(Default)]
pub(super) struct Workers {
    pool: Option<ThreadPool>,
    /// In which process they are: a fork of it has none of them.
    process: u32,
}

impl Workers {
    /// So many threads with the one that calls, or that one alone where the system makes no more.
    pub(super) fn new(threads: usize) -> Self {
        let more = threads.saturating_sub(1);
        let pool =
            ThreadPoolBuilder::new().num_threads(more).thread_name(|number| format!("mapper-{}", number + 1));
        let pool = (more > 0).then(|| pool.build().ok()).flatten();
        let process = pool.as_ref().map_or(0, |_| std::process::id());
        Self { pool, process }
    }

    /// Does something with each, at the same time.
    pub(super) fn each<S: Send>(&self, items: &mut [S], work: impl Fn(&mut S) + Sync) {
        match (&self.pool, items.split_first_mut()) {
            (Some(pool), Some((first, rest))) if !rest.is_empty() && self.process == std::process::id() => {
                let work = &work;
                pool.in_place_scope(|scope| {
                    for item in rest {
                        scope.spawn(move |_| work(item));
                    }
                    work(first);
                });
            }
            _ => items.iter_mut().for_each(work),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread::ThreadId;

    fn who_works(workers: &Workers, items: usize) -> Vec<ThreadId> {
        let mut who = vec![None; items];
        workers.each(&mut who, |who| *who = Some(std::thread::current().id()));
        who.into_iter().map(|who| who.expect("each is worked on")).collect()
    }

    #[test]
    fn each_is_worked_on_once_whatever_the_number_of_threads() {
        for threads in [0, 1, 2, 3, 8] {
            let workers = Workers::new(threads);
            for items in 0..20 {
                let mut counts = vec![0; items];
                workers.each(&mut counts, |count| *count += 1);
                assert_eq!(counts, vec![1; items], "{threads} threads");
            }
        }
    }

    #[test]
    fn nobody_else_works_unless_asked_and_nobody_waits_for_threads_of_another_process() {
        let here = std::thread::current().id();
        assert_eq!(who_works(&Workers::new(1), 3), [here; 3]);
        let mut workers = Workers::new(3);
        let who = who_works(&workers, 3);
        assert!(who[0] == here && who[1] != here && who[2] != here);
        // As after a fork.
        workers.process ^= 1;
        assert_eq!(who_works(&workers, 3), [here; 3]);
    }
}
