//! Lines over one axis, a legend beside them, nothing else.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::prelude::*;

use super::{COLORS, ChartError, FONT, Figure, GRID, dots, extent, logarithmic_ticks, number};

/// Lines over two axes.
pub struct LineChart<'a> {
    /// Of both.
    pub axes: Axes,
    /// Above it.
    pub title: &'a str,
    /// Quantity and unit along the horizontal axis.
    pub x_label: &'a str,
    /// The same for the vertical one.
    pub y_label: &'a str,
    /// One line each, at least one with a point.
    pub lines: Vec<Line>,
}

/// How numbers become places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axes {
    /// Only positive numbers; each point is marked.
    Logarithmic,
    /// y from zero, or the least number below; lines without marks.
    Linear,
}

/// A line of a chart.
pub struct Line {
    /// In the legend.
    pub name: String,
    /// x ascending; only points that the axes have are drawn.
    pub points: Vec<(f64, f64)>,
}

const SIZE_PX: (u32, u32) = (1060, 560);
// Right of the plot: there it covers no line.
const LEGEND_PX: f64 = 200.0;

impl Line {
    fn drawn(&self, axes: Axes) -> impl Iterator<Item = (f64, f64)> + Clone + '_ {
        let is_on = move |v: f64| v.is_finite() && (v > 0.0 || axes == Axes::Linear);
        self.points.iter().copied().filter(move |(x, y)| is_on(*x) && is_on(*y))
    }
}

impl LineChart<'_> {
    fn extent(&self, coordinate: fn((f64, f64)) -> f64) -> Option<Range<f64>> {
        extent(self.lines.iter().flat_map(|line| line.drawn(self.axes)).map(coordinate))
    }

    // Logarithmic: from a little below the least to a little above the greatest.
    fn logarithmic(&self, coordinate: fn((f64, f64)) -> f64) -> Option<Range<f64>> {
        self.extent(coordinate).map(|e| e.start / 1.2..e.end * 1.2)
    }
}

/// Where things go, and how large a pixel is.
struct Layout<'a, B: DrawingBackend> {
    plot: &'a DrawingArea<B, Shift>,
    legend: &'a DrawingArea<B, Shift>,
    scale: f64,
}

impl Figure for LineChart<'_> {
    fn size_px(&self) -> Result<(u32, u32), ChartError> {
        self.extent(|p| p.0).map(|_| SIZE_PX).ok_or(ChartError::NothingToDraw)
    }

    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, scale: f64) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let (plot, legend) = area.split_horizontally(dots(f64::from(SIZE_PX.0) - LEGEND_PX, scale));
        let layout = Layout { plot: &plot, legend: &legend, scale };
        match self.axes {
            Axes::Logarithmic => {
                let (Some(x), Some(y)) = (self.logarithmic(|p| p.0), self.logarithmic(|p| p.1)) else { return Ok(()) };
                let ticks = [logarithmic_ticks(&x), logarithmic_ticks(&y)];
                let counts = ticks.each_ref().map(Vec::len);
                let [x_ticks, y_ticks] = ticks;
                self.plot(&layout, x.log_scale().with_key_points(x_ticks), y.log_scale().with_key_points(y_ticks), counts)
            }
            Axes::Linear => {
                let (Some(x), Some(y)) = (self.extent(|p| p.0), self.extent(|p| p.1)) else { return Ok(()) };
                let (low, high) = (y.start.min(0.0), y.end.max(0.0));
                // Nothing but zeros: an axis all the same.
                let high = if high > low { high + 0.05 * (high - low) } else { low + 1.0 };
                self.plot(&layout, x, low..high, [13, 9])
            }
        }
    }
}

impl LineChart<'_> {
    fn plot<B: DrawingBackend, X, Y>(
        &self,
        layout: &Layout<'_, B>,
        x: X,
        y: Y,
        ticks: [usize; 2],
    ) -> Result<(), DrawingAreaErrorKind<B::ErrorType>>
    where
        X: AsRangedCoord<Value = f64>,
        Y: AsRangedCoord<Value = f64>,
        X::CoordDescType: ValueFormatter<f64>,
        Y::CoordDescType: ValueFormatter<f64>,
    {
        let px = |pixels| dots(pixels, layout.scale);
        let letters = (FONT, px(12.0));
        let mut context = ChartBuilder::on(layout.plot)
            .caption(self.title, (FONT, px(20.0)))
            .margin(px(12.0))
            .x_label_area_size(px(44.0))
            .y_label_area_size(px(70.0))
            .build_cartesian_2d(x, y)?;
        context
            .configure_mesh()
            .x_desc(self.x_label)
            .y_desc(self.y_label)
            .x_labels(ticks[0])
            .y_labels(ticks[1])
            .bold_line_style(GRID)
            .label_style(letters)
            .x_label_formatter(&number)
            .y_label_formatter(&number)
            .draw()?;
        for (number, line) in self.lines.iter().enumerate() {
            let stroke = COLORS[number % COLORS.len()].stroke_width(px(2.0) as u32);
            let points: Vec<(f64, f64)> = line.drawn(self.axes).collect();
            // Past the last colour lines are dashed.
            match number / COLORS.len() {
                0 => drop(context.draw_series(LineSeries::new(points.iter().copied(), stroke))?),
                _ => drop(context.draw_series(DashedLineSeries::new(points.iter().copied(), px(6.0) as u32, px(4.0) as u32, stroke))?),
            }
            if self.axes == Axes::Logarithmic {
                context.draw_series(points.iter().map(|at| Circle::new(*at, px(3.0), stroke)))?;
            }
            let top = px(40.0 + 20.0 * number as f64);
            let sample = (0..if number < COLORS.len() { 1 } else { 2 }).map(|dash| (dash, if number < COLORS.len() { 18.0 } else { 7.0 }));
            for (dash, length) in sample {
                let left = px(11.0 * f64::from(dash));
                layout.legend.draw(&PathElement::new([(left, top), (left + px(length), top)], stroke))?;
            }
            layout.legend.draw(&Text::new(line.name.clone(), (px(26.0), top - px(6.0)), letters))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::svg;
    use super::*;

    fn chart(points: Vec<(f64, f64)>) -> LineChart<'static> {
        LineChart {
            axes: Axes::Logarithmic,
            title: "misses",
            x_label: "faces",
            y_label: "%",
            lines: vec![Line { name: "lru".into(), points }],
        }
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
    fn every_line_is_told_apart_and_named_beside_the_plot() {
        let line = |number: usize| Line { name: format!("policy {number}"), points: vec![(1.0, 1.0 + number as f64), (9.0, 2.0)] };
        let lines: Vec<Line> = (0..COLORS.len() + 1).map(line).collect();
        let text = svg(&LineChart { lines, ..chart(vec![]) }).unwrap();
        let names: Vec<&str> = text.lines().filter(|l| l.starts_with("policy ")).collect();
        assert_eq!(names.len(), COLORS.len() + 1, "{names:?}");
        // The first colour again, in dashes: more pieces than a line has.
        let first = |stroke: &&str| stroke.contains("#0072B2");
        assert!(text.lines().filter(first).count() > 10, "{text}");
        let right = f64::from(SIZE_PX.0) - LEGEND_PX;
        let left_of = |l: &&str| l.split("x=\"").nth(1).and_then(|x| x.split('"').next()).and_then(|x| x.parse::<f64>().ok());
        let places: Vec<f64> = text.split("<text").skip(1).filter(|t| t.contains("policy ")).filter_map(|t| left_of(&t)).collect();
        assert!(places.len() == names.len() && places.iter().all(|x| *x >= right), "{places:?}");
    }

    #[test]
    fn linear_axes_have_zero_and_numbers_below() {
        let text = svg(&LineChart { axes: Axes::Linear, ..chart(vec![(-90.0, 0.25), (0.0, 0.0), (90.0, -0.5)]) }).unwrap();
        // One line of three points, without marks.
        let line = text.split("<polyline").skip(1).find(|l| l.contains("#0072B2")).unwrap();
        let points: Vec<&str> = line.split("points=\"").nth(1).unwrap().split('"').next().unwrap().split_whitespace().collect();
        assert_eq!((points.len(), text.matches("<circle").count()), (3, 0), "{line}");
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        assert!(svg(&chart(vec![(0.0, 1.0), (1.0, f64::NAN)])).is_err());
    }
}
