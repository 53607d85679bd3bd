//! Golden frames, one a representation, in `tests/golden`; `UPDATE_GOLDENS=1` writes them anew.

use std::path::{Path, PathBuf};

use crate::images::{Golden, Image, Tolerance, check_golden};
use crate::render::Frame;

fn path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(name)
}

/// The frame's colour is that of the golden image, and a shift by one pixel would be noticed.
pub fn assert_golden(name: &str, frame: &Frame) {
    let (width, height) = (frame.width_px as usize, frame.height_px as usize);
    let mut image = Image::zeros(width, height, 3);
    for at in 0..width * height {
        image.set_rgb(at, frame.pixels.color[3 * at..3 * at + 3].try_into().unwrap());
    }
    let mode = if std::env::var_os("UPDATE_GOLDENS").is_some() { Golden::Rewrite } else { Golden::Check };
    let failures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/golden-failures");
    check_golden(&path(name), &image, &Tolerance::F16_STORAGE, mode, &failures).unwrap();
    if mode == Golden::Check {
        image.planes.iter_mut().for_each(|plane| plane.rotate_right(1));
        assert!(check_golden(&path(name), &image, &Tolerance::F16_STORAGE, Golden::Check, &failures).is_err());
    }
}
