//! A light field that is known in closed form: a coloured sphere of radius 1 under a smooth environment at infinity, on a textured
//! floor that only the background shows. Everything can be turned about the origin and scaled.

use std::path::Path;
use std::sync::Arc;

use glam::{Quat, Vec2, Vec3};

use crate::capture::{Background, BackgroundSurface, SurfaceMesh, coarser_levels, halved, stacked, with_sky_shares};
use crate::directions::{FACES, direction_from_face, direction_from_lat_long, texel_direction};
use crate::geometry::{Camera, Intrinsics, Pose, TriangleMesh};
use crate::images::Image;
pub(crate) use crate::representations::MemoryPages;
use crate::representations::Original;
use crate::representations::offset_surface_light_field::{
    NO_SAMPLE, OffsetSurfaceLightField, Parameters, Placing, SampleMaps, SamplePoint, Spacing, build_sample_maps,
};
use crate::scenes::{Albedo, Environment, EnvironmentMap, Texture};
use crate::textures::{DatasetVersion, Page, PageId, PageShape, PixelFormat, Publication, Store, StoreOptions};

/// How the world is made and where it is put.
#[derive(Debug, Clone, Copy)]
pub struct World {
    /// Of object, light and background together.
    pub rotation: Quat,
    /// Of every length.
    pub scale: f32,
    /// Sample points around the sphere.
    pub points: usize,
    /// Texels along a cube map's face.
    pub face_size: u32,
    /// Quads along an edge of each of the sphere's six parts.
    pub quads: u32,
    /// Of the pages.
    pub pixel: PixelFormat,
    /// The environment is on a sphere of this radius about the origin; infinite: infinitely far.
    pub room: f32,
    /// Offset of the sample points, in radii.
    pub epsilon: f32,
    /// Radiance of a sun 6° wide in the environment; 0 for none.
    pub sun: f32,
    /// Of the sphere's point with this normal, in every direction; in the unturned world.
    pub surface: fn(Vec3) -> Vec3,
}

/// Small enough for tests.
pub const WORLD: World = World {
    rotation: Quat::IDENTITY,
    scale: 1.0,
    points: 80,
    face_size: 32,
    quads: 12,
    pixel: PixelFormat::F16,
    room: f32::INFINITY,
    epsilon: 0.1,
    sun: 0.0,
    surface: surface_radiance,
};

/// These pages as the only version of dataset "sphere" in a new store.
pub fn stored(root: &Path, pages: &MemoryPages) -> Arc<DatasetVersion> {
    let (store, _) = Store::open(root, StoreOptions::local()).unwrap();
    store.create_dataset("sphere").unwrap();
    let staging = store.stage("sphere", "test").unwrap();
    for (number, page) in pages.0.iter().enumerate() {
        staging.append_page(PageId(number as u32), &page.shape(), &page.to_f32()).unwrap();
    }
    staging.publish(publication()).unwrap()
}

/// Of pages alone.
pub fn publication() -> Publication {
    Publication {
        kind: "offset_surface_light_field".into(),
        parameters: serde_json::Value::Null,
        inputs: Default::default(),
        code_version: "test".into(),
        created_unix_millis: 0,
    }
}

/// From infinity, in the unturned world; smooth, between 0.1 and 1.6.
pub fn environment_radiance(d: Vec3) -> Vec3 {
    Vec3::new(0.8 + 0.5 * d.x, 0.7 + 0.3 * d.y + 0.2 * d.x * d.z, 0.9 - 0.4 * d.z + 0.3 * d.x * d.y)
}

/// Of the sphere's point with normal `n`, in every direction; in the unturned world.
pub fn surface_radiance(n: Vec3) -> Vec3 {
    Vec3::new(0.4 + 0.2 * n.y, 0.5 - 0.2 * n.x * n.z, 0.3 + 0.25 * n.z)
}

impl World {
    /// What is seen from `p` toward the unit vector `d`, and how far; in the unturned world of radius 1.
    pub fn seen(&self, p: Vec3, d: Vec3) -> (Vec3, f32) {
        let (b, c) = (p.dot(d), p.length_squared() - 1.0);
        let discriminant = b * b - c;
        if discriminant > 0.0 && -b - discriminant.sqrt() > 0.0 {
            let t = -b - discriminant.sqrt();
            return ((self.surface)((p + t * d).normalize()), t);
        }
        self.surroundings(p, d)
    }

    /// The same without the sphere.
    pub fn surroundings(&self, p: Vec3, d: Vec3) -> (Vec3, f32) {
        if self.room.is_infinite() {
            return (self.environment(d), f32::INFINITY);
        }
        let b = p.dot(d);
        let t = (b * b - p.length_squared() + self.room * self.room).sqrt() - b;
        (self.environment((p + t * d) / self.room), t)
    }

    fn environment(&self, d: Vec3) -> Vec3 {
        let sun = if d.dot(Vec3::new(0.48, 0.6, 0.64)) > 3f32.to_radians().cos() { self.sun } else { 0.0 };
        environment_radiance(d) + sun
    }

    /// The light field and its pages.
    pub fn build(&self) -> (OffsetSurfaceLightField, MemoryPages) {
        let place = |p: Vec3| self.scale * (self.rotation * p);
        let surface = self.sphere();
        let sample_points: Vec<SamplePoint> = (0..self.points)
            .map(|i| fibonacci(i, self.points))
            .map(|n| SamplePoint { position: place((1.0 + self.epsilon) * n), normal: self.rotation * n })
            .collect();
        // The same points for every rotation and scale: distances are compared on equal terms, whatever the rounding.
        let unturned = Self { rotation: Quat::IDENTITY, scale: 1.0, ..*self };
        let unturned_points: Vec<SamplePoint> = (0..self.points)
            .map(|i| fibonacci(i, self.points))
            .map(|n| SamplePoint { position: (1.0 + self.epsilon) * n, normal: n })
            .collect();
        let sample_maps = build_sample_maps(&unturned.sphere(), &unturned_points, 16, &|_, _| true);
        let seen = |cube: usize, d: Vec3| {
            let at = if cube < self.points { (1.0 + self.epsilon) * fibonacci(cube, self.points) } else { Vec3::ZERO };
            let d = self.rotation.inverse() * d;
            let (radiance, distance) = if cube == self.points { self.surroundings(at, d) } else { self.seen(at, d) };
            (radiance, distance * self.scale)
        };
        let made_with = (self.epsilon * self.scale, self.face_size, self.pixel);
        light_field((surface, self.background()), sample_points, sample_maps, made_with, seen)
    }

    // A part for each face of a cube, blown up to a sphere; (u, v) run with (s, t).
    fn sphere(&self) -> SurfaceMesh {
        let mut grids = Grids::default();
        for face in 0..FACES {
            add_part(&mut grids, self.quads, |uv| {
                let n = self.rotation * direction_from_face(face, 2.0 * uv.x - 1.0, 2.0 * uv.y - 1.0).normalize();
                (self.scale * n, n)
            });
        }
        grids.into()
    }

    // A square floor below the sphere with a checkered texture, and the environment as a small map.
    fn background(&self) -> Background {
        let corners = [Vec2::new(-3.0, -3.0), Vec2::new(3.0, -3.0), Vec2::new(3.0, 3.0), Vec2::new(-3.0, 3.0)];
        let positions = corners.map(|c| self.scale * (self.rotation * Vec3::new(c.x, -1.2, c.y))).to_vec();
        let normals = vec![self.rotation * Vec3::Y; 4];
        let uvs = corners.map(|c| (c + 3.0) / 3.0).to_vec();
        let mesh = TriangleMesh::new(positions, normals, uvs, vec![[0, 2, 1], [0, 3, 2]]).expect("a square is a mesh");
        let irradiance = [1.0, 2.0, 3.0, 4.0].map(|e| [Vec3::new(e, 2.0, 1.0), Vec3::new(0.5, e, 0.25)]).to_vec();
        let floor = BackgroundSurface { mesh, irradiance, albedo: Some(Albedo::Texture(0)), emission: Vec3::new(0.0, 0.0, 0.05) };
        let mut image = Image::zeros(16, 16, 3);
        for i in 0..256 {
            image.set_rgb(i, if (i % 16 / 4 + i / 64) % 2 == 0 { [0.75, 0.5, 0.25] } else { [0.25, 0.5, 0.75] });
        }
        Background { surfaces: vec![floor], textures: vec![Texture { image }], environment: Environment::Map(self.environment_map()) }
    }

    // Turned about +Y as far as the rotation is one about +Y; other rotations bake into the texels.
    fn environment_map(&self) -> EnvironmentMap {
        let mut image = Image::zeros(64, 32, 3);
        for (row, column) in (0..32).flat_map(|r| (0..64).map(move |c| (r, c))) {
            let d = direction_from_lat_long(Vec2::new((column as f32 + 0.5) / 64.0, (row as f32 + 0.5) / 32.0));
            let radiance = environment_radiance(self.rotation.inverse() * Quat::from_rotation_y(ENVIRONMENT_TURN) * d);
            image.set_rgb(row * 64 + column, radiance.into());
        }
        EnvironmentMap { image, rotation: ENVIRONMENT_TURN }
    }

    /// A camera at `origin` (in the unturned world of radius 1) that looks at `target`.
    pub fn camera(&self, origin: Vec3, target: Vec3, width: u32, height: u32) -> Camera {
        let up = if (target - origin).normalize().y.abs() > 0.99 { Vec3::Z } else { Vec3::Y };
        let place = |p: Vec3| self.scale * (self.rotation * p);
        let pose = Pose::look_at(place(origin), place(target), self.rotation * up).expect("distinct points");
        Camera::new(Intrinsics::from_vfov(45.0, width, height).expect("a sensible angle"), pose).expect("a camera")
    }
}

// So that the map's own rotation is tested, too.
const ENVIRONMENT_TURN: f32 = 0.6;

/// Takes away samples: every third texel keeps `kept` of its four, whatever was there.
pub fn starve(field: &mut OffsetSurfaceLightField, kept: usize) {
    for texel in field.sample_maps.indices.iter_mut().step_by(3) {
        texel[kept..].fill(NO_SAMPLE);
    }
}

/// The light field of these points, made with ε, face size and format; `seen(cube, d)`: radiance and distance from a point toward the unit
/// vector `d`, the last cube without the object.
pub fn light_field(
    (surface, background): (SurfaceMesh, Background),
    sample_points: Vec<SamplePoint>,
    sample_maps: SampleMaps,
    (epsilon, face_size, pixel): (f32, u32, PixelFormat),
    seen: impl Fn(usize, Vec3) -> (Vec3, f32),
) -> (OffsetSurfaceLightField, MemoryPages) {
    let size = face_size as usize;
    let page = |cube: usize, face: usize| {
        let mut values = Vec::with_capacity(4 * size * size);
        for (row, column) in (0..size).flat_map(|r| (0..size).map(move |c| (r, c))) {
            let (radiance, distance) = seen(cube, texel_direction(face, size, column as f32 + 0.5, row as f32 + 0.5));
            values.extend([radiance.x, radiance.y, radiance.z, distance]);
        }
        let shape = PageShape { width: face_size, height: face_size, channels: 4, pixel };
        Page::from_f32(shape, &values).expect("shape and count agree")
    };
    let mut pages = Vec::new();
    let levels = coarser_levels(face_size) as usize;
    let mut coarser = vec![Vec::new(); levels];
    for cube in 0..=sample_points.len() {
        let mut faces: Vec<Page> = (0..FACES).map(|face| page(cube, face)).collect();
        pages.extend(faces.iter().cloned().map(Arc::new));
        faces = faces.iter().map(|face| with_sky_shares(face).expect("four channels")).collect();
        for level in &mut coarser {
            faces = faces.iter().map(|face| halved(face, 4).expect("even sizes")).collect();
            level.push(Arc::new(stacked(&faces).expect("six faces")));
        }
    }
    pages.extend(coarser.into_iter().flatten());
    let parameters = Parameters {
        object: "sphere".into(),
        epsilon,
        face_size_texels: face_size,
        coarser_levels: levels as u32,
        sample_map_size_texels: sample_maps.size as u32,
        spacing: Spacing::Count(sample_points.len() as u32),
        placing: Placing::Uniform,
        object_center: [0.0; 3],
        samples_per_texel: 1,
        max_bounces: 1,
        seed: 0,
        original: Original::Diffuse,
        thinned_from: None,
        replaced: None,
    };
    (OffsetSurfaceLightField { parameters, surface, sample_points, sample_maps, background }, MemoryPages(pages))
}

/// A part of squares on a grid over (u, v), `edge` along an edge, whose point and normal are `at(uv)`; added behind what `mesh` has. u to the
/// right and v down, seen from inside: counter-clockwise from outside.
pub fn add_part(mesh: &mut Grids, edge: u32, at: impl Fn(Vec2) -> (Vec3, Vec3)) {
    let first = mesh.positions.len() as u32;
    for (j, i) in (0..=edge).flat_map(|j| (0..=edge).map(move |i| (j, i))) {
        let uv = Vec2::new(i as f32, j as f32) / edge as f32;
        let (position, normal) = at(uv);
        mesh.positions.push(position);
        mesh.normals.push(normal);
        mesh.uvs.push(uv);
    }
    for (j, i) in (0..edge).flat_map(|j| (0..edge).map(move |i| (j, i))) {
        let row = edge + 1;
        let a = first + j * row + i;
        mesh.triangles.extend([[a, a + 1, a + row + 1], [a, a + row + 1, a + row]]);
        mesh.part_of_triangle.extend([mesh.parts; 2]);
    }
    mesh.parts += 1;
}

/// Parts that [`add_part`] made.
#[derive(Default)]
pub struct Grids {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    uvs: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
    part_of_triangle: Vec<u32>,
    parts: u32,
}

impl From<Grids> for SurfaceMesh {
    fn from(grids: Grids) -> Self {
        let Grids { positions, normals, uvs, triangles, part_of_triangle, parts } = grids;
        let mesh = TriangleMesh::new(positions, normals, uvs, triangles).expect("grids are a mesh");
        Self { mesh, part_of_triangle, parts }
    }
}

/// Point i of n spread evenly over the sphere.
pub fn fibonacci(i: usize, n: usize) -> Vec3 {
    let y = 1.0 - (2.0 * i as f32 + 1.0) / n as f32;
    let (sin, cos) = (2.399_963_2 * i as f32).sin_cos();
    let r = (1.0 - y * y).sqrt();
    Vec3::new(r * cos, y, r * sin)
}
