//! Figures between measured ones: straight lines between logarithms.

/// Where a value lies on an axis of measured ones.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Place {
    /// The measured value below it, or the one before the last.
    pub(super) low: usize,
    /// How far it is on the way to the next one, 0 to 1; beyond that outside of the axis.
    pub(super) share: f64,
}

impl Place {
    /// On an axis of at least two positive values that ascend.
    pub(super) fn on(axis: &[f64], value: f64) -> Self {
        let low = axis.iter().skip(1).take(axis.len().saturating_sub(2)).filter(|at| **at <= value).count();
        let (from, to) = (axis[low], axis[low + 1]);
        let share = if value == to { 1.0 } else { (value / from).ln() / (to / from).ln() };
        Self { low, share }
    }

    /// Whether it lies between the first and the last value of an axis of so many.
    pub(super) fn is_inside(self, values: usize) -> bool {
        (self.low > 0 || self.share >= 0.0) && (self.low + 2 < values || self.share <= 1.0)
    }
}

/// Between two positive figures; exactly these at 0 and 1.
pub(super) fn between(from: f64, to: f64, share: f64) -> f64 {
    if share == 0.0 {
        from
    } else if share == 1.0 {
        to
    } else {
        from * (to / from).powf(share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measured_values_are_met_exactly_and_what_is_outside_is_seen() {
        let axis = [0.1, 0.2, 0.4];
        assert_eq!(Place::on(&axis, 0.1), Place { low: 0, share: 0.0 });
        assert_eq!(Place::on(&axis, 0.2), Place { low: 1, share: 0.0 });
        assert_eq!(Place::on(&axis, 0.4), Place { low: 1, share: 1.0 });
        assert!([0.1, 0.15, 0.2, 0.3, 0.4].iter().all(|value| Place::on(&axis, *value).is_inside(3)));
        assert!([0.09, 0.41].iter().all(|value| !Place::on(&axis, *value).is_inside(3)));
        assert_eq!((between(3.0, 12.0, 0.0), between(3.0, 12.0, 1.0)), (3.0, 12.0));
        assert!((between(3.0, 12.0, 0.5) - 6.0).abs() < 1e-12);
    }
}
