//! Small line and dot plots as SVG text: no fonts, no scripts, colours that follow the page's light or dark
//! scheme.

use std::fmt::Write;

use use3d_numerics::math;

/// One curve or cloud of points.
#[derive(Clone, Debug)]
pub struct Series {
    /// The name in the legend.
    pub label: String,
    /// Any CSS colour.
    pub color: &'static str,
    /// The points; non-finite ones are left out.
    pub points: Vec<(f64, f64)>,
    /// Dots instead of a line.
    pub dots: bool,
    /// The name of each dot, in the order of the points; empty if the position is enough.
    pub names: Vec<String>,
}

impl Series {
    /// A curve.
    pub fn line(label: &str, color: &'static str, points: Vec<(f64, f64)>) -> Self {
        Self { label: label.into(), color, points, dots: false, names: Vec::new() }
    }
}

/// A plot.
#[derive(Clone, Debug)]
pub struct Plot {
    /// The title above the plot.
    pub title: String,
    /// The label below the horizontal axis.
    pub x_label: String,
    /// Logarithmic vertical axis (non-positive values are left out).
    pub log_y: bool,
    /// The curves and dots.
    pub series: Vec<Series>,
}

/// Colours of the three channels, readable on light and dark backgrounds.
pub const RGB: [&str; 3] = ["#e0525c", "#3aa76d", "#3d8fd1"];

const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 240.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 34.0;

impl Plot {
    /// The SVG element.
    pub fn svg(&self) -> String {
        let y_of = |y: f64| if self.log_y { math::log10(y) } else { y };
        let usable = |p: &&(f64, f64)| p.0.is_finite() && y_of(p.1).is_finite();
        let all = || self.series.iter().flat_map(|s| s.points.iter().filter(usable));
        let (mut x0, mut x1, mut y0, mut y1) = (f64::MAX, f64::MIN, f64::MAX, f64::MIN);
        for p in all() {
            (x0, x1) = (x0.min(p.0), x1.max(p.0));
            (y0, y1) = (y0.min(y_of(p.1)), y1.max(y_of(p.1)));
        }
        let title = escape(&self.title);
        let mut out = format!(
            "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" xmlns=\"http://www.w3.org/2000/svg\" font-family=\"system-ui,sans-serif\" font-size=\"11\" fill=\"currentColor\"><title>{title}</title><text x=\"{LEFT}\" y=\"16\" font-size=\"13\" font-weight=\"600\">{title}</text>"
        );
        if x0 > x1 {
            let _ = write!(out, "<text x=\"{LEFT}\" y=\"{}\">no data</text></svg>", HEIGHT / 2.0);
            return out;
        }
        if x1 - x0 < 1e-12 {
            (x0, x1) = (x0 - 0.5, x1 + 0.5);
        }
        let margin = if y1 - y0 < 1e-12 { y1.abs().max(1e-6) * 0.05 } else { 0.04 * (y1 - y0) };
        (y0, y1) = (y0 - margin, y1 + margin);
        let px = |x: f64| LEFT + (x - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT);
        let py = |y: f64| HEIGHT - BOTTOM - (y - y0) / (y1 - y0) * (HEIGHT - TOP - BOTTOM);

        let (right, below, edge) = (WIDTH - RIGHT, HEIGHT - BOTTOM + 15.0, LEFT - 6.0);
        for value in if self.log_y { log_ticks(y0, y1) } else { ticks(y0, y1, 5) } {
            let (y, value) = (py(y_of(value)), short(value));
            let base = y + 4.0;
            let _ = write!(
                out,
                "<line x1=\"{LEFT}\" x2=\"{right}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"currentColor\" stroke-opacity=\".15\"/><text x=\"{edge}\" y=\"{base:.1}\" text-anchor=\"end\">{value}</text>"
            );
        }
        for tick in ticks(x0, x1, 6) {
            let (x, tick) = (px(tick), short(tick));
            let _ = write!(out, "<text x=\"{x:.1}\" y=\"{below}\" text-anchor=\"middle\">{tick}</text>");
        }
        let (bottom, label) = (HEIGHT - 5.0, escape(&self.x_label));
        let _ = write!(
            out,
            "<text x=\"{right}\" y=\"{bottom}\" text-anchor=\"end\" fill-opacity=\".7\">{label}</text>"
        );
        let mut legend = LEFT;
        for series in &self.series {
            let color = series.color;
            let shown = series.points.iter().enumerate().filter(|(_, point)| usable(point));
            if series.dots {
                for (i, (at, value)) in shown.clone() {
                    let (x, y) = (px(*at), py(y_of(*value)));
                    let place = || format!("{} {}", self.x_label, short(*at));
                    let name = escape(&series.names.get(i).cloned().unwrap_or_else(place));
                    let value = short(*value);
                    let _ = write!(
                        out,
                        "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.6\" fill=\"{color}\" fill-opacity=\".75\"><title>{name}: {value}</title></circle>"
                    );
                }
            } else {
                let place = |(_, p): (usize, &(f64, f64))| format!("{:.1},{:.1}", px(p.0), py(y_of(p.1)));
                let path = shown.clone().map(place).collect::<Vec<_>>().join(" ");
                let _ = write!(
                    out,
                    "<polyline points=\"{path}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.6\" stroke-linejoin=\"round\"/>"
                );
            }
            if !series.label.is_empty() && shown.count() > 0 {
                let (text, label) = (legend + 14.0, escape(&series.label));
                let _ = write!(
                    out,
                    "<rect x=\"{legend}\" y=\"25\" width=\"10\" height=\"10\" rx=\"2\" fill=\"{color}\"/><text x=\"{text}\" y=\"34\">{label}</text>"
                );
                legend += 26.0 + 6.2 * series.label.chars().count() as f64;
            }
        }
        out.push_str("</svg>");
        out
    }
}

/// Plots one below the other, as an SVG document on white paper.
pub fn column(plots: &[Plot]) -> String {
    let height = HEIGHT * plots.len() as f64;
    let mut out = format!(
        "<svg viewBox=\"0 0 {WIDTH} {height}\" xmlns=\"http://www.w3.org/2000/svg\"><rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>"
    );
    for (i, plot) in plots.iter().enumerate() {
        let svg = plot.svg();
        let inner = svg.strip_prefix("<svg ").unwrap_or(&svg);
        let _ = write!(out, "<svg y=\"{}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" {inner}", HEIGHT * i as f64);
    }
    out + "</svg>\n"
}

/// Round numbers between `low` and `high`, about `count` of them.
fn ticks(low: f64, high: f64, count: usize) -> Vec<f64> {
    let raw = (high - low) / count as f64;
    let power = math::powf(10f64, math::log10(raw).floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= raw).unwrap_or(raw);
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last.min(first + 20)).map(|i| i as f64 * step).collect()
}

/// Round values of a logarithmic axis from `10^low` to `10^high`: evenly spaced values if the range is about
/// a decade or less, else powers of ten.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    if high - low < 1.3 {
        let even = ticks(math::powf(10f64, low), math::powf(10f64, high), 4);
        return even.into_iter().filter(|value| *value > 0.0).collect();
    }
    let step = ((high - low) / 6.0).ceil().max(1.0) as usize;
    (low.ceil() as i64..=high.floor() as i64)
        .step_by(step)
        .map(|power| math::powf(10f64, power as f64))
        .collect()
}

/// A number in at most about six characters.
fn short(value: f64) -> String {
    let magnitude = value.abs();
    if value == 0.0 {
        "0".into()
    } else if !(1e-3..1e6).contains(&magnitude) {
        format!("{value:.0e}")
    } else if magnitude >= 1000.0 {
        let thousands = value / 1000.0;
        if thousands.fract().abs() < 1e-9 { format!("{thousands:.0}k") } else { format!("{thousands:.1}k") }
    } else {
        let text = format!("{value:.3}");
        text.trim_end_matches('0').trim_end_matches('.').to_string()
    }
}

/// Text escaped for XML.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_draws_finite_points_inside_its_frame_and_escapes_text() {
        let points = vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 100.0), (3.0, -1.0)];
        let series = Series {
            label: "a<b".into(),
            color: RGB[0],
            points,
            dots: true,
            names: ["one", "two", "thr<ee"].map(String::from).into(),
        };
        let plot = Plot { title: "t & u".into(), x_label: "step".into(), log_y: true, series: vec![series] };
        let svg = plot.svg();
        assert_eq!(svg.matches("<circle").count(), 2);
        assert!(
            svg.contains("t &amp; u")
                && svg.contains("a&lt;b")
                && svg.contains("<title>thr&lt;ee: 100</title>")
                && !svg.contains("NaN")
        );
        let empty = Plot { series: Vec::new(), ..plot.clone() };
        assert!(empty.svg().contains("no data"));
        let both = column(&[plot, empty]);
        assert!(both.starts_with("<svg viewBox=\"0 0 420 480\"") && both.ends_with("</svg></svg>\n"));
        assert_eq!((both.matches("<svg").count(), both.matches("</svg>").count()), (3, 3));
        assert!(both.contains("<svg y=\"240\" width=\"420\" height=\"240\" viewBox"), "{both}");
    }

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 10.0, 5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert!(ticks(0.013, 0.097, 5).iter().all(|t| (0.013..=0.097).contains(t)));
        // Values such as 0.178 and 0.063 are not round.
        let shown = |low, high| log_ticks(low, high).into_iter().map(short).collect::<Vec<_>>();
        assert_eq!(shown(-0.76, -0.57), ["0.2", "0.25"]);
        assert_eq!(shown(-2.2, 1.1), ["0.01", "0.1", "1", "10"]);
        assert_eq!(
            [short(15000.0), short(0.25), short(1e-5), short(1500.0)],
            ["15k", "0.25", "1e-5", "1.5k"]
        );
    }
}
