//! Several threads, one result.

use std::sync::atomic::{AtomicUsize, Ordering};

/// Does every job, each on one of so many threads, and returns what came of them in the order of the jobs.
pub fn in_parallel<'j, J: Sync, T: Send>(
    threads: usize,
    jobs: &'j [J],
    work: impl Fn(&'j J) -> T + Sync,
) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let worker = || {
        let mut done = Vec::new();
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            let Some(job) = jobs.get(number) else { return done };
            done.push((number, work(job)));
        }
    };
    let mut done: Vec<(usize, T)> = std::thread::scope(|scope| {
        #[expect(clippy::needless_collect, reason = "all have to start before the first is waited for")]
        let threads: Vec<_> = (0..threads.clamp(1, jobs.len().max(1))).map(|_| scope.spawn(worker)).collect();
        let results = threads.into_iter().map(|thread| thread.join());
        results.flat_map(|result| result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    });
    done.sort_by_key(|(number, _)| *number);
    done.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_the_order_of_the_jobs() {
        let jobs: Vec<u64> = (0..100).collect();
        for threads in [0, 1, 3, 200] {
            let doubled = in_parallel(threads, &jobs, |job| 2 * job);
            assert!(doubled.iter().zip(&jobs).all(|(doubled, job)| *doubled == 2 * job));
            assert_eq!(doubled.len(), jobs.len());
        }
        assert!(in_parallel(2, &[] as &[u64], |job| *job).is_empty());
    }
}
