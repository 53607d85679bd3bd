use super::*;
use crate::geometry::{Camera, Intrinsics, Pose, TriangleMesh};
use crate::progress::Unattended;
use crate::raytrace::{TraceSettings, Tracer};
use crate::scenes::{Albedo, Material, Scene, builtin, builtin_files};

fn patchwork(relief_steps: u32) -> Scene {
    let mut options = BuiltinOptions::small();
    options.patchwork.relief_steps = relief_steps;
    builtin("patchwork", &options).unwrap()
}

fn mesh(scene: &Scene) -> &TriangleMesh {
    &scene.objects[scene.object("patchwork").unwrap()].mesh
}

#[test]
fn the_relief_faces_up_over_the_whole_unit_square() {
    let scene = patchwork(48);
    let mesh = mesh(&scene);
    for (position, uv) in mesh.positions.iter().zip(&mesh.uvs) {
        assert!(uv.min_element() >= 0.0 && uv.max_element() <= 1.0, "{uv}");
        // Six digits are written.
        assert!((Vec2::new(position.x, -position.z) + 0.5 - *uv).abs().max_element() < 2e-6, "{position} at {uv}");
        assert!((0.0..=0.012).contains(&position.y), "{position}");
    }
    let mut covered = 0.0;
    for t in 0..mesh.triangles.len() {
        assert!(mesh.area_vector(t).y > 0.0, "triangle {t}");
        let [a, b, c] = mesh.triangles[t].map(|i| mesh.uvs[i as usize]);
        covered += 0.5 * (b - a).perp_dot(c - a);
    }
    // Triangles that neither fold nor leave a gap; 4608 f32 sums of six digits.
    assert!((covered - 1.0).abs() < 1e-4, "{covered}");
}

#[test]
fn normals_are_those_of_the_relief() {
    let scene = patchwork(256);
    let mesh = mesh(&scene);
    let mut around = vec![Vec3::ZERO; mesh.positions.len()];
    for t in 0..mesh.triangles.len() {
        mesh.triangles[t].iter().for_each(|i| around[*i as usize] += mesh.area_vector(t));
    }
    let mean = |of: &dyn Fn(usize) -> f32| (0..around.len()).map(of).sum::<f32>() / around.len() as f32;
    let tilt = mean(&|i| (1.0 - mesh.normals[i].y).max(0.0));
    let apart = mean(&|i| 1.0 - mesh.normals[i].dot(around[i].normalize()).min(1.0));
    // A step is a quarter of a thread of the cloth, and creases fall between steps: not the same, but much closer than to the sheet's +Y.
    // A component of the wrong sign would be twice as far from it as that.
    assert!(apart < 0.25 * tilt, "{apart} apart, {tilt} tilted");
    assert!(mesh.normals.iter().all(|n| n.is_finite() && (n.length() - 1.0).abs() < 1e-5));
}

/// Diffuse, specular and roughness at a place seen from above, as the tracer looks them up.
fn finish_at(scene: &Scene, at: Vec2) -> [Vec3; 3] {
    let material = &scene.materials[scene.objects[scene.object("patchwork").unwrap()].material];
    let Material::Glossy { diffuse, specular, roughness } = material else { panic!("{material:?}") };
    [diffuse, specular, roughness].map(|map| {
        let Albedo::Texture(texture) = map else { panic!("{map:?}") };
        scene.textures[*texture].sample(at.x, 1.0 - at.y)
    })
}

#[test]
fn each_patch_reflects_as_its_material_does() {
    let scene = patchwork(16);
    // Off the middle, where the tapes have a seam.
    let middle = |column: f32, row: f32| finish_at(&scene, Vec2::new(0.04 + PITCH * (column + 0.5), 0.04 + PITCH * (row + 0.35)));
    // Textures of 8-bit codes: a linear 0.04 is known to 2 %.
    let is = |value: Vec3, expected: f32| (value - expected).abs().max_element() < 0.03 * expected.max(0.05);
    let [towel, cloth, duct] = [middle(0.0, 0.0), middle(1.0, 0.0), middle(2.0, 0.0)];
    assert!(towel[0].min_element() > 0.6 && is(towel[1], 0.0) && towel[2].x > 0.98, "{towel:?}");
    assert!(is(cloth[1], 0.0) && cloth[2].x > 0.98, "{cloth:?}");
    assert!(duct[0].max_element() < 0.3 && is(duct[1], 0.12), "{duct:?}");
    let [clear, red, silver] = [middle(0.0, 1.0), middle(1.0, 1.0), middle(2.0, 1.0)];
    assert!(clear[0].min_element() > 0.5 && is(clear[1], 0.04) && clear[2].x < 0.1, "{clear:?}");
    assert!(red[0].x > 10.0 * red[0].y && is(red[1], 0.04) && red[2].x < 0.06, "{red:?}");
    assert!(is(silver[0], 0.0) && silver[1].min_element() > 0.88 && silver[2].x < 0.08, "{silver:?}");
    let [gold, flyer, wood] = [middle(0.0, 2.0), middle(1.0, 2.0), middle(2.0, 2.0)];
    assert!(is(gold[0], 0.0) && gold[1].x > 2.0 * gold[1].z && gold[2].x > silver[2].x, "{gold:?}");
    assert!(is(flyer[1], 0.04) && flyer[2].x < 0.2, "{flyer:?}");
    assert!(wood[0].x > 1.5 * wood[0].z && wood[2].x > 2.0 * wood[2].y, "{wood:?}");
    let margin = finish_at(&scene, Vec2::splat(0.02));
    assert!(margin[0].min_element() > 0.7 && is(margin[1], 0.0), "{margin:?}");
}

#[test]
fn a_seed_changes_relief_and_textures_alike() {
    let files = |seed| builtin_files("patchwork", &BuiltinOptions { seed, ..BuiltinOptions::small() }).unwrap().files;
    let (a, b) = (files(1), files(2));
    for file in ["patchwork.obj", "patchwork_diffuse.png"] {
        assert_ne!(a[file], b[file], "{file}");
    }
}

#[test]
fn paper_has_the_radiance_that_the_lamp_is_made_for_wherever_it_stands() {
    for lamp in [Vec3::new(1.6, 3.2, -2.0), Vec3::new(-3.0, 2.0, 1.0)] {
        let mut options = BuiltinOptions::small();
        options.patchwork.lamp = lamp;
        let scene = builtin("patchwork", &options).unwrap();
        let pose = Pose::look_at(Vec3::new(0.0, 2.4, 0.0), Vec3::ZERO, Vec3::NEG_Z).unwrap();
        // The sheet fills the picture.
        let camera = Camera::new(Intrinsics::from_vfov(23.5, 32, 32).unwrap(), pose).unwrap();
        let settings = TraceSettings { samples_per_pixel: 32, max_bounces: 2, seed: 1 };
        let image = Tracer::new(&scene).unwrap().render(&camera, &settings, &Unattended).unwrap().radiance;
        let green = &image.planes[1];
        let margin: f32 = green[..32].iter().sum::<f32>() / 32.0;
        // Albedo 0.84 × irradiance 0.6 π ± a quarter across the sheet / π, × A. & S.'s 28/23 × rims of 0.9; and the sky.
        assert!((0.4..0.8).contains(&margin), "lamp at {lamp}: {margin}");
        let mean = green.iter().sum::<f32>() / green.len() as f32;
        assert!((0.1..1.0).contains(&mean), "lamp at {lamp}: {mean}");
        // The brightest thing that a black texel could see is the sky of 0.15.
        let least = green.iter().copied().fold(f32::INFINITY, f32::min);
        assert!(least > 0.005, "lamp at {lamp}: {least}");
    }
}
