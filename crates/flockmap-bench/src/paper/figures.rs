//! What the paper reports, to stand beside our own figures. KB and MB are as the paper prints them; it does
//! not say whether they are of 1,000 or 1,024 bytes.

use crate::place::Place;

/// A row of Table I.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TableOneRow {
    pub number: u8,
    pub scene: Place,
    pub resolution_m: f64,
    pub range_m: f64,
    /// Average, largest second (KB/s) and total (MB) of the paper's method.
    pub paper: [f64; 3],
    /// The same of RACER.
    pub racer: [f64; 3],
}

impl Place {
    /// In a sentence.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Forest => "forest",
            Self::Indoor => "office",
        }
    }

    /// Robots that explore it in the paper.
    pub const fn robots(self) -> usize {
        match self {
            Self::Forest => 2,
            Self::Indoor => 5,
        }
    }
}

/// A row from its figures.
const fn row(
    number: u8,
    scene: Place,
    [resolution_m, range_m]: [f64; 2],
    [paper, racer]: [[f64; 3]; 2],
) -> TableOneRow {
    TableOneRow { number, scene, resolution_m, range_m, paper, racer }
}

/// Table I.
pub const TABLE_ONE: [TableOneRow; 4] = [
    row(1, Place::Forest, [0.1, 7.0], [[35.84, 107.42, 4.54], [430.71, 2570.13, 43.62]]),
    row(2, Place::Forest, [0.2, 20.0], [[18.77, 85.25, 2.28], [59.44, 409.80, 5.73]]),
    row(3, Place::Indoor, [0.1, 7.0], [[9.25, 56.20, 2.01], [55.70, 883.53, 7.93]]),
    row(4, Place::Indoor, [0.2, 20.0], [[1.26, 8.74, 0.26], [7.66, 147.18, 0.97]]),
];

impl TableOneRow {
    /// How many times the paper's volume RACER's is: the honest saving, since the averages are over different
    /// times.
    pub fn volume_ratio(&self) -> f64 {
        self.racer[2] / self.paper[2]
    }

    /// "forest, 0.1 m, 7 m".
    pub fn name(&self) -> String {
        format!("{}, {} m, {} m", self.scene.name(), self.resolution_m, self.range_m)
    }
}

/// Seconds between two packages in simulation (Sec. V-A).
pub const PUBLISH_PERIOD_S: f64 = 0.5;
/// Changed voxels that close a batch (Sec. V-A).
pub const CHANGES_MAX: usize = 50_000;

/// Sensing range of Table II, forest at 0.1 m.
pub const TABLE_TWO_RANGE_M: f64 = 5.0;
/// Table II: average and largest KB/s along the Hilbert walk, and in nested order.
pub const TABLE_TWO: [(&str, f64, f64); 2] = [("paper", 17.60, 43.97), ("nested-zlib", 21.59, 59.11)];

/// Table III, one robot's average and largest KB/s: sent, received.
pub const TABLE_THREE: [(&str, f64, f64); 2] = [("sent", 25.4, 39.9), ("received", 25.3, 39.9)];
/// Seconds between two packages in the real flight (Sec. V-B).
pub const FLIGHT_PUBLISH_PERIOD_S: f64 = 0.2;
/// Half extents of the update scope of the real flight.
pub const FLIGHT_UPDATE_BOX_M: [f64; 3] = [7.5, 7.5, 1.5];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ratios_are_those_that_the_paper_claims() {
        let rounded = |value: f64| (value * 10.0).round() / 10.0;
        assert_eq!(TABLE_ONE.map(|row| rounded(row.volume_ratio())), [9.6, 2.5, 3.9, 3.7]);
        assert_eq!(TABLE_ONE.map(|row| rounded(row.racer[0] / row.paper[0])), [12.0, 3.2, 6.0, 6.1]);
        // "12 times lower" and "24 times lower" in the text.
        assert_eq!((TABLE_ONE[0].racer[1] / TABLE_ONE[0].paper[1]).round(), 24.0);
        // "both decreased by around 20 %".
        let saved = |of: fn((&str, f64, f64)) -> f64| 1.0 - of(TABLE_TWO[0]) / of(TABLE_TWO[1]);
        assert!((0.15..0.28).contains(&saved(|row| row.1)) && (0.15..0.28).contains(&saved(|row| row.2)));
    }
}
