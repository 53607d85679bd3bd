//! Lines over one axis, a legend, nothing else.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::{COLORS, ChartError, FONT, Figure, GRID, dots, extent, logarithmic_ticks, number};

/// Lines over two logarithmic axes.
pub struct LineChart<'a> {
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
    /// x ascending; only finite and positive points are drawn.
    pub points: Vec<(f64, f64)>,
}

const SIZE_PX: (u32, u32) = (900, 560);

impl Line {
    fn drawn(&self) -> impl Iterator<Item = (f64, f64)> + Clone + '_ {
        self.points.iter().copied().filter(|(x, y)| *x > 0.0 && *y > 0.0 && x.is_finite() && y.is_finite())
    }
}

impl LineChart<'_> {
    // From a little below the least to a little above the greatest.
    fn range(&self, coordinate: fn((f64, f64)) -> f64) -> Option<std::ops::Range<f64>> {
        let values = self.lines.iter().flat_map(Line::drawn).map(coordinate);
        extent(values).map(|e| e.start / 1.2..e.end * 1.2)
    }
}

impl Figure for LineChart<'_> {
    fn size_px(&self) -> Result<(u32, u32), ChartError> {
        self.range(|p| p.0).map(|_| SIZE_PX).ok_or(ChartError::NothingToDraw)
    }

    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, scale: f64) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let (Some(x), Some(y)) = (self.range(|p| p.0), self.range(|p| p.1)) else { return Ok(()) };
        let px = |pixels| dots(pixels, scale);
        let letters = (FONT, px(12.0));
        let (x_ticks, y_ticks) = (logarithmic_ticks(&x), logarithmic_ticks(&y));
        let mut context = ChartBuilder::on(area)
            .caption(self.title, (FONT, px(20.0)))
            .margin(px(12.0))
            .x_label_area_size(px(44.0))
            .y_label_area_size(px(70.0))
            .build_cartesian_2d(x.log_scale().with_key_points(x_ticks.clone()), y.log_scale().with_key_points(y_ticks.clone()))?;
        context
            .configure_mesh()
            .x_desc(self.x_label)
            .y_desc(self.y_label)
            .x_labels(x_ticks.len())
            .y_labels(y_ticks.len())
            .bold_line_style(GRID)
            .label_style(letters)
            .x_label_formatter(&number)
            .y_label_formatter(&number)
            .draw()?;
        for (line, color) in self.lines.iter().zip(COLORS.iter().cycle()) {
            let stroke = color.stroke_width(px(2.0) as u32);
            let series = context.draw_series(LineSeries::new(line.drawn(), stroke).point_size(px(3.0) as u32))?;
            series.label(&line.name).legend(move |(x, y)| PathElement::new([(x, y), (x + px(18.0), y)], stroke));
        }
        let frame = RGBColor(200, 200, 200);
        context
            .configure_series_labels()
            .label_font(letters)
            .legend_area_size(px(26.0))
            .background_style(WHITE.mix(0.85))
            .border_style(frame)
            .draw()
    }
}

#[cfg(test)]
mod tests {
    use super::super::svg;
    use super::*;

    fn chart(points: Vec<(f64, f64)>) -> LineChart<'static> {
        LineChart { title: "misses", x_label: "faces", y_label: "%", lines: vec![Line { name: "lru".into(), points }] }
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
