//! A bitmap to draw on whose letters stand where an SVG has them.

use plotters::prelude::{BitMapBackend, DrawingBackend};
use plotters_backend::{BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingErrorKind};

/// Of the letters' size, by which plotters' `ab_glyph` draws them too high: its box ends 0.81 of the size below its top, its base line lies
/// at 0.5; half an x-height below the middle, as in an SVG, is 0.62.
const TOO_HIGH: f64 = 0.12;

/// Everything goes to the bitmap; letters a little lower.
pub struct Lettered<'a>(pub BitMapBackend<'a>);

type Outcome = Result<(), DrawingErrorKind<<BitMapBackend<'static> as DrawingBackend>::ErrorType>>;

impl DrawingBackend for Lettered<'_> {
    type ErrorType = <BitMapBackend<'static> as DrawingBackend>::ErrorType;

    fn get_size(&self) -> (u32, u32) {
        self.0.get_size()
    }

    fn ensure_prepared(&mut self) -> Outcome {
        self.0.ensure_prepared()
    }

    fn present(&mut self) -> Outcome {
        self.0.present()
    }

    fn draw_pixel(&mut self, point: BackendCoord, color: BackendColor) -> Outcome {
        self.0.draw_pixel(point, color)
    }

    fn draw_line<S: BackendStyle>(&mut self, from: BackendCoord, to: BackendCoord, style: &S) -> Outcome {
        self.0.draw_line(from, to, style)
    }

    fn draw_rect<S: BackendStyle>(&mut self, upper_left: BackendCoord, bottom_right: BackendCoord, style: &S, fill: bool) -> Outcome {
        self.0.draw_rect(upper_left, bottom_right, style, fill)
    }

    fn draw_text<S: BackendTextStyle>(&mut self, text: &str, style: &S, (x, y): BackendCoord) -> Outcome {
        // Down as the letters stand: to the right where they are turned.
        let (right, down) = style.transform().transform(0, (TOO_HIGH * style.size()).round() as i32);
        self.0.draw_text(text, style, (x + right, y + down))
    }
}
