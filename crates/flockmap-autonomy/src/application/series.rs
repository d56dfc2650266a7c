//! The same flight over many seeds and radios.

use super::{ApplicationOptions, ApplicationOutcome, Course, Ending, MapSync, fly};
use crate::threads::in_parallel;
use flockmap::RobotError;
use std::sync::atomic::{AtomicBool, Ordering};

/// Which flights.
#[derive(Clone, PartialEq, Debug)]
pub struct SeriesOptions {
    /// Number of seeds: courses 1 … this, each the same in all series. Default 20.
    pub seeds: u64,
    /// Budgets in bytes a second; `None`: no limit. Default 1, 5, 25 and 100 KB/s (of 1,024 bytes).
    pub rates_bytes_per_s: Vec<u32>,
    /// Losses for each of these budgets. Default 0, 0.2 and 0.4.
    pub losses: Vec<f64>,
    /// Budgets of further series, with the same losses, in which obstacles go out after
    /// `application.publish_period_ms` and free space after 2 s. Default 1 and 5 KB/s, where everything
    /// together is too much.
    pub obstacles_first_rates_bytes_per_s: Vec<u32>,
    /// Delay of all radios, in milliseconds. Default 20.
    pub delay_ms: u32,
    /// Threads that fly at once; no outcome depends on it. Default 2.
    pub threads: usize,
    /// Everything else. Its `seed` and `sync` are set anew for each flight.
    pub application: ApplicationOptions,
}

impl Default for SeriesOptions {
    fn default() -> Self {
        Self {
            seeds: 20,
            rates_bytes_per_s: [1, 5, 25, 100].map(|kb| kb * 1024).to_vec(),
            losses: vec![0.0, 0.2, 0.4],
            obstacles_first_rates_bytes_per_s: [1, 5].map(|kb| kb * 1024).to_vec(),
            delay_ms: 20,
            threads: 2,
            application: ApplicationOptions::default(),
        }
    }
}

/// Milliseconds that free space waits where obstacles go first.
const FREE_SPACE_LATER_MS: u32 = 2_000;

impl SeriesOptions {
    /// The options of each series, with the seed of none: no sync, a radio without limit, each budget with
    /// each loss, and the budgets with obstacles first.
    fn plan(&self) -> Vec<ApplicationOptions> {
        let radio =
            |rate_bytes_per_s, loss| MapSync::Radio { rate_bytes_per_s, loss, delay_ms: self.delay_ms };
        let with = |sync| ApplicationOptions { sync, ..self.application.clone() };
        let mut plan = vec![with(MapSync::None), with(radio(None, 0.0))];
        for rate in &self.rates_bytes_per_s {
            plan.extend(self.losses.iter().map(|loss| with(radio(Some(*rate), *loss))));
        }
        for rate in &self.obstacles_first_rates_bytes_per_s {
            plan.extend(self.losses.iter().map(|loss| ApplicationOptions {
                publish_period_ms: FREE_SPACE_LATER_MS,
                obstacle_period_ms: Some(self.application.publish_period_ms),
                ..with(radio(Some(*rate), *loss))
            }));
        }
        plan
    }

    /// Number of flights that [`series`] will make.
    pub fn flights(&self) -> u64 {
        self.seeds * self.plan().len() as u64
    }
}

/// The flights with one radio, in order of their seeds.
#[derive(Clone, PartialEq, Debug)]
pub struct Series {
    /// The radio.
    pub sync: MapSync,
    /// Whether obstacles went out ahead of free space.
    pub obstacles_first: bool,
    /// What became of each seed, from 1 on.
    pub outcomes: Vec<ApplicationOutcome>,
}

impl Series {
    /// How many flights ended so.
    pub fn count(&self, ending: Ending) -> usize {
        self.outcomes.iter().filter(|outcome| outcome.ending == ending).count()
    }

    /// Mean over the flights that reached the goal, 0 if none did.
    pub fn mean_of_successes(&self, value: impl Fn(&ApplicationOutcome) -> f64) -> f64 {
        mean(self.outcomes.iter().filter(|outcome| outcome.is_success()).map(value))
    }

    /// Mean over all flights, 0 if there are none.
    pub fn mean(&self, value: impl Fn(&ApplicationOutcome) -> f64) -> f64 {
        mean(self.outcomes.iter().map(value))
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (count, sum) = values.fold((0.0, 0.0), |(count, sum), value| (count + 1.0, sum + value));
    if count == 0.0 { 0.0 } else { sum / count }
}

/// Flies every seed with every radio. `flown` is called after each flight, from any of the threads, and says
/// whether to go on; a series that was not finished holds the outcomes up to the first seed that is missing.
///
/// # Errors
/// [`RobotError`] names an option that cannot work.
pub fn series(options: &SeriesOptions, flown: impl Fn() -> bool + Sync) -> Result<Vec<Series>, RobotError> {
    let plan = options.plan();
    let stopped = AtomicBool::new(false);
    let mut seeds: Vec<Result<Vec<ApplicationOutcome>, RobotError>> =
        (0..options.seeds).map(|_| Ok(Vec::new())).collect();
    in_parallel(options.threads, &mut seeds, |number, outcomes| {
        let seed = number as u64 + 1;
        let course = Course::thicket(seed);
        let flights = plan.iter().take_while(|_| !stopped.load(Ordering::Relaxed));
        *outcomes = flights
            .map(|flight| {
                let outcome = fly(&course, &ApplicationOptions { seed, ..flight.clone() });
                stopped.fetch_or(outcome.is_err() || !flown(), Ordering::Relaxed);
                outcome
            })
            .collect();
    });
    let seeds = seeds.into_iter().collect::<Result<Vec<_>, _>>()?;
    let of = |number: usize| seeds.iter().map_while(move |seed| seed.get(number).cloned()).collect();
    let series = plan.iter().enumerate().map(|(number, flight)| Series {
        sync: flight.sync,
        obstacles_first: flight.obstacle_period_ms.is_some(),
        outcomes: of(number),
    });
    Ok(series.collect())
}
