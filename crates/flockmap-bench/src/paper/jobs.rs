//! Pieces of work that do not need each other, on several threads.

use flockmap_cli::parallel::in_parallel;
use flockmap_cli::{progress, stop};

/// Does the same work for all jobs, each with its name for progress, so many at a time. Results are in the
/// order of the jobs, whatever order they end in; `None` for what Ctrl-C kept from being done, or from being
/// done to its end.
pub fn run<J: Send, T: Send>(
    threads: usize,
    jobs: Vec<(String, J)>,
    work: impl Fn(J) -> anyhow::Result<T> + Sync,
) -> anyhow::Result<Vec<Option<T>>> {
    let count = jobs.len();
    let mut done = in_parallel(threads.min(count), jobs, |(name, job)| {
        let result = progress::within(&name, || work(job));
        // What was ended in the middle is not a result.
        (!stop::requested() || result.is_err()).then_some(result)
    });
    done.resize_with(count, || None);
    done.into_iter().map(Option::transpose).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_keep_the_order_of_the_jobs() {
        for threads in [1, 2, 8] {
            let jobs = (0..20u64).map(|n| (n.to_string(), n)).collect();
            let results = run(threads, jobs, |n| {
                std::thread::sleep(std::time::Duration::from_micros(20 * (20 - n)));
                Ok(n * n)
            });
            assert_eq!(results.unwrap(), (0..20).map(|n| Some(n * n)).collect::<Vec<_>>());
        }
    }

    #[test]
    fn an_error_is_passed_on() {
        let jobs = vec![("good".to_owned(), true), ("bad".to_owned(), false)];
        let results = run(2, jobs, |good| if good { Ok(1) } else { anyhow::bail!("broken") });
        assert_eq!(results.unwrap_err().to_string(), "broken");
    }
}
