//! When a batch of mapping ends, and what it holds (the paper's Alg. 1).

use core::time::Duration;
use flockmap_codec::Batch;
use flockmap_grid::{BlockIndex, Changes, Mapper, Plane, Pose, Resolution, Stamp, Stream, Which};

use super::cost::Room;
use crate::BatchConfig;

/// Of a batch that is published in parts, so many of obstacles alone come before one with free space, if
/// there are as many.
const OBSTACLES_IN_ROW: u32 = 3;
/// Longest pause between scans that is reckoned with.
const SCAN_PAUSE_MAX: Duration = Duration::from_secs(1);

/// Closes batches: takes the net changes from the mapper when enough have come up or enough time has passed.
#[derive(Clone, Debug)]
pub struct Packer {
    config: BatchConfig,
    stream: Stream,
    resolution: Resolution,
    /// When the last batch of obstacles and of free space was closed, on the robot's clock.
    closed_occupied: Stamp,
    closed_free: Stamp,
    /// Of a batch that is published in parts: how many of the parts of obstacles alone are used up.
    obstacles_in_row: u32,
    /// When the newest scan came, and by when the next one is expected; `None`: a batch was closed since.
    scanned: Option<[Stamp; 2]>,
    /// Mean pause between the last scans.
    scan_pause: Option<Duration>,
    /// Something has waited beyond its time that has not been published yet.
    is_behind: bool,
    /// Stamp of the newest scan.
    newest_scan: Stamp,
    /// End of the last batch; ends strictly increase.
    last_end: Option<Stamp>,
    /// Ends of the last batches that held obstacles and free space: where the next ones begin.
    occupied_from: Option<Stamp>,
    free_from: Option<Stamp>,
    /// Where the sensor was at the first scan since the last batch of everything, and where it was last, in
    /// sixteenths of a voxel.
    first_sensor: Option<[i32; 3]>,
    newest_sensor: [i32; 3],
}

impl Packer {
    /// The first batch begins now.
    pub const fn new(config: BatchConfig, stream: Stream, resolution: Resolution, now: Stamp) -> Self {
        Self {
            config,
            stream,
            resolution,
            closed_occupied: now,
            closed_free: now,
            obstacles_in_row: 0,
            scanned: None,
            scan_pause: None,
            is_behind: false,
            newest_scan: now,
            last_end: None,
            occupied_from: None,
            free_from: None,
            first_sensor: None,
            newest_sensor: [0; 3],
        }
    }

    /// What is closed from now on is of another stream. Ends go on to increase.
    pub const fn begin_run(&mut self, stream: Stream) {
        self.stream = stream;
    }

    /// Notes a scan that the mapper has taken in, now on the robot's clock: it is the time of what has changed, and the place
    /// that it was seen from.
    #[expect(non_snake_case, reason = "T_a_b is how the field writes poses")]
    pub fn note_scan(&mut self, now: Stamp, stamp: Stamp, T_map_sensor: &Pose) {
        self.note_observed(now, stamp, Some(T_map_sensor.translation()));
    }

    /// The same for whatever the mapper has taken in. `sensor`: in metres in the map; `None`: where it was.
    pub fn note_observed(&mut self, now: Stamp, stamp: Stamp, sensor: Option<[f64; 3]>) {
        if let Some(sensor) = sensor {
            // A cast to i32 clamps, and whatever comes of it is right: the codec codes better if it is near.
            let sixteenths = 16.0 / self.resolution.metres();
            self.newest_sensor = sensor.map(|metres| (metres * sixteenths).round() as i32);
            self.first_sensor.get_or_insert(self.newest_sensor);
        }
        if self.occupied_from.is_some() {
            let pause = stamp.since(self.newest_scan).min(SCAN_PAUSE_MAX);
            self.scan_pause = Some(self.scan_pause.map_or(pause, |mean| (3 * mean + pause) / 4));
        }
        // Scans come early and late by some milliseconds.
        let pause = self.scan_pause.map_or_else(|| self.obstacle_period(), |pause| pause * 5 / 4);
        self.scanned = Some([now, now.plus(pause)]);
        if self.newest_scan < stamp || self.last_end.is_none() {
            self.newest_scan = stamp;
        }
        self.occupied_from.get_or_insert(stamp);
        self.free_from.get_or_insert(stamp);
    }

    /// When the next batch is due if nothing more changes; `None` if nothing has changed.
    pub fn deadline(&self, mapper: &Mapper) -> Option<Stamp> {
        if mapper.pending() == 0 {
            return None;
        }
        if mapper.pending() >= self.config.voxels_max {
            return Some(Stamp(i64::MIN));
        }
        let free = self.due(self.closed_free, self.period());
        let occupied = self.due(self.closed_occupied, self.obstacle_period());
        Some(if self.config.obstacle_period_ms.is_some() { free.min(occupied) } else { free })
    }

    /// When a batch is due. Where obstacles go ahead, already with the newest scan if the next one is expected after the end
    /// of the period: until then nothing would be added.
    fn due(&self, closed: Stamp, period: Duration) -> Stamp {
        let due = closed.plus(period);
        let scanned =
            self.scanned.filter(|[_, next]| self.config.obstacle_period_ms.is_some() && *next >= due);
        scanned.map_or(due, |[at, _]| at.min(due))
    }

    /// When a batch that is closed now counts as closed: not before its period ends, so that on average each period has one.
    fn closed(&self, now: Stamp, closed: Stamp, period: Duration) -> Stamp {
        if now >= self.due(closed, period) { now.max(closed.plus(period)) } else { now }
    }

    /// Everything is closed now.
    fn note_closed(&mut self, now: Stamp) {
        self.closed_occupied = self.closed(now, self.closed_occupied, self.obstacle_period());
        self.closed_free = self.closed(now, self.closed_free, self.period());
        self.scanned = None;
    }

    /// Closes the batch that is due, if one is: with everything that has changed, or just the obstacles if
    /// only their time has come. Call it again until `None`.
    pub fn close_due(&mut self, now: Stamp, mapper: &mut Mapper) -> Option<(Batch, Changes)> {
        if self.deadline(mapper).is_none_or(|deadline| now < deadline) {
            return None;
        }
        if self.everything_is_due(now, mapper) {
            return self.close(now, mapper);
        }
        self.close_obstacles(now, mapper, usize::MAX)
    }

    /// As [`close_due`](Self::close_due), where the radio may have no room for all: what is nearest to the
    /// sensor goes first, obstacles and everything else in turn. The rest stays in the map, goes on changing
    /// there, and is due again at once.
    ///
    /// What is published late has a late stamp. So from when something was left, or
    /// [deferred](Self::note_late), until all is published, what is Free stays in the map as well where the
    /// robot itself believes what a team-mate saw later: `believed_occupied` of a block.
    pub(crate) fn close_part(
        &mut self,
        now: Stamp,
        mapper: &mut Mapper,
        room: Room,
        believed_occupied: impl Fn(BlockIndex) -> Plane,
    ) -> Option<(Batch, Changes)> {
        if self.deadline(mapper).is_none_or(|deadline| now < deadline) {
            return None;
        }
        let everything_is_due = self.everything_is_due(now, mapper);
        let has_room = everything_is_due && mapper.pending() <= room.voxels;
        if !has_room && (!everything_is_due || self.obstacles_in_row < OBSTACLES_IN_ROW) {
            let obstacles = self.close_obstacles(now, mapper, room.obstacles);
            if obstacles.is_some() || !everything_is_due {
                return obstacles;
            }
        }
        self.obstacles_in_row = 0;
        let was_behind = self.is_behind;
        let except = |block| if was_behind { believed_occupied(block) } else { [0; 8] };
        let (changes, is_cut) = mapper.take_nearest(Which::All, self.sensor_block(), room.voxels, except);
        self.is_behind = is_cut || (was_behind && mapper.pending() > 0);
        if !is_cut {
            self.note_closed(now);
        }
        if changes.is_empty() {
            return None;
        }
        let (start, end) = (self.free_from, self.end());
        self.occupied_from = Some(end);
        if !is_cut {
            self.free_from = Some(end);
        }
        let middle = self.middle_sensor();
        Some((self.batch(start, end, middle), changes))
    }

    /// The longest that a batch with changes waits if nothing defers it.
    pub(crate) const fn period(&self) -> Duration {
        Duration::from_millis(self.config.publish_period_ms as u64)
    }

    fn obstacle_period(&self) -> Duration {
        Duration::from_millis(self.config.obstacle_period_ms.unwrap_or(0).into())
    }

    /// Notes that a batch was deferred for so long that what it publishes is late.
    pub(crate) const fn note_late(&mut self) {
        self.is_behind = true;
    }

    /// Whether something has waited beyond its time that has not been published yet.
    pub(crate) const fn is_behind(&self) -> bool {
        self.is_behind
    }

    fn everything_is_due(&self, now: Stamp, mapper: &Mapper) -> bool {
        now >= self.due(self.closed_free, self.period())
            || mapper.pending() >= self.config.voxels_max
            || self.config.obstacle_period_ms.is_none()
    }

    fn close_obstacles(
        &mut self,
        now: Stamp,
        mapper: &mut Mapper,
        voxels_max: usize,
    ) -> Option<(Batch, Changes)> {
        let (changes, is_cut) =
            mapper.take_nearest(Which::Occupied, self.sensor_block(), voxels_max, |_| [0; 8]);
        if is_cut {
            self.obstacles_in_row += 1;
        } else {
            // There are no more: the turn is over.
            self.obstacles_in_row = OBSTACLES_IN_ROW;
            self.closed_occupied = self.closed(now, self.closed_occupied, self.obstacle_period());
            self.scanned = None;
        }
        if changes.is_empty() {
            return None;
        }
        let (start, end) = (self.occupied_from, self.end());
        self.occupied_from = Some(end);
        Some((self.batch(start, end, self.newest_sensor), changes))
    }

    /// Closes the batch now, with everything that has changed. `None` if nothing has.
    pub fn close(&mut self, now: Stamp, mapper: &mut Mapper) -> Option<(Batch, Changes)> {
        self.note_closed(now);
        self.obstacles_in_row = 0;
        self.is_behind = false;
        let changes = mapper.take_changes(Which::All);
        if changes.is_empty() {
            return None;
        }
        let (start, end) = (self.free_from, self.end());
        self.occupied_from = Some(end);
        self.free_from = Some(end);
        let middle = self.middle_sensor();
        Some((self.batch(start, end, middle), changes))
    }

    /// A batch without a scan.
    pub(super) fn batch_of_records(&mut self) -> Batch {
        let end = self.end();
        self.batch(None, end, self.newest_sensor)
    }

    /// Between where the sensor was at the first scan of a batch and where it is now.
    fn middle_sensor(&mut self) -> [i32; 3] {
        let (first, last) = (self.first_sensor.take().unwrap_or(self.newest_sensor), self.newest_sensor);
        core::array::from_fn(|axis| first[axis].midpoint(last[axis]))
    }

    fn sensor_block(&self) -> BlockIndex {
        let [x, y, z] = self.newest_sensor.map(|sixteenths| sixteenths.div_euclid(16 * 8));
        BlockIndex { x, y, z }
    }

    /// The newest scan's stamp, or just after the last batch's end if no newer scan came.
    fn end(&mut self) -> Stamp {
        let end = match self.last_end {
            Some(last) => self.newest_scan.max(last.plus_micros(1)),
            None => self.newest_scan,
        };
        self.last_end = Some(end);
        end
    }

    fn batch(&self, start: Option<Stamp>, end: Stamp, sensor: [i32; 3]) -> Batch {
        let start = start.unwrap_or(end).min(end);
        Batch { stream: self.stream, start, end, resolution: self.resolution, sensor }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockmap_grid::{MapperConfig, Preset, RobotId, Scan, State, Voxel};

    const MS: i64 = 1_000;

    fn setup(config: BatchConfig) -> (Packer, Mapper) {
        let resolution = Resolution::from_metres(0.1).unwrap();
        let stream = Stream { origin: RobotId(1), epoch: 1 };
        let mapper = Mapper::new(MapperConfig::preset(Preset::RogMap, resolution, 7.0)).unwrap();
        (Packer::new(config, stream, resolution, Stamp(0)), mapper)
    }

    fn scan(packer: &mut Packer, mapper: &mut Mapper, ms: i64, point: [f32; 3]) {
        let scan = Scan { stamp: Stamp(ms * MS), points: vec![point], no_returns: Vec::new() };
        mapper.insert(&scan, &Pose::IDENTITY, &[]);
        packer.note_scan(scan.stamp, scan.stamp, &Pose::IDENTITY);
    }

    #[test]
    fn a_batch_closes_after_t_l_and_only_if_something_changed() {
        let (mut packer, mut mapper) = setup(BatchConfig::default());
        assert!(packer.deadline(&mapper).is_none());
        scan(&mut packer, &mut mapper, 100, [2.0, 0.0, 0.0]);
        assert_eq!(packer.deadline(&mapper), Some(Stamp(500 * MS)));
        assert!(packer.close_due(Stamp(499 * MS), &mut mapper).is_none());
        let (batch, changes) = packer.close_due(Stamp(500 * MS), &mut mapper).unwrap();
        assert_eq!((batch.start, batch.end), (Stamp(100 * MS), Stamp(100 * MS)));
        assert_eq!(changes.len(), 21);
        assert!(packer.close_due(Stamp(2_000 * MS), &mut mapper).is_none());
        // After a quiet time the next change goes out at once, as in Alg. 1.
        scan(&mut packer, &mut mapper, 2_000, [0.0, 2.0, 0.0]);
        let (batch, _) = packer.close_due(Stamp(2_000 * MS), &mut mapper).unwrap();
        assert_eq!((batch.start, batch.end), (Stamp(100 * MS), Stamp(2_000 * MS)));
    }

    #[test]
    fn a_batch_closes_early_with_d_changes() {
        let (mut packer, mut mapper) = setup(BatchConfig { voxels_max: 15, ..BatchConfig::default() });
        scan(&mut packer, &mut mapper, 10, [1.0, 0.0, 0.0]);
        assert!(packer.close_due(Stamp(10 * MS), &mut mapper).is_none());
        scan(&mut packer, &mut mapper, 20, [0.0, 1.0, 0.0]);
        assert_eq!(packer.close_due(Stamp(20 * MS), &mut mapper).unwrap().1.len(), 21);
    }

    #[test]
    fn obstacles_go_ahead_of_free_space() {
        let (mut packer, mut mapper) = setup(BatchConfig {
            publish_period_ms: 2_000,
            obstacle_period_ms: Some(100),
            ..BatchConfig::default()
        });
        scan(&mut packer, &mut mapper, 100, [2.0, 0.0, 0.0]);
        let (first, changes) = packer.close_due(Stamp(100 * MS), &mut mapper).unwrap();
        assert!(changes.voxels().all(|(_, state)| state == State::Occupied));
        assert_eq!(changes.len(), 1);
        assert!(packer.close_due(Stamp(1_900 * MS), &mut mapper).is_none());
        let (second, changes) = packer.close_due(Stamp(2_000 * MS), &mut mapper).unwrap();
        assert_eq!(changes.len(), 20);
        assert!(second.end > first.end, "a voxel's newest observation must be distinguishable by its stamp");
    }

    #[test]
    fn what_a_scan_saw_does_not_wait_for_the_end_of_a_period_without_scans() {
        let config = BatchConfig { obstacle_period_ms: Some(100), ..BatchConfig::default() };
        let (mut packer, mut mapper) = setup(config);
        let mut closed = Vec::new();
        // 10 scans a second, some early and some late; then 20 a second.
        let late = [0, 12, -15, 20, -20, 7, 0, 24, -3, 0];
        let slow = (0..10).map(|i| 100 * i + late[i as usize]);
        for (number, ms) in slow.chain((0..20).map(|i| 1_000 + 50 * i)).enumerate() {
            let angle = number as f32;
            scan(&mut packer, &mut mapper, ms, [2.0 * angle.cos(), 2.0 * angle.sin(), 0.1 * angle]);
            let occupied = mapper.pending();
            assert!(occupied > 0);
            while let Some((batch, changes)) = packer.close_due(Stamp(ms * MS), &mut mapper) {
                assert_eq!(batch.end.0 / MS, ms, "nothing of an earlier scan is left");
                closed.push((ms, changes.has_occupied()));
            }
        }
        let of_slow = closed.iter().filter(|(ms, is_occupied)| *ms < 950 && *is_occupied).count();
        let of_fast = closed.iter().filter(|(ms, is_occupied)| *ms > 950 && *is_occupied).count();
        // Two of the batches of everything come between.
        assert!(of_slow == 10 && (10..=12).contains(&of_fast), "{closed:?}");
    }

    #[test]
    fn a_part_is_of_obstacles_or_of_what_is_nearest_and_the_rest_is_due_at_once() {
        let (mut packer, mut mapper) = setup(BatchConfig {
            publish_period_ms: 2_000,
            obstacle_period_ms: Some(100),
            ..BatchConfig::default()
        });
        let room = |voxels| Room { obstacles: 1, voxels, defer_max: Duration::ZERO };
        for (i, point) in [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 1.0]].into_iter().enumerate() {
            scan(&mut packer, &mut mapper, 100 + i as i64, point);
        }
        let all = mapper.pending();
        let mut close =
            |ms: i64, voxels| packer.close_part(Stamp(ms * MS), &mut mapper, room(voxels), |_| [0; 8]);
        // The nearest obstacle; the others are due at once.
        let (first, obstacle) = close(200, 10).unwrap();
        assert_eq!(obstacle.voxels().collect::<Vec<_>>(), [(Voxel::new(0, 0, 10), State::Occupied)]);
        let published = [close(200, 10).unwrap().1.len(), close(200, 10).unwrap().1.len()];
        assert_eq!(published, [1, 1]);
        assert!(close(200, 10).is_none(), "free space has its own time");
        let (near, changes) = close(2_200, 30).unwrap();
        assert!(near.end > first.end && changes.len() <= 30 && !changes.has_occupied());
        let (_, rest) = close(2_200, 1_000).unwrap();
        assert_eq!(3 + changes.len() + rest.len(), all);
        assert!(close(4_300, 10).is_none());
    }

    #[test]
    fn obstacles_without_end_leave_every_fourth_part_to_free_space() {
        let (mut packer, mut mapper) =
            setup(BatchConfig { publish_period_ms: 100, ..BatchConfig::default() });
        let points = (0..200i16).map(|i| {
            let angle = f32::from(i) / 200.0 * core::f32::consts::TAU;
            [6.0 * angle.cos(), 6.0 * angle.sin(), 0.0]
        });
        let scan = Scan { stamp: Stamp(100 * MS), points: points.collect(), no_returns: Vec::new() };
        mapper.insert(&scan, &Pose::IDENTITY, &[]);
        packer.note_scan(scan.stamp, scan.stamp, &Pose::IDENTITY);
        let room = Room { obstacles: 10, voxels: 10, defer_max: Duration::ZERO };
        let parts: Vec<bool> = (0..8)
            .map(|_| packer.close_part(Stamp(200 * MS), &mut mapper, room, |_| [0; 8]).unwrap().1)
            .map(|changes| changes.voxels().all(|(_, state)| state == State::Occupied))
            .collect();
        assert_eq!(parts, [true, true, true, false, true, true, true, false]);
    }

    #[test]
    fn what_waited_is_not_told_where_the_robot_believes_somebody_who_saw_it_later() {
        let (mut packer, mut mapper) =
            setup(BatchConfig { publish_period_ms: 100, ..BatchConfig::default() });
        scan(&mut packer, &mut mapper, 100, [3.0, 0.0, 0.0]);
        // A team-mate has put something at the second block of the ray.
        let believed = |block: BlockIndex| if block == BlockIndex::new(1, 0, 0) { [!0; 8] } else { [0; 8] };
        let room = |voxels| Room { obstacles: 100, voxels, defer_max: Duration::ZERO };
        let mut close = |ms: i64, voxels| {
            let closed = packer.close_part(Stamp(ms * MS), &mut mapper, room(voxels), believed);
            let changes = closed.map(|(_, changes)| changes);
            let blocks = changes.iter().flat_map(|changes| changes.blocks()).map(|(block, _)| block.x);
            (blocks.collect::<Vec<_>>(), mapper.pending(), packer.deadline(&mapper))
        };
        let at = |ms: i64| Some(Stamp(ms * MS));
        assert_eq!(close(200, 10), (vec![3], 30, at(100)), "the obstacle first");
        assert_eq!(close(200, 10), (vec![0], 22, at(100)));
        assert_eq!(close(210, 100), (vec![2, 3], 8, at(310)), "what waited");
        // It stays for as long as it is not seen again, and nothing runs in circles for it.
        assert_eq!(close(310, 100), (vec![], 8, at(410)));
        let all = packer.close(Stamp(320 * MS), &mut mapper).unwrap().1;
        assert_eq!(all.len(), 8, "whoever asks for all gets all");
    }
}
