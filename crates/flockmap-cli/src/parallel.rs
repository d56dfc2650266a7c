//! Several threads, one result.

use std::sync::{Mutex, PoisonError};
use std::thread;

use crate::stop;

/// Does the jobs, each on one of so many threads. What came of them, in the order of the jobs; after Ctrl-C
/// no other one is begun, and what came of the first few is returned.
pub fn in_parallel<J, T: Send>(
    threads: usize,
    jobs: impl IntoIterator<Item = J, IntoIter: Send>,
    work: impl Fn(J) -> T + Sync,
) -> Vec<T> {
    let jobs = Mutex::new(jobs.into_iter().enumerate());
    let worker = || {
        let mut done = Vec::new();
        while !stop::requested() {
            let next = jobs.lock().unwrap_or_else(PoisonError::into_inner).next();
            let Some((number, job)) = next else { break };
            done.push((number, work(job)));
        }
        done
    };
    let mut done: Vec<(usize, T)> = thread::scope(|scope| {
        #[expect(clippy::needless_collect, reason = "all have to start before the first is waited for")]
        let workers: Vec<_> = (0..threads.max(1)).map(|_| scope.spawn(worker)).collect();
        let results = workers.into_iter().map(|worker| worker.join());
        results.flat_map(|result| result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    });
    done.sort_by_key(|(number, _)| *number);
    done.into_iter().map(|(_, result)| result).collect()
}

/// Threads that this machine runs at once.
pub fn cores() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_the_order_of_the_jobs() {
        for threads in [0, 1, 3, 200] {
            let doubled = in_parallel(threads, 0..100u64, |job| {
                thread::sleep(std::time::Duration::from_micros(20 * (job % 7)));
                2 * job
            });
            assert!(doubled.iter().zip(0..100).all(|(doubled, job)| *doubled == 2 * job));
            assert_eq!(doubled.len(), 100);
        }
        assert!(in_parallel(2, [0; 0], |job| job).is_empty());
    }
}
