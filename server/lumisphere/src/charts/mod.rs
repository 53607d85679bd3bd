//! Charts, as SVG and as PNG from the same drawing code. Whoever measures draws with these: `evaluate`, and the client's load and cache
//! reports. A chart knows no light: it shows numbers.
//!
//! Lettering is measured (and, in a PNG, drawn) with a subset of DejaVu Sans that lies beside this file, so that a chart is the same on
//! every machine; an SVG leaves the letters to its viewer's own sans-serif.

mod lettering;
mod lines;
mod scatter;

use std::ops::Range;
use std::sync::Once;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::register_font;
use thiserror::Error;

use crate::images::{ImageError, Rgb8, encode_png};

use lettering::Lettered;

pub use lines::{Axes, Line, LineChart};
pub use scatter::{Mark, Panel, Scatter, SizeKey};

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
const GRID: RGBColor = RGBColor(225, 225, 225);
const FAINT_GRID: RGBColor = RGBColor(240, 240, 240);
const FONT: &str = "sans-serif";
static FONT_BYTES: &[u8] = include_bytes!("DejaVuSans-subset.ttf");
/// Dots of a PNG along one pixel of the SVG.
const PNG_SCALE: u32 = 2;

/// Why there is no chart.
#[derive(Debug, Error)]
pub enum ChartError {
    /// No point can be shown on its axes.
    #[error("nothing to draw: no point is finite and, on a logarithmic axis, positive")]
    NothingToDraw,
    /// The drawing code failed.
    #[error("cannot draw: {0}")]
    Draw(String),
    /// The PNG cannot be encoded.
    #[error(transparent)]
    Encode(#[from] ImageError),
}

/// Something that can be drawn.
pub trait Figure {
    /// Size as SVG, pixels.
    fn size_px(&self) -> Result<(u32, u32), ChartError>;

    /// Onto a white area of that size times `scale`, which all lengths are multiplied by.
    fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, scale: f64) -> Result<(), DrawingAreaErrorKind<B::ErrorType>>;
}

/// The figure as an SVG document.
pub fn svg(figure: &impl Figure) -> Result<String, ChartError> {
    let mut text = String::new();
    let size = figure.size_px()?;
    draw(figure, SVGBackend::with_string(&mut text, size).into_drawing_area(), 1)?;
    Ok(text)
}

/// The figure as a PNG, twice as large as the SVG.
pub fn png(figure: &impl Figure) -> Result<Vec<u8>, ChartError> {
    let (width, height) = figure.size_px()?;
    let (width, height) = (PNG_SCALE * width, PNG_SCALE * height);
    let mut image = Rgb8::filled(width as usize, height as usize, [255; 3]);
    let bitmap = BitMapBackend::with_buffer(&mut image.bytes, (width, height));
    draw(figure, Lettered(bitmap).into_drawing_area(), PNG_SCALE)?;
    Ok(encode_png(&image)?)
}

fn draw<B: DrawingBackend>(figure: &impl Figure, area: DrawingArea<B, Shift>, scale: u32) -> Result<(), ChartError> {
    static REGISTERED: Once = Once::new();
    // Where this fails, drawing does, and says that there is no font.
    REGISTERED.call_once(|| drop(register_font(FONT, FontStyle::Normal, FONT_BYTES)));
    let failed = |e: DrawingAreaErrorKind<B::ErrorType>| ChartError::Draw(e.to_string());
    area.fill(&WHITE).map_err(failed)?;
    figure.draw(&area, f64::from(scale)).map_err(failed)?;
    area.present().map_err(failed)
}

/// A length in SVG pixels as dots.
fn dots(pixels: f64, scale: f64) -> i32 {
    (pixels * scale).round() as i32
}

/// Text at an axis: plain where that is short.
fn number(value: &f64) -> String {
    if *value == 0.0 || (value.abs() >= 0.01 && value.abs() < 1e6) {
        format!("{}", (value * 1e4).round() / 1e4)
    } else {
        format!("{value:.0e}")
    }
}

/// From the least to the greatest of the finite values; None without any.
fn extent(values: impl Iterator<Item = f64>) -> Option<Range<f64>> {
    let (low, high) = values.filter(|v| v.is_finite()).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    (low <= high).then_some(low..high)
}

/// Values for a logarithmic axis: 1, 2 and 5 times powers of ten within a positive range, and where those are fewer than three, every
/// fifth of the way.
fn logarithmic_ticks(range: &Range<f64>) -> Vec<f64> {
    let (first, last) = (range.start.log10().floor() as i32, range.end.log10().ceil() as i32);
    let mut ticks: Vec<f64> = (first..=last).flat_map(|power| [1.0, 2.0, 5.0].map(|m| m * 10f64.powi(power))).collect();
    ticks.retain(|t| range.contains(t));
    // Three decades and more: powers of ten alone are enough.
    if range.end / range.start > 1e3 {
        ticks.retain(|t| (t.log10() - t.log10().round()).abs() < 1e-9);
    }
    if ticks.len() >= 3 {
        return ticks;
    }
    let step = 10f64.powf(((range.end - range.start) / 5.0).log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * step).into_iter().find(|s| (range.end - range.start) / s <= 8.0).unwrap_or(10.0 * step);
    let (first, last) = ((range.start / step).ceil() as i64, (range.end / step).floor() as i64);
    (first..=last).map(|k| k as f64 * step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images::{ReadLimits, decode_png_codes};

    #[test]
    fn a_logarithmic_axis_has_round_numbers_however_narrow_it_is() {
        assert_eq!(logarithmic_ticks(&(0.9..60.0)), [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]);
        assert_eq!(logarithmic_ticks(&(0.5..5e3)), [1.0, 10.0, 100.0, 1000.0]);
        let narrow: Vec<String> = logarithmic_ticks(&(11.0..16.0)).iter().map(number).collect();
        assert_eq!(narrow, ["11", "12", "13", "14", "15", "16"]);
    }

    #[test]
    fn axis_numbers_are_short() {
        assert_eq!([0.0, 0.3, 12.0, 1e6, 0.001].map(|v| number(&v)), ["0", "0.3", "12", "1e6", "1e-3"]);
    }

    #[test]
    fn letters_of_a_png_stand_in_the_middle_of_their_line() {
        use plotters::style::text_anchor::{HPos, Pos, VPos};
        struct Word;
        impl Figure for Word {
            fn size_px(&self) -> Result<(u32, u32), ChartError> {
                Ok((100, 40))
            }
            fn draw<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, scale: f64) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
                let style = TextStyle::from((FONT, dots(20.0, scale)).into_font()).pos(Pos::new(HPos::Left, VPos::Center));
                area.draw(&Text::new("xxxx", (dots(10.0, scale), dots(20.0, scale)), style))
            }
        }
        let image = decode_png_codes(&png(&Word).unwrap(), ReadLimits::SCENE).unwrap();
        let rows = (0..image.height).filter(|j| (0..image.width).any(|i| image.pixel(i, *j)[0] < 128)).collect::<Vec<_>>();
        let middle = 0.5 * (rows[0] + rows[rows.len() - 1]) as f64;
        // Within a pixel of the SVG, two dots; plotters alone is 6 dots too high.
        assert!((middle - 40.0).abs() <= 2.0, "{middle}");
    }

    #[test]
    fn a_png_shows_lines_and_letters_at_twice_the_size() {
        let line = Line { name: "lru".into(), points: vec![(1.0, 1.0), (10.0, 5.0)] };
        let chart = LineChart { axes: Axes::Logarithmic, title: "misses", x_label: "faces", y_label: "%", lines: vec![line] };
        let image = decode_png_codes(&png(&chart).unwrap(), ReadLimits::SCENE).unwrap();
        let (width, height) = chart.size_px().unwrap();
        assert_eq!((image.width, image.height), (2 * width as usize, 2 * height as usize));
        let dark = |rows: Range<usize>| {
            rows.flat_map(|j| (0..image.width).map(move |i| (i, j))).filter(|(i, j)| image.pixel(*i, *j)[0] < 100).count()
        };
        // The title's letters stand in the first rows; the line is drawn below them.
        assert!(dark(20..80) > 100, "{}", dark(20..80));
        assert!(dark(80..image.height) > 1000);
    }
}
