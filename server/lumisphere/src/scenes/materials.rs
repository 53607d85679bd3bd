//! The scene file's materials.

use std::sync::Arc;

use glam::Vec3;

use super::assembly::Assembly;
use super::error::SceneError;
use super::json::{Fields, Node};
use super::scene::{Albedo, Material};
use crate::formats::merl;
use crate::radiometry::brdf::{AnalyticBrdf, BrdfError, BrdfModel, BrdfParameters, Lafortune, LafortuneLobe};

/// Adds every material of the file.
pub(super) fn add(assembly: &mut Assembly, node: Option<Node>) -> Result<(), SceneError> {
    for (name, node) in node.map_or(Ok(Vec::new()), |n| n.named())? {
        let fields = node.fields()?;
        let kind = fields.required("type")?;
        let reflectance = || fields.required("reflectance").and_then(|n| n.reflectance());
        let material = match kind.text()? {
            "diffuse" => Material::Diffuse { albedo: albedo(assembly, &fields)? },
            "mirror" => Material::Mirror { reflectance: reflectance()? },
            "ggx" => {
                let alpha = fields.required("alpha")?;
                let alpha = alpha.length().ok().filter(|a| *a <= 1.0).ok_or_else(|| alpha.wrong("a roughness above 0, at most 1"))?;
                Material::Ggx { alpha, reflectance: reflectance()? }
            }
            "glossy" => glossy(assembly, &fields)?,
            "measured" => Material::Brdf(measured(assembly, &fields.required("file")?)?),
            model => match parameters(model, &fields)? {
                Some(parameters) => Material::Brdf(checked(parameters, &fields)?.into()),
                None => return Err(kind.wrong(KINDS)),
            },
        };
        fields.finish()?;
        assembly.add_material(name, material);
    }
    Ok(())
}

const KINDS: &str = "\"diffuse\", \"mirror\", \"ggx\", \"phong\", \"ashikhmin_shirley\", \"cook_torrance\", \"ward\", \"lafortune\", \"glossy\" or \"measured\"";

fn albedo(assembly: &mut Assembly, fields: &Fields) -> Result<Albedo, SceneError> {
    let expected = "a diffuse material with either \"albedo\" or \"albedo_texture\"";
    constant_or_texture(assembly, fields, ["albedo", "albedo_texture"], |n| n.reflectance(), expected)
}

fn glossy(assembly: &mut Assembly, fields: &Fields) -> Result<Material, SceneError> {
    let mut colour = |keys, expected| constant_or_texture(assembly, fields, keys, |n| n.reflectance(), expected);
    let diffuse = colour(["diffuse", "diffuse_texture"], "a glossy material with either \"diffuse\" or \"diffuse_texture\"")?;
    let specular = colour(["specular", "specular_texture"], "a glossy material with either \"specular\" or \"specular_texture\"")?;
    let expected = "a glossy material with either \"roughness\" or \"roughness_texture\"";
    let roughness = constant_or_texture(assembly, fields, ["roughness", "roughness_texture"], roughness, expected)?;
    Ok(Material::Glossy { diffuse, specular, roughness })
}

/// Along u and v, or the same along both.
fn roughness(node: &Node) -> Result<Vec3, SceneError> {
    let along = if node.is_list() { node.numbers::<2>()? } else { [node.number_in(0.0..=1.0)?; 2] };
    let valid = along.iter().all(|a| (0.0..=1.0).contains(a));
    if valid { Ok(Vec3::new(along[0], along[1], 0.0)) } else { Err(node.wrong("two roughnesses from 0 to 1")) }
}

/// What stands under the first key, or the picture that the second names.
fn constant_or_texture(
    assembly: &mut Assembly,
    fields: &Fields,
    [constant, texture]: [&'static str; 2],
    read: impl Fn(&Node) -> Result<Vec3, SceneError>,
    expected: &str,
) -> Result<Albedo, SceneError> {
    match (fields.optional(constant), fields.optional(texture)) {
        (Some(constant), None) => Ok(Albedo::Constant(read(&constant)?)),
        (None, Some(texture)) => {
            let path = assembly.beside(texture.text()?);
            assembly.texture(&path, Vec3::ONE, &texture)
        }
        _ => Err(fields.node().wrong(expected)),
    }
}

/// The parameters of an analytic model, under the names of `BrdfParameters`; None for a model that is not known.
fn parameters(model: &str, fields: &Fields) -> Result<Option<BrdfParameters>, SceneError> {
    let colour = |key| fields.required(key).and_then(|n| n.reflectance());
    let number = |key| fields.required(key).and_then(|n| n.number());
    Ok(Some(match model {
        "phong" => BrdfParameters::Phong { diffuse: colour("diffuse")?, specular: colour("specular")?, exponent: number("exponent")? },
        "ashikhmin_shirley" => BrdfParameters::AshikhminShirley {
            diffuse: colour("diffuse")?,
            specular: colour("specular")?,
            exponent_u: number("exponent_u")?,
            exponent_v: number("exponent_v")?,
        },
        "cook_torrance" => BrdfParameters::CookTorrance {
            alpha_x: number("alpha_x")?,
            alpha_y: number("alpha_y")?,
            f0: colour("f0")?,
            f90: fields.optional("f90").map_or(Ok(Vec3::ONE), |n| n.reflectance())?,
        },
        "ward" => BrdfParameters::Ward {
            diffuse: colour("diffuse")?,
            specular: colour("specular")?,
            alpha_x: number("alpha_x")?,
            alpha_y: number("alpha_y")?,
        },
        "lafortune" => BrdfParameters::Lafortune {
            diffuse: colour("diffuse")?,
            lobes: fields.required("lobes")?.list()?.iter().map(lobe).collect::<Result<_, _>>()?,
        },
        _ => return Ok(None),
    }))
}

fn lobe(node: &Node) -> Result<LafortuneLobe, SceneError> {
    let fields = node.fields()?;
    let lobe = LafortuneLobe {
        reflectance: fields.required("reflectance")?.reflectance()?,
        direction: fields.required("direction")?.vec3()?,
        exponent: fields.required("exponent")?.number()?,
    };
    // Alone first: a mistake is then named with the lobe's place.
    Lafortune::new(Vec3::ZERO, &[lobe]).map_err(|e| misplaced(e, &fields))?;
    fields.finish()?;
    Ok(lobe)
}

fn checked(parameters: BrdfParameters, fields: &Fields) -> Result<AnalyticBrdf, SceneError> {
    AnalyticBrdf::try_from(parameters).map_err(|e| misplaced(e, fields))
}

/// A BRDF's complaint about a parameter, at the parameter's place.
fn misplaced(error: BrdfError, fields: &Fields) -> SceneError {
    let BrdfError::Parameter { field, expected, .. } = error;
    fields.optional(field).unwrap_or(fields.node().clone()).wrong(expected)
}

fn measured(assembly: &mut Assembly, file: &Node) -> Result<BrdfModel, SceneError> {
    let path = assembly.beside(file.text()?);
    if let Some(table) = assembly.tables.get(&path) {
        return Ok(BrdfModel::Measured(table.clone()));
    }
    if assembly.tables.len() == MAX_TABLES {
        return Err(SceneError::TooMuch { file: assembly.file.to_owned(), what: "measured materials", limit: MAX_TABLES });
    }
    let table = merl::read(&assembly.read(&path, file)?);
    let table = Arc::new(table.map_err(|e| SceneError::Format { file: path.clone(), source: e.into() })?);
    assembly.tables.insert(path, table.clone());
    Ok(BrdfModel::Measured(table))
}

/// Tables one scene may hold: 17 MB each, half a gigabyte.
const MAX_TABLES: usize = 32;
