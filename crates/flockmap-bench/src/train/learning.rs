//! Recordings become tables.

use flockmap::Changes;
use flockmap::grid::Layer;
use flockmap_cli::parallel::in_parallel;
use flockmap_cli::progress::Progress;
use flockmap_codec::training::{self, ROUNDS, Trainer};

use super::recording::{Closing, Recording};
use super::scenes::Scans;

/// The file of the tables. The same bytes whatever the number of threads.
pub fn tables(recordings: &[Recording], threads: usize) -> Vec<u8> {
    let progress = Progress::new("rounds of learning", (training::SETS.len() * ROUNDS) as u64);
    let sets =
        in_parallel(threads, 0..training::SETS.len(), |set| learn(set, recordings, &progress).tables());
    training::file(&sets)
}

/// Whether a set is learned from a batch.
fn is_of_set(set: usize, recording: &Recording, changes: &Changes) -> bool {
    let is_of_obstacles = changes.blocks().iter().all(|(_, states)| *states.free() == [0; 8]);
    let is_ahead = recording.closing == Closing::ObstaclesAhead;
    match training::SETS[set] {
        "obstacles" => is_ahead && is_of_obstacles,
        "dense" => recording.scans == Scans::Dense && !is_ahead && !is_of_obstacles,
        "free" => recording.scans == Scans::Dense && is_ahead && !is_of_obstacles,
        _ => recording.scans == Scans::Sparse && !is_of_obstacles,
    }
}

fn learn(set: usize, recordings: &[Recording], progress: &Progress) -> Trainer {
    let mut trainer = Trainer::new(set);
    for _ in 0..ROUNDS {
        // One batch of each recording in turns: what is learned last counts most, and should be of all.
        let mut receivers: Vec<_> =
            recordings.iter().map(|recording| Receiver::new(set, recording)).collect();
        while !receivers.is_empty() {
            receivers.retain_mut(|receiver| receiver.learn(&mut trainer));
        }
        trainer.end_round();
        progress.step();
    }
    trainer
}

/// What those who receive the robot of a recording hold.
struct Receiver<'a> {
    set: usize,
    recording: &'a Recording,
    layer: Layer,
    /// Batches that are in the layer.
    held: usize,
}

impl<'a> Receiver<'a> {
    fn new(set: usize, recording: &'a Recording) -> Self {
        Self { set, recording, layer: Layer::default(), held: 0 }
    }

    /// Goes on to the next batch of its set and learns from it. Whether there was one.
    fn learn(&mut self, trainer: &mut Trainer) -> bool {
        let left = &self.recording.batches[self.held..];
        let fits = |(_, changes): &(_, Changes)| is_of_set(self.set, self.recording, changes);
        let Some(before) = left.iter().position(fits) else { return false };
        for (batch, changes) in &left[..before] {
            self.layer.apply(changes, batch.end);
        }
        let (batch, changes) = &left[before];
        trainer.learn(&self.layer, batch, changes);
        self.layer.apply(changes, batch.end);
        self.held += before + 1;
        true
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
    fn a_set_is_learned_from_the_batches_of_its_kind() {
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
        let batches: Vec<_> = (1..24).map(batch).collect();
        let learned = |set: usize, scans, closing| {
            let recording = Recording { scans, closing, batches: batches.clone() };
            batches.iter().filter(|(_, changes)| is_of_set(set, &recording, changes)).count()
        };
        let of_all = |scans, closing| [0, 1, 2, 3].map(|set| learned(set, scans, closing));
        assert_eq!(of_all(Scans::Dense, Closing::Together), [7, 0, 0, 0]);
        assert_eq!(of_all(Scans::Sparse, Closing::Together), [0, 7, 0, 0]);
        assert_eq!(of_all(Scans::Dense, Closing::ObstaclesAhead), [0, 0, 16, 7]);
        assert_eq!(of_all(Scans::Sparse, Closing::ObstaclesAhead), [0, 7, 16, 0]);
    }
}
