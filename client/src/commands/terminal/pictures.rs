//! Frames as what a terminal shows: the kitty graphics protocol, sixel, or half blocks in 24-bit colour.
//!
//! Sources: sw.kovidgoyal.net/kitty/graphics-protocol ("Displaying images", "Remote client"); DEC VT3xx, "Sixel graphics"; ISO 8613-6 (SGR
//! 38;2 and 48;2). A half block is U+2580: its upper half in the foreground's colour, its lower in the background's.

use std::io::Write;

use anyhow::Context as _;
use base64::Engine as _;
use clap::ValueEnum;
use icy_sixel::{EncodeOptions, SixelImage};
use lumisphere::images::{ReadLimits, Rgb8, decode_png_codes};

/// Cells of a terminal that tells no size of theirs: a common font's.
pub const USUAL_CELL_PX: (u32, u32) = (8, 16);
/// What a frame has at most, before it is stretched to its place: full HD.
const MOST_PIXELS: u32 = 1920 * 1080;
/// Of base64 in one escape sequence, as the protocol bounds it.
const KITTY_CHUNK: usize = 4096;
/// Rows that one line of sixels has.
const SIXEL_ROWS: u32 = 6;

/// How pictures reach the screen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Protocol {
    /// PNG, as it comes from the server
    Kitty,
    /// 256 colours
    Sixel,
    /// Two pixels a character, 24-bit colour
    HalfBlocks,
}

/// The picture's place on the screen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Area {
    /// At least 1.
    pub columns: u16,
    /// At least 1.
    pub rows: u16,
    /// Width and height of one cell.
    pub cell_px: (u32, u32),
}

/// What to ask the server for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameSize {
    /// Along a row.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// A pixel's width by its height, as it is shown.
    pub pixel_aspect: f32,
}

/// How much a picture may cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effort {
    /// Another follows at once.
    Little,
    /// This one stays.
    Full,
}

/// What is between two lines of half blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lines {
    /// They are placed: the screen is ours.
    Placed,
    /// They follow each other, as text does.
    Flowing,
}

impl Area {
    /// As the picture covers it.
    fn size_px(&self) -> (u32, u32) {
        (u32::from(self.columns) * self.cell_px.0, u32::from(self.rows) * self.cell_px.1)
    }
}

impl Protocol {
    /// As many pixels as are shown, where that is not too many.
    pub fn frame_size(self, area: Area) -> FrameSize {
        if self == Self::HalfBlocks {
            let pixel_aspect = 2.0 * area.cell_px.0 as f32 / area.cell_px.1 as f32;
            return FrameSize { width_px: area.columns.into(), height_px: 2 * u32::from(area.rows), pixel_aspect };
        }
        let (width, height) = self.shown_px(area);
        let shrink = (f64::from(MOST_PIXELS) / (f64::from(width) * f64::from(height))).sqrt().min(1.0);
        let part = |side: u32| ((f64::from(side) * shrink) as u32).max(1);
        FrameSize { width_px: part(width), height_px: part(height), pixel_aspect: 1.0 }
    }

    /// A last line of sixels that is cut would scroll the screen.
    fn shown_px(self, area: Area) -> (u32, u32) {
        let (width, height) = area.size_px();
        match self {
            Self::Sixel => (width, (height / SIXEL_ROWS * SIXEL_ROWS).max(height.min(SIXEL_ROWS))),
            Self::Kitty | Self::HalfBlocks => (width, height),
        }
    }

    /// Of a cell, in the frame's pixels.
    pub fn cell_in_frame(self, area: Area) -> (f32, f32) {
        let size = self.frame_size(area);
        (size.width_px as f32 / f32::from(area.columns), size.height_px as f32 / f32::from(area.rows))
    }

    /// What to write with the cursor at the area's upper left.
    pub fn picture(self, png: &[u8], area: Area, effort: Effort, lines: Lines) -> anyhow::Result<Vec<u8>> {
        if self == Self::Kitty {
            return Ok(kitty(png, area, lines));
        }
        let frame = decode_png_codes(png, ReadLimits::SCENE).context("a frame from the server")?;
        Ok(match self {
            Self::Sixel => {
                let (width, height) = self.shown_px(area);
                sixel(&stretched(&frame, width as usize, height as usize), effort)?
            }
            Self::Kitty | Self::HalfBlocks => half_blocks(&stretched(&frame, area.columns.into(), 2 * usize::from(area.rows)), lines),
        })
    }
}

/// Takes away all that `kitty` has placed.
pub const KITTY_CLEAR: &[u8] = b"\x1b_Ga=d,d=A,q=2\x1b\\";

/// The picture replaces the one before; the terminal stretches it over the area. No answers are asked for.
fn kitty(png: &[u8], area: Area, lines: Lines) -> Vec<u8> {
    let text = base64::engine::general_purpose::STANDARD.encode(png);
    // The cursor stays (C=1) where the screen is ours.
    let cursor = if lines == Lines::Placed { ",i=1,p=1,C=1" } else { "" };
    let mut out = Vec::with_capacity(text.len() + text.len() / 64 + 64);
    let mut chunks = text.as_bytes().chunks(KITTY_CHUNK).peekable();
    let mut keys = format!("a=T,f=100,q=2,c={},r={}{cursor},", area.columns, area.rows);
    while let Some(chunk) = chunks.next() {
        let more = u8::from(chunks.peek().is_some());
        out.extend_from_slice(format!("\x1b_G{keys}m={more};").as_bytes());
        out.extend_from_slice(chunk);
        out.extend_from_slice(b"\x1b\\");
        keys = "q=2,".into();
    }
    out
}

/// A palette of its own for every picture; errors are diffused in one that stays.
fn sixel(picture: &Rgb8, effort: Effort) -> anyhow::Result<Vec<u8>> {
    let rgba = picture.bytes.chunks_exact(3).flat_map(|rgb| [rgb[0], rgb[1], rgb[2], u8::MAX]).collect();
    let image = SixelImage::try_from_rgba(rgba, picture.width, picture.height).context("sixel")?;
    let full = EncodeOptions::default();
    let options = if effort == Effort::Little { EncodeOptions { diffusion: 0.0, ..full } } else { full };
    Ok(image.encode_with(&options).context("sixel")?.into_bytes())
}

/// The picture has two rows for each line. A colour is told where it changes.
fn half_blocks(picture: &Rgb8, lines: Lines) -> Vec<u8> {
    let mut out = Vec::new();
    for line in 0..picture.height / 2 {
        if lines == Lines::Placed {
            // (Cannot fail: a Vec takes everything.)
            let _ = write!(out, "\x1b[{};1H", line + 1);
        }
        let mut told = [None; 2];
        for column in 0..picture.width {
            let colours = [picture.pixel(column, 2 * line), picture.pixel(column, 2 * line + 1)];
            for (ground, (told, colour)) in [38, 48].into_iter().zip(told.iter_mut().zip(colours)) {
                if told.replace(colour) != Some(colour) {
                    let [r, g, b] = colour;
                    let _ = write!(out, "\x1b[{ground};2;{r};{g};{b}m");
                }
            }
            out.extend_from_slice("▀".as_bytes());
        }
        out.extend_from_slice(b"\x1b[0m");
        if lines == Lines::Flowing {
            out.push(b'\n');
        }
    }
    out
}

/// To another size, each pixel the nearest: frames of a moving viewer are smaller than their place.
fn stretched(picture: &Rgb8, width: usize, height: usize) -> Rgb8 {
    if (picture.width, picture.height) == (width, height) {
        return picture.clone();
    }
    let nearest = |at: usize, to: usize, from: usize| (2 * at + 1) * from / (2 * to);
    let mut out = Rgb8::filled(width, height, [0; 3]);
    for (at, rgb) in out.bytes.chunks_exact_mut(3).enumerate() {
        let (column, row) = (nearest(at % width, width, picture.width), nearest(at / width, height, picture.height));
        rgb.copy_from_slice(&picture.pixel(column, row));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const AREA: Area = Area { columns: 80, rows: 23, cell_px: (8, 16) };

    #[test]
    fn a_frame_has_the_pixels_of_its_place_and_never_too_many() {
        let size = |protocol: Protocol, area| {
            let size = protocol.frame_size(area);
            (size.width_px, size.height_px, size.pixel_aspect)
        };
        assert_eq!(size(Protocol::Kitty, AREA), (640, 368, 1.0));
        // 61 lines of six.
        assert_eq!(size(Protocol::Sixel, AREA), (640, 366, 1.0));
        assert_eq!(size(Protocol::HalfBlocks, AREA), (80, 46, 1.0));
        assert_eq!(size(Protocol::HalfBlocks, Area { cell_px: (10, 16), ..AREA }).2, 1.25);
        let (width, height, _) = size(Protocol::Kitty, Area { columns: 1000, rows: 500, ..AREA });
        assert!(width * height <= MOST_PIXELS && width * height > MOST_PIXELS - 4000 && width == height, "{width}x{height}");
        assert_eq!(size(Protocol::Sixel, Area { columns: 1, rows: 1, cell_px: (1, 2) }), (1, 2, 1.0));
    }

    #[test]
    fn a_smaller_frame_fills_its_place() {
        let picture = Rgb8::from_bytes(2, 1, vec![1, 1, 1, 2, 2, 2]).unwrap();
        let shades = |picture: &Rgb8| picture.bytes.iter().step_by(3).copied().collect::<Vec<_>>();
        assert_eq!(shades(&stretched(&picture, 4, 2)), [1, 1, 2, 2, 1, 1, 2, 2]);
        // And a larger one, of before the terminal shrank: the pixel amid.
        let picture = Rgb8::from_bytes(3, 1, vec![1, 1, 1, 2, 2, 2, 3, 3, 3]).unwrap();
        assert_eq!(shades(&stretched(&picture, 1, 1)), [2]);
    }

    #[test]
    fn a_colour_is_told_where_it_changes() {
        let picture = Rgb8::from_bytes(2, 2, vec![1, 2, 3, 1, 2, 3, 4, 5, 6, 7, 8, 9]).unwrap();
        let text = |lines| String::from_utf8(half_blocks(&picture, lines)).unwrap();
        assert_eq!(text(Lines::Flowing), "\x1b[38;2;1;2;3m\x1b[48;2;4;5;6m▀\x1b[48;2;7;8;9m▀\x1b[0m\n");
        assert!(text(Lines::Placed).starts_with("\x1b[1;1H\x1b[38"));
    }

    #[test]
    fn kitty_gets_the_png_in_pieces_that_say_whether_more_follow() {
        let png: Vec<u8> = (0..7000u32).map(|i| (i * i) as u8).collect();
        let text = String::from_utf8(kitty(&png, AREA, Lines::Placed)).unwrap();
        let pieces: Vec<(&str, &str)> =
            text.split("\x1b_G").skip(1).map(|p| p.strip_suffix("\x1b\\").unwrap().split_once(';').unwrap()).collect();
        let keys: Vec<&str> = pieces.iter().map(|p| p.0).collect();
        assert_eq!(keys, ["a=T,f=100,q=2,c=80,r=23,i=1,p=1,C=1,m=1", "q=2,m=1", "q=2,m=0"]);
        assert!(pieces.iter().all(|p| p.1.len() <= 4096));
        let whole: String = pieces.iter().map(|p| p.1).collect();
        assert_eq!(base64::engine::general_purpose::STANDARD.decode(whole).unwrap(), png);
    }
}
