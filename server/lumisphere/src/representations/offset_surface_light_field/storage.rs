//! The bytes of an offset surface light field: four named parts beside the cube-map pages, and the parameters in the manifest.
//!
//! Each part is one zstd frame of a format byte and the postcard encoding (little-endian floats) of its struct. The store
//! checks every part's hash; what is read here is checked again for sense, since datasets may come from other servers.

use std::io::Read;

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

use super::{NO_SAMPLE, OffsetSurfaceLightField, Parameters, SampleMaps, SamplePoint, SurfaceMesh};
use crate::capture::{Background, coarser_levels};
use crate::images::Image;
use crate::scenes::{Albedo, Environment};

// Not a part but checked with them.
const PARAMETERS: &str = "parameters";
const SURFACE: &str = "surface";
const SAMPLE_POINTS: &str = "sample_points";
const SAMPLE_MAPS: &str = "sample_maps";
const BACKGROUND: &str = "background";
// Of every part; a new layout gets a new number.
const FORMAT: u8 = 1;
// No part of a sensible dataset is larger; a lying one stops here instead of filling memory.
const MAX_PART_BYTES: u64 = 1 << 31;

/// A part cannot be encoded or decoded, or contradicts the others.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("part {part} of the offset surface light field is malformed: {reason}")]
pub struct PartsError {
    /// Which part.
    pub part: &'static str,
    /// What does not agree.
    pub reason: String,
}

/// The named parts to store beside the pages.
pub fn to_parts(field: &OffsetSurfaceLightField) -> Result<Vec<(&'static str, Vec<u8>)>, PartsError> {
    Ok(vec![
        (SURFACE, encode(SURFACE, &field.surface)?),
        (SAMPLE_POINTS, encode(SAMPLE_POINTS, &field.sample_points)?),
        (SAMPLE_MAPS, encode(SAMPLE_MAPS, &field.sample_maps)?),
        (BACKGROUND, encode(BACKGROUND, &field.background)?),
    ])
}

/// Builds the representation from its parameters and parts; `part(name)` gives a part's bytes, or why it cannot.
pub fn from_parts<E: From<PartsError>>(
    parameters: Parameters,
    part: &dyn Fn(&'static str) -> Result<Vec<u8>, E>,
) -> Result<OffsetSurfaceLightField, E> {
    let field = OffsetSurfaceLightField {
        parameters,
        surface: decode(SURFACE, &part(SURFACE)?)?,
        sample_points: decode(SAMPLE_POINTS, &part(SAMPLE_POINTS)?)?,
        sample_maps: decode(SAMPLE_MAPS, &part(SAMPLE_MAPS)?)?,
        background: decode(BACKGROUND, &part(BACKGROUND)?)?,
    };
    for (part, outcome) in [
        (PARAMETERS, check_parameters(&field.parameters)),
        (SURFACE, check_surface(&field.surface)),
        (SAMPLE_POINTS, check_points(&field.sample_points)),
        (SAMPLE_MAPS, check_maps(&field.sample_maps, field.surface.parts, field.sample_points.len())),
        (BACKGROUND, check_background(&field.background)),
    ] {
        outcome.map_err(|reason| PartsError { part, reason })?;
    }
    Ok(field)
}

fn encode<T: Serialize>(part: &'static str, value: &T) -> Result<Vec<u8>, PartsError> {
    let malformed = |reason: String| PartsError { part, reason };
    let bytes = postcard::to_extend(value, vec![FORMAT]).map_err(|e| malformed(e.to_string()))?;
    zstd::encode_all(bytes.as_slice(), 1).map_err(|e| malformed(e.to_string()))
}

fn decode<T: DeserializeOwned>(part: &'static str, compressed: &[u8]) -> Result<T, PartsError> {
    let malformed = |reason: String| PartsError { part, reason };
    let decoder = zstd::Decoder::new(compressed).map_err(|e| malformed(e.to_string()))?;
    let mut bytes = Vec::new();
    decoder.take(MAX_PART_BYTES + 1).read_to_end(&mut bytes).map_err(|e| malformed(e.to_string()))?;
    if bytes.len() as u64 > MAX_PART_BYTES {
        return Err(malformed(format!("larger than {MAX_PART_BYTES} bytes")));
    }
    match bytes.split_first() {
        Some((&FORMAT, rest)) => postcard::from_bytes(rest).map_err(|e| malformed(e.to_string())),
        Some((other, _)) => Err(malformed(format!("format {other}, {FORMAT} expected"))),
        None => Err(malformed("empty".into())),
    }
}

fn check_parameters(parameters: &Parameters) -> Result<(), String> {
    let (levels, most) = (parameters.coarser_levels, coarser_levels(parameters.face_size_texels));
    match levels <= most {
        true => Ok(()),
        false => Err(format!("{levels} coarser levels of faces of {}², at most {most} expected", parameters.face_size_texels)),
    }
}

fn check_surface(surface: &SurfaceMesh) -> Result<(), String> {
    let (parts, triangles) = (surface.part_of_triangle.len(), surface.mesh.triangles.len());
    if parts != triangles {
        return Err(format!("{parts} part numbers for {triangles} triangles"));
    }
    match surface.part_of_triangle.iter().find(|p| **p >= surface.parts) {
        Some(p) => Err(format!("a triangle belongs to part {p}, below {} expected", surface.parts)),
        None => Ok(()),
    }
}

fn check_points(points: &[SamplePoint]) -> Result<(), String> {
    if points.is_empty() || points.len() >= usize::from(NO_SAMPLE) {
        return Err(format!("{} sample points, 1 to {} expected", points.len(), NO_SAMPLE - 1));
    }
    match points.iter().position(|p| !(p.position.is_finite() && p.normal.is_finite())) {
        Some(i) => Err(format!("sample point {i} is not finite")),
        None => Ok(()),
    }
}

fn check_maps(maps: &SampleMaps, parts: u32, points: usize) -> Result<(), String> {
    let expected = maps.size.checked_mul(maps.size).and_then(|n| n.checked_mul(parts as usize));
    if maps.size == 0 || expected != Some(maps.indices.len()) {
        return Err(format!("{} texels for {parts} parts of {}x{}", maps.indices.len(), maps.size, maps.size));
    }
    match maps.indices.iter().flatten().find(|i| **i != NO_SAMPLE && usize::from(**i) >= points) {
        Some(i) => Err(format!("a texel names sample point {i}, below {points} expected")),
        None => Ok(()),
    }
}

fn check_background(background: &Background) -> Result<(), String> {
    let check_image = |what: &str, image: &Image| {
        let pixels = image.width.checked_mul(image.height).unwrap_or(0);
        let sound =
            pixels > 0 && image.planes.len() == 3 && image.planes.iter().all(|p| p.len() == pixels && p.iter().all(|v| v.is_finite()));
        if sound { Ok(()) } else { Err(format!("{what} is not a finite three-channel image of its stated size")) }
    };
    for (i, texture) in background.textures.iter().enumerate() {
        check_image(&format!("texture {i}"), &texture.image)?;
    }
    match &background.environment {
        Environment::Constant(radiance) if !radiance.is_finite() => return Err("environment is not finite".into()),
        Environment::Map(map) => check_image("environment", &map.image)?,
        Environment::Constant(_) => {}
    }
    for (i, surface) in background.surfaces.iter().enumerate() {
        if surface.irradiance.len() != surface.mesh.positions.len() {
            return Err(format!("surface {i} has {} irradiances for {} vertices", surface.irradiance.len(), surface.mesh.positions.len()));
        }
        if !(surface.emission.is_finite() && surface.irradiance.iter().flatten().all(|e| e.is_finite())) {
            return Err(format!("surface {i} has light that is not finite"));
        }
        if let Some(Albedo::Texture(t)) = surface.albedo
            && t >= background.textures.len()
        {
            return Err(format!("surface {i} names texture {t}, below {} expected", background.textures.len()));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use glam::{Vec2, Vec3};

    use super::super::Spacing;
    use super::*;
    use crate::capture::BackgroundSurface;
    use crate::geometry::TriangleMesh;

    fn triangle() -> TriangleMesh {
        TriangleMesh::new(vec![Vec3::ZERO, Vec3::X, Vec3::Y], vec![Vec3::Z; 3], vec![Vec2::ZERO, Vec2::X, Vec2::Y], vec![[0, 1, 2]])
            .unwrap()
    }

    fn field() -> OffsetSurfaceLightField {
        let lit = BackgroundSurface {
            mesh: triangle(),
            irradiance: vec![[Vec3::ONE, Vec3::ZERO]; 3],
            albedo: Some(Albedo::Constant(Vec3::splat(0.5))),
            emission: Vec3::ZERO,
        };
        OffsetSurfaceLightField {
            parameters: Parameters {
                object: "pot".into(),
                epsilon: 0.1,
                face_size_texels: 16,
                coarser_levels: 2,
                sample_map_size_texels: 2,
                spacing: Spacing::Count(4),
                object_center: [0.0; 3],
                samples_per_texel: 1,
                max_bounces: 1,
                seed: 7,
                thinned_from: None,
            },
            surface: SurfaceMesh { mesh: triangle(), part_of_triangle: vec![0], parts: 1 },
            sample_points: vec![SamplePoint { position: Vec3::Z, normal: Vec3::Z }],
            sample_maps: SampleMaps { size: 2, indices: vec![[0, NO_SAMPLE, NO_SAMPLE, NO_SAMPLE]; 4] },
            background: Background { surfaces: vec![lit], textures: vec![], environment: Environment::Constant(Vec3::ONE) },
        }
    }

    fn reload(
        field: &OffsetSurfaceLightField,
        change: impl Fn(&mut HashMap<&'static str, Vec<u8>>),
    ) -> Result<OffsetSurfaceLightField, PartsError> {
        let mut parts: HashMap<_, _> = to_parts(field).unwrap().into_iter().collect();
        change(&mut parts);
        from_parts(field.parameters.clone(), &|name| Ok(parts[name].clone()))
    }

    #[test]
    fn stored_parts_load_bit_equal() {
        let (before, after) = (field(), reload(&field(), |_| {}).unwrap());
        assert_eq!(before.surface, after.surface);
        assert_eq!(before.sample_points, after.sample_points);
        assert_eq!(before.sample_maps, after.sample_maps);
        assert_eq!(to_parts(&before).unwrap(), to_parts(&after).unwrap());
    }

    #[test]
    fn a_part_cut_anywhere_is_an_error_that_names_it() {
        for name in [SURFACE, SAMPLE_POINTS, SAMPLE_MAPS, BACKGROUND] {
            let full = to_parts(&field()).unwrap().into_iter().find(|(n, _)| *n == name).unwrap().1.len();
            for length in 0..full {
                let error = reload(&field(), |parts| parts.get_mut(name).unwrap().truncate(length)).unwrap_err();
                assert_eq!(error.part, name);
            }
        }
    }

    #[test]
    fn parts_that_contradict_each_other_are_refused() {
        let mut unknown_point = field();
        unknown_point.sample_maps.indices[3][1] = 1;
        assert_eq!(reload(&unknown_point, |_| {}).unwrap_err().part, SAMPLE_MAPS);
        let mut unknown_part = field();
        unknown_part.surface.part_of_triangle[0] = 1;
        assert_eq!(reload(&unknown_part, |_| {}).unwrap_err().part, SURFACE);
        let mut deep = field();
        deep.parameters.coarser_levels = 3;
        assert_eq!(reload(&deep, |_| {}).unwrap_err().part, PARAMETERS);
        let mut dark = field();
        dark.background.surfaces[0].irradiance[1][0].y = f32::NAN;
        assert_eq!(reload(&dark, |_| {}).unwrap_err().part, BACKGROUND);
        let mut untextured = field();
        untextured.background.surfaces[0].albedo = Some(Albedo::Texture(0));
        assert_eq!(reload(&untextured, |_| {}).unwrap_err().part, BACKGROUND);
    }
}
