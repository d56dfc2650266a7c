//! Lines over an axis as SVG and bars as HTML, coloured by the page that they stand in.

use maud::{Markup, html};

/// How values lie along an axis.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// Even steps from 0 on.
    Linear,
    /// A decade has the same width everywhere. What is not above 0 lies at its low end.
    Log,
}

/// An axis with what it says.
#[derive(Clone, Copy)]
pub struct Axis<'a> {
    pub label: &'a str,
    pub scale: Scale,
}

/// A line of a chart.
pub struct Line<'a> {
    pub name: &'a str,
    /// Class of the page's style that gives the colour.
    pub class: &'a str,
    /// x and y, x ascending.
    pub points: Vec<(f64, f64)>,
}

impl<'a> Line<'a> {
    /// A value for each second from 0 on.
    pub fn per_second(name: &'a str, class: &'a str, values: &[f64]) -> Self {
        let points = values.iter().enumerate().map(|(second, value)| (second as f64, *value));
        Self { name, class, points: points.collect() }
    }
}

/// A bar: name, class, length, and the length as text.
pub struct Bar {
    pub name: String,
    pub class: &'static str,
    pub value: f64,
    pub text: String,
}

/// Classes of the page's style for lines that only have to differ, in the order of use.
pub const COLOURS: [&str; 8] = ["c1", "c2", "c3", "c4", "c5", "c6", "c7", "c8"];

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 320.0;
const LEFT: f64 = 84.0;
const RIGHT: f64 = 22.0;
const TOP: f64 = 20.0;
const BOTTOM: f64 = 58.0;
/// A logarithmic axis shows at most so many decades below its top.
const DECADES_MAX: f64 = 9.0;

/// The chart and its legend.
pub fn svg(x_axis: Axis<'_>, y_axis: Axis<'_>, lines: &[Line<'_>]) -> Markup {
    let x_range = Range::of(x_axis.scale, lines.iter().flat_map(|line| &line.points).map(|point| point.0));
    let y_range = Range::of(y_axis.scale, lines.iter().flat_map(|line| &line.points).map(|point| point.1));
    // Time and the like fill the width; heights end at a round number.
    let y_range = y_range.rounded();
    let x = |value: f64| LEFT + x_range.share(value) * (WIDTH - LEFT - RIGHT);
    let y = |value: f64| HEIGHT - BOTTOM - y_range.share(value) * (HEIGHT - TOP - BOTTOM);
    let tenths = |at: f64| format!("{at:.1}");
    let points = |line: &Line<'_>| {
        let points = line.points.iter().map(|(at, value)| format!("{:.1},{:.1}", x(*at), y(*value)));
        points.collect::<Vec<_>>().join(" ")
    };
    html! {
        svg.chart viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img"
            aria-label={ (y_axis.label) " over " (x_axis.label) } {
            @for value in y_range.ticks(5.0) {
                @let at = tenths(y(value));
                line.grid x1=(LEFT) x2=(WIDTH - RIGHT) y1=(at) y2=(at) {}
                text.axis.end x=(LEFT - 8.0) y=(tenths(y(value) + 5.0)) { (label(value)) }
            }
            @for value in x_range.ticks(6.0) {
                text.axis.mid x=(tenths(x(value))) y=(HEIGHT - BOTTOM + 24.0) { (label(value)) }
            }
            text.axis.mid x=((LEFT + WIDTH - RIGHT) / 2.0) y=(HEIGHT - 4.0) { (x_axis.label) }
            @for line in lines { polyline class={ "line " (line.class) } points=(points(line)) {} }
        }
        p.legend {
            "Upwards: " (y_axis.label) ". "
            @for line in lines {
                span.entry { span class={ "key " (line.class) } {} (line.name) } " "
            }
        }
    }
}

/// Bars from the left, the longest over the whole width.
pub fn bars(bars: &[Bar]) -> Markup {
    let largest = bars.iter().fold(0.0f64, |a, b| a.max(b.value)).max(1e-300);
    let width = |bar: &Bar| format!("width:{:.2}%", (bar.value / largest * 100.0).clamp(0.0, 100.0));
    html! {
        div.bars {
            @for bar in bars {
                span { (bar.name) }
                div.track { i class={ "key " (bar.class) } style=(width(bar)) {} }
                b { (bar.text) }
            }
        }
    }
}

/// What an axis spans.
struct Range {
    scale: Scale,
    low: f64,
    high: f64,
}

impl Range {
    fn of(scale: Scale, values: impl Iterator<Item = f64> + Clone) -> Self {
        let finite = values.filter(|value| value.is_finite());
        let high = finite.clone().fold(0.0f64, f64::max);
        let high = if high > 0.0 { high } else { 1.0 };
        match scale {
            Scale::Linear => Self { scale, low: 0.0, high },
            Scale::Log => {
                let low = finite.filter(|value| *value > 0.0).fold(high, f64::min);
                let low = if low < high { low } else { high / 10.0 };
                Self { scale, low: low.max(high * 10f64.powf(-DECADES_MAX)), high }
            }
        }
    }

    /// To the next decade, or the next round number.
    fn rounded(self) -> Self {
        match self.scale {
            Scale::Linear => {
                let step = step_of(self.high / 5.0);
                Self { high: (self.high / step).ceil() * step, ..self }
            }
            Scale::Log => Self {
                low: 10f64.powf(self.low.log10().floor()),
                high: 10f64.powf(self.high.log10().ceil()),
                ..self
            },
        }
    }

    /// Where a value lies, 0 at the low end and 1 at the high one.
    fn share(&self, value: f64) -> f64 {
        let share = match self.scale {
            Scale::Linear => (value - self.low) / (self.high - self.low),
            Scale::Log => {
                (value.max(self.low).log10() - self.low.log10()) / (self.high.log10() - self.low.log10())
            }
        };
        if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 }
    }

    /// Round values along the axis, about so many.
    fn ticks(&self, about: f64) -> Vec<f64> {
        match self.scale {
            Scale::Linear => {
                let step = step_of((self.high - self.low) / about);
                let count = ((self.high - self.low) / step + 1e-9).floor() as u32;
                (0..=count).map(|number| self.low + f64::from(number) * step).collect()
            }
            Scale::Log => {
                let first = (self.low.log10() - 1e-9).ceil() as i32;
                let last = (self.high.log10() + 1e-9).floor() as i32;
                (first..=last).map(|decade| 10f64.powi(decade)).collect()
            }
        }
    }
}

/// A round number in few characters: 0.1, 100, 10k, 1M.
fn label(value: f64) -> String {
    let (scaled, unit) = match value.abs() {
        v if v >= 1e9 => (value / 1e9, "G"),
        v if v >= 1e6 => (value / 1e6, "M"),
        v if v >= 1e3 => (value / 1e3, "k"),
        _ => (value, ""),
    };
    // Ticks are round: six digits after the point drop what floating point adds.
    format!("{}{unit}", (scaled * 1e6).round() / 1e6)
}

/// 1, 2 or 5 times a power of ten, not below the width.
fn step_of(width: f64) -> f64 {
    let power = 10f64.powf(width.max(1e-6).log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|m| m * power)
        .find(|s| *s >= width * (1.0 - 1e-9))
        .unwrap_or(power * 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round() {
        assert_eq!([1.0, 1.5, 7.0, 43.0, 51.0].map(step_of), [1.0, 2.0, 10.0, 50.0, 100.0]);
        let range = Range { scale: Scale::Linear, low: 0.0, high: 37.0 }.rounded();
        assert_eq!(range.ticks(5.0), [0.0, 10.0, 20.0, 30.0, 40.0]);
        let range = Range { scale: Scale::Log, low: 0.03, high: 40.0 }.rounded();
        assert_eq!(range.ticks(5.0).len(), 5);
    }

    #[test]
    fn labels_are_short() {
        let values = [0.0001, 0.1, 1.0, 100.0, 1e3, 1e4, 1e6, 2.5e7, 1e9];
        assert_eq!(values.map(label), ["0.0001", "0.1", "1", "100", "1k", "10k", "1M", "25M", "1G"]);
    }

    #[test]
    fn a_chart_of_nothing_is_still_a_chart() {
        for values in [&[][..], &[0.0], &[0.0, 0.0, 1e9], &[f64::NAN, f64::INFINITY]] {
            let axis = Axis { label: "a", scale: Scale::Log };
            let svg = svg(axis, axis, &[Line::per_second("a", "ours", values)]).into_string();
            assert!(svg.starts_with("<svg") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
        let bar = |value| Bar { name: String::new(), class: "c1", value, text: String::new() };
        assert!(bars(&[bar(0.0)]).into_string().contains("width:0.00%"));
        assert!(bars(&[bar(2.0), bar(4.0)]).into_string().contains("width:50.00%"));
    }

    #[test]
    fn values_lie_where_the_axis_says() {
        let range = Range { scale: Scale::Log, low: 1.0, high: 100.0 };
        assert_eq!([0.0, 1.0, 10.0, 100.0, 1e9].map(|v| range.share(v)), [0.0, 0.0, 0.5, 1.0, 1.0]);
    }
}
