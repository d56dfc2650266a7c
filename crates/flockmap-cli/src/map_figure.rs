//! Pictures of maps with what flew in them: paths, robots and a scale bar over a map, in a page or as a file.

use flockmap::Stamp;
use maud::{Markup, html};

use crate::picture::Picture;
use crate::program::command_line;

/// A map with what is drawn over it.
pub struct MapFigure {
    picture: Picture,
    title: String,
    caption: String,
    flown: Vec<Flown>,
}

/// Where a robot flew until the picture was taken.
pub struct Path<'a> {
    /// As which it is known to people.
    pub number: usize,
    /// Whether the map is this robot's.
    pub is_own: bool,
    /// When it was where, in metres in the map's frame.
    pub places: &'a [(Stamp, [f64; 3])],
}

/// The same in pixels.
struct Flown {
    number: usize,
    is_own: bool,
    places: Vec<[f64; 2]>,
}

/// Sizes of what is drawn are for a picture of this width, which is about that on a screen.
const WIDTH: f64 = 360.0;
/// Width of a panel of a file.
const PANEL: f64 = 440.0;
/// Between the panels of a file, and around them.
const GAP: f64 = 16.0;
/// Height of the line above a panel, and of the one below it.
const TEXT: f64 = 26.0;
/// Height of a line of the legend.
const LEGEND: f64 = 19.0;

/// Colours of a file of its own, which stands on any ground: those of a light page.
const STYLE: &str = "text{font-family:system-ui,sans-serif;fill:#1c1b29}.soft{fill:#5d5b70}.ground{fill:#fbfbfd}\
.path{fill:none;stroke-linejoin:round;stroke-linecap:round}.path.halo{stroke:#fff}.path.self{stroke:#d9480f}.path.mate{stroke:#1467b8}\
.robot{stroke:#fff}.robot.self{fill:#d9480f}.robot.mate{fill:#1467b8}.number{fill:#fff;font-weight:700;text-anchor:middle}\
.bar{fill:#1c1b29}.plate{fill:#fff;opacity:.8}";

impl MapFigure {
    /// A picture with the paths up to a time. The caption ends with the size of what is seen.
    pub fn new(picture: Picture, title: String, caption: &str, paths: &[Path<'_>], until: Stamp) -> Self {
        let step = f64::from(picture.width) / WIDTH;
        let flown = |path: &Path<'_>| {
            let mut places: Vec<[f64; 2]> = Vec::new();
            let before = path.places.iter().take_while(|(stamp, _)| *stamp <= until);
            let mut last = None;
            for place in before.map(|(_, place)| picture.pixel_of(*place)) {
                let is_far = |from: &[f64; 2]| (from[0] - place[0]).hypot(from[1] - place[1]) >= step;
                if places.last().is_none_or(is_far) {
                    places.push(place);
                }
                last = Some(place);
            }
            places.extend(last);
            Flown { number: path.number, is_own: path.is_own, places }
        };
        // The map's own robot lies on top.
        let mut flown: Vec<Flown> =
            paths.iter().map(flown).filter(|flown| !flown.places.is_empty()).collect();
        flown.sort_by_key(|flown| flown.is_own);
        let [wide, high] = [picture.width, picture.height].map(|pixels| f64::from(pixels) * picture.pixel_m);
        let caption = format!("{caption}; {wide:.0} × {high:.0} m");
        Self { picture, title, caption, flown }
    }

    /// As a figure of a page.
    pub fn markup(&self) -> Markup {
        let Picture { width, height, .. } = &self.picture;
        html! {
            figure {
                @if !self.title.is_empty() { b { (self.title) } }
                // A tall map is no higher than the screen.
                div.map style={ "max-width:" (format!("{:.0}", 80.0 * f64::from(*width) / f64::from(*height))) "vh" } {
                    img alt={ "Map: " (self.title) " " (self.caption) } width=(width) height=(height)
                        src=(self.picture.data_url());
                    svg viewBox={ "0 0 " (width) " " (height) } aria-hidden="true" { (self.overlay()) }
                }
                figcaption { (self.caption) }
            }
        }
    }

    /// Paths, robots and the scale bar, in pixels of the picture.
    fn overlay(&self) -> Markup {
        let unit = f64::from(self.picture.width) / WIDTH;
        let height = f64::from(self.picture.height);
        let of = |units: f64| format!("{:.2}", units * unit);
        let bar_m = bar_metres(WIDTH * unit * self.picture.pixel_m / 4.0);
        let bar = bar_m / self.picture.pixel_m;
        let foot = |units: f64| format!("{:.2}", height - units * unit);
        html! {
            @for flown in &self.flown {
                @let points = points(&flown.places);
                @let class = if flown.is_own { "self" } else { "mate" };
                polyline.path.halo points=(points) stroke-width=(of(4.5)) {}
                polyline class={ "path " (class) } points=(points) stroke-width=(of(2.2)) {}
            }
            @for flown in &self.flown {
                @let class = if flown.is_own { "self" } else { "mate" };
                @if let Some([x, y]) = flown.places.last() {
                    circle class={ "robot " (class) } cx=(format!("{x:.1}")) cy=(format!("{y:.1}")) r=(of(9.0))
                        stroke-width=(of(1.5)) {}
                    text.number x=(format!("{x:.1}")) y=(format!("{:.1}", y + 4.5 * unit)) font-size=(of(12.5)) {
                        (flown.number)
                    }
                }
            }
            rect.plate x=(of(6.0)) y=(foot(34.0)) width=(format!("{:.2}", bar + 16.0 * unit)) height=(of(28.0))
                rx=(of(4.0)) {}
            rect.bar x=(of(14.0)) y=(foot(14.0)) width=(format!("{bar:.2}")) height=(of(3.0)) {}
            text.scale x=(of(14.0)) y=(foot(18.5)) font-size=(of(13.0)) { (bar_m) " m" }
        }
    }
}

/// Figures side by side as an SVG file, which needs no other one. `title` stands above, the lines of `legend`
/// below.
pub fn svg_file(title: &str, legend: &[String], figures: &[MapFigure]) -> String {
    let scaled =
        |figure: &MapFigure| f64::from(figure.picture.height) * PANEL / f64::from(figure.picture.width);
    let panel = figures.iter().map(scaled).fold(0.0, f64::max).round();
    let width = figures.len() as f64 * (PANEL + GAP) + GAP;
    let top = 2.0 * TEXT + GAP / 2.0;
    let foot = top + panel + TEXT;
    let height = foot + legend.len() as f64 * LEGEND + GAP;
    html! {
        svg xmlns="http://www.w3.org/2000/svg" viewBox={ "0 0 " (width) " " (height) } width=(width) height=(height) {
            desc { "Made by " (command_line()) }
            style { (STYLE) }
            rect.ground width=(width) height=(height) rx="10" {}
            text x=(GAP) y=(TEXT) font-size="17" font-weight="600" { (title) }
            @for (number, figure) in figures.iter().enumerate() {
                @let Picture { width, height, .. } = &figure.picture;
                @let left = GAP + number as f64 * (PANEL + GAP);
                text x=(left) y=(2.0 * TEXT) font-size="15" font-weight="600" { (figure.title) }
                g transform={ "translate(" (left) " " (top) ") scale(" (format!("{:.5}", PANEL / f64::from(*width))) ")" } {
                    image width=(width) height=(height) href=(figure.picture.data_url())
                        style="image-rendering:pixelated" {}
                    (figure.overlay())
                }
                text.soft x=(left) y=(foot - 6.0) font-size="13" { (figure.caption) }
            }
            @for (number, line) in legend.iter().enumerate() {
                text.soft x=(GAP) y=(foot + (number as f64 + 1.0) * LEGEND) font-size="13" { (line) }
            }
        }
    }
    .into_string()
}

fn points(places: &[[f64; 2]]) -> String {
    places.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect::<Vec<_>>().join(" ")
}

/// 1, 2 or 5 times a power of ten, not above so many metres.
fn bar_metres(at_most: f64) -> f64 {
    let power = 10f64.powf(at_most.max(1e-3).log10().floor());
    let fits = |steps: &f64| steps * power <= at_most * (1.0 + 1e-9);
    [5.0, 2.0, 1.0].into_iter().find(fits).unwrap_or(1.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Picture {
        Picture { png: vec![1, 2, 3], width: 360, height: 220, pixel_m: 0.1, corner_m: [-10.0, 5.0] }
    }

    #[test]
    fn a_place_lies_where_the_map_is_drawn() {
        assert_eq!(picture().pixel_of([-10.0, 5.0, 9.0]), [0.0, 220.0]);
        assert_eq!(picture().pixel_of([26.0, 27.0, 0.0]), [360.0, 0.0]);
    }

    #[test]
    fn a_path_ends_where_the_robot_is_when_the_picture_is_taken() {
        let places: Vec<_> = (0..100).map(|i| (Stamp(i * 100_000), [i as f64 * 0.01, 10.0, 1.0])).collect();
        let path = |is_own| Path { number: 1 + usize::from(is_own), is_own, places: &places };
        let figure =
            MapFigure::new(picture(), "t".to_owned(), "c", &[path(true), path(false)], Stamp(5_000_000));
        let own = figure.flown.last().unwrap();
        assert!(own.is_own, "the own path lies on top");
        // 50 steps of a centimetre are 5 pixels: about one point each, and the last place.
        assert!((5..=7).contains(&own.places.len()), "{:?}", own.places);
        let near = |place: [f64; 2], x: f64| (place[0] - x).abs() < 1e-9 && (place[1] - 170.0).abs() < 1e-9;
        assert!(
            near(own.places[0], 100.0) && near(own.places[own.places.len() - 1], 105.0),
            "{:?}",
            own.places
        );
        let none = MapFigure::new(picture(), "t".to_owned(), "c", &[path(true)], Stamp(-1));
        assert!(none.flown.is_empty(), "nothing has flown yet");
    }

    #[test]
    fn the_scale_bar_is_round_and_no_longer_than_it_may_be() {
        assert_eq!(
            [11.0, 10.0, 9.9, 4.0, 0.3, 1_999.0].map(bar_metres),
            [10.0, 10.0, 5.0, 2.0, 0.2, 1_000.0]
        );
        let figure = MapFigure::new(picture(), "t".to_owned(), "c", &[], Stamp(0));
        // 36 m wide: a quarter is 9 m, and 5 m are 50 pixels.
        let drawn = figure.markup().into_string();
        assert!(drawn.contains("width=\"50.00\"") && drawn.contains(">5 m<"), "{drawn}");
    }

    #[test]
    fn a_file_of_its_own_needs_no_other() {
        let file = svg_file(
            "T",
            &["l".to_owned()],
            &[MapFigure::new(picture(), "a & b".to_owned(), "c", &[], Stamp(0))],
        );
        assert!(
            file.starts_with("<svg xmlns=") && file.contains("a &amp; b") && file.contains("data:image/png")
        );
        assert!(!file.contains("class=\"map\"") && !file.contains("var("), "colours of its own");
    }
}
