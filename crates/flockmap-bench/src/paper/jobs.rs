//! Pieces of work that do not need each other, on several threads.

use flockmap_cli::parallel::in_parallel;
use flockmap_cli::{progress, stop};

/// A piece of work with its name for progress.
pub struct Job<'a, T> {
    pub name: String,
    work: Box<dyn FnOnce() -> anyhow::Result<T> + Send + 'a>,
}

impl<'a, T> Job<'a, T> {
    pub fn new(name: impl Into<String>, work: impl FnOnce() -> anyhow::Result<T> + Send + 'a) -> Self {
        Self { name: name.into(), work: Box::new(work) }
    }
}

/// Does all jobs, so many at a time. Results are in the order of the jobs, whatever order they end in; `None` for what Ctrl-C
/// kept from being done, or from being done to its end.
pub fn run<T: Send>(threads: usize, jobs: Vec<Job<'_, T>>) -> anyhow::Result<Vec<Option<T>>> {
    let count = jobs.len();
    let mut done = in_parallel(threads.min(count), jobs, |job| {
        let result = progress::within(&job.name, job.work);
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
            let jobs = (0..20u64).map(|n| {
                Job::new(n.to_string(), move || {
                    std::thread::sleep(std::time::Duration::from_micros(20 * (20 - n)));
                    Ok(n * n)
                })
            });
            let results = run(threads, jobs.collect()).unwrap();
            assert_eq!(results, (0..20).map(|n| Some(n * n)).collect::<Vec<_>>());
        }
    }

    #[test]
    fn an_error_is_told() {
        let jobs = vec![Job::new("good", || Ok(1)), Job::new("bad", || anyhow::bail!("broken"))];
        assert_eq!(run(2, jobs).unwrap_err().to_string(), "broken");
    }
}
