//! Shapes that a scene file describes in place of a mesh file: `"shape": {"type": …}`.
//!
//! All face outward, all have uv in [0, 1]² in which no two points of the surface share a place. Called by the scene file's reader;
//! the built-in scenes are made of them.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use super::error::SceneError;
use super::json::{Fields, Node};
use crate::geometry::{TangentFrame, TriangleMesh};

/// Reads and builds a shape.
pub(super) fn build(node: &Node, file: &str, object: &str) -> Result<TriangleMesh, SceneError> {
    let fields = node.fields()?;
    let mesh = build_from(&fields, file, object)?;
    fields.finish()?;
    Ok(mesh)
}

/// Builds a shape from fields among which the caller has others of its own, and finishes them.
pub(super) fn build_from(fields: &Fields, file: &str, object: &str) -> Result<TriangleMesh, SceneError> {
    let kind = fields.required("type")?;
    let vec3 = |key| fields.required(key).and_then(|n| n.vec3());
    let length = |key| fields.required(key).and_then(|n| n.length());
    let segments = |default| fields.optional("segments").map_or(Ok(default), |n| n.count(3..=4096));
    let arrays = match kind.text()? {
        "rect" => rect(vec3("corner")?, vec3("edge_u")?, vec3("edge_v")?),
        "disc" => disc(vec3("center")?, fields.required("normal")?.direction()?, length("radius")?, segments(64)?),
        "box" => {
            let (low, high) = (vec3("min")?, vec3("max")?);
            let size = high - low;
            block(low, Vec3::X * size.x, Vec3::Y * size.y, Vec3::Z * size.z)
        }
        "beam" => {
            let up = fields.optional("up").map_or(Ok(Vec3::Y), |n| n.direction())?;
            beam(vec3("from")?, vec3("to")?, length("width")?, length("height")?, up)
        }
        "sphere" => sphere(vec3("center")?, length("radius")?, segments(64)?),
        "lathe" => {
            let profile = fields.required("profile")?;
            let points = profile.list()?.iter().map(|p| p.numbers::<2>().map(Vec2::from)).collect::<Result<Vec<_>, _>>()?;
            if points.len() < 2 || points.iter().any(|p| p.x < 0.0) {
                return Err(profile.wrong("at least two points [radius, height], no radius below 0"));
            }
            let flat = fields.optional("flat_sides").map_or(Ok(false), |n| n.flag())?;
            lathe(&points, segments(48)?, if flat { Sides::Flat } else { Sides::Round })
        }
        "cloth" => {
            let cloth = Cloth {
                radius: length("radius")?,
                drop: length("drop")?,
                folds: fields.required("folds")?.count(1..=200)?,
                depth: fields.required("fold_depth")?.number_in(0.0..=100.0)?,
            };
            cloth.arrays(segments(144)?)
        }
        "blob" => {
            let seed = fields.required("seed")?.count(0..=u32::MAX)?;
            blob(vec3("center")?, vec3("radii")?, fields.required("roughness")?.number_in(0.0..=0.9)?, segments(24)?, seed)
        }
        _ => return Err(kind.wrong("rect, disc, box, beam, sphere, lathe, cloth or blob")),
    };
    let Arrays { positions, normals, uvs, triangles } = arrays;
    TriangleMesh::new(positions, normals, uvs, triangles).map_err(|source| SceneError::Geometry {
        file: file.to_owned(),
        object: object.to_owned(),
        source,
    })
}

#[derive(Default)]
struct Arrays {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    uvs: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
}

/// How the flank of a turned body is shaded.
#[derive(Clone, Copy, PartialEq)]
enum Sides {
    Round,
    /// A prism: every side one plane.
    Flat,
}

impl Arrays {
    // A quadrilateral patch of surface, counter-clockwise.
    fn quad(&mut self, corners: [Vec3; 4], normals: [Vec3; 4], uvs: [Vec2; 4]) {
        let base = self.positions.len() as u32;
        self.positions.extend(corners);
        self.normals.extend(normals);
        self.uvs.extend(uvs);
        self.triangles.extend([[base, base + 1, base + 2], [base, base + 2, base + 3]]);
    }

    // A grid of (columns + 1) × (rows + 1) vertices with normals from its neighbours; `closed` in the column direction.
    fn smooth_grid(columns: u32, rows: u32, position: impl Fn(u32, u32) -> Vec3, uv: impl Fn(u32, u32) -> Vec2) -> Self {
        let mut arrays = Self::default();
        for row in 0..=rows {
            for column in 0..=columns {
                // The last column is the first again: same position, so that no ray passes through the seam.
                let at = |c: u32, r: u32| position(c % columns, r);
                let along = at((column + 1) % columns, row) - at((column + columns - 1) % columns, row);
                let down = at(column, (row + 1).min(rows)) - at(column, row.saturating_sub(1));
                arrays.positions.push(at(column, row));
                arrays.normals.push(down.cross(along).normalize_or_zero());
                arrays.uvs.push(uv(column, row));
            }
        }
        for row in 0..rows {
            for column in 0..columns {
                let corner = row * (columns + 1) + column;
                let below = corner + columns + 1;
                arrays.triangles.extend([[corner, below, below + 1], [corner, below + 1, corner + 1]]);
            }
        }
        arrays
    }
}

// Normal edge_u × edge_v.
fn rect(corner: Vec3, edge_u: Vec3, edge_v: Vec3) -> Arrays {
    let mut arrays = Arrays::default();
    let normal = edge_u.cross(edge_v).normalize_or_zero();
    let uvs = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    arrays.quad([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v], [normal; 4], uvs);
    arrays
}

// A regular polygon seen as a disc; uv is its plan, so that a picture lies on it undistorted.
fn disc(center: Vec3, normal: Vec3, radius: f32, segments: u32) -> Arrays {
    // Horizontal discs have their picture's u along +X and v along −Z, as seen on a map.
    let frame =
        if normal.y > 0.999_999 { TangentFrame { tangent: Vec3::X, bitangent: Vec3::NEG_Z, normal } } else { TangentFrame::around(normal) };
    let mut arrays = Arrays::default();
    let mut vertex = |x: f32, y: f32| {
        arrays.positions.push(center + radius * frame.world_from_local(Vec3::new(x, y, 0.0)));
        arrays.normals.push(normal);
        arrays.uvs.push(0.5 + 0.5 * Vec2::new(x, y));
    };
    vertex(0.0, 0.0);
    for i in 0..segments {
        let (sin, cos) = (TAU * i as f32 / segments as f32).sin_cos();
        vertex(cos, sin);
    }
    arrays.triangles = (0..segments).map(|i| [0, 1 + i, 1 + (i + 1) % segments]).collect();
    arrays
}

// Six faces from one corner and three edges (right-handed); uv: a 3 × 2 atlas.
fn block(corner: Vec3, x: Vec3, y: Vec3, z: Vec3) -> Arrays {
    let mut arrays = Arrays::default();
    let faces = [(corner + x + z, -z, y), (corner, z, y), (corner + y + z, x, -z), (corner, x, z), (corner + z, x, y), (corner + x, -x, y)];
    for (i, (origin, u, v)) in faces.into_iter().enumerate() {
        let cell = Vec2::new((i % 3) as f32 / 3.0, (i / 3) as f32 / 2.0);
        let uvs = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y].map(|c| cell + c * Vec2::new(1.0 / 3.0, 0.5));
        arrays.quad([origin, origin + u, origin + u + v, origin + v], [u.cross(v).normalize_or_zero(); 4], uvs);
    }
    arrays
}

// A straight bar: `height` along `up` as far as that is across the bar, `width` across both.
fn beam(from: Vec3, to: Vec3, width: f32, height: f32, up: Vec3) -> Arrays {
    let along = to - from;
    let side = along.cross(up).try_normalize().unwrap_or_else(|| along.any_orthogonal_vector().normalize_or_zero());
    let upward = side.cross(along).normalize_or_zero();
    let corner = from - 0.5 * width * side - 0.5 * height * upward;
    block(corner, side * width, upward * height, -along).shifted(along)
}

impl Arrays {
    fn shifted(mut self, by: Vec3) -> Self {
        self.positions.iter_mut().for_each(|p| *p += by);
        self
    }
}

fn sphere(center: Vec3, radius: f32, segments: u32) -> Arrays {
    let rows = (segments / 2).max(2);
    let unit = |column: u32, row: u32| {
        let (longitude, polar) = (TAU * column as f32 / segments as f32, PI * row as f32 / rows as f32);
        // Exact poles: their ring of vertices is one point.
        let ring = if row == 0 || row == rows { 0.0 } else { polar.sin() };
        Vec3::new(ring * longitude.cos(), polar.cos(), -ring * longitude.sin())
    };
    let mut arrays = Arrays::smooth_grid(
        segments,
        rows,
        |c, r| center + radius * unit(c, r),
        |c, r| Vec2::new(c as f32 / segments as f32, 1.0 - r as f32 / rows as f32),
    );
    arrays.normals = arrays.positions.iter().map(|p| (*p - center) / radius).collect();
    arrays
}

// Turns a profile of (radius, height) about +Y; outside is to its right going up. Corners sharper than CREASE stay sharp.
fn lathe(profile: &[Vec2], segments: u32, sides: Sides) -> Arrays {
    const CREASE_COSINE: f32 = 0.8;
    let legs: Vec<Vec2> = profile.windows(2).map(|p| p[1] - p[0]).collect();
    let normals: Vec<Vec2> = legs.iter().map(|l| Vec2::new(l.y, -l.x).normalize_or_zero()).collect();
    let total: f32 = legs.iter().map(|l| l.length()).sum();
    let joined = |a: Vec2, b: Vec2| if a.dot(b) > CREASE_COSINE { (a + b).normalize_or_zero() } else { a };
    let turned = |p: Vec2, i: f32| {
        let (sin, cos) = (TAU * i / segments as f32).sin_cos();
        Vec3::new(p.x * cos, p.y, -p.x * sin)
    };
    let mut arrays = Arrays::default();
    let mut done = 0.0;
    for (k, leg) in legs.iter().enumerate() {
        let start = if k == 0 { normals[k] } else { joined(normals[k], normals[k - 1]) };
        let end = normals.get(k + 1).map_or(normals[k], |next| joined(normals[k], *next));
        let (v0, v1) = (done / total, (done + leg.length()) / total);
        done += leg.length();
        for i in 0..segments {
            let (a, b) = (i as f32, ((i + 1) % segments) as f32);
            let (na, nb) = if sides == Sides::Flat { (a + 0.5, a + 0.5) } else { (a, b) };
            let (u0, u1) = (a / segments as f32, (a + 1.0) / segments as f32);
            arrays.quad(
                [turned(profile[k], a), turned(profile[k], b), turned(profile[k + 1], b), turned(profile[k + 1], a)],
                [turned(start, na), turned(start, nb), turned(end, nb), turned(end, na)],
                [Vec2::new(u0, v0), Vec2::new(u1, v0), Vec2::new(u1, v1), Vec2::new(u0, v1)],
            );
        }
    }
    arrays
}

// A round cloth on a round table: flat to `radius`, then hanging in folds. uv is the cloth laid out flat.
struct Cloth {
    radius: f32,
    drop: f32,
    folds: u32,
    depth: f32,
}

impl Cloth {
    fn arrays(&self, segments: u32) -> Arrays {
        const TOP_ROWS: u32 = 3;
        const SKIRT_ROWS: u32 = 14;
        let uv = |column: u32, row: u32| {
            let (sin, cos) = (TAU * column as f32 / segments as f32).sin_cos();
            0.5 + 0.5 * self.laid_out(row, TOP_ROWS, SKIRT_ROWS) / self.laid_out_radius() * Vec2::new(cos, sin)
        };
        let position = |column: u32, row: u32| self.hanging(column as f32 / segments as f32, self.laid_out(row, TOP_ROWS, SKIRT_ROWS));
        Arrays::smooth_grid(segments, TOP_ROWS + SKIRT_ROWS, position, uv)
    }

    // Length of the bend over the table's edge, a quarter circle.
    fn bend(&self) -> f32 {
        0.06 * self.radius
    }

    // From the cloth's centre to its hem, measured on the cloth.
    fn laid_out_radius(&self) -> f32 {
        self.radius + self.bend() + self.drop
    }

    // Distance of a row from the cloth's centre, measured on the cloth. The bend needs the narrow rows.
    fn laid_out(&self, row: u32, top_rows: u32, skirt_rows: u32) -> f32 {
        if row <= top_rows {
            return self.radius * row as f32 / top_rows as f32;
        }
        let s = (row - top_rows) as f32 / skirt_rows as f32;
        self.radius + s.powf(1.6) * (self.bend() + self.drop)
    }

    // Where the cloth's point at `turn` (of a full turn) and `distance` from its centre hangs; the top lies at height 0.
    fn hanging(&self, turn: f32, distance: f32) -> Vec3 {
        let (sin, cos) = (TAU * turn).sin_cos();
        let over = (distance - self.radius).max(0.0);
        let circle = 2.0 * self.bend() / PI;
        let arc = (over / circle).min(PI / 2.0);
        let below = (over - self.bend()).max(0.0) / self.drop;
        // Folds open downward; two frequencies, so that no two folds are alike.
        let wave = (TAU * turn * self.folds as f32).cos() + 0.35 * (TAU * turn * (self.folds / 2 + 1) as f32 + 1.0).sin();
        let radius = distance.min(self.radius) + circle * arc.sin() + self.depth * below.powf(0.8) * (0.55 + wave);
        let height = -circle * (1.0 - arc.cos()) - below * self.drop * 0.985;
        Vec3::new(radius * cos, height, -radius * sin)
    }
}

// A lumpy ellipsoid: tree crowns and bushes.
fn blob(center: Vec3, radii: Vec3, roughness: f32, segments: u32, seed: u32) -> Arrays {
    let rows = (segments / 2).max(3);
    let position = |column: u32, row: u32| {
        let (longitude, polar) = (TAU * column as f32 / segments as f32, PI * row as f32 / rows as f32);
        let pole = row == 0 || row == rows;
        let ring = if pole { 0.0 } else { polar.sin() };
        let unit = Vec3::new(ring * longitude.cos(), polar.cos(), -ring * longitude.sin());
        // Lumps a quarter of the girth wide, and leaves from vertex to vertex. Poles are one point.
        let turn = if pole { 0.0 } else { column as f32 / segments as f32 };
        let lump = super::noise::value(seed, turn * 8.0, polar * 1.6, 8);
        let leaf = super::noise::unit(seed, if pole { 0 } else { column as i32 }, row as i32);
        center + radii * unit * (1.0 - roughness * (0.7 * lump + 0.3 * leaf))
    };
    let uv = |c: u32, r: u32| Vec2::new(c as f32 / segments as f32, 1.0 - r as f32 / rows as f32);
    Arrays::smooth_grid(segments, rows, position, uv)
}

#[cfg(test)]
mod tests {
    use super::super::json::Json;
    use super::*;

    fn shape(text: &str) -> Result<TriangleMesh, SceneError> {
        let json = Json::parse("s.json", text.as_bytes()).unwrap();
        build(&Node::root("s.json", &json), "s.json", "it")
    }

    fn volume(mesh: &TriangleMesh) -> f32 {
        (0..mesh.triangles.len()).map(|t| mesh.area_vector(t).dot(mesh.corners(t)[0]) / 3.0).sum()
    }

    #[test]
    fn closed_shapes_enclose_their_volume_with_outward_fronts() {
        let cases = [
            (r#"{"type":"box","min":[1,1,1],"max":[2,3,4]}"#, 6.0, 1e-5),
            (r#"{"type":"beam","from":[0,0,0],"to":[0,3,4],"width":2,"height":0.5}"#, 5.0, 1e-5),
            (r#"{"type":"beam","from":[1,0,0],"to":[1,2,0],"width":1,"height":1}"#, 2.0, 1e-5),
            // A sphere's 64-gon facets lie inside it by about (π/64)²/2 in radius, three times that and more in volume.
            (r#"{"type":"sphere","center":[5,0,0],"radius":1}"#, 4.0 / 3.0 * PI, 0.01),
            (r#"{"type":"lathe","profile":[[0,0],[2,0],[2,3],[0,3]],"segments":256}"#, 12.0 * PI, 0.001),
            (r#"{"type":"lathe","profile":[[0,0],[1,0],[1,1],[0,1]],"segments":4,"flat_sides":true}"#, 2.0, 1e-5),
        ];
        for (text, expected, tolerance) in cases {
            let mesh = shape(text).unwrap();
            assert!((volume(&mesh) / expected - 1.0).abs() < tolerance, "{text}: {}", volume(&mesh));
            for t in 0..mesh.triangles.len() {
                let normal: Vec3 = mesh.triangles[t].iter().map(|v| mesh.normals[*v as usize]).sum();
                assert!(mesh.area_vector(t).dot(normal) > 0.0, "{text}: triangle {t}");
            }
        }
    }

    #[test]
    fn flat_shapes_face_the_way_they_say() {
        assert!(shape(r#"{"type":"disc","center":[0,1,0],"normal":[0,1,0],"radius":1}"#).unwrap().area_vector(0).y > 0.0);
        assert!(shape(r#"{"type":"disc","center":[0,1,0],"normal":[0,-2,0],"radius":1}"#).unwrap().area_vector(0).y < 0.0);
        assert!(shape(r#"{"type":"rect","corner":[0,0,0],"edge_u":[1,0,0],"edge_v":[0,1,0]}"#).unwrap().area_vector(0).z > 0.0);
    }

    #[test]
    fn a_cloth_faces_up_and_out_and_its_uv_is_its_plan() {
        let mesh = shape(r#"{"type":"cloth","radius":8,"drop":4,"folds":12,"fold_depth":0.4}"#).unwrap();
        for t in 0..mesh.triangles.len() {
            let [a, b, c] = mesh.corners(t);
            let middle = (a + b + c) / 3.0;
            let n = mesh.area_vector(t).normalize();
            if middle.y > -0.01 {
                assert!(n.y > 0.99, "top {t}: {n}");
            } else if middle.y < -1.0 {
                assert!(n.dot(Vec3::new(middle.x, 0.0, middle.z)) > 0.0, "skirt {t}: {n}");
            }
        }
        let (low, high) = mesh.uvs.iter().fold((Vec2::ONE, Vec2::ZERO), |(l, h), uv| (l.min(*uv), h.max(*uv)));
        assert!(low.min_element() >= -1e-6 && high.max_element() <= 1.0 + 1e-6);
    }

    #[test]
    fn uv_stay_in_the_unit_square_for_every_shape() {
        for text in [
            r#"{"type":"blob","center":[0,0,0],"radii":[1,2,1],"roughness":0.3,"seed":1}"#,
            r#"{"type":"lathe","profile":[[1,0],[2,1],[1,2]]}"#,
            r#"{"type":"box","min":[0,0,0],"max":[1,1,1]}"#,
            r#"{"type":"sphere","center":[0,0,0],"radius":1}"#,
        ] {
            let mesh = shape(text).unwrap();
            assert!(mesh.uvs.iter().all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0), "{text}");
        }
    }

    #[test]
    fn shapes_without_area_or_sense_are_refused() {
        for text in [
            r#"{"type":"sphere","center":[0,0,0],"radius":0}"#,
            r#"{"type":"rect","corner":[0,0,0],"edge_u":[1,0,0],"edge_v":[2,0,0]}"#,
            r#"{"type":"box","min":[0,0,0],"max":[0,0,0]}"#,
            r#"{"type":"beam","from":[0,0,0],"to":[0,0,0],"width":1,"height":1}"#,
            r#"{"type":"lathe","profile":[[1,0]]}"#,
            r#"{"type":"lathe","profile":[[-1,0],[1,1]]}"#,
            r#"{"type":"disc","center":[0,0,0],"normal":[0,0,0],"radius":1}"#,
            r#"{"type":"disc","center":[0,0,0],"normal":[0,1,0],"radius":1,"segments":2}"#,
            r#"{"type":"disc","center":[0,0,0],"normal":[0,1,0],"radius":1,"color":2}"#,
            r#"{"type":"cube"}"#,
        ] {
            assert!(shape(text).is_err(), "{text}");
        }
    }
}
