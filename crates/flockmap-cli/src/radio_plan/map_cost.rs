//! What the map of one robot costs, by its voxels, its range and its periods, as measured.

use core::fmt;

use super::interpolation::{Place, between};

/// Sides of voxels that were measured, in metres.
pub const RESOLUTIONS_M: [f64; 3] = [0.1, 0.2, 0.4];
/// Ranges of the sensor that were measured, in metres.
pub const RANGES_M: [f64; 3] = [7.0, 15.0, 30.0];
/// Publish periods that were measured, in seconds.
pub const PERIODS_S: [f64; 3] = [0.5, 1.0, 2.0];
/// The obstacle period that was measured, in seconds.
pub(super) const OBSTACLE_PERIOD_S: f64 = 0.1;

/// Bytes of headers of a datagram with one package: 28 of IP and UDP, 29 of Flockmap's own. In the flights of
/// the tables below: `package_datagram_bytes` less `own_package_bytes`, over `package_datagrams`.
const HEADER_BYTES: f64 = 57.0;
/// Bytes of the shortest package there is, more or less, and of the longest.
const PACKAGE_BYTES: [f64; 2] = [20.0, 1_150.0];

/// Bytes a second of the packages that a robot makes, and bytes of a datagram with packages, with its headers.
type Cell = (f64, f64);
/// By voxels, range and publish period.
type Cells = [[[Cell; 3]; 3]; 3];

/// Two robots that map for 30 s, without any loss; mean of both. First obstacles with everything else, then
/// ahead of free space. Of each cell the command is, with its own figures and `--json`,
/// `flockmap replay forest --cast broadcast --seconds 30 --resolution 0.2 --range 7 --publish-period 1`,
/// the second with `--obstacle-period 0.1`: `own_package_bytes` over `record_s`, and `package_datagram_bytes`
/// over `package_datagrams`.
#[rustfmt::skip]
const FOREST: [Cells; 2] = [
    [
        // Voxels of 0.1 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(2455.9, 814.0), (1885.9, 931.0), (1635.8, 1016.0)],
            [(10310.2, 1068.0), (9254.0, 1113.0), (8992.5, 1130.0)],
            [(20921.7, 1124.0), (20154.2, 1145.0), (19862.0, 1157.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(680.3, 396.0), (507.1, 562.0), (417.1, 680.0)],
            [(2171.5, 759.0), (1739.9, 870.0), (1504.5, 1014.0)],
            [(4451.3, 921.0), (3782.1, 1032.0), (3408.0, 1086.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(246.2, 179.0), (172.3, 228.0), (130.5, 317.0)],
            [(614.3, 358.0), (471.1, 490.0), (381.2, 690.0)],
            [(1126.5, 538.0), (896.7, 688.0), (739.8, 876.0)],
        ],
    ],
    [
        // Voxels of 0.1 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(3256.8, 381.0), (2831.8, 346.0), (2642.8, 328.0)],
            [(11885.4, 811.0), (11093.3, 791.0), (10872.3, 783.0)],
            [(22796.0, 959.0), (22223.9, 957.0), (22005.8, 953.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(1095.4, 180.0), (992.1, 170.0), (928.2, 163.0)],
            [(2915.6, 366.0), (2619.4, 341.0), (2462.4, 326.0)],
            [(5475.6, 551.0), (5011.8, 529.0), (4754.0, 512.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(511.0, 115.0), (475.0, 112.0), (452.9, 110.0)],
            [(994.4, 172.0), (913.5, 165.0), (856.5, 160.0)],
            [(1638.4, 245.0), (1504.4, 233.0), (1408.8, 224.0)],
        ],
    ],
];

/// The same with `flockmap replay indoor`.
#[rustfmt::skip]
const INDOOR: [Cells; 2] = [
    [
        // Voxels of 0.1 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(994.6, 537.0), (685.2, 651.0), (538.9, 773.0)],
            [(1733.4, 663.0), (1383.2, 809.0), (1263.3, 935.0)],
            [(1748.3, 665.0), (1401.0, 826.0), (1291.7, 945.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(353.6, 233.0), (240.3, 296.0), (179.0, 414.0)],
            [(406.7, 258.0), (288.1, 339.0), (218.0, 477.0)],
            [(386.7, 249.0), (280.3, 332.0), (212.0, 453.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(183.1, 147.0), (121.2, 177.0), (83.6, 223.0)],
            [(203.0, 157.0), (138.3, 194.0), (99.0, 254.0)],
            [(199.6, 156.0), (136.9, 193.0), (97.5, 251.0)],
        ],
    ],
    [
        // Voxels of 0.1 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(1715.9, 227.0), (1518.8, 207.0), (1429.0, 198.0)],
            [(2597.6, 307.0), (2394.3, 289.0), (2326.8, 282.0)],
            [(2602.4, 305.0), (2429.4, 290.0), (2389.9, 285.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(731.0, 130.0), (670.9, 124.0), (636.4, 121.0)],
            [(809.1, 141.0), (750.3, 136.0), (714.7, 134.0)],
            [(787.3, 139.0), (740.2, 135.0), (707.0, 133.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(459.4, 103.0), (427.6, 101.0), (405.9, 99.0)],
            [(476.2, 107.0), (437.0, 105.0), (406.6, 103.0)],
            [(471.1, 106.0), (432.9, 104.0), (403.2, 103.0)],
        ],
    ],
];

/// A generated world in which robots were measured.
#[derive(Clone, Copy, PartialEq, Eq, Debug, clap::ValueEnum)]
pub enum Scene {
    /// Trees and undergrowth, 60 × 25 m.
    Forest,
    /// An office floor, 35 × 30 m.
    Indoor,
}

/// How a robot maps.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct RobotKind {
    /// Where; `None` for the one of the scenes that costs more.
    pub scene: Option<Scene>,
    /// Side of a voxel in metres.
    pub resolution_m: f64,
    /// Range of its sensor in metres.
    pub range_m: f64,
    /// Publish period in seconds.
    pub period_s: f64,
    /// Obstacles go out ahead of free space after so many seconds.
    pub obstacle_period_s: Option<f64>,
}

/// What its map costs.
#[derive(Clone, PartialEq, Debug)]
pub struct MapCost {
    /// Bytes a second of the packages that a robot makes.
    pub bytes_per_s: f64,
    /// Bytes of a datagram with packages, with its headers, on the mean.
    pub datagram_bytes: f64,
    /// The scene that this is measured in.
    pub scene: Scene,
    /// What of the robot lies outside of what was measured, in words.
    pub outside: Vec<String>,
}

impl Scene {
    const ALL: [Self; 2] = [Self::Forest, Self::Indoor];

    const fn cells(self) -> &'static [Cells; 2] {
        match self {
            Self::Forest => &FOREST,
            Self::Indoor => &INDOOR,
        }
    }
}

impl fmt::Display for Scene {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Forest => "forest",
            Self::Indoor => "indoor",
        })
    }
}

impl MapCost {
    /// Bytes a second of datagrams with packages, headers counted, where nothing is lost.
    pub fn datagrams_bytes_per_s(&self) -> f64 {
        self.bytes_per_s * self.datagram_bytes / (self.datagram_bytes - HEADER_BYTES)
    }
}

impl RobotKind {
    /// What its map costs: as measured, or between what was measured, or going on from there.
    pub fn map_cost(&self) -> MapCost {
        let (scene, (bytes_per_s, datagram_bytes)) = match self.scene {
            Some(scene) => (scene, self.cell(scene)),
            None => {
                let [forest, indoor] = Scene::ALL.map(|scene| (scene, self.cell(scene)));
                if forest.1.0 >= indoor.1.0 { forest } else { indoor }
            }
        };
        // Where figures go on beyond what was measured, datagrams could become shorter than their headers.
        let [shortest, longest] = PACKAGE_BYTES.map(|bytes| bytes + HEADER_BYTES);
        let datagram_bytes = datagram_bytes.clamp(shortest, longest);
        MapCost { bytes_per_s, datagram_bytes, scene, outside: self.outside() }
    }

    /// The same of a robot of which the user knows that its map takes so many bytes a second. Datagrams are as
    /// large as those of the measured robot with the nearest figure and the same periods.
    pub fn known_cost(&self, bytes_per_s: f64) -> MapCost {
        let sides = RESOLUTIONS_M.into_iter().flat_map(|side| RANGES_M.map(|range| (side, range)));
        let like = sides.map(|(resolution_m, range_m)| Self { resolution_m, range_m, ..*self }.map_cost());
        let distance = |cost: &MapCost| (cost.bytes_per_s / bytes_per_s).ln().abs();
        let nearest = like.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        MapCost { bytes_per_s, outside: Vec::new(), ..nearest.unwrap_or_else(|| self.map_cost()) }
    }

    fn cell(&self, scene: Scene) -> Cell {
        let [side, range, period] = [
            Place::on(&RESOLUTIONS_M, self.resolution_m),
            Place::on(&RANGES_M, self.range_m),
            Place::on(&PERIODS_S, self.period_s),
        ];
        let mix = |a: Cell, b: Cell, share| (between(a.0, b.0, share), between(a.1, b.1, share));
        let along = |place: Place, cell: &dyn Fn(usize) -> Cell| {
            mix(cell(place.low), cell(place.low + 1), place.share)
        };
        let of = |cells: &Cells| {
            let at = |s: usize, r: usize| along(period, &|p| cells[s][r][p]);
            along(side, &|s| along(range, &|r| at(s, r)))
        };
        let [together, ahead] = scene.cells();
        // With the publish period obstacles go out with everything else.
        match self.obstacle_period_s.filter(|obstacles| *obstacles < self.period_s) {
            None => of(together),
            Some(obstacles) if self.period_s > OBSTACLE_PERIOD_S => {
                let place = Place::on(&[OBSTACLE_PERIOD_S, self.period_s], obstacles);
                mix(of(ahead), of(together), place.share.max(0.0))
            }
            Some(_) => of(ahead),
        }
    }

    fn outside(&self) -> Vec<String> {
        let figure = |axis: &[f64; 3], value: f64, what: &str, unit: &str| {
            let is_inside = Place::on(axis, value).is_inside(axis.len());
            (!is_inside)
                .then(|| format!("{what} {value} {unit} (measured: {} to {} {unit})", axis[0], axis[2]))
        };
        let obstacles = self.obstacle_period_s.filter(|period| *period < OBSTACLE_PERIOD_S);
        let obstacles = obstacles
            .map(|period| format!("obstacle period {period} s (measured: {OBSTACLE_PERIOD_S} s or more)"));
        [
            figure(&RESOLUTIONS_M, self.resolution_m, "voxels of", "m"),
            figure(&RANGES_M, self.range_m, "range", "m"),
            figure(&PERIODS_S, self.period_s, "publish period", "s"),
            obstacles,
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(resolution_m: f64, range_m: f64, period_s: f64) -> RobotKind {
        RobotKind { scene: Some(Scene::Forest), resolution_m, range_m, period_s, obstacle_period_s: None }
    }

    #[test]
    fn measured_figures_come_back_exactly() {
        for (s, resolution) in RESOLUTIONS_M.into_iter().enumerate() {
            for (r, range) in RANGES_M.into_iter().enumerate() {
                for (p, period) in PERIODS_S.into_iter().enumerate() {
                    let cost = kind(resolution, range, period).map_cost();
                    assert_eq!((cost.bytes_per_s, cost.datagram_bytes), FOREST[0][s][r][p]);
                    assert_eq!(cost.outside, Vec::<String>::new());
                    let ahead = RobotKind { obstacle_period_s: Some(0.1), ..kind(resolution, range, period) };
                    assert_eq!(ahead.map_cost().bytes_per_s, FOREST[1][s][r][p].0);
                }
            }
        }
    }

    #[test]
    fn what_lies_between_costs_what_lies_between() {
        let bytes = |side, range, period| kind(side, range, period).map_cost().bytes_per_s;
        assert!(bytes(0.1, 7.0, 0.5) > bytes(0.15, 7.0, 0.5) && bytes(0.15, 7.0, 0.5) > bytes(0.2, 7.0, 0.5));
        assert!(
            bytes(0.2, 7.0, 0.5) < bytes(0.2, 10.0, 0.5) && bytes(0.2, 10.0, 0.5) < bytes(0.2, 15.0, 0.5)
        );
        assert!(bytes(0.2, 7.0, 1.0) > bytes(0.2, 7.0, 1.5) && bytes(0.2, 7.0, 1.5) > bytes(0.2, 7.0, 2.0));
        let obstacles = |period| RobotKind { obstacle_period_s: Some(period), ..kind(0.2, 7.0, 1.0) };
        assert!(obstacles(0.1).map_cost().bytes_per_s > obstacles(0.3).map_cost().bytes_per_s);
        assert_eq!(obstacles(1.0).map_cost(), kind(0.2, 7.0, 1.0).map_cost());
    }

    #[test]
    fn a_figure_outside_of_what_was_measured_is_said() {
        assert!(
            kind(0.05, 7.0, 0.5).map_cost().outside[0].contains("voxels of 0.05 m (measured: 0.1 to 0.4 m)")
        );
        assert!(kind(0.1, 50.0, 0.5).map_cost().outside[0].contains("range 50 m"));
        assert!(kind(0.1, 7.0, 5.0).map_cost().outside[0].contains("publish period 5 s"));
        let often = RobotKind { obstacle_period_s: Some(0.05), ..kind(0.1, 7.0, 0.5) };
        assert!(often.map_cost().outside[0].contains("obstacle period"));
        assert!(kind(0.05, 7.0, 0.5).map_cost().bytes_per_s > FOREST[0][0][0][0].0);
        // However far that is, it is a number that can be.
        for far in [kind(100.0, 100.0, 3_600.0), kind(100.0, 5e4, 0.001), kind(0.001, 0.001, 3_600.0)] {
            let cost = far.map_cost();
            assert!(cost.datagrams_bytes_per_s() > cost.bytes_per_s && cost.bytes_per_s > 0.0, "{cost:?}");
        }
    }

    #[test]
    fn without_a_scene_the_one_that_costs_more_counts() {
        let any = RobotKind { scene: None, ..kind(0.2, 7.0, 1.0) }.map_cost();
        let [forest, indoor] =
            Scene::ALL.map(|scene| RobotKind { scene: Some(scene), ..kind(0.2, 7.0, 1.0) });
        assert_eq!(any.bytes_per_s, forest.map_cost().bytes_per_s.max(indoor.map_cost().bytes_per_s));
    }

    #[test]
    fn a_figure_of_the_users_own_is_taken_as_it_is() {
        let cost = kind(0.2, 7.0, 1.0).known_cost(FOREST[0][1][1][1].0);
        assert_eq!((cost.bytes_per_s, cost.datagram_bytes), FOREST[0][1][1][1]);
        assert_eq!(kind(0.2, 7.0, 1.0).known_cost(777.0).bytes_per_s, 777.0);
    }
}
