//! Options that are out of their range.

use thiserror::Error;

/// An option that is out of its range.
#[derive(Clone, PartialEq, Debug, Error)]
#[error("{name} is {value}, expected {expected}")]
pub struct OptionError {
    /// The option.
    pub name: &'static str,
    /// What it was.
    pub value: f64,
    /// What it may be.
    pub expected: &'static str,
}

/// An option: its name, its value, the lowest and the highest that it may be, and the same in words.
pub type Limit = (&'static str, f64, f64, f64, &'static str);

impl OptionError {
    /// Whether every option is in its range.
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(limits: &[Limit]) -> Result<(), Self> {
        let is_out = |(_, value, low, high, _): &&Limit| !(low <= value && value <= high);
        limits
            .iter()
            .find(is_out)
            .map_or(Ok(()), |&(name, value, _, _, expected)| Err(Self { name, value, expected }))
    }
}
