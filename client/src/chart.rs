//! Charts as SVG: lines over one axis, a legend, nothing else.

use anyhow::anyhow;
use plotters::prelude::*;

/// What a chart shows.
pub struct Chart<'a> {
    /// Above it.
    pub title: &'a str,
    /// Quantity and unit along the horizontal axis.
    pub x_label: &'a str,
    /// The same for the vertical one.
    pub y_label: &'a str,
    /// One line each, at least one with a point.
    pub lines: Vec<Line>,
}

/// A line of a chart.
pub struct Line {
    /// In the legend.
    pub name: String,
    /// x ascending; both axes are logarithmic, so only positive points are drawn.
    pub points: Vec<(f64, f64)>,
}

const SIZE_PX: (u32, u32) = (900, 560);
/// Told apart by those who do not see red and green apart, too (Okabe and Ito 2008).
const COLORS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(230, 159, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(213, 94, 0),
    RGBColor(0, 0, 0),
];

/// The chart as an SVG document, both axes logarithmic.
pub fn svg(chart: &Chart<'_>) -> anyhow::Result<String> {
    let lines: Vec<(&str, Vec<(f64, f64)>)> = chart
        .lines
        .iter()
        .map(|l| {
            (l.name.as_str(), l.points.iter().copied().filter(|(x, y)| *x > 0.0 && *y > 0.0 && x.is_finite() && y.is_finite()).collect())
        })
        .collect();
    let points = || lines.iter().flat_map(|(_, points)| points);
    let (x, y) = (range(points().map(|p| p.0)), range(points().map(|p| p.1)));
    let (Some(x), Some(y)) = (x, y) else { return Err(anyhow!("nothing to draw: no line has a positive point")) };
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, SIZE_PX).into_drawing_area();
        draw(&area, chart, &lines, x, y).map_err(|e| anyhow!("cannot draw: {e}"))?;
        area.present().map_err(|e| anyhow!("cannot draw: {e}"))?;
    }
    Ok(text)
}

fn draw<'a>(
    area: &DrawingArea<SVGBackend<'a>, plotters::coord::Shift>,
    chart: &Chart<'_>,
    lines: &[(&str, Vec<(f64, f64)>)],
    x: std::ops::Range<f64>,
    y: std::ops::Range<f64>,
) -> Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>> {
    area.fill(&WHITE)?;
    let mut context = ChartBuilder::on(area)
        .caption(chart.title, ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(44)
        .y_label_area_size(70)
        .build_cartesian_2d(x.log_scale(), y.log_scale())?;
    let number = |v: &f64| if *v >= 0.01 && *v < 1e6 { format!("{}", (*v * 1e4).round() / 1e4) } else { format!("{v:.0e}") };
    context
        .configure_mesh()
        .x_desc(chart.x_label)
        .y_desc(chart.y_label)
        .x_label_formatter(&number)
        .y_label_formatter(&number)
        .light_line_style(RGBColor(240, 240, 240))
        .draw()?;
    for ((name, points), color) in lines.iter().zip(COLORS.iter().cycle()) {
        let series = context.draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)).point_size(3))?;
        series.label(*name).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
    }
    context.configure_series_labels().background_style(WHITE.mix(0.85)).border_style(RGBColor(200, 200, 200)).draw()
}

/// From a little below the least to a little above the greatest; None without values.
fn range(values: impl Iterator<Item = f64>) -> Option<std::ops::Range<f64>> {
    let (low, high) = values.fold((f64::INFINITY, 0.0f64), |(low, high), v| (low.min(v), high.max(v)));
    (low <= high).then_some(low / 1.2..high * 1.2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(points: Vec<(f64, f64)>) -> Chart<'static> {
        Chart { title: "misses", x_label: "faces", y_label: "%", lines: vec![Line { name: "lru".into(), points }] }
    }

    #[test]
    fn a_chart_names_its_axes_and_lines_and_draws_every_positive_point() {
        let text = svg(&chart(vec![(2.0, 24.9), (4.0, 18.7), (8.0, 0.0), (16.0, 14.0)])).unwrap();
        for part in ["misses", "faces", "lru", "<polyline"] {
            assert!(text.contains(part), "no {part} in {text}");
        }
        assert_eq!(text.matches("<circle").count(), 3);
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        assert!(svg(&chart(vec![(0.0, 1.0), (1.0, f64::NAN)])).is_err());
    }
}
