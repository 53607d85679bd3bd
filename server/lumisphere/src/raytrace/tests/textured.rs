//! Glossy surfaces whose parameters are textures.

use glam::Vec3;

use super::glossy::{integrated, narrow_view, uneven_sky};
use super::*;
use crate::radiometry::brdf::AshikhminShirley;
use crate::raytrace::Appearance;
use crate::scenes::Texture;

/// R_d, R_s, α of the left and the right texel of three textures.
const TEXELS: [[Vec3; 3]; 2] = [
    [Vec3::new(0.6, 0.3, 0.1), Vec3::splat(0.04), Vec3::new(0.5, 0.1, 0.0)],
    [Vec3::new(0.1, 0.2, 0.3), Vec3::new(0.7, 0.5, 0.2), Vec3::new(0.2, 0.4, 0.0)],
];

/// A floor of two texels; the origin is the middle of the left one (0) or the right one (1).
fn floor_of_two(middle: usize) -> Scene {
    let left = if middle == 0 { -0.5 } else { -1.5 };
    let corner = |x: f32, z: f32| Vec3::new(left + 2.0 * x, 0.0, z);
    let floor = quad([corner(0.0, 1.0), corner(1.0, 1.0), corner(1.0, -1.0), corner(0.0, -1.0)]);
    let [diffuse, specular, roughness] = [0, 1, 2].map(Albedo::Texture);
    let mut scene = scene(vec![(floor, Material::Glossy { diffuse, specular, roughness }, None)], Vec3::ONE);
    scene.textures = (0..3)
        .map(|map| {
            let mut image = Image::zeros(2, 1, 3);
            (0..2).for_each(|texel| image.set_rgb(texel, TEXELS[texel][map].to_array()));
            Texture { image }
        })
        .collect();
    scene
}

#[test]
fn each_texel_reflects_an_uneven_sky_as_its_own_parameters_say() {
    for (texel, [diffuse, specular, roughness]) in TEXELS.into_iter().enumerate() {
        // Off both tangents: roughness along the wrong one shows.
        let wo = Vec3::new(0.5, 0.6, 0.3).normalize();
        let alpha = roughness.truncate();
        let brdf = AshikhminShirley::new(diffuse, specular, 2.0 / (alpha * alpha) - 2.0).unwrap().into();
        let mut scene = floor_of_two(texel);
        scene.environment = uneven_sky();
        let expected = integrated(&brdf, wo, |wi| scene.environment.radiance(wi).x);
        let image = render(&Tracer::new(&scene).unwrap(), &narrow_view(wo), &settings(256, 1));
        let (mean, deviation) = mean_and_deviation(&image);
        // 4.5 standard deviations, and the integral's own 10⁻³ (see `glossy`).
        assert!((mean - expected).abs() < 4.5 * deviation + 2e-3 * expected, "texel {texel}: {mean} ± {deviation}, {expected} expected");
        assert!(deviation < 0.01 * expected, "texel {texel}: too noisy to tell, {deviation} of {expected}");
    }
}

#[test]
fn made_diffuse_a_textured_surface_keeps_the_light_of_both_lobes() {
    for (texel, [diffuse, specular, _]) in TEXELS.into_iter().enumerate() {
        let tracer = Tracer::new(&floor_of_two(texel)).unwrap().with_appearance(0, Appearance::Diffuse);
        let image = render(&tracer, &narrow_view(Vec3::Y), &settings(16, 1)).radiance;
        let expected = specular + (Vec3::ONE - specular) * diffuse;
        // A Lambertian floor under a white sky has no noise.
        assert!((Vec3::from(image.rgb(0)) - expected).abs().max_element() < 1e-4, "{:?}, {expected} expected", image.rgb(0));
    }
}
