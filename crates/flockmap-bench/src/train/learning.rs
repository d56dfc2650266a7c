//! Recordings become tables.

use flockmap::Changes;
use flockmap::grid::Layer;
use flockmap_cli::parallel::in_parallel;
use flockmap_cli::progress::Progress;
use flockmap_codec::training::{self, ROUNDS, Trainer};

use super::recording::{Closing, Recording};
use super::scenes::Scans;

/// Batches that are learned from, of each recording with all changes together, at even distances: those of a
/// minute, so that a longer flight does not outweigh the others. With a third of them packages became 0.2 to
/// 0.5 % larger.
const BATCHES_TOGETHER: usize = 120;
/// The same of recordings whose obstacles go ahead. Such a batch has a few voxels in place of thousands, and
/// there are five times as many.
const BATCHES_OF_OBSTACLES: usize = 600;

/// The file of the tables. The same bytes whatever the number of threads.
pub fn tables(recordings: &[Recording], threads: usize) -> Vec<u8> {
    let progress = Progress::new("rounds of learning", 3 * ROUNDS as u64);
    // In the order of the file.
    let kinds = [Some(Scans::Dense), Some(Scans::Sparse), None];
    let sets = in_parallel(threads, kinds, |scans| learn(&samples(recordings, scans), &progress).tables());
    training::file(&sets)
}

/// A recording, and which of its batches to learn from.
struct Sample<'a> {
    recording: &'a Recording,
    /// Ascending.
    chosen: Vec<usize>,
}

/// What to learn a set from. `None`: batches of obstacles from all scans.
fn samples(recordings: &[Recording], scans: Option<Scans>) -> Vec<Sample<'_>> {
    let (closing, wanted) = match scans {
        Some(_) => (Closing::Together, BATCHES_TOGETHER),
        None => (Closing::ObstaclesAhead, BATCHES_OF_OBSTACLES),
    };
    let fits = |recording: &&Recording| {
        recording.closing == closing && scans.is_none_or(|scans| scans == recording.scans)
    };
    let sample = |recording| Sample { recording, chosen: choose(recording, scans.is_none(), wanted) };
    recordings.iter().filter(fits).map(sample).collect()
}

/// At most `wanted` batches at even distances, of those that hold only obstacles, or of the others.
fn choose(recording: &Recording, of_obstacles: bool, wanted: usize) -> Vec<usize> {
    let batches = recording.batches.iter().enumerate();
    let fitting: Vec<usize> = batches
        .filter(|(_, (_, changes))| is_of_obstacles(changes) == of_obstacles)
        .map(|(number, _)| number)
        .collect();
    let count = wanted.min(fitting.len());
    (0..count).map(|n| fitting[(2 * n + 1) * fitting.len() / (2 * count)]).collect()
}

fn is_of_obstacles(changes: &Changes) -> bool {
    changes.blocks().iter().all(|(_, states)| states.free().iter().all(|plane| *plane == 0))
}

fn learn(samples: &[Sample<'_>], progress: &Progress) -> Trainer {
    let mut trainer = Trainer::new();
    for _ in 0..ROUNDS {
        // One batch of each recording in turns: what is learned last counts most, and should be of all.
        let mut receivers: Vec<_> = samples.iter().map(Receiver::new).collect();
        for turn in 0..samples.iter().map(|sample| sample.chosen.len()).max().unwrap_or(0) {
            for receiver in &mut receivers {
                receiver.learn(turn, &mut trainer);
            }
        }
        trainer.end_round();
        progress.step();
    }
    trainer
}

/// What those who receive the robot of a recording hold.
struct Receiver<'a> {
    sample: &'a Sample<'a>,
    layer: Layer,
    /// Batches that are in the layer.
    held: usize,
}

impl<'a> Receiver<'a> {
    fn new(sample: &'a Sample<'a>) -> Self {
        Self { sample, layer: Layer::default(), held: 0 }
    }

    /// Goes on to the chosen batch of this turn, if there is one, and learns from it.
    fn learn(&mut self, turn: usize, trainer: &mut Trainer) {
        let Some(chosen) = self.sample.chosen.get(turn) else { return };
        let batches = &self.sample.recording.batches;
        for (batch, changes) in &batches[self.held..*chosen] {
            self.layer.apply(changes, batch.end);
        }
        self.held = *chosen;
        let (batch, changes) = &batches[*chosen];
        trainer.learn(&self.layer, batch, changes);
    }
}

#[cfg(test)]
mod tests {
    use super::super::recording::record;
    use super::super::scenes::{SCENES, Scene};
    use super::*;
    use flockmap::{Batch, Resolution, RobotId, Stamp, State, Stream, Voxel};

    #[test]
    fn threads_change_nothing_and_the_file_can_be_read_back() {
        let indoor = SCENES.last().expect("there are scenes");
        let scenes = [Scene { seconds: 1.0, ..*indoor }];
        let mut one = record(&scenes, 1).expect("it can be flown");
        assert_eq!(one, record(&scenes, 2).expect("it can be flown"));
        // One world is quicker than two: what the second robot has seen stands for sparse scans.
        for recording in one.iter_mut().rev().take(2) {
            recording.scans = Scans::Sparse;
        }
        let file = tables(&one, 1);
        assert_eq!(file, tables(&one, 2));
        let sets = training::read(&file).expect("a file of tables");
        assert_eq!(training::file(&sets), file);
        assert_eq!(sets.len(), training::SETS.len());
        assert!(sets.windows(2).all(|pair| pair[0] != pair[1]), "each set has learned something of its own");
    }

    #[test]
    fn chosen_batches_are_of_one_kind_and_spread_over_the_recording() {
        let batch = |number: i64| {
            let states = [State::Occupied, if number % 3 == 0 { State::Free } else { State::Occupied }];
            let voxels = states.into_iter().enumerate().map(|(x, state)| (Voxel::new(x as i32, 0, 0), state));
            let batch = Batch {
                stream: Stream { origin: RobotId(1), epoch: 1 },
                start: Stamp(number),
                end: Stamp(number),
                resolution: Resolution::from_metres(0.1).expect("a usual one"),
                sensor: [0; 3],
            };
            (batch, Changes::from_voxels(voxels))
        };
        let batches = (0..24).map(batch).collect();
        let recording = Recording { scans: Scans::Dense, closing: Closing::Together, batches };
        assert_eq!(choose(&recording, false, 100), [0, 3, 6, 9, 12, 15, 18, 21]);
        assert_eq!(choose(&recording, false, 2), [6, 18]);
        assert_eq!(choose(&recording, true, 4), [4, 10, 16, 22]);
        assert_eq!(choose(&recording, true, 0), [0; 0]);
    }
}
