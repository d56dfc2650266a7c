//! The rows of `flockmap sim table`, read back from its text.

use super::RadioPreset;

/// One row: what a swarm of so many robots costs on one radio. Of several flights the worst of each figure.
#[derive(Clone, Copy, PartialEq, Debug)]
#[non_exhaustive]
pub struct TableRow {
    /// The radio.
    pub radio: RadioPreset,
    /// How many robots.
    pub robots: usize,
    /// Bytes of the packages that a robot made.
    pub map_bytes: f64,
    /// Bytes that a robot sent, with IP and UDP headers.
    pub sent_bytes: f64,
    /// The same of all robots as a multiple of the map.
    pub sent_per_map: f64,
    /// Of what was sent: requests, as a share of 1.
    pub request_share: f64,
    /// Median age of what was merged, from the end of its batch, in seconds.
    pub age_median_s: f64,
    /// The age that 99 % did not exceed, in seconds.
    pub age_99_s: f64,
    /// From the end of mapping until all agreed, in seconds; `None` if they never did.
    pub agreement_s: Option<f64>,
}

/// All rows of a table, in its order. What stands above the first row is left out.
///
/// # Errors
/// The line that is no row.
pub fn rows(table: &str) -> Result<Vec<TableRow>, String> {
    let mut lines = table.lines();
    lines
        .find(|line| line.split_whitespace().take(2).eq(["radio", "robots"]))
        .ok_or_else(|| "there is no table in it".to_owned())?;
    let lines = lines.filter(|line| !line.trim().is_empty());
    lines.map(|line| row(line).ok_or_else(|| format!("no row of a table: {line}"))).collect()
}

fn row(line: &str) -> Option<TableRow> {
    let (radio, figures) = line.split_once(' ')?;
    // Columns can touch: the unit of one stands right before a long number of the next.
    let figures = figures.replace(['%', 's'], " ");
    let mut figures = figures.split_whitespace();
    let mut next = || figures.next()?.parse::<f64>().ok().filter(|figure| *figure >= 0.0);
    let [robots, map_bytes, sent_bytes, sent_per_map, requests, _air] = array(&mut next)?;
    let [age_median_s, age_99_s, _bound] = array(&mut next)?;
    let agreement_s = match figures.next()? {
        "-" => None,
        figure => Some(figure.parse().ok()?),
    };
    let row = TableRow {
        radio: radio.parse().ok()?,
        robots: robots as usize,
        map_bytes,
        sent_bytes,
        sent_per_map,
        request_share: requests / 100.0,
        age_median_s,
        age_99_s,
        agreement_s,
    };
    figures.next().is_none().then_some(row)
}

fn array<const N: usize>(next: &mut impl FnMut() -> Option<f64>) -> Option<[f64; N]> {
    let mut all = [0.0; N];
    for figure in &mut all {
        *figure = next()?;
    }
    Some(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::swarm::table;

    #[test]
    fn a_row_that_was_written_is_read_back() {
        let flight = table::flight(RadioPreset::WifiLossy, 2, 1);
        let written = table::row(RadioPreset::WifiLossy, 2, core::slice::from_ref(&flight)).unwrap();
        let read = rows(&(table::head() + &written)).unwrap();
        let [row] = read.as_slice() else { panic!("{read:?}") };
        let packages: u64 = flight.robots.iter().map(|robot| robot.package_bytes).sum();
        let sent: u64 = flight.robots.iter().map(|robot| robot.bytes).sum();
        assert_eq!((row.radio, row.robots), (RadioPreset::WifiLossy, 2));
        assert!((row.map_bytes - packages as f64 / 2.0).abs() <= 0.5, "{row:?}");
        assert!((row.sent_bytes - sent as f64 / 2.0).abs() <= 0.5, "{row:?}");
        assert!((row.sent_per_map - sent as f64 / packages as f64).abs() <= 0.005, "{row:?}");
        assert!((row.agreement_s.unwrap() - flight.agreement_s.unwrap()).abs() <= 0.005, "{row:?}");
    }

    #[test]
    fn columns_that_touch_and_robots_that_never_agreed_are_read() {
        let line = "lora   100   5322     8778     1.72     23 %100.0 % 15.798 s133.535 s  17.0 s          -";
        let row = row(line).unwrap();
        assert_eq!((row.robots, row.age_99_s, row.agreement_s), (100, 133.535, None));
        assert_eq!((row.sent_per_map, row.request_share), (1.72, 0.23));
    }

    #[test]
    fn what_is_no_row_is_named() {
        assert!(rows("nothing").is_err());
        for line in
            ["lora 2 3", "lara  2 1 1 1 1 % 1 % 1 s 1 s 1 s 1 s", "lora  2 1 1 1 1 % 1 % 1 s 1 s 1 s 1 s 5"]
        {
            let error = rows(&format!("{}{line}\n", table::head())).unwrap_err();
            assert!(error.contains(line), "{error}");
        }
    }
}
