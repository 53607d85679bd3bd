//! What a 640 × 480 frame costs between the kernel and the wire, and what judging it costs: medians, in milliseconds.
//!
//! `cargo bench -p lumisphere --bench frame_encoding`. The picture is generated: smooth shading under a fine pattern and noise, which compresses
//! about as a rendered frame does.

use std::time::Instant;

use lumisphere::images::{
    CompareOptions, ExrCompression, ExrImage, ExrLayer, ExrStorage, Image, JpegQuality, ToneMap, compare, decode_exr, encode_exr,
    encode_exr_rgb, encode_jpeg, encode_png, tone_mapped,
};

const RUNS: usize = 15;

fn main() {
    let frame = frame();
    let codes = tone_mapped(&frame, ToneMap::PLAIN).expect("three planes");
    println!("step                       median ms       bytes");
    measure("tone map to 8 bits", || tone_mapped(&frame, ToneMap::PLAIN).expect("three planes").bytes);
    for quality in [75, 85, 95] {
        let quality = JpegQuality::new(quality).expect("within 1–100");
        measure(&format!("JPEG {quality:?}"), || encode_jpeg(&codes, quality).expect("a valid size"));
    }
    measure("PNG", || encode_png(&codes).expect("a valid size"));
    for compression in [ExrCompression::None, ExrCompression::Piz] {
        let layer = ExrLayer::from_planes(frame.clone(), &["R", "G", "B"], ExrStorage::Half).expect("three planes");
        let image = ExrImage { layers: vec![layer] };
        measure(&format!("EXR half {compression:?}"), || encode_exr(&image, compression).expect("three planes"));
    }
    measure("EXR half ZIP", || encode_exr_rgb(&frame, ExrStorage::Half).expect("three planes"));
    measure("EXR float ZIP", || encode_exr_rgb(&frame, ExrStorage::Float).expect("three planes"));
    measure("raw interleaved f32", || frame.to_interleaved_bytes());

    let exr = encode_exr_rgb(&frame, ExrStorage::Half).expect("three planes");
    let limits = lumisphere::images::ReadLimits::SCENE;
    measure("decode EXR half ZIP", || decode_exr(&exr, limits).expect("our own file").layers);
    let mut other = frame.clone();
    other.planes[0].rotate_right(1);
    measure("all metrics", || vec![compare(&frame, &other, None, CompareOptions::STANDARD).expect("equal sizes")]);
}

fn frame() -> Image {
    let (width, height) = (640, 480);
    let mut image = Image::zeros(width, height, 3);
    let mut state = 1u32;
    for index in 0..width * height {
        let (x, y) = ((index % width) as f32 / width as f32, (index / width) as f32 / height as f32);
        state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        let noise = (state >> 16) as f32 / 65_536.0 * 0.01;
        let pattern = 0.1 * (90.0 * x).sin() * (70.0 * y).cos() + noise;
        image.set_rgb(index, [0.6 * x + pattern, 0.5 * y + pattern, 0.4 * (1.0 - x) + noise]);
    }
    image
}

fn measure<T>(what: &str, mut run: impl FnMut() -> Vec<T>) {
    let mut length = 0;
    let mut millis: Vec<f64> = (0..RUNS)
        .map(|_| {
            let start = Instant::now();
            length = std::hint::black_box(run()).len();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    millis.sort_by(f64::total_cmp);
    println!("{what:<28}{:>8.2}{length:>12}", millis[RUNS / 2]);
}
