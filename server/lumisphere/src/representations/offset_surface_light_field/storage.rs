//! The bytes of an offset surface light field: four named parts beside the cube-map pages, and the parameters in the manifest.
//!
//! The store checks every part's hash; what is read here is checked again for sense, since datasets may come from other servers.

use super::{NO_SAMPLE, OffsetSurfaceLightField, Parameters, SampleMaps, SamplePoint};
use crate::capture::coarser_levels;
use crate::capture::parts::{PartsError, decode, encode};

// Not a part but checked with them.
const PARAMETERS: &str = "parameters";
const SURFACE: &str = "surface";
const SAMPLE_POINTS: &str = "sample_points";
const SAMPLE_MAPS: &str = "sample_maps";
const BACKGROUND: &str = "background";

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
        (SURFACE, field.surface.check()),
        (SAMPLE_POINTS, check_points(&field.sample_points)),
        (SAMPLE_MAPS, check_maps(&field.sample_maps, field.surface.parts, field.sample_points.len())),
        (BACKGROUND, field.background.check()),
    ] {
        outcome.map_err(|reason| PartsError { part, reason })?;
    }
    Ok(field)
}

fn check_parameters(parameters: &Parameters) -> Result<(), String> {
    let (levels, most) = (parameters.coarser_levels, coarser_levels(parameters.face_size_texels));
    match levels <= most {
        true => Ok(()),
        false => Err(format!("{levels} coarser levels of faces of {}², at most {most} expected", parameters.face_size_texels)),
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

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use glam::{Vec2, Vec3};

    use super::super::{Placing, Spacing};
    use super::*;
    use crate::capture::{Background, BackgroundSurface, SurfaceMesh};
    use crate::geometry::TriangleMesh;
    use crate::representations::Original;
    use crate::scenes::{Albedo, Environment};

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
                placing: Placing::Uniform,
                object_center: [0.0; 3],
                samples_per_texel: 1,
                max_bounces: 1,
                seed: 7,
                original: Original::AsAuthored,
                thinned_from: None,
                replaced: None,
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
