//! A clear sky with the sun, some clouds and haze, as a latitude–longitude map.
//!
//! Preetham, Shirley, Smits 1999, "A Practical Analytic Model for Daylight", appendix A.2 (Perez distribution with their fits for
//! luminance and chromaticity). Clouds are noise on a plane overhead. Everything is scaled together so that a white surface lying flat
//! under this sun leaves a radiance near 1.

use std::f32::consts::PI;

use glam::{Mat3, Vec2, Vec3};
use rayon::prelude::*;

use super::super::noise;
use crate::directions::direction_from_lat_long;
use crate::images::Image;

/// What the map shows.
pub(super) struct Sky {
    /// Unit vector to the sun, above the horizon.
    pub sun: Vec3,
    /// Haze: 2 very clear, 6 hazy.
    pub turbidity: f32,
    /// Of the clouds.
    pub seed: u32,
    /// Radiance below the horizon, where no ground is modelled.
    pub ground: Vec3,
}

/// Radiance per kcd/m² of the model: a white sheet lying in the sun comes out near 1.
const RADIANCE_PER_KCD: f32 = 0.055;
/// Irradiance from the sun's disc alone on a surface facing it, in the map's unit: some five times the sky's, as on a clear day.
const SUN_IRRADIANCE: Vec3 = Vec3::new(4.4, 3.9, 3.1);
/// Angular radius of the disc in the map. The true one, 0.27°, is less than a texel of a 1024-pixel map; the irradiance is kept.
const SUN_RADIUS: f32 = 0.75 * PI / 180.0;

// Coefficients a·T + b of Perez' five parameters.
const LUMINANCE: [[f32; 2]; 5] = [[0.1787, -1.4630], [-0.3554, 0.4275], [-0.0227, 5.3251], [0.1206, -2.5771], [-0.0670, 0.3703]];
const CHROMA_X: [[f32; 2]; 5] = [[-0.0193, -0.2592], [-0.0665, 0.0008], [-0.0004, 0.2125], [-0.0641, -0.8989], [-0.0033, 0.0452]];
const CHROMA_Y: [[f32; 2]; 5] = [[-0.0167, -0.2608], [-0.0950, 0.0092], [-0.0079, 0.2102], [-0.0441, -1.6537], [-0.0109, 0.0529]];
// Zenith chromaticity: rows for T², T, 1; columns for θ³, θ², θ, 1.
const ZENITH_X: [[f32; 4]; 3] =
    [[0.00166, -0.00375, 0.00209, 0.0], [-0.02903, 0.06377, -0.03202, 0.00394], [0.11693, -0.21196, 0.06052, 0.25886]];
const ZENITH_Y: [[f32; 4]; 3] =
    [[0.00275, -0.00610, 0.00317, 0.0], [-0.04214, 0.08970, -0.04153, 0.00516], [0.15346, -0.26756, 0.06670, 0.26688]];

impl Sky {
    /// `width` × `width / 2`, linear.
    pub fn map(&self, width: usize) -> Image {
        let height = width / 2;
        let model = Model::new(self);
        let texel = |index: usize| {
            let at = Vec2::new((index % width) as f32 + 0.5, (index / width) as f32 + 0.5) / Vec2::new(width as f32, height as f32);
            let d = direction_from_lat_long(at);
            self.without_sun(&model, d) + self.sun_coverage(at, width) * self.sun_radiance()
        };
        let texels: Vec<Vec3> = (0..width * height).into_par_iter().map(texel).collect();
        let plane = |channel: usize| texels.iter().map(|t| t[channel]).collect();
        Image { width, height, planes: (0..3).map(plane).collect() }
    }

    fn without_sun(&self, model: &Model, d: Vec3) -> Vec3 {
        if d.y <= 0.0 {
            // Haze hides where the ground ends.
            let horizon = model.radiance(Vec3::new(d.x, 0.0, d.z).normalize_or(Vec3::X));
            return self.ground.lerp(horizon, (1.0 + d.y * 12.0).clamp(0.0, 1.0).powi(2) * 0.9);
        }
        let clear = model.radiance(d);
        let cover = self.cloud_cover(d);
        // Lit from the sun's side: brighter toward it.
        let toward = 0.5 + 0.5 * d.dot(self.sun);
        let cloud = Vec3::new(1.0, 0.98, 0.95) * (0.85 + 0.9 * toward.powi(4));
        clear.lerp(cloud, cover)
    }

    // Opacity in [0, 1] of the clouds toward d: noise on a plane, thinned out near the horizon and around the sun.
    fn cloud_cover(&self, d: Vec3) -> f32 {
        let plane = Vec2::new(d.x, d.z) / (d.y + 0.12) * 1.1;
        let density = noise::fractal(self.seed, plane.x + 32.0, plane.y + 32.0, 64, 5);
        let near_horizon = (d.y * 6.0).clamp(0.0, 1.0);
        let near_sun = 1.0 - ((d.dot(self.sun) - 0.97) / 0.02).clamp(0.0, 1.0);
        ((density - 0.54) * 4.5).clamp(0.0, 0.85) * near_horizon * near_sun
    }

    fn sun_radiance(&self) -> Vec3 {
        SUN_IRRADIANCE / (2.0 * PI * (1.0 - SUN_RADIUS.cos()))
    }

    // Part of the texel around `at` that the sun's disc covers, from 8 × 8 directions. Small maps keep its light by the disc never
    // being smaller than a texel's sub-sample.
    fn sun_coverage(&self, at: Vec2, width: usize) -> f32 {
        const SUBSAMPLES: usize = 8;
        let texel = Vec2::new(1.0 / width as f32, 2.0 / width as f32);
        let reach = SUN_RADIUS + 2.0 * PI * texel.x;
        if direction_from_lat_long(at).dot(self.sun) < reach.cos() {
            return 0.0;
        }
        let covered = (0..SUBSAMPLES * SUBSAMPLES).filter(|i| {
            let offset = Vec2::new((i % SUBSAMPLES) as f32 + 0.5, (i / SUBSAMPLES) as f32 + 0.5) / SUBSAMPLES as f32 - 0.5;
            direction_from_lat_long(at + offset * texel).dot(self.sun) >= SUN_RADIUS.cos()
        });
        covered.count() as f32 / (SUBSAMPLES * SUBSAMPLES) as f32
    }
}

// The fits evaluated for one sun and turbidity.
struct Model {
    sun: Vec3,
    perez: [[f32; 5]; 3],
    zenith: [f32; 3],
}

impl Model {
    fn new(sky: &Sky) -> Self {
        let t = sky.turbidity;
        let sun_polar = sky.sun.y.clamp(-1.0, 1.0).acos();
        let perez = [LUMINANCE, CHROMA_X, CHROMA_Y].map(|fits| fits.map(|[a, b]| a * t + b));
        let chi = (4.0 / 9.0 - t / 120.0) * (PI - 2.0 * sun_polar);
        let luminance = (4.0453 * t - 4.9710) * chi.tan() - 0.2155 * t + 2.4192;
        let powers = [sun_polar.powi(3), sun_polar.powi(2), sun_polar, 1.0];
        let chroma = |m: [[f32; 4]; 3]| {
            let row = |r: [f32; 4]| r.iter().zip(powers).map(|(a, b)| a * b).sum::<f32>();
            t * t * row(m[0]) + t * row(m[1]) + row(m[2])
        };
        Self { sun: sky.sun, perez, zenith: [luminance, chroma(ZENITH_X), chroma(ZENITH_Y)] }
    }

    // Linear Rec. 709 toward d, at or above the horizon.
    fn radiance(&self, d: Vec3) -> Vec3 {
        let (cos_polar, cos_gamma) = (d.y.max(0.02), d.dot(self.sun).clamp(-1.0, 1.0));
        let cos_sun = self.sun.y;
        let perez = |[a, b, c, e, f]: [f32; 5], cos_polar: f32, cos_gamma: f32| {
            (1.0 + a * (b / cos_polar).exp()) * (1.0 + c * (e * cos_gamma.acos()).exp() + f * cos_gamma * cos_gamma)
        };
        let value = |i: usize| self.zenith[i] * perez(self.perez[i], cos_polar, cos_gamma) / perez(self.perez[i], 1.0, cos_sun);
        let (luminance, x, y) = (value(0) * RADIANCE_PER_KCD, value(1), value(2));
        let xyz = Vec3::new(x / y, 1.0, (1.0 - x - y) / y) * luminance;
        // CIE XYZ → linear Rec. 709 (IEC 61966-2-1).
        let rgb_from_xyz = Mat3::from_cols_array(&[3.2406, -0.9689, 0.0557, -1.5372, 1.8758, -0.2040, -0.4986, 0.0415, 1.0570]);
        let fitted = (rgb_from_xyz * xyz).max(Vec3::ZERO);
        // The fits turn pinkish at the horizon opposite a low sun; haze there is blue-white.
        let hazy = crate::radiometry::color::luminance(fitted.to_array()) * Vec3::new(0.90, 0.99, 1.22);
        fitted.lerp(hazy, (-7.0 * d.y).exp())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::EnvironmentMap;

    fn sky() -> Sky {
        Sky { sun: Vec3::new(0.6, 0.5, 0.4).normalize(), turbidity: 3.0, seed: 1, ground: Vec3::splat(0.1) }
    }

    // ∫ L cos⁺ over the sphere of texels.
    fn irradiance(image: &Image, normal: Vec3) -> Vec3 {
        let (w, h) = (image.width, image.height);
        let mut sum = Vec3::ZERO;
        for row in 0..h {
            let solid_angle = 2.0 * PI / w as f32 * ((PI * row as f32 / h as f32).cos() - (PI * (row + 1) as f32 / h as f32).cos());
            for column in 0..w {
                let d = direction_from_lat_long(Vec2::new((column as f32 + 0.5) / w as f32, (row as f32 + 0.5) / h as f32));
                sum += Vec3::from(image.rgb(row * w + column)) * d.dot(normal).max(0.0) * solid_angle;
            }
        }
        sum
    }

    #[test]
    fn the_sun_stands_where_it_should_and_brings_its_irradiance() {
        let sky = sky();
        let image = sky.map(512);
        let map = EnvironmentMap { image: image.clone(), rotation: 0.0 };
        assert!(map.radiance(sky.sun).y > 1000.0);
        assert!(map.radiance(-sky.sun).y < 1.0);
        let model = Model::new(&sky);
        let mut without = image.clone();
        for i in 0..without.planes[0].len() {
            let at = Vec2::new((i % 512) as f32 + 0.5, (i / 512) as f32 + 0.5) / Vec2::new(512.0, 256.0);
            without.set_rgb(i, sky.without_sun(&model, direction_from_lat_long(at)).into());
        }
        let sun = irradiance(&image, sky.sun) - irradiance(&without, sky.sun);
        // The disc is two texels across at this size: its area from 8 × 8 sub-samples is good to some percent.
        assert!((sun / SUN_IRRADIANCE - 1.0).abs().max_element() < 0.05, "{sun}");
    }

    #[test]
    fn a_white_sheet_lying_in_the_sun_leaves_about_one() {
        let sheet = irradiance(&sky().map(256), Vec3::Y) / PI;
        assert!((0.7..1.4).contains(&sheet.y), "{sheet}");
    }

    #[test]
    fn the_sky_is_blue_away_from_the_sun_and_finite_everywhere() {
        let image = sky().map(128);
        assert!(image.planes.iter().flatten().all(|v| v.is_finite() && *v >= 0.0));
        let away = Model::new(&sky()).radiance(Vec3::new(-0.5, 0.7, -0.4).normalize());
        assert!(away.z > 1.3 * away.x, "{away}");
    }
}
