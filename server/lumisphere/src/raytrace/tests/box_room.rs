//! An independent renderer's images of a room (Mitsuba 3.9.1; `data/scenes/box-room`) matched within both noises.
//!
//! How: ours is rendered twice with different seeds. Half the mean square difference of the halves' mean, `(A − B)²/4`, estimates
//! the noise of `(A + B)/2`, the truth's report states its own, and `rmse² − noise²(ours) − noise²(truth)` is then zero up to
//! chance for a perfect renderer. Chance is measured too: mean squares of N errors spread by their deviation / √N; ours is seen
//! in `(A − B)²/4`, and the truth's, of the same paths in the same pixels, is taken to be of the same relative size. The excess
//! must stay below 4.5 standard deviations. The same on means over 8 × 8 pixels, where the noise is eight times less and any bias
//! that is not noise stands out.
//!
//! The truth shows the two textures upside down: row 0 of their images at v = 0, against the format's own description (v = 0 is the
//! bottom row) and against the `.glb` beside it, whose v is 1 − v. The product follows the description; here the textures are
//! turned over to compare light, and a control holds that they match no other way.

use std::path::PathBuf;

use super::*;
use crate::directions::{CubeMap, texel_direction};
use crate::images::{ExrLayer, Nan, ReadLimits, decode_exr};
use crate::scenes::{LoadOptions, SceneFolder, load};
use crate::testdata::shipped;

struct Room {
    scene: Scene,
    truth: PathBuf,
}

impl Room {
    fn open() -> Self {
        let folder = shipped("scenes/box-room");
        let files = SceneFolder::open(&folder, 1 << 26).unwrap();
        let mut room = Self { scene: load(&files, "scene.json", &LoadOptions::as_written()).unwrap(), truth: folder.join("truth") };
        room.turn_textures_over();
        room
    }

    fn turn_textures_over(&mut self) {
        for image in self.scene.textures.iter_mut().map(|t| &mut t.image) {
            let width = image.width;
            image.planes.iter_mut().for_each(|p| *p = p.chunks(width).rev().flatten().copied().collect());
        }
    }

    fn layer(&self, file: &str) -> ExrLayer {
        let limits = ReadLimits { nan: Nan::Keep, ..ReadLimits::SCENE };
        decode_exr(&std::fs::read(self.truth.join(file)).unwrap(), limits).unwrap().layers.remove(0)
    }

    /// The radiance of a truth file and its stated noise.
    fn radiance(&self, file: &str) -> (Image, f64) {
        let report: serde_json::Value = serde_json::from_slice(&std::fs::read(self.truth.join("report.json")).unwrap()).unwrap();
        let entry = report.as_array().unwrap().iter().find(|e| e["file"] == file).unwrap();
        (self.layer(file).planes(&["R", "G", "B"]).unwrap(), entry["noise_rmse"].as_f64().unwrap())
    }

    fn view(&self, index: usize) -> Camera {
        self.scene.cameras.iter().find(|c| c.name == format!("view{index}")).unwrap().camera
    }

    /// Two independent renderings of a view.
    fn halves(&self, view: usize, settings: TraceSettings) -> [Image; 2] {
        let tracer = Tracer::new(&self.scene).unwrap();
        [1, 2].map(|seed| render(&tracer, &self.view(view), &TraceSettings { seed, ..settings }).radiance)
    }
}

/// What is left of the difference once both noises are taken off.
#[derive(Debug, Clone, Copy)]
#[expect(dead_code, reason = "printed when a comparison fails")]
struct Comparison {
    /// √max(0, rmse² − noise²): radiance units.
    error: f64,
    noise: f64,
    /// The excess of the mean square in standard deviations.
    z: f64,
}

/// Means over `block` × `block` pixels.
fn blocks(image: &Image, block: usize) -> Vec<f64> {
    let (columns, rows) = (image.width / block, image.height / block);
    let mean = |plane: &Vec<f32>, i: usize| {
        let (left, top) = (i % columns * block, i / columns * block);
        let pixels = (0..block * block).map(|k| plane[(top + k / block) * image.width + left + k % block]);
        pixels.map(f64::from).sum::<f64>() / (block * block) as f64
    };
    image.planes.iter().flat_map(|p| (0..columns * rows).map(move |i| mean(p, i))).collect()
}

fn compare([a, b]: &[Image; 2], truth: &Image, truth_noise: f64, block: usize) -> Comparison {
    let (a, b, truth) = (blocks(a, block), blocks(b, block), blocks(truth, block));
    let count = truth.len() as f64;
    // The truth's pixels are independent: their block means are quieter by the block's edge.
    let truth_square = (truth_noise / block as f64).powi(2);
    let own: Vec<f64> = a.iter().zip(&b).map(|(a, b)| (a - b).powi(2) / 4.0).collect();
    let own_square = own.iter().sum::<f64>() / count;
    let spread = (own.iter().map(|d| (d - own_square).powi(2)).sum::<f64>() / count).sqrt() / own_square / count.sqrt();
    let square = truth.iter().zip(a.iter().zip(&b)).map(|(t, (a, b))| (t - 0.5 * (a + b)).powi(2)).sum::<f64>() / count;
    let excess = square - own_square - truth_square;
    // Each noise enters twice: once in the measured difference, once in its own estimate.
    let deviation = spread * 2f64.sqrt() * (own_square.powi(2) + truth_square.powi(2)).sqrt();
    // Both sums also hold the product of the two errors, 2·n₁·n₂ in every pixel.
    let deviation = deviation.hypot(2.0 * (own_square * truth_square / count).sqrt());
    Comparison { error: excess.max(0.0).sqrt(), noise: (own_square + truth_square).sqrt(), z: excess / deviation }
}

const Z: f64 = 4.5;

fn assert_matches(what: &str, halves: &[Image; 2], (truth, noise): &(Image, f64)) {
    for block in [1, 8] {
        let comparison = compare(halves, truth, *noise, block);
        assert!(comparison.z < Z, "{what}, means over {block} x {block} pixels: {comparison:?}");
    }
}

#[test]
fn every_view_matches_the_independent_renderer_within_the_noise() {
    let room = Room::open();
    for view in [0, 1] {
        assert_matches(&format!("view{view}"), &room.halves(view, settings(8, 64)), &room.radiance(&format!("view{view}.exr")));
        let direct = format!("view{view}_direct.exr");
        assert_matches(&direct, &room.halves(view, settings(16, 1)), &room.radiance(&direct));
    }
}

#[test]
fn wrong_albedos_shifted_images_swapped_channels_and_turned_textures_do_not_match() {
    let mut room = Room::open();
    let truth = room.radiance("view0_direct.exr");
    let fails = |halves: &[Image; 2]| [1, 8].iter().any(|block| compare(halves, &truth.0, truth.1, *block).z > 2.0 * Z);
    let right = room.halves(0, settings(16, 1));
    assert!(!fails(&right));
    let shifted = right.clone().map(|mut image| {
        image.planes.iter_mut().for_each(|p| p.rotate_right(1));
        image
    });
    assert!(fails(&shifted), "shifted by one pixel");
    let swapped = right.map(|mut image| {
        image.planes.swap(0, 2);
        image
    });
    assert!(fails(&swapped), "red and blue swapped");
    room.turn_textures_over();
    assert!(fails(&room.halves(0, settings(16, 1))), "textures as described");
    room.turn_textures_over();
    for material in &mut room.scene.materials {
        if let Material::Diffuse { albedo: Albedo::Constant(albedo) } = material {
            *albedo *= 0.98;
        }
    }
    assert!(fails(&room.halves(0, settings(16, 1))), "albedos 2 % too dark");
}

#[test]
fn distance_and_normal_match_at_every_pixel_centre() {
    let room = Room::open();
    let tracer = Tracer::new(&room.scene).unwrap();
    for view in [0, 1] {
        let truth = room.layer(&format!("view{view}_geometry.exr"));
        let truth = truth.planes(&["D", "N.X", "N.Y", "N.Z"]).unwrap();
        let image = render(&tracer, &room.view(view), &settings(1, 0));
        let far = |i: &usize| {
            let (d, t) = (image.distance.planes[0][*i], truth.planes[0][*i]);
            let normal = Vec3::from(image.normal.rgb(*i)) - Vec3::new(truth.planes[1][*i], truth.planes[2][*i], truth.planes[3][*i]);
            // Distances are f32 in the file: a few ULP of coordinates up to 4 m. Normals are half: 2⁻¹¹.
            !(d == t || (d - t).abs() < 1e-5 * t) || normal.length() > 2e-3
        };
        let off = (0..image.object.len()).filter(far).count();
        // Rays along an edge may fall to either side of it.
        assert!(off <= 8, "view{view}: {off} pixels of {} differ", image.object.len());
    }
}

/// The six faces in one column, as the file has them.
fn column(cube: &CubeMap) -> Image {
    let mut image = Image::zeros(cube.size, 6 * cube.size, 3);
    cube.texels.iter().enumerate().for_each(|(i, t)| image.set_rgb(i, [t[0], t[1], t[2]]));
    image
}

fn face(image: &Image, face: usize) -> Image {
    let texels = image.width * image.width;
    let planes = image.planes.iter().map(|p| p[face * texels..(face + 1) * texels].to_vec()).collect();
    Image { width: image.width, height: image.width, planes }
}

#[test]
fn every_face_of_the_cube_map_matches_the_independent_renderer() {
    let room = Room::open();
    let cubes: serde_json::Value = serde_json::from_slice(&std::fs::read(room.truth.join("cubes.json")).unwrap()).unwrap();
    let at: Vec<f32> = cubes[0]["position"].as_array().unwrap().iter().map(|c| c.as_f64().unwrap() as f32).collect();
    let position = Vec3::new(at[0], at[1], at[2]);
    let tracer = Tracer::new(&room.scene).unwrap();
    let (truth, noise) = room.radiance("cube_0.exr");
    let size = truth.width;
    let cubes = [1, 2].map(|seed| {
        let settings = TraceSettings { seed, ..settings(32, 64) };
        tracer.cube_map(position, size, &settings, &Unattended).unwrap()
    });
    let columns = [column(&cubes[0]), column(&cubes[1])];
    assert_matches("cube_0", &columns, &(truth.clone(), noise));
    let own_square = |[a, b]: &[Image; 2]| {
        let differences = a.planes.iter().zip(&b.planes).flat_map(|(a, b)| a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)));
        differences.sum::<f64>() / (3 * a.width * a.height) as f64
    };
    let layer = room.layer("cube_0.exr");
    let distance = layer.channel("D").unwrap();
    for f in 0..6 {
        let halves = [face(&columns[0], f), face(&columns[1], f)];
        // The stated noise is that of all faces together; over the faces it is spread as ours is.
        let face_noise = noise * (own_square(&halves) / own_square(&columns)).sqrt();
        let comparison = compare(&halves, &face(&truth, f), face_noise, 8);
        assert!(comparison.z < Z, "face {f}: {comparison:?}");
        let off = (0..size * size).filter(|i| {
            let (d, t) = (cubes[0].texels[f * size * size + i][3], distance[f * size * size + i]);
            !((d - t).abs() < 1e-5 * t)
        });
        assert!(off.count() <= 4, "distances of face {f}");
        // The normals of the file are those where the texel's direction meets the room.
        let toward = texel_direction(f, size, 20.5, 30.5);
        let hit = tracer.intersect(&crate::geometry::Ray { origin: position, direction: toward }, f32::INFINITY).unwrap();
        let n = ["N.X", "N.Y", "N.Z"].map(|c| layer.channel(c).unwrap()[f * size * size + 30 * size + 20]);
        assert!((hit.shading_normal - Vec3::from(n)).length() < 2e-3, "normal of face {f}");
    }
}
