//! Pictures that came out of a video, a terminal or a file, and how far they are from what `render` shows.

use std::fs;
use std::path::Path;

use lumisphere::images::{ReadLimits, Rgb8, decode_png_codes};

use crate::process::Server;
use crate::tiny::DATASET;

/// R G B of each pixel, in codes that need not be whole, rows from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Along a row.
    pub width: usize,
    /// Rows of them.
    pub pixels: Vec<[f32; 3]>,
}

impl Picture {
    /// Of codes.
    pub fn of(codes: &Rgb8) -> Self {
        let pixels = codes.bytes.chunks_exact(3).map(|rgb| [rgb[0], rgb[1], rgb[2]].map(f32::from)).collect();
        Self { width: codes.width, pixels }
    }

    /// Of a PNG.
    pub fn of_png(bytes: &[u8]) -> Self {
        Self::of(&decode_png_codes(bytes, ReadLimits::SCENE).unwrap())
    }

    /// The mean of each block of `side` pixels each way, fewer at odd edges.
    pub fn means(&self, side: usize) -> Self {
        let height = self.pixels.len() / self.width;
        let (columns, rows) = (self.width.div_ceil(side), height.div_ceil(side));
        let mean = |at: usize| {
            let (left, top) = (at % columns * side, at / columns * side);
            let block: Vec<[f32; 3]> = (top..(top + side).min(height))
                .flat_map(|row| (left..(left + side).min(self.width)).map(move |column| self.pixels[row * self.width + column]))
                .collect();
            [0, 1, 2].map(|c| block.iter().map(|rgb| rgb[c]).sum::<f32>() / block.len() as f32)
        };
        Self { width: columns, pixels: (0..columns * rows).map(mean).collect() }
    }

    fn differences(&self, other: &Self) -> impl Iterator<Item = f32> {
        assert_eq!((self.width, self.pixels.len()), (other.width, other.pixels.len()), "pictures of two sizes");
        self.pixels.iter().flatten().zip(other.pixels.iter().flatten()).map(|(a, b)| (a - b).abs())
    }

    /// The largest difference of two codes.
    pub fn worst(&self, other: &Self) -> f32 {
        self.differences(other).fold(0.0, f32::max)
    }

    /// The mean difference.
    pub fn mean(&self, other: &Self) -> f32 {
        self.differences(other).sum::<f32>() / (3 * self.pixels.len()) as f32
    }
}

/// What `render` shows of the tiny dataset with these flags: a PNG a frame, as its files are.
pub fn rendered(server: &Server, folder: &Path, flags: &[&str]) -> Vec<Vec<u8>> {
    let out = tempfile::tempdir_in(folder).unwrap();
    server.succeed(&[&["render", "--dataset", DATASET, "--out", out.path().to_str().unwrap(), "--quiet"], flags].concat());
    let mut names: Vec<_> = fs::read_dir(out.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.retain(|path| path.file_name().unwrap().to_string_lossy().starts_with("frame-"));
    names.sort();
    names.iter().map(|path| fs::read(path).unwrap()).collect()
}

#[test]
fn a_picture_that_differs_in_one_pixel_is_told_and_means_are_of_blocks() {
    let picture = Picture { width: 3, pixels: (0..6).map(|i| [i as f32; 3]).collect() };
    let mut other = picture.clone();
    other.pixels[4][1] += 12.0;
    assert_eq!((picture.worst(&other), picture.mean(&other)), (12.0, 12.0 / 18.0));
    assert_eq!((picture.worst(&picture), picture.mean(&picture)), (0.0, 0.0));
    assert_eq!(picture.means(2), Picture { width: 2, pixels: vec![[2.0; 3], [3.5; 3]] });
}
