//! Reading and writing foreign formats: what comes back, and that bad bytes give an error and nothing else.

use proptest::prelude::*;

use super::*;
use crate::testdata::{shared, shipped};

const LIMITS: ReadLimits = ReadLimits::SCENE;

/// Every pixel and channel different, values on both sides of 1.
fn gradient(width: usize, height: usize, channels: usize) -> Image {
    let mut image = Image::zeros(width, height, channels);
    for (channel, plane) in image.planes.iter_mut().enumerate() {
        for (index, sample) in plane.iter_mut().enumerate() {
            *sample = (index as f32 + 0.5) * 0.01 + channel as f32;
        }
    }
    image
}

fn checker(width: usize, height: usize) -> Rgb8 {
    let bytes = (0..width * height).flat_map(|index| [(index * 7) as u8, (index / width * 11) as u8, (index % 5 * 50) as u8]);
    Rgb8 { width, height, bytes: bytes.collect() }
}

fn encoded_examples() -> Vec<(Format, Vec<u8>)> {
    let image = gradient(19, 13, 3);
    let layer = ExrLayer::from_planes(image.clone(), &["R", "G", "B"], ExrStorage::Half).unwrap();
    let exr = |compression| (Format::Exr, encode_exr(&ExrImage { layers: vec![layer.clone()] }, compression).unwrap());
    vec![
        exr(ExrCompression::None),
        exr(ExrCompression::Zip),
        exr(ExrCompression::Piz),
        (Format::Png, encode_png(&checker(19, 13)).unwrap()),
        (Format::Jpeg, encode_jpeg(&checker(19, 13), JpegQuality::STREAM).unwrap()),
        (Format::Hdr, hdr_file("", "-Y 2 +X 8", &[&[2, 2, 0, 8], &[136, 1, 136, 2, 136, 3, 136, 129][..]].concat().repeat(2))),
    ]
}

fn hdr_file(header: &str, resolution: &str, pixels: &[u8]) -> Vec<u8> {
    let mut bytes = format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n{header}\n{resolution}\n").into_bytes();
    bytes.extend_from_slice(pixels);
    bytes
}

#[test]
fn float_exr_comes_back_bit_for_bit_under_every_compression() {
    for compression in [ExrCompression::None, ExrCompression::Zip, ExrCompression::Piz] {
        let mut image = gradient(37, 21, 4);
        image.planes[3][5] = f32::INFINITY;
        let layer = ExrLayer::from_planes(image, &["D", "N.X", "N.Y", "N.Z"], ExrStorage::Float).unwrap();
        let written = ExrImage { layers: vec![layer] };
        let bytes = encode_exr(&written, compression).unwrap();
        assert_eq!(decode_exr(&bytes, LIMITS).unwrap(), written, "{compression:?}");
    }
}

#[test]
fn half_exr_rounds_to_half_and_keeps_channel_order() {
    let image = gradient(9, 4, 3);
    let back = decode_image(&encode_exr_rgb(&image, ExrStorage::Half).unwrap(), LIMITS).unwrap();
    let rounded: Vec<Vec<f32>> =
        image.planes.iter().map(|plane| plane.iter().map(|&sample| half::f16::from_f32(sample).to_f32()).collect()).collect();
    assert_eq!(back.planes, rounded);
}

#[test]
fn layers_are_found_by_name_and_missing_ones_named() {
    let layer = |name: &str, value: f32| ExrLayer {
        name: Some(name.to_owned()),
        width: 2,
        height: 1,
        channels: vec![ExrChannel { name: "Y".into(), storage: ExrStorage::Float, samples: vec![value; 2] }],
    };
    let bytes = encode_exr(&ExrImage { layers: vec![layer("first", 1.0), layer("second", 2.0)] }, ExrCompression::Zip).unwrap();
    let image = decode_exr(&bytes, LIMITS).unwrap();
    assert_eq!(image.layer("second").unwrap().rgb().unwrap().planes, vec![vec![2.0; 2]; 3]);
    let message = image.layer("third").unwrap_err().to_string();
    assert_eq!(message, "no layer third in the image, which has first, second");
    let message = image.layers[0].channel("D").unwrap_err().to_string();
    assert_eq!(message, "no channel D in the image, which has Y");
}

#[test]
fn exr_bytes_do_not_depend_on_threads() {
    let image = gradient(640, 480, 3);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| encode_exr_rgb(&image, ExrStorage::Float).unwrap())
    };
    assert!(with(1) == with(2));
}

#[test]
fn png_is_lossless_and_linearised() {
    let codes = checker(33, 17);
    let bytes = encode_png(&codes).unwrap();
    assert_eq!(decode_png_codes(&bytes, LIMITS).unwrap(), codes);
    assert_eq!(decode_image(&bytes, LIMITS).unwrap(), codes.to_linear());
}

#[test]
fn sixteen_bit_grey_png_with_alpha_gives_four_planes() {
    let mut bytes = Vec::new();
    let samples: Vec<u8> = [32_768u16, 13_107].iter().flat_map(|sample| sample.to_ne_bytes()).collect();
    let encoder = ::image::codecs::png::PngEncoder::new(&mut bytes);
    ::image::ImageEncoder::write_image(encoder, &samples, 1, 1, ::image::ExtendedColorType::La16).unwrap();
    let image = decode_image(&bytes, LIMITS).unwrap();
    // Code one half is 0.21404 of the light; alpha is not encoded: 13107 / 65535 = 0.2.
    for plane in &image.planes[..3] {
        assert!((plane[0] - 0.214_05).abs() < 2e-5, "{plane:?}");
    }
    assert!((image.planes[3][0] - 0.2).abs() < 1e-6);
}

#[test]
fn jpeg_is_close_to_what_was_encoded() {
    let codes = Rgb8::filled(64, 48, [200, 100, 50]);
    let back = decode_jpeg_codes(&encode_jpeg(&codes, JpegQuality::new(95).unwrap()).unwrap(), LIMITS).unwrap();
    assert_eq!((back.width, back.height), (64, 48));
    // A flat block loses only the colour conversion's and the DC term's rounding: 2 codes.
    assert!(back.bytes.iter().zip(&codes.bytes).all(|(a, b)| a.abs_diff(*b) <= 2));
}

#[test]
fn jpeg_quality_outside_its_range_cannot_be_made() {
    assert!(JpegQuality::new(0).is_none() && JpegQuality::new(101).is_none() && JpegQuality::new(100).is_some());
}

#[test]
fn hdr_pixels_are_divided_by_their_exposure() {
    // Mantissa 128 at exponent 129 is 1.0; exposures multiply.
    let bytes = hdr_file("EXPOSURE=2\nEXPOSURE= 4\n", "-Y 1 +X 2", &[128, 64, 0, 129, 0, 0, 0, 0]);
    let image = decode_image(&bytes, LIMITS).unwrap();
    assert_eq!(image.planes, vec![vec![0.125, 0.0], vec![0.0625, 0.0], vec![0.0, 0.0]]);
}

#[test]
fn hdr_orientations_keep_the_picture_upright() {
    let pixels: Vec<u8> = (1..=6u8).flat_map(|value| [value, 0, 0, 136]).collect();
    let red = |resolution| decode_image(&hdr_file("", resolution, &pixels), LIMITS).unwrap().planes[0].clone();
    assert_eq!(red("-Y 2 +X 3"), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert_eq!(red("+Y 2 +X 3"), [4.0, 5.0, 6.0, 1.0, 2.0, 3.0]);
    assert_eq!(red("-Y 2 -X 3"), [3.0, 2.0, 1.0, 6.0, 5.0, 4.0]);
    assert!(matches!(decode_image(&hdr_file("", "+X 3 -Y 2", &pixels), LIMITS), Err(ImageError::Unsupported { .. })));
}

#[test]
fn hdr_old_runs_repeat_the_pixel_before_in_base_256() {
    let pixel = [7, 0, 0, 136];
    let bytes = hdr_file("", "-Y 1 +X 260", &[&pixel[..], &[1, 1, 1, 3], &[1, 1, 1, 1]].concat());
    assert_eq!(decode_image(&bytes, LIMITS).unwrap().planes[0], vec![7.0; 260]);
    for bad in [
        &[[1, 1, 1, 3], pixel].concat()[..],
        &[pixel, [1, 1, 1, 255], [1, 1, 1, 255]].concat(),
        &[&pixel[..], &[1, 1, 1, 0].repeat(12)].concat(),
    ] {
        let error = decode_image(&hdr_file("", "-Y 1 +X 260", bad), LIMITS).unwrap_err();
        assert!(matches!(error, ImageError::Malformed { .. }), "{error}");
    }
}

#[test]
fn real_hdr_environments_decode_as_another_decoder_does() {
    for (name, width, height) in [
        ("env/forest_slope_1k", 1024, 512),
        ("env/venice_sunset_1k", 1024, 512),
        ("env/empty_warehouse_01_1k", 1024, 512),
        ("exposures/memorial/memorial", 512, 768),
    ] {
        let Some(path) = shared(&format!("{name}.hdr")) else { return };
        let image = read_image(&path, LIMITS).unwrap();
        assert_eq!((image.width, image.height, image.channels()), (width, height, 3));
        let oracle =
            ::image::load_from_memory_with_format(&std::fs::read(&path).unwrap(), ::image::ImageFormat::Hdr).unwrap().into_rgb32f();
        let interleaved = (0..image.width * image.height).flat_map(|index| image.rgb(index));
        assert!(interleaved.eq(oracle.into_raw()), "{name}");
    }
}

#[test]
fn real_tiled_mip_mapped_half_exr_gives_its_largest_level() {
    for (name, width, height) in
        [("KernerEnvCube", 256, 1536), ("KernerEnvLatLong", 1024, 512), ("OrientationCube", 512, 3072), ("WavyLinesLatLong", 1024, 512)]
    {
        let Some(path) = shared(&format!("env/pairs/{name}.exr")) else { return };
        let image = read_image(&path, LIMITS).unwrap();
        assert_eq!((image.width, image.height), (width, height), "{name}");
        assert!(image.planes.iter().flatten().all(|sample| sample.is_finite()), "{name}");
    }
}

#[test]
fn real_truths_have_distance_and_unit_normals() {
    let path = shipped("scenes/box-room/truth/view0_geometry.exr");
    let image = decode_exr(&std::fs::read(path).unwrap(), LIMITS).unwrap();
    let layer = &image.layers[0];
    let distance = layer.channel("D").unwrap();
    let normal = layer.planes(&["N.X", "N.Y", "N.Z"]).unwrap();
    let mut hits = 0;
    for (index, distance) in distance.iter().enumerate().filter(|(_, distance)| distance.is_finite()) {
        let length = normal.rgb(index).iter().map(|x| x * x).sum::<f32>().sqrt();
        assert!(*distance > 0.0 && (length - 1.0).abs() < 2e-3, "pixel {index}: distance {distance}, normal's length {length}");
        hits += 1;
    }
    assert!(hits > layer.width * layer.height / 2);
}

#[test]
fn real_cube_faces_and_photographs_are_read() {
    for face in ["px", "nx", "py", "ny", "pz", "nz"] {
        let Some(path) = shared(&format!("env/entrance_hall_cube/{face}.exr")) else { return };
        let image = read_image(&path, LIMITS).unwrap();
        assert_eq!((image.width, image.height), (512, 512));
    }
    let Some(path) = shared("rti/san_michele/image01.jpg") else { return };
    let image = read_image(&path, LIMITS).unwrap();
    assert_eq!((image.width, image.height, image.channels()), (402, 395, 3));
}

#[test]
fn a_real_texture_is_read() {
    let image = read_image(&shipped("scenes/box-room/textures/brick.png"), LIMITS).unwrap();
    assert!(image.planes.iter().flatten().all(|sample| (0.0..=1.0).contains(sample)));
}

#[test]
fn every_cut_of_every_format_is_a_typed_error() {
    for (format, bytes) in encoded_examples() {
        decode_image(&bytes, LIMITS).unwrap_or_else(|error| panic!("{format} whole: {error}"));
        // PNG's decoder does not ask for the 12 bytes of its closing chunk, which carry no pixel.
        let needed = if format == Format::Png { bytes.len() - 12 } else { bytes.len() };
        for length in 0..needed {
            let error = decode_image(&bytes[..length], LIMITS).err();
            let error = error.unwrap_or_else(|| panic!("{format} cut to {length} of {} bytes was taken", bytes.len()));
            assert!(
                matches!(error, ImageError::Malformed { .. } | ImageError::UnknownFormat | ImageError::Unsupported { .. }),
                "{format} at {length}: {error:?}"
            );
        }
    }
}

#[test]
fn a_header_that_announces_too_much_is_refused_before_memory_is_taken() {
    let small = ReadLimits { max_samples: 19 * 13 * 3 - 1, nan: Nan::Reject };
    for (format, bytes) in encoded_examples().into_iter().filter(|(format, _)| *format != Format::Hdr) {
        assert!(matches!(decode_image(&bytes, small), Err(ImageError::TooLarge { width: 19, height: 13, .. })), "{format}");
        assert!(decode_image(&bytes, ReadLimits { max_samples: 19 * 13 * 3, ..small }).is_ok(), "{format}");
    }
    let huge = hdr_file("", "-Y 4000000000 +X 4000000000", &[]);
    assert!(matches!(decode_image(&huge, LIMITS), Err(ImageError::TooLarge { .. })));
    let within_limits_but_empty = hdr_file("", "-Y 4000 +X 4000", &[0; 64]);
    assert!(matches!(decode_image(&within_limits_but_empty, LIMITS), Err(ImageError::Malformed { .. })));
}

#[test]
fn an_exr_data_window_of_two_to_the_thirty_is_refused() {
    let bytes = encode_exr_rgb(&gradient(4, 4, 3), ExrStorage::Half).unwrap();
    let name = b"dataWindow\0box2i\0";
    let start = bytes.windows(name.len()).position(|window| window == name).unwrap() + name.len() + 4;
    for (right, bottom) in [(1 << 30, 1 << 30), (i32::MAX, i32::MAX), (3, i32::MAX), (i32::MAX, 3), (-5, 3), (3, 100_000)] {
        let mut lying = bytes.clone();
        lying[start + 8..start + 12].copy_from_slice(&i32::to_le_bytes(right));
        lying[start + 12..start + 16].copy_from_slice(&i32::to_le_bytes(bottom));
        let error = decode_image(&lying, LIMITS).unwrap_err();
        assert!(matches!(error, ImageError::TooLarge { .. } | ImageError::Malformed { .. }), "{right} × {bottom}: {error:?}");
    }
}

/// The CRC-32 that closes each chunk of a PNG.
fn png_crc(bytes: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
    !bytes.iter().fold(u32::MAX, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), |crc, _| step(crc)))
}

#[test]
fn a_size_within_limits_that_so_short_a_file_cannot_hold_is_refused() {
    let refused = |bytes: &[u8]| {
        let message = decode_image(bytes, LIMITS).unwrap_err().to_string();
        assert!(message.contains("bytes of pixels in a file of"), "{message}");
    };
    let mut exr = encode_exr_rgb(&gradient(4, 4, 3), ExrStorage::Half).unwrap();
    let name = b"dataWindow\0box2i\0";
    let window = exr.windows(name.len()).position(|window| window == name).unwrap() + name.len() + 4;
    exr[window + 8..window + 12].copy_from_slice(&29_999i32.to_le_bytes());
    exr[window + 12..window + 16].copy_from_slice(&999i32.to_le_bytes());
    refused(&exr);

    // Signature 8, length 4, "IHDR" 4, width 4, height 4, five more bytes, CRC.
    let mut png = encode_png(&checker(4, 4)).unwrap();
    png[16..20].copy_from_slice(&6_000u32.to_be_bytes());
    png[20..24].copy_from_slice(&6_000u32.to_be_bytes());
    let crc = png_crc(&png[12..29]);
    png[29..33].copy_from_slice(&crc.to_be_bytes());
    refused(&png);

    // Frame header: marker 2, length 2, precision 1, height 2, width 2.
    let mut jpeg = encode_jpeg(&checker(4, 4), JpegQuality::STREAM).unwrap();
    let frame = jpeg.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0x20, 0, 0x10, 0]);
    refused(&jpeg);
}

#[test]
fn a_jpeg_of_strips_is_the_picture_of_one_pass() {
    // Whole strips, one row more, part of a minimum coded unit, more strips than there are restart markers.
    for (width, height) in [(40, 64), (17, 33), (8, 7), (3, 400)] {
        let image = checker(width, height);
        for quality in [10, 89, 90, 100] {
            let strips = encode_jpeg(&image, JpegQuality::new(quality).unwrap()).unwrap();
            let mut one = Vec::new();
            let encoder = jpeg_encoder::Encoder::new(&mut one, quality);
            encoder.encode(&image.bytes, width as u16, height as u16, jpeg_encoder::ColorType::Rgb).unwrap();
            let (strips, one) = (decode_jpeg_codes(&strips, LIMITS).unwrap(), decode_jpeg_codes(&one, LIMITS).unwrap());
            assert!(strips == one, "{width} × {height} at quality {quality}");
        }
    }
}

#[test]
fn a_jpeg_of_radiance_is_that_of_its_codes() {
    for (width, height) in [(40, 64), (17, 33), (1, 1)] {
        let pixels: Vec<[f32; 3]> = (0..width * height).map(|i| [0.01, 0.02, -0.03].map(|step| 0.3 + step * (i % 50) as f32)).collect();
        for tone_map in [ToneMap::PLAIN, ToneMap::Exponential(Exposure::ONE)] {
            let codes = tone_mapped_pixels(&pixels, width, tone_map).unwrap();
            let file = encode_jpeg_pixels(&pixels, width, tone_map, JpegQuality::STREAM).unwrap();
            assert!(file == encode_jpeg(&codes, JpegQuality::STREAM).unwrap(), "{width} × {height}, {tone_map:?}");
        }
    }
    for (pixels, width) in [(1, 0), (3, 2), (1 << 16, 1 << 16)] {
        let refused = encode_jpeg_pixels(&vec![[0.0; 3]; pixels], width, ToneMap::PLAIN, JpegQuality::STREAM);
        assert!(matches!(refused, Err(ImageError::Shape { .. })), "rows of {width}");
    }
    assert!(matches!(encode_jpeg_pixels(&[], 4, ToneMap::PLAIN, JpegQuality::STREAM), Err(ImageError::Shape { .. })));
}

#[test]
fn black_images_which_compress_best_are_not_taken_for_lies() {
    let black = Image::zeros(1024, 1024, 3);
    for compression in [ExrCompression::Zip, ExrCompression::Piz] {
        let layer = ExrLayer::from_planes(black.clone(), &["R", "G", "B"], ExrStorage::Float).unwrap();
        let bytes = encode_exr(&ExrImage { layers: vec![layer] }, compression).unwrap();
        assert_eq!(decode_image(&bytes, LIMITS).unwrap(), black, "{compression:?}");
    }
    let codes = Rgb8::filled(2048, 2048, [0; 3]);
    assert_eq!(decode_png_codes(&encode_png(&codes).unwrap(), LIMITS).unwrap(), codes);
    assert_eq!(decode_jpeg_codes(&encode_jpeg(&codes, JpegQuality::STREAM).unwrap(), LIMITS).unwrap(), codes);
}

#[test]
fn nan_is_refused_by_name_and_place_or_kept_on_request() {
    let mut image = gradient(5, 4, 3);
    image.planes[1][2 * 5 + 3] = f32::NAN;
    let bytes = encode_exr_rgb(&image, ExrStorage::Half).unwrap();
    let error = decode_image(&bytes, LIMITS).unwrap_err();
    assert_eq!(error.to_string(), "not a number in channel G at column 3, row 2");
    let kept = decode_image(&bytes, ReadLimits { nan: Nan::Keep, ..LIMITS }).unwrap();
    assert!(kept.planes[1][13].is_nan());
}

#[test]
fn errors_in_files_name_the_file_last() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notes.exr");
    std::fs::write(&path, "hello").unwrap();
    let message = read_image(&path, LIMITS).unwrap_err().to_string();
    assert_eq!(message, format!("neither an OpenEXR, Radiance HDR, PNG, JPEG nor TIFF image: {}", path.display()));
    assert!(matches!(read_image(&folder.path().join("absent.png"), LIMITS), Err(ImageError::InFile { .. })));
}

#[test]
fn what_cannot_be_written_is_a_typed_error() {
    let two_planes = Image::zeros(4, 4, 2);
    assert!(matches!(encode_exr_rgb(&two_planes, ExrStorage::Half), Err(ImageError::Shape { .. })));
    assert!(matches!(encode_exr(&ExrImage { layers: vec![] }, ExrCompression::Zip), Err(ImageError::Shape { .. })));
    let empty = Rgb8::filled(0, 3, [0; 3]);
    assert!(matches!(encode_png(&empty), Err(ImageError::Shape { .. })));
    assert!(matches!(encode_jpeg(&empty, JpegQuality::STREAM), Err(ImageError::Shape { .. })));
    assert!(matches!(encode_exr_rgb(&Image::zeros(0, 3, 3), ExrStorage::Half), Err(ImageError::Shape { .. })));
    assert!(matches!(Rgb8::from_bytes(2, 2, vec![0; 11]), Err(ImageError::Shape { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    /// Any result will do; a panic or a runaway allocation will not.
    #[test]
    fn flipped_bytes_never_panic(example in 0..6usize, flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let (_, mut bytes) = encoded_examples().swap_remove(example);
        for (place, value) in flips {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        let small = ReadLimits { max_samples: 1 << 20, nan: Nan::Keep };
        if let Ok(image) = decode_image(&bytes, small) {
            prop_assert!(image.width * image.height * image.channels() <= 1 << 20);
        }
    }
}
