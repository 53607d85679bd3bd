//! The changes that every comparator and metric must notice, for their tests.

use super::Image;

/// 64 × 64 pixels: three smooth, different planes with a fine pattern, values about 0.1–1.
pub(super) fn textured() -> Image {
    let mut image = Image::zeros(64, 64, 3);
    for index in 0..64 * 64 {
        let (x, y) = ((index % 64) as f32, (index / 64) as f32);
        let pattern = 0.1 * (0.9 * x).sin() * (0.7 * y).cos();
        image.set_rgb(index, [0.5 + 0.005 * x + pattern, 0.3 + 0.004 * y - pattern, 0.2 + 0.002 * (x + y) + 0.5 * pattern]);
    }
    image
}

/// The image with one pixel changed by a twentieth of white, shifted by one texel, with red and blue swapped, with a NaN, and with
/// wrong sizes; each with its name.
pub(super) fn controls(image: &Image) -> Vec<(&'static str, Image)> {
    let mut one_pixel = image.clone();
    one_pixel.planes[1][20 * image.width + 30] += 0.05;

    let mut shifted = image.clone();
    for (target, source) in shifted.planes.iter_mut().zip(&image.planes) {
        for row in 0..image.height {
            let start = row * image.width;
            target[start + 1..start + image.width].copy_from_slice(&source[start..start + image.width - 1]);
        }
    }

    let mut swapped = image.clone();
    swapped.planes.swap(0, 2);

    let mut nan = image.clone();
    nan.planes[2][7] = f32::NAN;

    let shorter = Image {
        height: image.height - 1,
        planes: image.planes.iter().map(|plane| plane[image.width..].to_vec()).collect(),
        ..image.clone()
    };
    let transposed_shape = Image { width: image.width / 2, height: image.height * 2, ..image.clone() };
    let fewer_channels = Image { planes: image.planes[..2].to_vec(), ..image.clone() };
    vec![
        ("one changed pixel", one_pixel),
        ("one-texel shift", shifted),
        ("swapped channels", swapped),
        ("a NaN", nan),
        ("one row less", shorter),
        ("other shape of the same length", transposed_shape),
        ("a channel less", fewer_channels),
    ]
}
