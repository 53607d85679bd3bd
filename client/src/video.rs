//! Frames as uncompressed video, YUV4MPEG2 (`.y4m`), which players and encoders read from files and pipes. `stream` calls it.
//!
//! Sources: mjpegtools, yuv4mpeg(5); ITU-R BT.709-6 and BT.601-7 (luma weights, 8-bit quantisation: luma 16 to 235, chroma 16 to 240 around
//! 128). Frames come as 8-bit sRGB codes, and the codes are what the weights are applied to, as players undo it: no transfer curve is touched.
//! The format has a field for the range (an extension of FFmpeg's), none for the weights: players take BT.709 for high definition, some take
//! BT.601 below it.

use std::io::{self, Write};

use clap::{Args, ValueEnum};
use lumisphere::images::Rgb8;
use y4m::{Colorspace, Ratio, VendorExtensionString};

/// How colours are written.
#[derive(Debug, Clone, Copy, Args)]
pub struct ColourFlags {
    /// Of y4m: colour at every pixel, or one for four
    #[arg(long, value_enum, default_value = "444")]
    pub chroma: Chroma,
    /// Of y4m: luma 16 to 235, as players expect, or 0 to 255
    #[arg(long, value_enum, default_value = "limited")]
    pub range: Range,
    /// Of y4m: weights of luma
    #[arg(long, value_enum, default_value = "bt709")]
    pub matrix: Matrix,
}

/// How many pixels share a colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Chroma {
    /// Each has its own
    #[value(name = "444")]
    Full,
    /// Two by two, the mean, in their middle
    #[value(name = "420")]
    Quarter,
}

/// What codes mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Range {
    /// Luma 16 to 235, chroma 16 to 240
    Limited,
    /// 0 to 255
    Full,
}

/// Weights of red, green and blue in luma.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Matrix {
    /// ITU-R BT.709
    Bt709,
    /// ITU-R BT.601
    Bt601,
}

/// Frames per second, a fraction: 30000/1001 is written as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameRate {
    numerator: u32,
    denominator: u32,
}

/// Beyond this no display goes.
const MOST_FRAMES_PER_SECOND: f64 = 1000.0;

impl std::str::FromStr for FrameRate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parse = || {
            if let Some((numerator, denominator)) = text.split_once('/') {
                return Some(Self { numerator: numerator.parse().ok()?, denominator: denominator.parse().ok()? });
            }
            let (whole, decimals) = text.split_once('.').unwrap_or((text, ""));
            let denominator = 10u32.checked_pow(u32::try_from(decimals.len()).ok()?)?;
            Some(Self { numerator: format!("{whole}{decimals}").parse().ok()?, denominator })
        };
        let rate = parse().filter(|r| {
            let rate = f64::from(r.numerator) / f64::from(r.denominator);
            rate > 0.0 && rate <= MOST_FRAMES_PER_SECOND
        });
        rate.ok_or_else(|| "a number of frames per second expected, above 0 and at most 1000, such as 30, 23.976 or 30000/1001".to_string())
    }
}

/// Writes a video's header and its frames.
pub struct VideoWriter<W: Write> {
    encoder: y4m::Encoder<W>,
    size: (usize, usize),
    colours: ColourFlags,
}

impl<W: Write> VideoWriter<W> {
    /// Writes the header.
    pub fn new(to: W, (width, height): (usize, usize), rate: FrameRate, colours: ColourFlags) -> io::Result<Self> {
        let space = match colours.chroma {
            Chroma::Full => Colorspace::C444,
            // The name that says where the colours lie: amid their four pixels.
            Chroma::Quarter => Colorspace::C420jpeg,
        };
        let range = match colours.range {
            Range::Limited => "COLORRANGE=LIMITED",
            Range::Full => "COLORRANGE=FULL",
        };
        let range = VendorExtensionString::new(range.into()).map_err(io_error)?;
        let header = y4m::encode(width, height, Ratio::new(rate.numerator as usize, rate.denominator as usize))
            .with_colorspace(space)
            .append_vendor_extension(range);
        Ok(Self { encoder: header.write_header(to).map_err(io_error)?, size: (width, height), colours })
    }

    /// Writes a frame, which must have the header's size.
    pub fn write(&mut self, picture: &Rgb8) -> io::Result<()> {
        if (picture.width, picture.height) != self.size {
            let (width, height) = self.size;
            let problem = format!("a frame of {}x{} in a video of {width}x{height}", picture.width, picture.height);
            return Err(io::Error::other(problem));
        }
        let [luma, blue, red] = planes(picture, self.colours);
        self.encoder.write_frame(&y4m::Frame::new([&luma, &blue, &red], None)).map_err(io_error)
    }
}

/// A closed pipe stays one.
fn io_error(error: y4m::Error) -> io::Error {
    match error {
        y4m::Error::IoError(error) => error,
        other => io::Error::other(other),
    }
}

impl Matrix {
    /// Of red, green and blue; their sum is 1.
    fn weights(self) -> [f32; 3] {
        match self {
            Self::Bt709 => [0.2126, 0.7152, 0.0722],
            Self::Bt601 => [0.299, 0.587, 0.114],
        }
    }
}

/// Y′, C_B, C_R, rows from the top.
fn planes(picture: &Rgb8, colours: ColourFlags) -> [Vec<u8>; 3] {
    // Offset and scale of luma, scale of chroma.
    let (black, luma_scale, chroma_scale) = match colours.range {
        Range::Limited => (16.0, 219.0 / 255.0, 224.0 / 255.0),
        Range::Full => (0.0, 1.0, 1.0),
    };
    let weights = colours.matrix.weights();
    let luma = |rgb: [f32; 3]| weights[0] * rgb[0] + weights[1] * rgb[1] + weights[2] * rgb[2];
    // Rounded; the cast saturates.
    let chroma = |rgb: [f32; 3], channel: usize| {
        let difference = 0.5 * (rgb[channel] - luma(rgb)) / (1.0 - weights[channel]);
        (128.5 + chroma_scale * difference) as u8
    };
    let pixels = || picture.bytes.chunks_exact(3).map(|rgb| [f32::from(rgb[0]), f32::from(rgb[1]), f32::from(rgb[2])]);
    let luma_plane = pixels().map(|rgb| (black + luma_scale * luma(rgb) + 0.5) as u8).collect();
    let shared: Vec<[f32; 3]> = match colours.chroma {
        Chroma::Full => pixels().collect(),
        Chroma::Quarter => means_of_four(picture),
    };
    [luma_plane, shared.iter().map(|&rgb| chroma(rgb, 2)).collect(), shared.iter().map(|&rgb| chroma(rgb, 0)).collect()]
}

/// Of two by two pixels; at an odd edge of those that are there.
fn means_of_four(picture: &Rgb8) -> Vec<[f32; 3]> {
    let (columns, rows) = (picture.width.div_ceil(2), picture.height.div_ceil(2));
    let mean = |at: usize| {
        let (column, row) = (2 * (at % columns), 2 * (at / columns));
        let ahead = [column, (column + 1).min(picture.width - 1)];
        let below = [row, (row + 1).min(picture.height - 1)];
        let four = below.map(|row| ahead.map(|column| picture.pixel(column, row).map(f32::from)));
        [0, 1, 2].map(|c| 0.25 * (four[0][0][c] + four[0][1][c] + four[1][0][c] + four[1][1][c]))
    };
    (0..columns * rows).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITED: ColourFlags = ColourFlags { chroma: Chroma::Full, range: Range::Limited, matrix: Matrix::Bt709 };

    fn written(picture: &Rgb8, colours: ColourFlags) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut video = VideoWriter::new(&mut bytes, (picture.width, picture.height), "30000/1001".parse().unwrap(), colours).unwrap();
        video.write(picture).unwrap();
        bytes
    }

    #[test]
    fn the_header_says_size_rate_range_and_chroma() {
        let picture = Rgb8::filled(3, 2, [9; 3]);
        let header = |colours| String::from_utf8_lossy(&written(&picture, colours)).lines().next().unwrap().to_string();
        assert_eq!(header(LIMITED), "YUV4MPEG2 W3 H2 F30000:1001 XCOLORRANGE=LIMITED C444");
        let other = ColourFlags { chroma: Chroma::Quarter, range: Range::Full, ..LIMITED };
        assert_eq!(header(other), "YUV4MPEG2 W3 H2 F30000:1001 XCOLORRANGE=FULL C420jpeg");
    }

    #[test]
    fn colours_are_the_recommendations() {
        let of = |rgb, colours| planes(&Rgb8::filled(1, 1, rgb), colours).map(|plane| plane[0]);
        let full = ColourFlags { range: Range::Full, ..LIMITED };
        for (rgb, limited, full_range) in [
            ([0; 3], [16, 128, 128], [0, 128, 128]),
            ([255; 3], [235, 128, 128], [255, 128, 128]),
            // BT.709-6, 3.4 and 3.5, for the bars of 100 %.
            ([255, 0, 0], [63, 102, 240], [54, 99, 255]),
            ([0, 255, 0], [173, 42, 26], [182, 30, 12]),
            ([0, 0, 255], [32, 240, 118], [18, 255, 116]),
        ] {
            assert_eq!((of(rgb, LIMITED), of(rgb, full)), (limited, full_range), "{rgb:?}");
        }
        let old = ColourFlags { matrix: Matrix::Bt601, ..LIMITED };
        assert_eq!(of([255, 0, 0], old), [81, 90, 240]);
    }

    #[test]
    fn four_pixels_share_their_mean_colour_and_odd_edges_share_what_is_there() {
        let rows = [[[200, 0, 0], [0, 0, 0], [0, 0, 200]], [[0, 0, 0], [0, 0, 0], [0, 0, 100]]];
        let picture = Rgb8::from_bytes(3, 2, rows.iter().flatten().flatten().copied().collect()).unwrap();
        let [luma, blue, red] = planes(&picture, ColourFlags { chroma: Chroma::Quarter, ..LIMITED });
        assert_eq!((luma.len(), blue.len(), red.len()), (6, 2, 2));
        let alone = |rgb| planes(&Rgb8::filled(1, 1, rgb), LIMITED).map(|plane| plane[0]);
        assert_eq!([[blue[0], red[0]], [blue[1], red[1]]], [alone([50, 0, 0]), alone([0, 0, 150])].map(|ycc| [ycc[1], ycc[2]]));
    }

    #[test]
    fn frame_rates_are_fractions() {
        let rate = |numerator, denominator| Ok(FrameRate { numerator, denominator });
        assert_eq!(["30", "23.976", "30000/1001"].map(str::parse), [rate(30, 1), rate(23_976, 1000), rate(30_000, 1001)]);
        for bad in ["0", "-1", "1/0", "0/0", "x", "", ".", "1001", "1e9", "nan", "30.0000000000"] {
            assert!(bad.parse::<FrameRate>().is_err(), "{bad}");
        }
    }

    #[test]
    fn a_frame_of_another_size_is_refused() {
        let mut video = VideoWriter::new(Vec::new(), (2, 2), "1".parse().unwrap(), LIMITED).unwrap();
        for (width, height) in [(2, 1), (1, 2), (4, 1)] {
            let problem = video.write(&Rgb8::filled(width, height, [0; 3])).unwrap_err().to_string();
            assert_eq!(problem, format!("a frame of {width}x{height} in a video of 2x2"));
        }
    }
}
