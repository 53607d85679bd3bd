//! A viewer's frames as one H.264 stream: each says how it differs from the one before, so none may be lost on the way. One that was encoded
//! and not sent is followed by a key frame, which needs no other; so is a change of size or quality.
//!
//! Baseline profile, 4:2:0, BT.601 coefficients in the limited range over BT.709's primaries and sRGB's curve, which the stream says, too;
//! Annex B, an access unit a frame, no frame held back.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use lumisphere::images::{JpegQuality, Rgb8};
use openh264::OpenH264API;
use openh264::encoder::{
    ColorPrimaries, Encoder, EncoderConfig, FrameType, Profile, QpRange, RateControlMode, TransferCharacteristics, VuiConfig,
};
use openh264::formats::{RgbSliceU8, YUVBuffer};

use crate::errors::ApiError;
use crate::frames::Encoded;

/// Smaller ones are, too: they get a margin.
const LEAST_SIDE_PX: usize = 16;
/// Quality is what bounds the bytes, not this.
const BITS_PER_SECOND: u32 = 200_000_000;

/// In the place of the number of the frame that was sent last.
pub const NONE_SENT: u64 = 0;

/// The stream so far.
pub struct Video {
    encoder: Option<(u8, Encoder)>,
    /// Number of the frame that was encoded last; they count from 1.
    encoded: u64,
    /// Of the one that was sent last.
    sent: Arc<AtomicU64>,
}

impl Video {
    /// Nothing seen of it. `sent` holds the number of the frame that was sent last. None in a server that is built without.
    #[allow(clippy::unnecessary_wraps)]
    pub fn new(sent: Arc<AtomicU64>) -> Option<Self> {
        Some(Self { encoder: None, encoded: NONE_SENT, sent })
    }

    /// The next frame: `image` in the upper left corner of an access unit, the margin to even sides repeats its edge.
    pub fn encode(&mut self, image: &Rgb8, quality: JpegQuality) -> Result<Encoded, ApiError> {
        let failed = |error: openh264::Error| ApiError::internal(format!("cannot encode a frame as H.264: {error}"));
        let quality = quality.value();
        let mut encoder = match self.encoder.take().filter(|(q, _)| *q == quality) {
            Some((_, encoder)) => encoder,
            None => Encoder::with_api_config(OpenH264API::from_source(), configuration(quality)).map_err(failed)?,
        };
        // It would build on a frame that nobody has.
        if self.encoded > NONE_SENT && self.sent.load(Ordering::SeqCst) != self.encoded {
            encoder.force_intra_frame();
        }
        let (pixels, sides) = padded(image);
        let stream = encoder.encode(&YUVBuffer::from_rgb8_source(RgbSliceU8::new(&pixels, sides))).map_err(failed)?;
        self.encoded += 1;
        let encoded = Encoded { is_key: stream.frame_type() == FrameType::IDR, bytes: stream.to_vec(), number: self.encoded };
        self.encoder = Some((quality, encoder));
        Ok(encoded)
    }
}

fn configuration(quality: u8) -> EncoderConfig {
    let qp = qp(quality);
    let colors = VuiConfig::bt601().color_primaries(ColorPrimaries::Bt709).transfer_characteristics(TransferCharacteristics::Srgb);
    let config = EncoderConfig::new().profile(Profile::Baseline).vui(colors).skip_frames(false).num_threads(1);
    let config = config.rate_control_mode(RateControlMode::Quality).qp(QpRange::new(qp, qp));
    config.bitrate(openh264::encoder::BitRate::from_bps(BITS_PER_SECOND)).adaptive_quantization(false).scene_change_detect(false)
}

/// Quantisation for a JPEG quality, with about as many codes of error.
fn qp(quality: u8) -> u8 {
    match quality {
        91.. => 110 - quality.min(100),
        _ => 20 + (u16::from(90 - quality) * 4 / 15) as u8,
    }
}

/// With even sides, at least the least.
fn padded(image: &Rgb8) -> (Vec<u8>, (usize, usize)) {
    let even = |side: usize| side.next_multiple_of(2).max(LEAST_SIDE_PX);
    let (width, height) = (even(image.width), even(image.height));
    let rows = image.bytes.chunks_exact(3 * image.width);
    let mut bytes = Vec::with_capacity(3 * width * height);
    for row in rows {
        bytes.extend_from_slice(row);
        (image.width..width).for_each(|_| bytes.extend_from_slice(&row[row.len() - 3..]));
    }
    let last = bytes.len() - 3 * width;
    (image.height..height).for_each(|_| bytes.extend_from_within(last..last + 3 * width));
    (bytes, (width, height))
}

#[cfg(test)]
mod tests {
    use openh264::decoder::Decoder;
    use openh264::formats::YUVSource;

    use super::*;

    /// A smooth picture that turns with `step`.
    fn picture(width: usize, height: usize, step: usize) -> Rgb8 {
        let pixel = |at: usize| {
            let (x, y) = ((at % width) as f32 / width as f32, (at / width) as f32 / height as f32);
            [x, y, 0.5 + 0.4 * (6.0 * (x + y) + 0.1 * step as f32).sin()].map(|v| (255.0 * v) as u8)
        };
        Rgb8 { width, height, bytes: (0..width * height).flat_map(pixel).collect() }
    }

    /// The stream, and the number of the frame that was sent last.
    fn stream() -> (Video, Arc<AtomicU64>) {
        let sent = Arc::new(AtomicU64::new(NONE_SENT));
        (Video::new(sent.clone()).unwrap(), sent)
    }

    fn quality(quality: u8) -> JpegQuality {
        JpegQuality::new(quality).unwrap()
    }

    /// The picture in the corner.
    fn decoded(decoder: &mut Decoder, encoded: &Encoded, image: &Rgb8) -> Rgb8 {
        let yuv = decoder.decode(&encoded.bytes).unwrap().expect("a frame at once");
        let (width, height) = yuv.dimensions();
        assert_eq!((width, height), padded(image).1);
        let mut rgb = vec![0; 3 * width * height];
        yuv.write_rgb8(&mut rgb);
        let bytes = rgb.chunks_exact(3 * width).take(image.height).flat_map(|row| &row[..3 * image.width]).copied().collect();
        Rgb8 { width: image.width, height: image.height, bytes }
    }

    /// Mean absolute difference in codes.
    fn difference(a: &Rgb8, b: &Rgb8) -> f32 {
        let differences: u32 = a.bytes.iter().zip(&b.bytes).map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
        differences as f32 / a.bytes.len() as f32
    }

    #[test]
    fn every_frame_is_decoded_at_once_and_shows_its_picture() {
        for (width, height) in [(64, 48), (133, 57), (33, 17), (640, 480)] {
            let ((mut video, sent), mut decoder) = (stream(), Decoder::new().unwrap());
            for step in 0..5 {
                let image = picture(width, height, step);
                let encoded = video.encode(&image, quality(90)).unwrap();
                sent.store(encoded.number, Ordering::SeqCst);
                assert_eq!(encoded.is_key, step == 0, "{width} x {height}, frame {step}");
                let shown = decoded(&mut decoder, &encoded, &image);
                let error = difference(&shown, &image);
                assert!(error < 8.0, "{width} x {height}, frame {step}: {error} codes");
                let mirrored = Rgb8 { bytes: image.bytes.iter().map(|code| 255 - code).collect(), ..image };
                assert!(difference(&shown, &mirrored) > 40.0, "{width} x {height}: no measure");
            }
        }
    }

    #[test]
    fn a_lost_frame_another_size_and_another_quality_begin_anew() {
        let ((mut video, sent), mut decoder) = (stream(), Decoder::new().unwrap());
        let mut shown = |video: &mut Video, step, width, q| {
            let image = picture(width, 48, step);
            let encoded = video.encode(&image, quality(q)).unwrap();
            assert!(difference(&decoded(&mut decoder, &encoded, &image), &image) < 8.0, "frame {step}");
            sent.store(encoded.number, Ordering::SeqCst);
            encoded.is_key
        };
        assert!(shown(&mut video, 0, 64, 90) && !shown(&mut video, 1, 64, 90));
        // Encoded, but never sent; nor is the next, which is encoded before another is sent.
        let lost = video.encode(&picture(64, 48, 2), quality(90)).unwrap();
        assert!(!lost.is_key);
        assert!(shown(&mut video, 3, 64, 90));
        let late = sent.load(Ordering::SeqCst);
        assert!(!video.encode(&picture(64, 48, 2), quality(90)).unwrap().is_key);
        sent.store(late, Ordering::SeqCst);
        assert!(shown(&mut video, 3, 64, 90) && !shown(&mut video, 4, 64, 90));
        assert!(shown(&mut video, 5, 80, 90) && !shown(&mut video, 6, 80, 90));
        assert!(shown(&mut video, 7, 80, 60) && !shown(&mut video, 8, 80, 60));
        sent.store(NONE_SENT, Ordering::SeqCst);
        assert!(shown(&mut video, 9, 80, 60));
    }

    #[test]
    fn less_quality_takes_fewer_bytes_and_motion_fewer_than_a_key_frame() {
        let bytes = |q: u8| {
            let (mut video, sent) = stream();
            let mut encode = |step| {
                let encoded = video.encode(&picture(640, 480, step), quality(q)).unwrap();
                sent.store(encoded.number, Ordering::SeqCst);
                encoded.bytes.len()
            };
            [encode(0), encode(1)]
        };
        let sizes = [100, 90, 75, 60, 45, 1].map(bytes);
        assert!(sizes.windows(2).all(|pair| pair[0][0] > pair[1][0]), "{sizes:?}");
        assert!(sizes.iter().all(|[key, next]| next < key), "{sizes:?}");
        assert!((1..=100).all(|q| qp(q) <= 44 && (q == 1 || qp(q) <= qp(q - 1))));
    }
}
