//! A page: the unit that is stored, moved and cached.

use std::fmt;
use std::ops::Range;

use half::f16;
use half::slice::HalfFloatSliceExt;
use serde::{Deserialize, Serialize};

use super::buffers::Number;
use super::codec::to_f16;
use super::error::StoreError;

/// Most channels a texel can have.
pub const MAX_CHANNELS: u32 = 4;
/// Most decoded bytes of one page; keeps a record far below a segment's limit.
pub const MAX_PAGE_BYTES: u64 = 64 << 20;

/// A page's number within its dataset version: dense, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct PageId(pub u32);

impl fmt::Display for PageId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// How one channel of one texel is stored, decoded or not. The numbers are those on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelFormat {
    /// IEEE binary32, bit-exact.
    F32 = 1,
    /// IEEE binary16: relative error ≤ 2⁻¹¹ from 2⁻¹⁴ to 65504, clamped beyond; infinities are kept.
    F16 = 2,
}

impl PixelFormat {
    /// Of one channel.
    pub fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
        }
    }
}

/// Size and format of a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct PageShape {
    /// Texels along a row, above 0.
    pub width: u32,
    /// Rows, above 0.
    pub height: u32,
    /// Numbers in a texel, 1…[`MAX_CHANNELS`], interleaved.
    pub channels: u32,
    /// Of each channel.
    pub pixel: PixelFormat,
}

impl PageShape {
    /// The shape, if pages of it can be stored.
    pub fn checked(self) -> Result<Self, StoreError> {
        let bytes = u64::from(self.width) * u64::from(self.height);
        let bytes = bytes.checked_mul(u64::from(self.channels) * self.pixel.bytes() as u64);
        let sized = bytes.is_some_and(|b| b > 0 && b <= MAX_PAGE_BYTES);
        if sized && (1..=MAX_CHANNELS).contains(&self.channels) {
            return Ok(self);
        }
        Err(StoreError::InvalidPage {
            reason: format!(
                "{}×{} texels of {} {:?} channels: at least 1×1, 1 to {MAX_CHANNELS} channels, at most {MAX_PAGE_BYTES} bytes",
                self.width, self.height, self.channels, self.pixel
            ),
        })
    }

    /// Numbers in a row: width · channels.
    pub fn row_values(&self) -> usize {
        self.width as usize * self.channels as usize
    }

    /// Numbers in the page: height · width · channels.
    pub fn values(&self) -> usize {
        self.row_values() * self.height as usize
    }

    /// What holding a page of this shape in memory costs, its own fields included.
    pub fn resident_bytes(&self) -> usize {
        size_of::<Page>() + self.decoded_bytes()
    }

    /// Bytes of the decoded page.
    pub fn decoded_bytes(&self) -> usize {
        self.values() * self.pixel.bytes()
    }
}

/// Interleaved numbers, row 0 first, in the stored format.
#[derive(Debug, Clone, PartialEq)]
pub enum Texels {
    /// Bit-exact.
    F32(Vec<f32>),
    /// Rounded to nearest even.
    F16(Vec<f16>),
}

impl Texels {
    /// None yet.
    pub(super) fn none(pixel: PixelFormat) -> Self {
        match pixel {
            PixelFormat::F32 => Self::F32(Vec::new()),
            PixelFormat::F16 => Self::F16(Vec::new()),
        }
    }

    /// How many numbers.
    pub(super) fn count(&self) -> usize {
        match self {
            Self::F32(v) => v.len(),
            Self::F16(v) => v.len(),
        }
    }

    /// Appends some numbers of a page of the same format.
    fn extend(&mut self, page: &Page, values: Range<usize>) {
        match (self, &page.texels) {
            (Self::F32(v), Self::F32(from)) => v.extend_from_slice(&from[values]),
            (Self::F16(v), Self::F16(from)) => v.extend_from_slice(&from[values]),
            _ => unreachable!("rows of one page have one format"),
        }
    }

    /// Room for so many numbers to come, so that appending them allocates once, or not at all where a page that is gone has left room for as
    /// many.
    pub(super) fn make_room(&mut self, count: usize) {
        fn make<T: Number>(texels: &mut Vec<T>, count: usize) {
            if texels.is_empty() {
                *texels = T::buffers().take(count);
            } else {
                texels.reserve_exact(count);
            }
        }
        match self {
            Self::F32(v) => make(v, count),
            Self::F16(v) => make(v, count),
        }
    }
}

/// Two texels from `first` on, and the two a row below. Checked once a row, not once a texel.
#[inline(always)]
fn gather<const CHANNELS: usize>(numbers: &[f32], first: usize, row: usize) -> [[f32; 4]; 4] {
    let [upper, lower] = [first, first + row].map(|at| &numbers[at..at + 2 * CHANNELS]);
    [padded(&upper[..CHANNELS]), padded(&upper[CHANNELS..]), padded(&lower[..CHANNELS]), padded(&lower[CHANNELS..])]
}

/// Bilinear interpolation between upper left, upper right, lower left and lower right.
#[inline(always)]
pub(super) fn mixed([a, b, c, d]: &[[f32; 4]; 4], (u, v): (f32, f32)) -> [f32; 4] {
    std::array::from_fn(|channel| {
        let upper = a[channel] + u * (b[channel] - a[channel]);
        let lower = c[channel] + u * (d[channel] - c[channel]);
        upper + v * (lower - upper)
    })
}

/// Zeros behind. Inlined where the length is known, so that no copying is called for a few numbers.
#[inline(always)]
fn padded(numbers: &[f32]) -> [f32; 4] {
    std::array::from_fn(|k| if k < numbers.len() { numbers[k] } else { 0.0 })
}

/// A decoded page, or some whole rows of one.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    shape: PageShape,
    texels: Texels,
}

impl Drop for Page {
    fn drop(&mut self) {
        match &mut self.texels {
            Texels::F32(v) => f32::buffers().give(std::mem::take(v)),
            Texels::F16(v) => f16::buffers().give(std::mem::take(v)),
        }
    }
}

impl Page {
    /// `texels` holds exactly `shape.values()` numbers of `shape.pixel`; the decoder sees to it.
    pub(super) fn new(shape: PageShape, texels: Texels) -> Self {
        let is_of_format = matches!((&texels, shape.pixel), (Texels::F32(_), PixelFormat::F32) | (Texels::F16(_), PixelFormat::F16));
        assert!(is_of_format && texels.count() == shape.values(), "a page's texels agree with its shape");
        Self { shape, texels }
    }

    /// From height · width · channels numbers, interleaved, row 0 first; rounded and clamped as storage would.
    pub fn from_f32(shape: PageShape, values: &[f32]) -> Result<Self, StoreError> {
        let shape = shape.checked()?;
        if values.len() != shape.values() {
            return Err(StoreError::InvalidPage { reason: format!("{} numbers where the shape has {}", values.len(), shape.values()) });
        }
        let texels = match shape.pixel {
            PixelFormat::F32 => Texels::F32(values.to_vec()),
            PixelFormat::F16 => Texels::F16(to_f16(values).0),
        };
        Ok(Self::new(shape, texels))
    }

    /// Size and format; of the rows present, if only some were read.
    pub fn shape(&self) -> PageShape {
        self.shape
    }

    /// The numbers as stored, interleaved, row 0 first.
    pub fn texels(&self) -> &Texels {
        &self.texels
    }

    /// Texel at column `x`, row `y`; channels that the page lacks are 0. Outside the page is a caller's bug and panics.
    #[inline]
    pub fn texel(&self, x: u32, y: u32) -> [f32; 4] {
        let channels = self.shape.channels as usize;
        let first = y as usize * self.shape.row_values() + x as usize * channels;
        assert!(x < self.shape.width, "column {x} of a page {} wide", self.shape.width);
        match (&self.texels, channels) {
            (Texels::F32(v), 3) => padded(&v[first..first + 3]),
            (Texels::F32(v), 4) => padded(&v[first..first + 4]),
            (Texels::F32(v), 2) => padded(&v[first..first + 2]),
            (Texels::F32(v), _) => padded(&v[first..first + 1]),
            (Texels::F16(v), _) => {
                let mut texel = [0.0; 4];
                v[first..first + channels].convert_to_f32_slice(&mut texel[..channels]);
                texel
            }
        }
    }

    /// Interpolation between the texels (x, y) and (x+1, y+1); `u` and `v`, 0…1, are the weights of the right column and the lower row;
    /// channels that the page lacks are 0. Outside the page is a caller's bug and panics.
    #[inline]
    pub fn bilinear(&self, (x, y): (u32, u32), weights: (f32, f32)) -> [f32; 4] {
        let channels = self.shape.channels as usize;
        let (row, first) = (self.shape.row_values(), y as usize * self.shape.row_values() + x as usize * channels);
        assert!(x + 1 < self.shape.width, "columns {x} and {} of a page {} wide", x + 1, self.shape.width);
        // With the channel count a constant the copies become a few moves.
        let corners = match (&self.texels, channels) {
            (Texels::F32(v), 3) => gather::<3>(v, first, row),
            (Texels::F32(v), 4) => gather::<4>(v, first, row),
            (Texels::F32(v), 2) => gather::<2>(v, first, row),
            (Texels::F32(v), _) => gather::<1>(v, first, row),
            (Texels::F16(_), _) => [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].map(|(x, y)| self.texel(x, y)),
        };
        mixed(&corners, weights)
    }

    /// These rows with those of `below` under them, of the same width and format.
    pub(super) fn with_rows_below(&self, below: &Self) -> Self {
        let shape = PageShape { height: self.shape.height + below.shape.height, ..self.shape };
        let mut texels = Texels::none(shape.pixel);
        texels.make_room(shape.values());
        for rows in [self, below] {
            texels.extend(rows, 0..rows.shape.values());
        }
        Self::new(shape, texels)
    }

    /// Appends row `y`'s width · channels numbers to `out`.
    pub fn extend_row(&self, y: u32, out: &mut Vec<f32>) {
        let count = self.shape.row_values();
        let row = y as usize * count..(y as usize + 1) * count;
        match &self.texels {
            Texels::F32(v) => out.extend_from_slice(&v[row]),
            Texels::F16(v) => {
                let start = out.len();
                out.resize(start + count, 0.0);
                v[row].convert_to_f32_slice(&mut out[start..]);
            }
        }
    }

    /// All numbers as f32, interleaved, row 0 first.
    pub fn to_f32(&self) -> Vec<f32> {
        match &self.texels {
            Texels::F32(v) => v.clone(),
            Texels::F16(v) => v.to_f32_vec(),
        }
    }

    /// The texels as a GPU takes them: interleaved, no padding, this machine's byte order (R32F … RGBA32F, or the 16-bit ones).
    pub fn bytes(&self) -> &[u8] {
        match &self.texels {
            Texels::F32(v) => bytemuck::cast_slice(v),
            Texels::F16(v) => bytemuck::cast_slice(v),
        }
    }

    /// Some of the rows, as a page of that height.
    pub(super) fn rows(self, rows: Range<u32>) -> Self {
        if rows == (0..self.shape.height) {
            return self;
        }
        let count = self.shape.row_values();
        let values = rows.start as usize * count..rows.end as usize * count;
        let mut texels = Texels::none(self.shape.pixel);
        texels.make_room(values.len());
        texels.extend(&self, values);
        Self::new(PageShape { height: rows.end - rows.start, ..self.shape }, texels)
    }

    /// What holding the page in memory costs, its own fields included.
    pub fn resident_bytes(&self) -> usize {
        self.shape.resident_bytes()
    }
}
