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
            [(2218.0, 786.0), (1718.4, 892.0), (1502.5, 993.0)],
            [(9535.3, 1052.0), (8540.6, 1114.0), (8322.6, 1130.0)],
            [(19263.4, 1117.0), (18597.0, 1144.0), (18332.3, 1154.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(619.2, 365.0), (467.0, 522.0), (385.6, 716.0)],
            [(2005.2, 742.0), (1611.0, 860.0), (1400.8, 998.0)],
            [(4141.2, 902.0), (3523.0, 1019.0), (3181.3, 1097.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(225.1, 169.0), (160.2, 216.0), (121.5, 299.0)],
            [(575.7, 339.0), (443.1, 477.0), (360.6, 656.0)],
            [(1062.6, 514.0), (847.6, 668.0), (700.9, 848.0)],
        ],
    ],
    [
        // Voxels of 0.1 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(2919.6, 352.0), (2480.6, 313.0), (2296.1, 294.0)],
            [(10985.9, 782.0), (10192.0, 761.0), (9970.8, 754.0)],
            [(20980.3, 943.0), (20418.0, 942.0), (20244.7, 937.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(967.1, 166.0), (859.0, 154.0), (790.7, 147.0)],
            [(2665.7, 344.0), (2354.2, 316.0), (2192.0, 300.0)],
            [(5083.5, 528.0), (4611.7, 501.0), (4339.3, 484.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(447.4, 108.0), (412.2, 105.0), (387.0, 102.0)],
            [(904.6, 161.0), (818.9, 154.0), (758.2, 148.0)],
            [(1516.6, 231.0), (1376.2, 219.0), (1275.3, 209.0)],
        ],
    ],
];

/// The same with `flockmap replay indoor`.
#[rustfmt::skip]
const INDOOR: [Cells; 2] = [
    [
        // Voxels of 0.1 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(857.7, 477.0), (594.7, 604.0), (470.8, 761.0)],
            [(1548.5, 625.0), (1228.9, 764.0), (1129.6, 923.0)],
            [(1555.8, 628.0), (1245.5, 760.0), (1153.7, 919.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(306.6, 209.0), (211.7, 268.0), (159.0, 374.0)],
            [(356.7, 233.0), (255.4, 307.0), (193.2, 430.0)],
            [(338.5, 225.0), (248.0, 300.0), (187.1, 406.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(164.1, 138.0), (111.0, 167.0), (77.1, 210.0)],
            [(184.2, 148.0), (128.1, 184.0), (92.3, 241.0)],
            [(181.4, 147.0), (126.7, 183.0), (90.9, 238.0)],
        ],
    ],
    [
        // Voxels of 0.1 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(1457.0, 202.0), (1267.6, 183.0), (1182.7, 174.0)],
            [(2314.4, 281.0), (2109.4, 262.0), (2035.3, 255.0)],
            [(2310.3, 280.0), (2139.1, 265.0), (2094.6, 259.0)],
        ],
        // Voxels of 0.2 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(603.6, 117.0), (545.8, 111.0), (510.1, 108.0)],
            [(681.7, 128.0), (625.2, 123.0), (585.8, 120.0)],
            [(663.6, 126.0), (618.2, 122.0), (578.0, 119.0)],
        ],
        // Voxels of 0.4 m: range 7, 15, 30 m; each: period 0.5, 1, 2 s.
        [
            [(390.6, 96.0), (361.0, 94.0), (339.0, 92.0)],
            [(405.7, 99.0), (369.7, 97.0), (340.3, 96.0)],
            [(401.6, 99.0), (366.5, 97.0), (337.8, 95.0)],
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
