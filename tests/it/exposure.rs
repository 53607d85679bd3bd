//! From radiance to the codes of a screen, end to end: what PNG and JPEG frames show of a RAW frame of the same pose.

use lumisphere::images::{ReadLimits, decode_jpeg_codes, decode_png_codes};
use lumisphere_proto::v1alpha1 as wire;

use crate::clients::with_dataset;
use crate::process::Server;
use crate::tiny::DATASET;
use crate::wire::{fields, frame_request, output, raw_pixels};

const STOPS: f32 = 1.0;
const GAMMA: f32 = 0.75;

/// IEC 61966-2-1.
fn srgb_code(light: f64) -> f64 {
    255.0 * if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

async fn color(server: &Server, encoding: wire::Encoding, exposure_gamma: f32) -> bytes::Bytes {
    let output = wire::OutputSettings { exposure_stops: STOPS, exposure_gamma, jpeg_quality: 100, ..output(encoding) };
    let request = wire::RenderFrameRequest { output: Some(output), ..frame_request(DATASET) };
    server.rendering().await.render_frame(request).await.unwrap().into_inner().color
}

#[tokio::test]
async fn frames_show_radiance_as_the_exposure_says() {
    let (folder, server) = with_dataset().await;
    let radiance = raw_pixels(&color(&server, wire::Encoding::RawZstd, 0.0).await);
    // Linear frames have no exposure.
    assert_eq!(raw_pixels(&color(&server, wire::Encoding::RawZstd, GAMMA).await), radiance);
    let clipped = |x: f32| (f64::from(x) * 2.0_f64.powf(STOPS.into())).clamp(0.0, 1.0);
    let compressed = |x: f32| -(-f64::from(GAMMA) * f64::from(x.max(0.0)) * 2.0_f64.powf(STOPS.into())).exp_m1();
    let curves: [(f32, &dyn Fn(f32) -> f64); 2] = [(0.0, &clipped), (GAMMA, &compressed)];
    for (gamma, shown) in curves {
        let png = decode_png_codes(&color(&server, wire::Encoding::Png, gamma).await, ReadLimits::SCENE).unwrap();
        // Half a code, and the rounding of f32 at the thresholds.
        let far = |code: u8, x: f32| (f64::from(code) - srgb_code(shown(x))).abs() > 0.51;
        let wrong = png.bytes.iter().zip(&radiance).filter(|(code, x)| far(**code, **x)).count();
        assert_eq!((wrong, png.bytes.len()), (0, radiance.len()), "γ = {gamma}");
        let jpeg = decode_jpeg_codes(&color(&server, wire::Encoding::Jpeg, gamma).await, ReadLimits::SCENE).unwrap();
        let mean = |codes: &[u8]| codes.iter().map(|c| f64::from(*c)).sum::<f64>() / codes.len() as f64;
        // Of the best quality, with its chroma at half the resolution: the mean stays.
        assert!((mean(&jpeg.bytes) - mean(&png.bytes)).abs() < 2.0, "γ = {gamma}");
    }
    assert!(radiance.iter().any(|x| x * 2.0 > 1.0), "something is clipped without γ");
    // The command line says the same.
    let out = folder.path().join("shown");
    let gamma = GAMMA.to_string();
    let flags = ["--gamma", &gamma, "--exposure-stops", "1", "--component", "full", "--blend", "average", "--size", "32x24"];
    let place = ["--position", "0,1,3", "--target", "0,1,0", "--vfov-deg", "53.130102", "--out", out.to_str().unwrap()];
    server.succeed(&[&["render", "--dataset", DATASET], &flags[..], &place[..]].concat());
    let file = std::fs::read(out.join("frame-00000.png")).unwrap();
    let (file, frame) = (
        decode_png_codes(&file, ReadLimits::SCENE),
        decode_png_codes(&color(&server, wire::Encoding::Png, GAMMA).await, ReadLimits::SCENE),
    );
    let (file, frame) = (file.unwrap().bytes, frame.unwrap().bytes);
    // The same camera but for the rounding of its field of view.
    let off = file.iter().zip(&frame).filter(|(a, b)| a.abs_diff(**b) > 2).count();
    assert!(file.len() == frame.len() && off * 50 < frame.len(), "{off} of {} codes", frame.len());
}

#[tokio::test]
async fn exposures_that_are_none_are_refused_by_field() {
    let (_folder, server) = with_dataset().await;
    for (exposure_stops, exposure_gamma) in [(0.0, f32::NAN), (0.0, -1.0), (0.0, 1001.0), (30.0, 2.0), (-30.0, 0.5)] {
        let output = wire::OutputSettings { exposure_stops, exposure_gamma, ..output(wire::Encoding::Png) };
        let request = wire::RenderFrameRequest { output: Some(output), ..frame_request(DATASET) };
        let status = server.rendering().await.render_frame(request).await.unwrap_err();
        assert_eq!(fields(&status), ["output.exposure_gamma"], "γ = {exposure_gamma}, {exposure_stops} stops");
    }
}
