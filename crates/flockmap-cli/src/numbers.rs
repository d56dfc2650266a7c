//! Numbers as people read them.

use indicatif::HumanCount;

/// A whole number with a comma at each thousand.
pub fn thousands(number: u64) -> String {
    HumanCount(number).to_string()
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
    fn numbers_read_well() {
        assert_eq!(thousands(0), "0");
        assert_eq!(thousands(999), "999");
        assert_eq!(thousands(1_234_567), "1,234,567");
        assert_eq!(percent(1.0), "100 %");
        assert_eq!(percent(0.999_999_999), "99.9999 %");
        assert_eq!([0.999_999, 0.5, 1.0].map(percent_short), ["99.9 %", "50.0 %", "100 %"]);
    }
}
