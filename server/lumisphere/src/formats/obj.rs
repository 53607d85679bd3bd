//! Wavefront OBJ and MTL: the part that holds surfaces and their diffuse colours.
//!
//! Our own reader because those at hand panic on broken lines (`Kd 1 1`) and name no line in their errors. Polygons become fans.
//! Corners without a normal get their face's, or inside a smoothing group (`s 1`) the mean of the faces around their vertex weighted by
//! area; corners without texture coordinates get (0, 0). Lines, points, curves and groups are passed over.

use std::collections::{HashMap, HashSet};

use glam::{Vec2, Vec3};

use super::FormatError;
use crate::geometry::TriangleMesh;

/// A file's faces, ready to be built into meshes.
#[derive(Debug, Clone)]
pub struct ObjFile {
    /// MTL files named by `mtllib`, relative to the OBJ.
    pub material_libraries: Vec<String>,
    /// Names after `usemtl`, in order of first use; `None` for faces before any.
    pub materials: Vec<Option<String>>,
    positions: Vec<Vec3>,
    uvs: Vec<Vec2>,
    normals: Vec<Vec3>,
    triangles: Vec<Triangle>,
}

/// A material of an MTL file, as far as we show it.
#[derive(Debug, Clone, PartialEq)]
pub struct MtlMaterial {
    /// After `newmtl`.
    pub name: String,
    /// `Kd`, linear as the file has it; white by default.
    pub diffuse: Vec3,
    /// `map_Kd`.
    pub diffuse_map: Option<String>,
    /// `Ke`, as radiance; zero by default.
    pub emission: Vec3,
    /// A map that dims `Ke` or cuts holes (`map_Ke`, `map_d`), which we do not apply.
    pub ignored_maps: Vec<String>,
}

#[derive(Debug, Clone, Copy)]
struct Triangle {
    corners: [Corner; 3],
    material: usize,
    // Smoothing group; 0 is none.
    smoothing: u32,
    // Faces may be polygons: their triangles share the face's normal.
    face: u32,
}

#[derive(Debug, Clone, Copy)]
struct Corner {
    position: u32,
    uv: Option<u32>,
    normal: Option<u32>,
}

// What makes two corners the same vertex.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum NormalKey {
    Given(u32),
    Smooth(u32),
    Face(u32),
}

/// Vertices or triangles beyond this are refused: 32-bit indices, and no such scene is meant for us.
const MAX_ELEMENTS: usize = 1 << 27;

/// Reads an OBJ file. A file without faces is an error.
pub fn read(bytes: &[u8]) -> Result<ObjFile, FormatError> {
    let text = String::from_utf8_lossy(bytes).replace("\\\r\n", " ").replace("\\\n", " ");
    let mut reader = Reader::new();
    for (i, line) in text.lines().enumerate() {
        reader.line(line).map_err(|message| FormatError::Line { line: i + 1, message })?;
        if reader.file.triangles.len() > MAX_ELEMENTS || reader.file.positions.len() > MAX_ELEMENTS {
            return Err(FormatError::File(format!("more than {MAX_ELEMENTS} vertices or triangles")));
        }
    }
    if reader.file.triangles.is_empty() {
        return Err(FormatError::File("OBJ file has no face".into()));
    }
    Ok(reader.file)
}

impl ObjFile {
    /// How many triangles the file's faces make, those without area included.
    pub fn triangle_count(&self) -> usize {
        self.triangles.len()
    }

    /// Everything as one mesh.
    pub fn mesh(&self) -> Result<TriangleMesh, FormatError> {
        self.build(self.triangles.iter())
    }

    /// The faces of `materials[material]`.
    pub fn mesh_of(&self, material: usize) -> Result<TriangleMesh, FormatError> {
        self.build(self.triangles.iter().filter(|t| t.material == material))
    }

    fn build<'a>(&'a self, triangles: impl Iterator<Item = &'a Triangle> + Clone) -> Result<TriangleMesh, FormatError> {
        let (smooth, faceted) = self.missing_normals(triangles.clone());
        let mut vertices: HashMap<(u32, Option<u32>, NormalKey), u32> = HashMap::new();
        let (mut positions, mut normals, mut uvs, mut indices) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for t in triangles {
            indices.push(t.corners.map(|c| {
                let (key, normal) = match c.normal {
                    Some(n) => (NormalKey::Given(n), self.normals[n as usize]),
                    None if t.smoothing > 0 => (NormalKey::Smooth(t.smoothing), smooth[&(t.smoothing, c.position)]),
                    None => (NormalKey::Face(t.face), faceted[&t.face]),
                };
                *vertices.entry((c.position, c.uv, key)).or_insert_with(|| {
                    positions.push(self.positions[c.position as usize]);
                    uvs.push(c.uv.map_or(Vec2::ZERO, |i| self.uvs[i as usize]));
                    normals.push(normal);
                    positions.len() as u32 - 1
                })
            }));
        }
        Ok(TriangleMesh::new(positions, normals, uvs, indices)?)
    }

    // Sums of area vectors: by (group, position) for smooth corners, by face for the others.
    fn missing_normals<'a>(
        &self,
        triangles: impl Iterator<Item = &'a Triangle> + Clone,
    ) -> (HashMap<(u32, u32), Vec3>, HashMap<u32, Vec3>) {
        let wanting = triangles.filter(|t| t.corners.iter().any(|c| c.normal.is_none()));
        let mut faceted = HashMap::new();
        for t in wanting.clone() {
            let [a, b, c] = t.corners.map(|c| self.positions[c.position as usize]);
            *faceted.entry(t.face).or_insert(Vec3::ZERO) += (b - a).cross(c - a);
        }
        // A face counts once at each of its vertices, into however many triangles it was cut.
        let (mut smooth, mut counted) = (HashMap::new(), HashSet::new());
        for t in wanting {
            for corner in t.corners.iter().filter(|c| counted.insert((t.face, c.position))) {
                *smooth.entry((t.smoothing, corner.position)).or_insert(Vec3::ZERO) += faceted[&t.face];
            }
        }
        (smooth, faceted)
    }
}

struct Reader {
    file: ObjFile,
    material: Option<usize>,
    smoothing: u32,
    faces: u32,
}

impl Reader {
    fn new() -> Self {
        let file = ObjFile {
            material_libraries: Vec::new(),
            materials: Vec::new(),
            positions: Vec::new(),
            uvs: Vec::new(),
            normals: Vec::new(),
            triangles: Vec::new(),
        };
        Self { file, material: None, smoothing: 0, faces: 0 }
    }

    fn line(&mut self, line: &str) -> Result<(), String> {
        let line = line.split('#').next().unwrap_or_default().trim();
        let (keyword, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        let rest = rest.trim();
        match keyword {
            "v" => self.file.positions.push(Vec3::from(floats::<3>(rest, "a vertex x y z", 6)?)),
            "vn" => self.file.normals.push(Vec3::from(floats::<3>(rest, "a normal x y z", 3)?)),
            // v may be left out: a one-dimensional texture.
            "vt" if rest.split_whitespace().count() == 1 => self.file.uvs.push(Vec2::new(floats::<1>(rest, "u", 1)?[0], 0.0)),
            "vt" => self.file.uvs.push(Vec2::from(floats::<2>(rest, "texture coordinates u v", 3)?)),
            "f" => self.face(rest)?,
            "s" => self.smoothing = rest.parse().unwrap_or(0),
            "usemtl" => self.material = Some(self.material_index(Some(rest.to_owned()))),
            "mtllib" => self.file.material_libraries.push(rest.to_owned()),
            _ => {}
        }
        Ok(())
    }

    fn material_index(&mut self, name: Option<String>) -> usize {
        let materials = &mut self.file.materials;
        materials.iter().position(|m| *m == name).unwrap_or_else(|| {
            materials.push(name);
            materials.len() - 1
        })
    }

    fn face(&mut self, rest: &str) -> Result<(), String> {
        let corners = rest.split_whitespace().map(|word| self.corner(word)).collect::<Result<Vec<_>, _>>()?;
        if corners.len() < 3 {
            return Err(format!("a face with {} corners, at least 3 expected", corners.len()));
        }
        let material = match self.material {
            Some(material) => material,
            None => self.material_index(None),
        };
        self.faces += 1;
        for pair in corners[1..].windows(2) {
            let corners = [corners[0], pair[0], pair[1]];
            self.file.triangles.push(Triangle { corners, material, smoothing: self.smoothing, face: self.faces });
        }
        Ok(())
    }

    fn corner(&self, word: &str) -> Result<Corner, String> {
        let mut parts = word.split('/');
        let mut index = |count: usize, what: &str| match parts.next().filter(|p| !p.is_empty()) {
            None => Ok(None),
            Some(part) => resolve(part, count).map(Some).ok_or_else(|| format!("face corner {word:?}: {what} 1 to {count} expected")),
        };
        let position = index(self.file.positions.len(), "a vertex from")?;
        let uv = index(self.file.uvs.len(), "texture coordinates from")?;
        let normal = index(self.file.normals.len(), "a normal from")?;
        match (position, parts.next()) {
            (Some(position), None) => Ok(Corner { position, uv, normal }),
            _ => Err(format!("face corner {:?}, vertex/texture/normal expected", word.chars().take(40).collect::<String>())),
        }
    }
}

// Index from 0 of "3" (from 1) or "-1" (from the end).
fn resolve(part: &str, count: usize) -> Option<u32> {
    let index: i64 = part.parse().ok()?;
    let from_zero = if index < 0 { count as i64 + index } else { index - 1 };
    (0..count as i64).contains(&from_zero).then_some(from_zero as u32)
}

// The first N numbers of a line that may hold up to `most`.
fn floats<const N: usize>(rest: &str, what: &str, most: usize) -> Result<[f32; N], String> {
    let wrong = || format!("{:?}, {what} expected", rest.chars().take(60).collect::<String>());
    let words: Vec<f32> = rest.split_whitespace().map(|w| w.parse().map_err(|_| wrong())).collect::<Result<_, _>>()?;
    if words.len() > most || words.iter().any(|n| !n.is_finite()) {
        return Err(wrong());
    }
    words.get(..N).and_then(|n| n.try_into().ok()).ok_or_else(wrong)
}

/// Reads an MTL file.
pub fn read_materials(bytes: &[u8]) -> Result<Vec<MtlMaterial>, FormatError> {
    let text = String::from_utf8_lossy(bytes);
    let mut materials: Vec<MtlMaterial> = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or_default().trim();
        let (keyword, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        let at = |message: String| FormatError::Line { line: i + 1, message };
        match (keyword, materials.last_mut()) {
            ("newmtl", _) => materials.push(MtlMaterial::plain(rest.trim())),
            ("Kd", Some(m)) => m.diffuse = Vec3::from(floats::<3>(rest, "Kd r g b", 3).map_err(at)?),
            ("Ke", Some(m)) => m.emission = Vec3::from(floats::<3>(rest, "Ke r g b", 3).map_err(at)?),
            ("map_Kd", Some(m)) => m.diffuse_map = Some(map_path(rest)).filter(|p| !p.is_empty()),
            ("map_Ke" | "map_d" | "map_opacity", Some(m)) => m.ignored_maps.push(format!("{keyword} {}", map_path(rest))),
            _ => {}
        }
    }
    Ok(materials)
}

impl MtlMaterial {
    fn plain(name: &str) -> Self {
        Self { name: name.into(), diffuse: Vec3::ONE, diffuse_map: None, emission: Vec3::ZERO, ignored_maps: Vec::new() }
    }
}

// The file's name after options such as `-s 1 1 1` or `-clamp on`; it may hold spaces.
fn map_path(rest: &str) -> String {
    let mut words = rest.split_whitespace().peekable();
    while let Some(option) = words.next_if(|w| w.starts_with('-')) {
        let most = match option {
            "-o" | "-s" | "-t" => 3,
            "-mm" => 2,
            _ => 1,
        };
        for taken in 0..most {
            // Trailing components of vectors may be left out; every other option has exactly its arguments.
            let is_argument = |w: &&str| most == 1 || taken == 0 || w.parse::<f32>().is_ok();
            if words.next_if(is_argument).is_none() {
                break;
            }
        }
    }
    words.collect::<Vec<_>>().join(" ").replace('\\', "/")
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: &str =
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl red\nf 1/1 2/2 3/3 4/4\n";

    #[test]
    fn a_polygon_becomes_a_fan_with_its_own_normal() {
        let file = read(SQUARE.as_bytes()).unwrap();
        let mesh = file.mesh().unwrap();
        assert_eq!(mesh.triangles, vec![[0, 1, 2], [0, 2, 3]]);
        assert_eq!(mesh.normals, vec![Vec3::Z; 4]);
        assert_eq!(mesh.uvs[2], Vec2::ONE);
        assert_eq!((file.materials, file.material_libraries), (vec![Some("red".to_owned())], vec!["a.mtl".to_owned()]));
    }

    #[test]
    fn missing_normals_are_flat_unless_a_smoothing_group_joins_the_faces() {
        let roof = "v 0 0 0\nv 1 1 0\nv 2 0 0\nv 0 0 -1\nv 1 1 -1\nv 2 0 -1\nf 1 2 5 4\nf 2 3 6 5\n";
        let flat = read(roof.as_bytes()).unwrap().mesh().unwrap();
        assert_eq!(flat.positions.len(), 8);
        let smooth = read(format!("s 1\n{roof}").as_bytes()).unwrap().mesh().unwrap();
        assert_eq!(smooth.positions.len(), 6);
        let ridge = smooth.positions.iter().position(|p| *p == Vec3::new(1.0, 1.0, 0.0)).unwrap();
        assert!(smooth.normals[ridge].x.abs() < 1e-6, "the ridge's normal is the mean of both slopes");
    }

    #[test]
    fn indices_count_from_the_end_when_negative_and_never_leave_the_file() {
        let mesh = read(SQUARE.replace("f 1/1 2/2 3/3 4/4", "f -4/-4 -3/-3 -2/-2").as_bytes()).unwrap().mesh().unwrap();
        assert_eq!(mesh.positions[1], Vec3::X);
        for corner in ["5", "0", "-5", "1/5", "1/1/1", "9999999999999999999999", "/1", "1/1/1/1", "x"] {
            let broken = read(SQUARE.replace("f 1/1", &format!("f {corner}")).as_bytes());
            assert!(matches!(broken, Err(FormatError::Line { line: 11, .. })), "{corner}: {broken:?}");
        }
    }

    #[test]
    fn what_is_no_number_or_no_face_is_named_with_its_line() {
        let wrong = |from: &str, to: &str| read(SQUARE.replacen(from, to, 1).as_bytes()).unwrap_err().to_string();
        assert_eq!(wrong("v 1 0 0", "v 1 0"), r#"line 3: "1 0", a vertex x y z expected"#);
        assert_eq!(wrong("v 1 0 0", "v 1 NaN 0"), r#"line 3: "1 NaN 0", a vertex x y z expected"#);
        assert_eq!(wrong("f 1/1 2/2 3/3 4/4", "f 1/1 2/2"), "line 11: a face with 2 corners, at least 3 expected");
        assert_eq!(read(b"v 0 0 0\n").unwrap_err().to_string(), "OBJ file has no face");
        assert!(read(b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n").unwrap().mesh().is_err(), "no area");
    }

    #[test]
    fn cut_off_anywhere_it_never_panics() {
        for length in 0..SQUARE.len() {
            let _ = read(&SQUARE.as_bytes()[..length]).and_then(|f| f.mesh());
        }
    }

    #[test]
    fn materials_keep_colour_map_and_emission() {
        let mtl =
            "newmtl a b\n Kd 0.1 0.2 0.3\n map_Kd -s 2 2 -clamp on my wall.png # x\nKe 1 1 1\nmap_Ke -mm 0 0.4 screen.png\nnewmtl c\n";
        let materials = read_materials(mtl.as_bytes()).unwrap();
        assert_eq!(materials[0].name, "a b");
        assert_eq!(materials[0].diffuse, Vec3::new(0.1, 0.2, 0.3));
        assert_eq!(materials[0].diffuse_map.as_deref(), Some("my wall.png"));
        assert_eq!((materials[0].emission, materials[0].ignored_maps.clone()), (Vec3::ONE, vec!["map_Ke screen.png".to_owned()]));
        assert_eq!(materials[1], MtlMaterial::plain("c"));
        assert_eq!(
            read_materials(b"newmtl a\nKd 1 1\n").unwrap_err().to_string(),
            r#"line 2: " 1 1", Kd r g b expected"#.replace("\" ", "\"")
        );
    }
}
