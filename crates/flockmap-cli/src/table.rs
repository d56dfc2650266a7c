//! Tables of text, and numbers as people read them.

use std::fmt;

/// Rows of cells; the first column is set left, the others right.
#[derive(Default)]
pub struct Table {
    rows: Vec<Vec<String>>,
}

/// One column of rows of `R`: its heading, and its cell in a row.
pub type Column<'a, R> = (&'static str, &'a dyn Fn(&R) -> String);

impl Table {
    /// A table with these headings.
    pub fn new<S: Into<String>>(headings: impl IntoIterator<Item = S>) -> Self {
        Self { rows: vec![headings.into_iter().map(Into::into).collect()] }
    }

    /// A table with a row for each of these: headings, and what stands below them.
    pub fn of<R>(rows: &[R], columns: &[Column<'_, R>]) -> Self {
        let mut table = Self::new(columns.iter().map(|(heading, _)| *heading));
        rows.iter().for_each(|row| table.row(columns.iter().map(|(_, cell)| cell(row))));
        table
    }

    /// One row more.
    pub fn row<S: Into<String>>(&mut self, cells: impl IntoIterator<Item = S>) {
        self.rows.push(cells.into_iter().map(Into::into).collect());
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |column: usize| {
            self.rows
                .iter()
                .filter_map(|row| row.get(column))
                .map(|cell| cell.chars().count())
                .max()
                .unwrap_or(0)
        };
        let widths: Vec<usize> = (0..columns).map(width).collect();
        for (number, row) in self.rows.iter().enumerate() {
            let mut line = String::from("  ");
            for (column, cell) in row.iter().enumerate() {
                let width = widths[column];
                if column == 0 {
                    line += &format!("{cell:<width$}");
                } else {
                    line += &format!("  {cell:>width$}");
                }
            }
            writeln!(f, "{}", line.trim_end())?;
            if number == 0 {
                let all: usize = widths.iter().sum::<usize>() + 2 * columns.saturating_sub(1);
                writeln!(f, "  {}", "─".repeat(all))?;
            }
        }
        Ok(())
    }
}

/// A whole number with a comma at each thousand.
pub fn thousands(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// A share as per cent: exactly "100 %" only if it is 1.
pub fn percent(share: f64) -> String {
    if share >= 1.0 { "100 %".to_owned() } else { format!("{:.4} %", (share * 1e6).floor() / 1e4) }
}

/// As [`percent`], with one digit.
pub fn percent_short(share: f64) -> String {
    if share >= 1.0 { "100 %".to_owned() } else { format!("{:.1} %", (share * 1e3).floor() / 10.0) }
}

/// Bytes as kilobytes of 1,024 bytes with one digit.
pub fn kb(bytes: f64) -> String {
    let kb = bytes / 1024.0;
    if kb >= 1000.0 { thousands(kb.round() as u64) } else { format!("{kb:.2}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_line_up() {
        let mut table = Table::new(["name", "bytes"]);
        table.row(["a", "1"]);
        table.row(["längst", "1,000,000"]);
        let text = table.to_string();
        let ends: Vec<usize> = text.lines().map(|l| l.chars().count()).collect();
        assert!(ends.windows(2).all(|w| w[0] == w[1]), "{text}");
    }

    #[test]
    fn numbers_read_well() {
        assert_eq!(thousands(0), "0");
        assert_eq!(thousands(999), "999");
        assert_eq!(thousands(1_234_567), "1,234,567");
        assert_eq!(percent(1.0), "100 %");
        assert_eq!(percent(0.999_999_999), "99.9999 %");
        assert_eq!([0.999_999, 0.5, 1.0].map(percent_short), ["99.9 %", "50.0 %", "100 %"]);
    }
}
