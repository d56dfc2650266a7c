//! Lines over axes and bars, coloured by the page that they stand in. Only lines stretch with the width;
//! words are as large on a phone as on a desk.

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

/// Width and height of the field of lines, in its own units: the page stretches it.
const FIELD: f64 = 1_000.0;
/// A logarithmic axis shows at most so many decades below its top.
const DECADES_MAX: f64 = 9.0;
/// Over so many decades at most, 2 and 5 are marked besides 1.
const FINE_DECADES_MAX: f64 = 3.0;

/// The chart and its legend.
pub fn lines(x_axis: Axis<'_>, y_axis: Axis<'_>, lines: &[Line<'_>]) -> Markup {
    let x_range = Range::of(x_axis.scale, lines.iter().flat_map(|line| &line.points).map(|point| point.0));
    let y_range = Range::of(y_axis.scale, lines.iter().flat_map(|line| &line.points).map(|point| point.1));
    // Time and the like fill the width; heights end at a round number.
    let y_range = y_range.rounded();
    let x = |value: f64| format!("{:.1}", x_range.share(value) * FIELD);
    let y = |value: f64| format!("{:.1}", (1.0 - y_range.share(value)) * FIELD);
    let points = |line: &Line<'_>| {
        let points = line.points.iter().map(|(at, value)| format!("{},{}", x(*at), y(*value)));
        points.collect::<Vec<_>>().join(" ")
    };
    let place = |side: &str, share: f64| format!("{side}:{:.2}%", share * 100.0);
    html! {
        div.chart role="img" aria-label={ (y_axis.label) " over " (x_axis.label) } {
            p.label { (y_axis.label) }
            div.plot {
                svg viewBox={ "0 0 " (FIELD) " " (FIELD) } preserveAspectRatio="none" {
                    @for value in y_range.ticks(5.0) {
                        @let at = y(value);
                        line.grid x1="0" x2=(FIELD) y1=(at) y2=(at) {}
                    }
                    @for line in lines { polyline class={ "line " (line.class) } points=(points(line)) {} }
                }
                @for value in y_range.ticks(5.0) {
                    span.tick.up style=(place("bottom", y_range.share(value))) { (label(value)) }
                }
                @for value in x_range.ticks(6.0) {
                    span.tick.along style=(place("left", x_range.share(value))) { (label(value)) }
                }
            }
            p.label.mid { (x_axis.label) }
        }
        p.legend {
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

    /// To the next round number.
    fn rounded(self) -> Self {
        match self.scale {
            Scale::Linear => {
                let step = step_of(self.high / 5.0);
                Self { high: (self.high / step).ceil() * step, ..self }
            }
            Scale::Log => {
                let marks = self.marks();
                let low = marks.iter().rev().find(|mark| **mark <= self.low * (1.0 + 1e-9));
                let high = marks.iter().find(|mark| **mark >= self.high * (1.0 - 1e-9));
                Self { low: *low.unwrap_or(&self.low), high: *high.unwrap_or(&self.high), ..self }
            }
        }
    }

    /// The round values of a logarithmic axis, from below its low end to above its high one.
    fn marks(&self) -> Vec<f64> {
        let is_fine = (self.high / self.low).log10() <= FINE_DECADES_MAX;
        let steps: &[f64] = if is_fine { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let decades = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        decades.flat_map(|decade| steps.iter().map(move |step| step * 10f64.powi(decade))).collect()
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
                let inside = self.low * (1.0 - 1e-9)..=self.high * (1.0 + 1e-9);
                self.marks().into_iter().filter(|mark| inside.contains(mark)).collect()
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
        let range = Range { scale: Scale::Log, low: 12.0, high: 340.0 }.rounded();
        assert_eq!(range.ticks(5.0), [10.0, 20.0, 50.0, 100.0, 200.0, 500.0]);
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
            let chart = lines(axis, axis, &[Line::per_second("a", "ours", values)]).into_string();
            assert!(
                chart.contains("<polyline") && !chart.contains("NaN") && !chart.contains("inf"),
                "{chart}"
            );
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
