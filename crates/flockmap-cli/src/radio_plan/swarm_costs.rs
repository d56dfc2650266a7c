//! What a swarm costs by its radio and the number of its robots: `tests/tables/swarms.txt`, read when it is used.

use flockmap_netsim::swarm::{RadioPreset, TableRow, table, table_rows};

use super::interpolation::{Place, between};
use super::radio::Radio;

/// The table, as it was when the program was built.
const TABLE: &str = include_str!("../../../../tests/tables/swarms.txt");

/// Robots, and bytes of a request with IP and UDP headers on the mean. Of each N the command is
/// `flockmap sim swarm --seed 1 --robots N --radio lora --seconds 5 --cast broadcast --calm`.
const REQUEST_BYTES: [(usize, f64); 4] = [(2, 86.0), (5, 136.0), (10, 145.0), (20, 174.0)];

/// The rows of one radio.
#[derive(Debug)]
pub struct SwarmCosts {
    rows: Vec<Row>,
}

/// A row, split into what grows with the map and what grows with time.
#[derive(Clone, Copy, Debug)]
struct Row {
    robots: f64,
    /// Packages on the air, for each byte of them that goes out where nothing is lost: repairs, relays.
    repairs: f64,
    /// Requests of all robots, bytes a second.
    requests_bytes_per_s: f64,
    age_median_s: f64,
    age_99_s: f64,
    /// The map was more than the radio carries: packages waited.
    is_crowded: bool,
}

/// What a swarm of so many robots costs.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SwarmCost {
    /// Packages on the air, for each byte of them that goes out where nothing is lost: repairs, relays.
    pub repairs: f64,
    /// Requests of one robot, bytes a second.
    pub requests_bytes_per_s: f64,
    /// Bytes of a request on the mean.
    pub request_bytes: f64,
    /// Ages that half of what is merged, and 99 % of it, do not exceed, from the end of its batch in seconds:
    /// at least and at most. `None` for more robots than the table has.
    pub ages_s: Option<[Ages; 2]>,
    /// The table has rows for so many robots or more.
    pub is_inside: bool,
}

/// Ages of voxels in seconds.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Ages {
    /// Half of them are younger.
    pub median: f64,
    /// Of 100, 99 are younger.
    pub p99: f64,
}

impl SwarmCosts {
    /// The rows of a radio.
    ///
    /// # Errors
    /// The table cannot be read, or has fewer than two rows of it.
    pub fn of(radio: RadioPreset) -> anyhow::Result<Self> {
        Self::read(TABLE, radio)
    }

    fn read(text: &str, radio: RadioPreset) -> anyhow::Result<Self> {
        let rows = table_rows(text).map_err(anyhow::Error::msg)?;
        // Where nothing is lost, a byte of the map costs its headers alone.
        let lossless = |robots: usize| {
            rows.iter()
                .find(|row| row.radio == RadioPreset::Lan && row.robots == robots)
                .map(packages_per_map)
        };
        let of_radio = rows.iter().filter(|row| row.radio == radio);
        let mut rows: Vec<Row> =
            of_radio.filter_map(|row| Some(Row::of(row, lossless(row.robots)?))).collect();
        anyhow::ensure!(rows.len() > 1, "the table of swarms has no two rows of {radio} beside those of lan");
        rows.sort_by(|a, b| a.robots.total_cmp(&b.robots));
        // Where a radio is full, requests become rarer: that is not what more robots cost where it is not.
        let mut most = 0.0;
        for row in &mut rows {
            most = f64::max(most, row.requests_bytes_per_s);
            row.requests_bytes_per_s = most;
        }
        Ok(Self { rows })
    }

    /// Most robots of a row.
    pub fn robots_most(&self) -> usize {
        self.rows.last().map_or(0, |row| row.robots as usize)
    }

    /// Between the rows; beyond the last one as the last two go on, and never less.
    pub fn at(&self, robots: usize) -> SwarmCost {
        let axis: Vec<f64> = self.rows.iter().map(|row| row.robots).collect();
        let place = Place::on(&axis, robots as f64);
        let is_inside = place.is_inside(axis.len());
        let figure = |of: fn(&Row) -> f64, slope_least: f64| {
            let [low, high] = [0, 1].map(|next| &self.rows[place.low + next]);
            let (from, to) = (of(low), of(high));
            if place.share > 1.0 {
                let slope = (to / from).ln() / (high.robots / low.robots).ln();
                to * (robots as f64 / high.robots).powf(slope.max(slope_least))
            } else {
                between(from, to, place.share)
            }
        };
        let ages = |place: Place| {
            let age = |of: fn(&Row) -> f64| {
                between(of(&self.rows[place.low]), of(&self.rows[place.low + 1]), place.share)
            };
            Ages { median: age(|row| row.age_median_s), p99: age(|row| row.age_99_s) }
        };
        let calm = self.rows.iter().take_while(|row| !row.is_crowded).last().unwrap_or(&self.rows[0]);
        let at_least = Place::on(&axis, f64::min(calm.robots, robots as f64));
        let requests: [f64; 4] = REQUEST_BYTES.map(|(robots, _)| robots as f64);
        let size = Place::on(&requests, robots.clamp(REQUEST_BYTES[0].0, REQUEST_BYTES[3].0) as f64);
        SwarmCost {
            repairs: figure(|row| row.repairs, 0.0),
            requests_bytes_per_s: figure(|row| row.requests_bytes_per_s, 1.0) / robots as f64,
            request_bytes: between(REQUEST_BYTES[size.low].1, REQUEST_BYTES[size.low + 1].1, size.share),
            ages_s: is_inside.then(|| [ages(at_least), ages(place)]),
            is_inside,
        }
    }
}

/// Packages on the air, with headers and repairs, for each byte of the map.
fn packages_per_map(row: &TableRow) -> f64 {
    row.sent_per_map * (1.0 - row.request_share)
}

impl Row {
    /// Of a row, and of packages on the air for each byte of the map where nothing is lost.
    fn of(row: &TableRow, lossless: f64) -> Self {
        let robots = row.robots as f64;
        let mapping_s = f64::from(table::MAPPING_S);
        // The figures of a row count until all agree.
        let flight_s = mapping_s + row.agreement_s.unwrap_or_else(|| table::WAIT_S.into());
        let radio = Radio::of_preset(row.radio);
        let senders = if radio.is_shared { robots } else { 1.0 };
        Self {
            robots,
            repairs: packages_per_map(row) / lossless,
            requests_bytes_per_s: robots * row.sent_bytes * row.request_share / flight_s,
            age_median_s: row.age_median_s,
            age_99_s: row.age_99_s,
            is_crowded: senders * row.sent_bytes / mapping_s > radio.rate_bytes_per_s,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_rows_of_the_table_are_read() {
        let is_row =
            |line: &&str| RadioPreset::ALL.iter().any(|radio| line.split(' ').next() == Some(radio.name()));
        let rows = TABLE.lines().filter(is_row).count();
        let read: usize =
            RadioPreset::ALL.map(|radio| SwarmCosts::of(radio).unwrap().rows.len()).iter().sum();
        assert_eq!(read, rows);
        assert!(rows >= 4 * RadioPreset::ALL.len(), "{rows}");
    }

    #[test]
    fn the_figures_of_a_row_come_back_exactly() {
        for row in table_rows(TABLE).unwrap() {
            let at = |radio| SwarmCosts::of(radio).unwrap().at(row.robots);
            let cost = at(row.radio);
            assert_eq!(at(RadioPreset::Lan).repairs, 1.0);
            let lan = table_rows(TABLE).unwrap().into_iter().find(|lan| lan.robots == row.robots).unwrap();
            assert_eq!(lan.radio, RadioPreset::Lan);
            assert_eq!(cost.repairs, packages_per_map(&row) / packages_per_map(&lan), "{row:?}");
            let [_, most] = cost.ages_s.unwrap();
            assert_eq!(most, Ages { median: row.age_median_s, p99: row.age_99_s }, "{row:?}");
            assert!(cost.is_inside);
        }
    }

    #[test]
    fn more_robots_never_send_less_in_all() {
        for radio in RadioPreset::ALL {
            let costs = SwarmCosts::of(radio).unwrap();
            let all = |robots: usize| {
                let cost = costs.at(robots);
                [cost.repairs, cost.requests_bytes_per_s].map(|figure| figure * robots as f64)
            };
            for robots in 2..200 {
                let (less, more) = (all(robots), all(robots + 1));
                assert!(less[0] <= more[0] && less[1] <= more[1] * 1.000_001, "{radio}, {robots}");
            }
        }
    }

    #[test]
    fn ages_of_a_row_whose_radio_was_full_are_only_an_upper_bound() {
        let costs = SwarmCosts::of(RadioPreset::Lora).unwrap();
        let [least, most] = costs.at(2).ages_s.unwrap();
        assert_eq!(least, most);
        let [least, most] = costs.at(10).ages_s.unwrap();
        assert!(least.median * 3.0 < most.median, "{least:?} {most:?}");
        assert_eq!(costs.at(costs.robots_most() + 1).ages_s, None);
        assert!(!costs.at(costs.robots_most() + 1).is_inside);
    }

    #[test]
    fn a_radio_without_rows_is_said() {
        let error = SwarmCosts::read(&table::head(), RadioPreset::Lora).unwrap_err();
        assert!(error.to_string().contains("lora"), "{error}");
    }
}
