//! What a 640 × 480 frame costs between the kernel and the wire, and what judging it costs: medians, in milliseconds.
//!
//! `cargo bench -p lumisphere --bench frame_encoding`. The picture is generated: smooth shading under a fine pattern and noise, which compresses
//! about as a rendered frame does.
//!
//! With pictures after `--` (PNG): what a slow link should take from a frame, its size or JPEG's quality. Means over the pictures of bytes and of
//! the error in codes (RMS) of what a viewer sees, who draws smaller frames larger (bilinear).

use std::time::Instant;

use lumisphere::images::{
    CompareOptions, ExrCompression, ExrImage, ExrLayer, ExrStorage, Image, JpegQuality, ReadLimits, Rgb8, ToneMap, compare, decode_exr,
    decode_image_codes, decode_jpeg_codes, encode_exr, encode_exr_rgb, encode_jpeg, encode_jpeg_pixels, encode_png, tone_mapped,
    tone_mapped_pixels,
};

const RUNS: usize = 15;

fn main() {
    let pictures: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with("--")).collect();
    if !pictures.is_empty() {
        return size_or_quality(&pictures);
    }
    let frame = frame();
    let codes = tone_mapped(&frame, ToneMap::PLAIN).expect("three planes");
    println!("step                       median ms       bytes");
    let pixels: Vec<[f32; 3]> = (0..frame.width * frame.height).map(|i| frame.rgb(i)).collect();
    measure("tone map to 8 bits", || tone_mapped_pixels(&pixels, frame.width, ToneMap::PLAIN).expect("whole rows").bytes);
    for quality in [75, 85, 95] {
        let quality = JpegQuality::new(quality).expect("within 1–100");
        measure(&format!("JPEG {quality:?}"), || encode_jpeg(&codes, quality).expect("a valid size"));
        measure("  with the tone map", || encode_jpeg_pixels(&pixels, codes.width, ToneMap::PLAIN, quality).expect("a valid size"));
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
    let limits = ReadLimits::SCENE;
    measure("decode EXR half ZIP", || decode_exr(&exr, limits).expect("our own file").layers);
    let mut other = frame.clone();
    other.planes[0].rotate_right(1);
    measure("all metrics", || vec![compare(&frame, &other, None, CompareOptions::STANDARD).expect("equal sizes")]);
}

fn size_or_quality(pictures: &[String]) {
    let read = |path: &String| {
        let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{path}: {e}"));
        decode_image_codes(&bytes, ReadLimits::SCENE).unwrap_or_else(|e| panic!("{path}: {e}"))
    };
    let pictures: Vec<Rgb8> = pictures.iter().map(read).collect();
    println!("of the pixels, quality: bytes, error");
    for (side, quality) in [1.0, 0.84, 0.71, 0.5].into_iter().flat_map(|side| [90, 75, 60, 45, 30].map(|quality| (side, quality))) {
        let (mut bytes, mut squares) = (0, 0.0);
        for picture in &pictures {
            let smaller = resized(picture, |length| ((length as f32 * side).round() as usize).max(1));
            let encoded = encode_jpeg(&smaller, JpegQuality::new(quality).expect("within 1-100")).expect("a valid size");
            let seen = decode_jpeg_codes(&encoded, ReadLimits::SCENE).expect("our own file");
            let seen = stretched(&seen, picture.width, picture.height);
            bytes += encoded.len();
            let differences = seen.bytes.iter().zip(&picture.bytes).map(|(a, b)| (f32::from(*a) - f32::from(*b)).powi(2));
            squares += differences.sum::<f32>() / picture.bytes.len() as f32;
        }
        let count = pictures.len();
        println!("{:.2} {quality}: {} {:.1}", side * side, bytes / count, (squares / count as f32).sqrt());
    }
}

/// Every pixel the mean of those it covers.
fn resized(picture: &Rgb8, length: impl Fn(usize) -> usize) -> Rgb8 {
    let (width, height) = (length(picture.width), length(picture.height));
    let covered = |at: usize, of: usize, all: usize| (at * all / of)..((at + 1) * all).div_ceil(of);
    let code = |i: usize| {
        let (channel, column, row) = (i % 3, i / 3 % width, i / 3 / width);
        let (columns, rows) = (covered(column, width, picture.width), covered(row, height, picture.height));
        let count = (columns.len() * rows.len()) as u32;
        let sum: u32 =
            rows.flat_map(|r| columns.clone().map(move |c| u32::from(picture.bytes[3 * (r * picture.width + c) + channel]))).sum();
        ((sum + count / 2) / count) as u8
    };
    Rgb8 { width, height, bytes: (0..3 * width * height).map(code).collect() }
}

/// As a browser draws it larger.
fn stretched(picture: &Rgb8, width: usize, height: usize) -> Rgb8 {
    let around = |at: usize, of: usize, all: usize| {
        let place = ((at as f32 + 0.5) * all as f32 / of as f32 - 0.5).clamp(0.0, (all - 1) as f32);
        let first = place as usize;
        [(first, 1.0 - place.fract()), ((first + 1).min(all - 1), place.fract())]
    };
    let code = |i: usize| {
        let (channel, column, row) = (i % 3, i / 3 % width, i / 3 / width);
        let (columns, rows) = (around(column, width, picture.width), around(row, height, picture.height));
        let read = |c: usize, r: usize| f32::from(picture.bytes[3 * (r * picture.width + c) + channel]);
        rows.iter().flat_map(|(r, y)| columns.iter().map(move |(c, x)| x * y * read(*c, *r))).sum::<f32>().round() as u8
    };
    Rgb8 { width, height, bytes: (0..3 * width * height).map(code).collect() }
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
