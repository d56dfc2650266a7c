//! Lines over time as SVG, coloured by the page that it stands in.

use core::fmt::Write;

/// A line of the chart.
pub struct Line<'a> {
    pub name: &'a str,
    /// Class of the page's style that gives the colour.
    pub class: &'a str,
    /// A value for each second.
    pub values: &'a [f64],
}

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 64.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 20.0;
const BOTTOM: f64 = 48.0;

/// KB in each second on a logarithmic axis, so that lines a factor of ten apart can both be read. A second with nothing lies on the
/// floor of the axis.
pub fn kb_per_second(lines: &[Line<'_>]) -> String {
    let seconds = lines.iter().map(|line| line.values.len()).max().unwrap_or(0).max(2);
    let largest = lines.iter().flat_map(|line| line.values).fold(1.0f64, |a, b| a.max(*b));
    let positive = lines.iter().flat_map(|line| line.values).filter(|v| **v > 0.0);
    let smallest = positive.fold(largest, |a, b| a.min(*b));
    let top = largest.log10().ceil().max(1.0);
    let floor = smallest.max(0.1).log10().floor().min(top - 1.0);
    let x = |second: f64| LEFT + second / (seconds - 1) as f64 * (WIDTH - LEFT - RIGHT);
    let y = |value: f64| {
        let share = (value.max(1e-9).log10().max(floor) - floor) / (top - floor);
        HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)
    };
    let mut svg = format!(
        "<svg class=\"chart\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"KB sent in each second\">"
    );
    for decade in floor as i32..=top as i32 {
        let at = y(10f64.powi(decade));
        let value = label(decade);
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{}\" y1=\"{at:.1}\" y2=\"{at:.1}\"/><text class=\"axis end\" x=\"{}\" y=\"{:.1}\">{value}</text>",
            WIDTH - RIGHT,
            LEFT - 8.0,
            at + 5.0
        );
    }
    let step = step_of(seconds as f64 / 6.0);
    let mut second = 0.0;
    while second < seconds as f64 {
        let at = x(second);
        let _ = write!(
            svg,
            "<text class=\"axis mid\" x=\"{at:.1}\" y=\"{}\">{second}</text>",
            HEIGHT - BOTTOM + 20.0
        );
        second += step;
    }
    let _ = write!(
        svg,
        "<text class=\"axis mid\" x=\"{}\" y=\"{}\">time in s</text>",
        (LEFT + WIDTH - RIGHT) / 2.0,
        HEIGHT - 4.0
    );
    for line in lines {
        let mut points = String::new();
        for (second, value) in line.values.iter().enumerate() {
            let _ = write!(points, "{:.1},{:.1} ", x(second as f64), y(*value));
        }
        let _ = write!(svg, "<polyline class=\"line {}\" points=\"{}\"/>", line.class, points.trim_end());
    }
    svg += "</svg><p class=\"legend\">";
    for line in lines {
        let _ = write!(svg, "<span class=\"key {}\"></span>{} ", line.class, line.name);
    }
    svg += "</p>";
    svg
}

/// A power of ten in few characters: 0.1, 100, 10k.
fn label(decade: i32) -> String {
    if decade < 3 { 10f64.powi(decade).to_string() } else { format!("{}k", 10f64.powi(decade - 3)) }
}

/// 1, 2 or 5 times a power of ten, not below the width.
fn step_of(width: f64) -> f64 {
    let power = 10f64.powf(width.max(1.0).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= width).unwrap_or(power * 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round() {
        assert_eq!([0.3, 1.0, 1.5, 7.0, 43.0, 51.0].map(step_of), [1.0, 1.0, 2.0, 10.0, 50.0, 100.0]);
    }

    #[test]
    fn labels_are_short() {
        assert_eq!([-1, 0, 2, 3, 4, 6].map(label), ["0.1", "1", "100", "1k", "10k", "1000k"]);
    }

    #[test]
    fn a_chart_of_nothing_is_still_a_chart() {
        for values in [&[][..], &[0.0], &[0.0, 0.0, 1e9]] {
            let svg = kb_per_second(&[Line { name: "a", class: "ours", values }]);
            assert!(svg.starts_with("<svg") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}
