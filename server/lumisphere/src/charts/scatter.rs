//! Points of two quantities, their areas a third: what costs how much and is how good. The front of the best is drawn through them.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::cartesian::Cartesian2d;
use plotters::coord::combinators::{LogCoord, WithKeyPoints};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::TextStyle;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{COLORS, ChartError, FAINT_GRID, FONT, Figure, GRID, dots, extent, logarithmic_ticks, number};

/// Panels below each other, whose points belong to the same series.
#[derive(Debug, Clone)]
pub struct Scatter {
    /// At least one, each with a point.
    pub panels: Vec<Panel>,
    /// Names; each has a colour and, beyond seven, a shape of its own.
    pub series: Vec<String>,
    /// What a mark's area means.
    pub size_label: String,
    /// Areas for the legend.
    pub sizes: Vec<SizeKey>,
}

/// One set of points that compare with each other.
#[derive(Debug, Clone)]
pub struct Panel {
    /// Above it.
    pub title: String,
    /// Quantity and unit along the horizontal, logarithmic axis.
    pub x_label: String,
    /// The same along the vertical one, which begins at 0 unless all points lie far above it.
    pub y_label: String,
    /// The points.
    pub marks: Vec<Mark>,
}

/// A point.
#[derive(Debug, Clone)]
pub struct Mark {
    /// Positive.
    pub x: f64,
    /// Not negative.
    pub y: f64,
    /// In proportion to its area; not negative.
    pub size: f64,
    /// Index into the chart's series.
    pub series: usize,
    /// Where it is on the front: its two lines in the list of the front's points. The front is drawn through these.
    pub on_front: Option<[String; 2]>,
}

/// An area of the legend.
#[derive(Debug, Clone)]
pub struct SizeKey {
    /// As `Mark::size`.
    pub size: f64,
    /// What it says.
    pub text: String,
}

const WIDTH_PX: u32 = 1020;
const LEGEND_PX: f64 = 340.0;
const LEAST_HEIGHT_PX: u32 = 440;
const GREATEST_RADIUS_PX: f64 = 17.0;
/// A mark of nothing is still seen.
const LEAST_RADIUS_PX: f64 = 3.0;
/// Of the greatest value: where the least is above, the lower part of a panel would be empty.
const FAR_ABOVE_0: f64 = 0.6;
const LINE_PX: f64 = 19.0;
const TEXT_PX: f64 = 13.0;
const SMALL_TEXT_PX: f64 = 11.5;
const GREY: RGBColor = RGBColor(95, 95, 95);
const INK: RGBColor = RGBColor(30, 30, 30);

impl Mark {
    fn is_drawn(&self) -> bool {
        (1e-9..1e15).contains(&self.x) && (0.0..1e15).contains(&self.y)
    }
}

impl Panel {
    fn drawn(&self) -> impl Iterator<Item = &Mark> + Clone {
        self.marks.iter().filter(|m| m.is_drawn())
    }

    // The front's points from left to right.
    fn front(&self) -> Vec<&Mark> {
        let mut front: Vec<&Mark> = self.drawn().filter(|m| m.on_front.is_some()).collect();
        front.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
        front
    }

    // A little more than what the points span: a mark at the end is not cut.
    fn ranges(&self) -> Option<(Range<f64>, Range<f64>)> {
        let (x, y) = (extent(self.drawn().map(|m| m.x))?, extent(self.drawn().map(|m| m.y))?);
        let margin = (x.end / x.start).powf(0.1).max(1.12);
        let bottom = if y.start > FAR_ABOVE_0 * y.end { y.start - 0.3 * (y.end - y.start) - 0.05 * y.end } else { 0.0 };
        let top = if y.end > 0.0 { y.end + 0.12 * (y.end - bottom) } else { 1.0 };
        Some((x.start / margin..x.end * margin, bottom..top))
    }
}

impl Scatter {
    // Series that have a point in the panel.
    fn series_of(&self, panel: &Panel) -> Vec<usize> {
        (0..self.series.len()).filter(|s| panel.drawn().any(|m| m.series == *s)).collect()
    }

    fn panel_height_px(&self, panel: &Panel) -> u32 {
        // The legend's lines: series, areas with their heading, front with its heading and two lines a point.
        let lines = self.series_of(panel).len() as f64 + 2.6 + 2.0 * self.sizes.len() as f64 + 1.6 + 2.0 * panel.front().len() as f64;
        LEAST_HEIGHT_PX.max((60.0 + lines * LINE_PX) as u32)
    }

    fn radius_px(&self, size: f64) -> f64 {
        let greatest = self.panels.iter().flat_map(|p| p.drawn()).map(|m| m.size).fold(0.0, f64::max);
        if greatest > 0.0 { (GREATEST_RADIUS_PX * (size / greatest).sqrt()).max(LEAST_RADIUS_PX) } else { LEAST_RADIUS_PX }
    }
}

impl Figure for Scatter {
    fn size_px(&self) -> Result<(u32, u32), ChartError> {
        if self.panels.is_empty() || self.panels.iter().any(|p| p.ranges().is_none()) {
            return Err(ChartError::NothingToDraw);
        }
        Ok((WIDTH_PX, self.panels.iter().map(|p| self.panel_height_px(p)).sum()))
    }

    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, scale: f64) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let mut rest = area.clone();
        for panel in &self.panels {
            let (top, below) = rest.split_vertically(dots(f64::from(self.panel_height_px(panel)), scale));
            let (plot, legend) = top.split_horizontally(dots(f64::from(WIDTH_PX) - LEGEND_PX, scale));
            self.draw_points(panel, &plot, scale)?;
            self.draw_legend(panel, &legend, scale)?;
            rest = below;
        }
        Ok(())
    }
}

impl Scatter {
    fn draw_points<B: DrawingBackend>(
        &self,
        panel: &Panel,
        area: &DrawingArea<B, Shift>,
        scale: f64,
    ) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let Some((x, y)) = panel.ranges() else { return Ok(()) };
        let px = |pixels| dots(pixels, scale);
        let ticks = logarithmic_ticks(&x);
        let mut context = ChartBuilder::on(area)
            .caption(&panel.title, (FONT, px(16.0)))
            .margin(px(10.0))
            .x_label_area_size(px(46.0))
            .y_label_area_size(px(58.0))
            .build_cartesian_2d(x.clone().log_scale().with_key_points(ticks.clone()), y.clone())?;
        context
            .configure_mesh()
            .x_desc(&panel.x_label)
            .y_desc(&panel.y_label)
            .x_labels(ticks.len())
            .y_labels(8)
            .max_light_lines(2)
            .label_style((FONT, px(TEXT_PX)))
            .x_label_formatter(&number)
            .y_label_formatter(&number)
            .bold_line_style(GRID)
            .light_line_style(FAINT_GRID)
            .draw()?;
        let front = panel.front();
        let stairs = stairs(&front, &x, &y);
        context.draw_series(std::iter::once(PathElement::new(stairs, GREY.stroke_width(px(1.5) as u32))))?;
        let mut marks: Vec<&Mark> = panel.drawn().collect();
        // Large ones first: none hides a small one.
        marks.sort_by(|a, b| b.size.total_cmp(&a.size));
        for mark in marks {
            let at = context.backend_coord(&(mark.x, mark.y));
            draw_mark(area, relative(area, at), px(self.radius_px(mark.size)), mark.series, px(1.0))?;
        }
        let spots = self.label_spots(&context, &front, px(TEXT_PX), scale);
        for (number, spot) in spots.iter().enumerate() {
            area.draw(&Text::new(
                (number + 1).to_string(),
                relative(area, *spot),
                letters(px(TEXT_PX), &INK).pos(Pos::new(HPos::Center, VPos::Center)),
            ))?;
        }
        Ok(())
    }

    // Where the numbers of the front's points stand: beside the mark, first on the side where nothing better can lie, and on no other number
    // and no mark of the front.
    fn label_spots<B: DrawingBackend>(
        &self,
        context: &ChartContext<'_, B, Axes>,
        front: &[&Mark],
        height: i32,
        scale: f64,
    ) -> Vec<(i32, i32)> {
        let place = |mark: &Mark| (context.backend_coord(&(mark.x, mark.y)), dots(self.radius_px(mark.size), scale));
        let places: Vec<((i32, i32), i32)> = front.iter().map(|mark| place(mark)).collect();
        let is_covered = |spot: (i32, i32)| {
            let covers = |((x, y), radius): &((i32, i32), i32)| (x - spot.0).pow(2) + (y - spot.1).pow(2) < (radius + height / 2).pow(2);
            places.iter().any(covers)
        };
        let mut spots: Vec<(i32, i32)> = Vec::new();
        for ((x, y), radius) in &places {
            let away = f64::from(radius + 3 * height / 4);
            let candidates: Vec<(i32, i32)> = [1.0, 1.5, 2.0, 2.5]
                .iter()
                .flat_map(|far| [135.0f64, 90.0, 180.0, 60.0, 225.0, 0.0].map(|degrees| (far * away, degrees.to_radians())))
                .map(|(far, angle)| (x + (far * angle.cos()).round() as i32, y + (far * angle.sin()).round() as i32))
                .collect();
            let is_written =
                |spot: (i32, i32)| spots.iter().any(|s| (s.0 - spot.0).abs() < height * 3 / 2 && (s.1 - spot.1).abs() < height);
            let free = candidates.iter().find(|spot| !is_written(**spot) && !is_covered(**spot));
            spots.push(*free.unwrap_or(&candidates[0]));
        }
        spots
    }

    fn draw_legend<B: DrawingBackend>(
        &self,
        panel: &Panel,
        area: &DrawingArea<B, Shift>,
        scale: f64,
    ) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let px = |pixels| dots(pixels, scale);
        let (text_left, mark_at) = (px(44.0), px(22.0));
        let mut pen = Pen { area, y: 40.0, scale };
        for series in self.series_of(panel) {
            draw_mark(area, (mark_at, px(pen.y)), px(6.0), series, px(1.0))?;
            pen.write(&self.series[series], text_left, TEXT_PX, &INK, 1.0)?;
        }
        pen.y += 0.6 * LINE_PX;
        pen.write(&self.size_label, px(8.0), TEXT_PX, &INK, 1.5)?;
        for key in &self.sizes {
            let circle = Circle::new((mark_at, px(pen.y)), px(self.radius_px(key.size)), GREY.stroke_width(px(1.0) as u32));
            area.draw(&circle)?;
            pen.write(&key.text, text_left, TEXT_PX, &INK, 2.0)?;
        }
        pen.y += 0.6 * LINE_PX;
        area.draw(&PathElement::new([(px(8.0), px(pen.y)), (px(36.0), px(pen.y))], GREY.stroke_width(px(1.5) as u32)))?;
        pen.write("Pareto front, from the fastest", text_left, TEXT_PX, &INK, 1.0)?;
        for (number, mark) in panel.front().iter().enumerate() {
            let [name, figures] = mark.on_front.as_ref().map_or(["", ""], |[a, b]| [a.as_str(), b.as_str()]);
            pen.mark_number(number + 1, px(22.0))?;
            pen.write(name, text_left, SMALL_TEXT_PX, &INK, 0.85)?;
            pen.write(figures, text_left, SMALL_TEXT_PX, &GREY, 1.15)?;
        }
        Ok(())
    }
}

// The horizontal axis with ticks of its own, and the vertical one.
type Axes = Cartesian2d<WithKeyPoints<LogCoord<f64>>, RangedCoordf64>;

// Writes line after line.
struct Pen<'a, B: DrawingBackend> {
    area: &'a DrawingArea<B, Shift>,
    // SVG pixels from the area's top to the middle of the next line.
    y: f64,
    scale: f64,
}

impl<B: DrawingBackend> Pen<'_, B> {
    fn write(
        &mut self,
        text: &str,
        left: i32,
        size_px: f64,
        color: &'static RGBColor,
        lines: f64,
    ) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let style = letters(dots(size_px, self.scale), color).pos(Pos::new(HPos::Left, VPos::Center));
        let room = self.area.dim_in_pixel().0 as i32 - left - dots(8.0, self.scale);
        let text = fitted(text, |t| self.area.estimate_text_size(t, &style).is_ok_and(|(width, _)| width as i32 <= room));
        self.area.draw(&Text::new(text, (left, dots(self.y, self.scale)), style))?;
        self.y += lines * LINE_PX;
        Ok(())
    }

    fn mark_number(&self, number: usize, x: i32) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
        let style = letters(dots(TEXT_PX, self.scale), &INK).pos(Pos::new(HPos::Center, VPos::Center));
        self.area.draw(&Text::new(number.to_string(), (x, dots(self.y, self.scale)), style))
    }
}

fn letters(height: i32, color: &'static RGBColor) -> TextStyle<'static> {
    TextStyle::from((FONT, height).into_font()).color(color)
}

// The text, or as much of its beginning as fits, with an ellipsis.
fn fitted(text: &str, fits: impl Fn(&str) -> bool) -> String {
    if fits(text) {
        return text.to_string();
    }
    let ends = text.char_indices().map(|(at, _)| at).rev();
    ends.map(|at| format!("{}…", text[..at].trim_end())).find(|t| fits(t)).unwrap_or_default()
}

// Of a point that the backend knows, in the area's own dots.
fn relative<B: DrawingBackend>(area: &DrawingArea<B, Shift>, (x, y): (i32, i32)) -> (i32, i32) {
    let (left, top) = area.get_base_pixel();
    (x - left, y - top)
}

fn draw_mark<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    (x, y): (i32, i32),
    radius: i32,
    series: usize,
    stroke: i32,
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    let color = COLORS[series % COLORS.len()];
    let (fill, line) = (color.mix(0.35).filled(), color.stroke_width(stroke as u32));
    let corners = |corners: &[(f64, f64)]| {
        let at = |(i, j): &(f64, f64)| (x + (i * f64::from(radius)).round() as i32, y + (j * f64::from(radius)).round() as i32);
        corners.iter().map(at).collect::<Vec<_>>()
    };
    // Shapes of one area, about.
    let outline = match series / COLORS.len() {
        0 => {
            area.draw(&Circle::new((x, y), radius, fill))?;
            return area.draw(&Circle::new((x, y), radius, line));
        }
        1 => corners(&[(-0.89, -0.89), (0.89, -0.89), (0.89, 0.89), (-0.89, 0.89)]),
        _ => corners(&[(0.0, -1.4), (1.3, 0.85), (-1.3, 0.85)]),
    };
    area.draw(&Polygon::new(outline.clone(), fill))?;
    area.draw(&PathElement::new([&outline[..], &outline[..1]].concat(), line))
}

// Right of and above this line every point is beaten.
fn stairs(front: &[&Mark], x: &Range<f64>, y: &Range<f64>) -> Vec<(f64, f64)> {
    let mut corners = Vec::new();
    let mut height = y.end;
    for mark in front {
        corners.push((mark.x, height));
        corners.push((mark.x, mark.y));
        height = mark.y;
    }
    if !corners.is_empty() {
        corners.push((x.end, height));
    }
    corners
}

#[cfg(test)]
mod tests {
    use super::super::svg;
    use super::*;

    fn mark(x: f64, y: f64, size: f64, series: usize, on_front: Option<&str>) -> Mark {
        Mark { x, y, size, series, on_front: on_front.map(|t| [t.to_string(), "figures".to_string()]) }
    }

    fn scatter(marks: Vec<Mark>) -> Scatter {
        let panel = Panel { title: "mirror <1>".into(), x_label: "ms".into(), y_label: "error".into(), marks };
        let sizes = vec![SizeKey { size: 4e6, text: "4 MB".into() }];
        Scatter { panels: vec![panel], series: vec!["distance".into(), "unused".into()], size_label: "area: bytes".into(), sizes }
    }

    #[test]
    fn a_mark_a_point_with_areas_in_proportion_and_the_front_listed() {
        let text = svg(&scatter(vec![
            mark(1.0, 3.0, 4e6, 0, Some("fast & rough")),
            mark(10.0, 1.0, 1e6, 0, Some("slow")),
            mark(f64::NAN, 1.0, 1e6, 0, None),
        ]))
        .unwrap();
        // Two points as fill and outline; the legend's series the same; one area.
        assert_eq!(text.matches("<circle").count(), 2 * 2 + 2 + 1);
        // A quarter of the bytes is half the radius: 17 and 8.5, rounded.
        assert_eq!((text.matches("r=\"17\"").count(), text.matches("r=\"9\"").count()), (3, 2));
        for part in ["mirror &lt;1&gt;", "fast &amp; rough", "slow", "distance", "4 MB", "area: bytes"] {
            assert!(text.contains(part), "no {part} in {text}");
        }
        assert!(!text.contains("unused"), "a series without a point is in the legend");
    }

    #[test]
    fn the_vertical_axis_begins_at_0_unless_all_points_are_far_above() {
        let bottom =
            |least: f64| scatter(vec![mark(1.0, least, 1.0, 0, None), mark(2.0, 10.0, 1.0, 0, None)]).panels[0].ranges().unwrap().1;
        assert_eq!(bottom(5.0).start, 0.0);
        assert!(bottom(8.0).start > 6.0 && bottom(8.0).start < 8.0 && bottom(8.0).end > 10.0);
        assert!(bottom(10.0).start < 10.0);
    }

    #[test]
    fn the_front_is_a_staircase_to_the_edges() {
        let (a, b) = (mark(2.0, 3.0, 1.0, 0, Some("")), mark(4.0, 1.0, 1.0, 0, Some("")));
        assert_eq!(stairs(&[&a, &b], &(1.0..8.0), &(0.0..5.0)), [(2.0, 5.0), (2.0, 3.0), (4.0, 3.0), (4.0, 1.0), (8.0, 1.0)]);
    }

    #[test]
    fn the_legend_grows_with_the_front_and_long_names_are_cut() {
        let short = scatter(vec![mark(1.0, 1.0, 1.0, 0, Some("a"))]).size_px().unwrap().1;
        let many = (0..30).map(|k| mark(1.0 + f64::from(k), 30.0 - f64::from(k), 1.0, 0, Some("a"))).collect();
        assert!(scatter(many).size_px().unwrap().1 > short + 800);
        assert_eq!(fitted("points 40, face 64", |t| t.chars().count() <= 10), "points 40…");
        assert_eq!(fitted("short", |_| true), "short");
    }

    #[test]
    fn a_panel_without_a_point_is_an_error() {
        assert!(matches!(svg(&scatter(vec![mark(0.0, 1.0, 1.0, 0, None)])), Err(ChartError::NothingToDraw)));
    }
}
