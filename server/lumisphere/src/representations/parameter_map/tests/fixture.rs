//! A bumpy sheet of two parts whose texels have every kind of model there is, and some none. Everything can be turned and scaled.

use std::sync::Arc;

use glam::{Quat, Vec2, Vec3};

use crate::capture::observation_map::ObservationParameters;
use crate::capture::{Background, SurfaceMesh};
use crate::fitting::{Basis, Flags, Lobe, Model, Outliers, Precision};
use crate::geometry::{Camera, Intrinsics, Pose, TriangleMesh};
use crate::representations::MemoryPages;
use crate::representations::parameter_map::{ModelCode, ParameterMap, Parameters, QUADS_PER_PAGE, TexelTable, texel_order};
use crate::scenes::Environment;
use crate::textures::{Page, PixelFormat};

/// How the world is made and where it is put.
#[derive(Debug, Clone, Copy)]
pub struct World {
    /// Of object and light together.
    pub rotation: Quat,
    /// Of every length.
    pub scale: f32,
    /// Texels along a part's edge.
    pub size: usize,
    /// Of pages.
    pub pixel: PixelFormat,
}

pub const WORLD: World = World { rotation: Quat::IDENTITY, scale: 1.0, size: 12, pixel: PixelFormat::F32 };

// Vertices along an edge of a part.
const GRID: usize = 9;

impl World {
    /// A camera of this world, 80 × 60 pixels unless said otherwise.
    pub fn camera(&self, position: Vec3, target: Vec3, width: u32, height: u32) -> Camera {
        let place = |p: Vec3| self.scale * (self.rotation * p);
        let pose = Pose::look_at(place(position), place(target), self.rotation * Vec3::Y).unwrap();
        Camera::new(Intrinsics::from_vfov(40.0, width, height).unwrap(), pose).unwrap()
    }

    /// Two sheets side by side, about 1 × 1 each, bumpy along x and z; u grows with x, v against z.
    pub fn surface(&self) -> SurfaceMesh {
        let (mut positions, mut normals, mut uvs, mut triangles, mut parts) = (vec![], vec![], vec![], vec![], vec![]);
        for part in 0..2u32 {
            let first = positions.len() as u32;
            for (row, column) in (0..GRID * GRID).map(|i| (i / GRID, i % GRID)) {
                let uv = Vec2::new(column as f32, row as f32) / (GRID - 1) as f32;
                let (x, z) = (uv.x - 1.0 + part as f32, 0.5 - uv.y);
                let height = 0.05 * ((5.0 * x).sin() + (4.0 * z).cos());
                let slope = Vec3::new(-0.25 * (5.0 * x).cos(), 1.0, 0.2 * (4.0 * z).sin());
                positions.push(self.scale * (self.rotation * Vec3::new(x, height, z)));
                normals.push(self.rotation * slope.normalize());
                uvs.push(uv);
            }
            for (row, column) in (0..(GRID - 1) * (GRID - 1)).map(|i| (i / (GRID - 1), i % (GRID - 1))) {
                let corner = |dr: usize, dc: usize| first + ((row + dr) * GRID + column + dc) as u32;
                triangles.push([corner(0, 0), corner(0, 1), corner(1, 1)]);
                triangles.push([corner(0, 0), corner(1, 1), corner(1, 0)]);
                parts.extend([part; 2]);
            }
        }
        let mesh = TriangleMesh::new(positions, normals, uvs, triangles).unwrap();
        SurfaceMesh { mesh, part_of_triangle: parts, parts: 2 }
    }

    /// The map and its pages; `model(texel)` by `part · size² + row · size + column`.
    pub fn build(&self, model: impl Fn(usize) -> Option<Model>) -> (ParameterMap, MemoryPages) {
        let count = 2 * self.size * self.size;
        let packed: Vec<_> = (0..count).map(|i| model(i).map_or((ModelCode::NONE, Vec::new()), |m| ModelCode::pack(&m))).collect();
        // Every seventh is flagged.
        let flags = |i: usize| if i % 7 == 3 { Flags::UNRESOLVED.with(Flags::OUTLIERS) } else { Flags::NONE };
        let codes: Vec<_> = packed.iter().enumerate().map(|(i, (code, _))| (*code, flags(i))).collect();
        let texels = TexelTable::new(self.size, &codes).unwrap();
        let mut numbers: Vec<f32> = texel_order(self.size, count).flat_map(|i| packed[i].1.as_flattened().to_vec()).collect();
        let shape = ParameterMap::page_shape(self.pixel);
        numbers.resize(numbers.len().max(1).next_multiple_of(4 * QUADS_PER_PAGE as usize), 0.0);
        let pages = numbers.chunks(shape.values()).map(|page| Arc::new(Page::from_f32(shape, page).unwrap())).collect();
        let background = Background { surfaces: vec![], textures: vec![], environment: Environment::Constant(Vec3::new(0.2, 0.3, 0.4)) };
        (ParameterMap { parameters: self.parameters(), surface: self.surface(), background, texels }, MemoryPages(pages))
    }

    fn parameters(&self) -> Parameters {
        let observed = ObservationParameters {
            object: "sheet".into(),
            size_texels: self.size as u32,
            directions: "icosahedron:73".into(),
            samples_per_observation: 1,
            max_bounces: 1,
            seed: 0,
        };
        Parameters {
            observed,
            observations: "none".into(),
            models: "auto".into(),
            outliers: Outliers::Keep,
            precision: Precision::Single,
            max_bytes: None,
            pixel_format: self.pixel,
            histogram: Default::default(),
            partial: None,
        }
    }
}

/// Of texel i: every kind in turn, none now and then. Nowhere negative.
pub fn every_kind(i: usize) -> Option<Model> {
    let tone = |k: usize| 0.2 + 0.1 * ((i * 7 + k * 3) % 9) as f32;
    let rgb = [tone(0), tone(1), tone(2)];
    let lobe = |j: usize| {
        let angle = (i * 5 + j * 11) as f32;
        let axis = Vec3::new(0.6 * angle.sin(), 0.6 * angle.cos(), 0.9).normalize();
        Lobe { axis: axis.to_array(), exponent: [2.0, 20.0, 150.0][(i + j) % 3], amplitude: [tone(j), 0.5, tone(j + 4)] }
    };
    match i % 17 {
        16 => None,
        0 => Some(Model::Constant { value: rgb }),
        1 => Some(Model::CosinePower { value: rgb, exponent: 0.3 + 0.1 * (i % 5) as f32 }),
        2..=5 => Some(Model::Lobes { constant: rgb, lobes: (0..i % 17 - 1).map(lobe).collect() }),
        k => {
            let bands = k - 5;
            let coefficient =
                |n: usize| if n == 0 { 1.5 } else { 0.3 / (1.0 + n as f32) * if (n + i).is_multiple_of(2) { 1.0 } else { -1.0 } };
            let basis = if i.is_multiple_of(2) { Basis::Hemispherical } else { Basis::Spherical };
            Some(Model::Harmonics {
                basis,
                coefficients: (0..bands * bands).map(|n| [coefficient(n), 0.7 * coefficient(n), 1.2]).collect(),
            })
        }
    }
}
