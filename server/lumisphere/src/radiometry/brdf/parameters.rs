//! The numbers behind a model, as settings, requests and files carry them.

use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};

use super::{AnalyticBrdf, AshikhminShirley, BrdfError, CookTorrance, Lafortune, LafortuneLobe, Lambert, Phong, Ward};

/// What the models' constructors take, unchecked; JSON `{"model": "ward", "diffuse": [r, g, b], …}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "model", rename_all = "snake_case", deny_unknown_fields)]
pub enum BrdfParameters {
    /// See [`Lambert::new`].
    Lambert {
        /// In [0, 1].
        albedo: Vec3,
    },
    /// See [`Phong::new`].
    Phong {
        /// k_d.
        diffuse: Vec3,
        /// k_s.
        specular: Vec3,
        /// n.
        exponent: f32,
    },
    /// See [`AshikhminShirley::new`].
    AshikhminShirley {
        /// R_d.
        diffuse: Vec3,
        /// R_s.
        specular: Vec3,
        /// n_u, along +X.
        exponent_u: f32,
        /// n_v, along +Y.
        exponent_v: f32,
    },
    /// See [`CookTorrance::new`].
    CookTorrance {
        /// Along +X.
        alpha_x: f32,
        /// Along +Y.
        alpha_y: f32,
        /// Reflectance at normal incidence.
        f0: Vec3,
        /// Reflectance at grazing incidence; white unless given.
        #[serde(default = "white")]
        f90: Vec3,
    },
    /// See [`Ward::new`].
    Ward {
        /// ρ_d.
        diffuse: Vec3,
        /// ρ_s.
        specular: Vec3,
        /// Along +X.
        alpha_x: f32,
        /// Along +Y.
        alpha_y: f32,
    },
    /// See [`Lafortune::new`].
    Lafortune {
        /// ρ_d.
        diffuse: Vec3,
        /// At most three.
        lobes: Vec<LafortuneLobe>,
    },
}

fn white() -> Vec3 {
    Vec3::ONE
}

impl TryFrom<BrdfParameters> for AnalyticBrdf {
    type Error = BrdfError;

    fn try_from(parameters: BrdfParameters) -> Result<Self, BrdfError> {
        Ok(match parameters {
            BrdfParameters::Lambert { albedo } => Lambert::new(albedo)?.into(),
            BrdfParameters::Phong { diffuse, specular, exponent } => Phong::new(diffuse, specular, exponent)?.into(),
            BrdfParameters::AshikhminShirley { diffuse, specular, exponent_u, exponent_v } => {
                AshikhminShirley::new(diffuse, specular, Vec2::new(exponent_u, exponent_v))?.into()
            }
            BrdfParameters::CookTorrance { alpha_x, alpha_y, f0, f90 } => CookTorrance::new(Vec2::new(alpha_x, alpha_y), f0, f90)?.into(),
            BrdfParameters::Ward { diffuse, specular, alpha_x, alpha_y } => {
                Ward::new(diffuse, specular, Vec2::new(alpha_x, alpha_y))?.into()
            }
            BrdfParameters::Lafortune { diffuse, lobes } => Lafortune::new(diffuse, &lobes)?.into(),
        })
    }
}

impl From<AnalyticBrdf> for BrdfParameters {
    fn from(brdf: AnalyticBrdf) -> Self {
        match brdf {
            AnalyticBrdf::Lambert(Lambert { albedo }) => Self::Lambert { albedo },
            AnalyticBrdf::Phong(Phong { diffuse, specular, exponent }) => Self::Phong { diffuse, specular, exponent },
            AnalyticBrdf::AshikhminShirley(AshikhminShirley { diffuse, specular, exponents }) => {
                Self::AshikhminShirley { diffuse, specular, exponent_u: exponents.x, exponent_v: exponents.y }
            }
            AnalyticBrdf::CookTorrance(CookTorrance { alpha, f0, f90 }) => {
                Self::CookTorrance { alpha_x: alpha.x, alpha_y: alpha.y, f0, f90 }
            }
            AnalyticBrdf::Ward(Ward { diffuse, specular, alpha }) => Self::Ward { diffuse, specular, alpha_x: alpha.x, alpha_y: alpha.y },
            AnalyticBrdf::Lafortune(Lafortune { diffuse, lobes }) => {
                let given = lobes.into_iter().filter(|lobe| lobe.reflectance != Vec3::ZERO).collect();
                Self::Lafortune { diffuse, lobes: given }
            }
        }
    }
}

macro_rules! from_model {
    ($($model:ident),*) => {
        $(impl From<$model> for AnalyticBrdf {
            fn from(model: $model) -> Self {
                Self::$model(model)
            }
        })*
    };
}

from_model!(Lambert, Phong, AshikhminShirley, CookTorrance, Ward, Lafortune);

#[cfg(test)]
mod tests {
    use super::*;

    fn read(json: &str) -> Result<AnalyticBrdf, String> {
        serde_json::from_str(json).map_err(|e| e.to_string())
    }

    #[test]
    fn every_model_survives_json() {
        for json in [
            r#"{"model":"lambert","albedo":[0.1,0.2,0.3]}"#,
            r#"{"model":"phong","diffuse":[0.1,0.2,0.3],"specular":[0.5,0.5,0.5],"exponent":20.0}"#,
            r#"{"model":"ashikhmin_shirley","diffuse":[0.1,0.2,0.3],"specular":[0.5,0.5,0.5],"exponent_u":10.0,"exponent_v":1000.0}"#,
            r#"{"model":"cook_torrance","alpha_x":0.25,"alpha_y":0.5,"f0":[0.1,0.2,0.3],"f90":[1.0,1.0,1.0]}"#,
            r#"{"model":"ward","diffuse":[0.1,0.2,0.3],"specular":[0.5,0.5,0.5],"alpha_x":0.25,"alpha_y":0.5}"#,
            r#"{"model":"lafortune","diffuse":[0.1,0.2,0.3],"lobes":[{"reflectance":[0.5,0.5,0.5],"direction":[-1.0,-1.0,0.75],"exponent":9.0}]}"#,
        ] {
            assert_eq!(serde_json::to_string(&read(json).unwrap()).unwrap(), json);
        }
        assert!(read(r#"{"model":"cook_torrance","alpha_x":0.25,"alpha_y":0.5,"f0":[0.1,0.2,0.3]}"#).is_ok());
        assert!(read(r#"{"model":"lambert","albedo":[0,0,0],"gloss":1}"#).unwrap_err().contains("gloss"));
    }

    #[test]
    fn a_number_out_of_range_is_named_with_what_was_expected() {
        let ward = |d: f32, s: f32, a: f32| Ward::new(Vec3::splat(d), Vec3::splat(s), Vec2::new(0.5, a)).unwrap_err().to_string();
        assert_eq!(ward(-0.5, 0.0, 0.1), "diffuse is [-0.5, -0.5, -0.5], three numbers from 0 to 1 expected");
        assert_eq!(ward(0.75, 0.5, 0.1), "specular is [0.5, 0.5, 0.5], diffuse + specular of at most 1 in each channel expected");
        assert_eq!(ward(0.5, 0.5, 1.5), "alpha_y is 1.5, a number from 0 to 1 expected");
        assert!(ward(f32::NAN, 0.0, 0.1).starts_with("diffuse") && ward(0.0, 0.0, f32::NAN).starts_with("alpha_y"));
        assert!(Phong::new(Vec3::ZERO, Vec3::ZERO, 2e7).is_err() && Phong::new(Vec3::ZERO, Vec3::ZERO, f32::INFINITY).is_err());
        let lobe = |direction| LafortuneLobe { reflectance: Vec3::splat(0.5), direction, exponent: 1.0 };
        assert!(Lafortune::new(Vec3::ZERO, &[lobe(Vec3::ZERO)]).unwrap_err().to_string().starts_with("direction"));
        assert!(Lafortune::new(Vec3::ZERO, &[lobe(Vec3::ONE); 3]).unwrap_err().to_string().starts_with("lobes"));
        assert!(Lafortune::new(Vec3::ZERO, &[LafortuneLobe { reflectance: Vec3::ZERO, ..lobe(Vec3::ONE) }; 4]).is_err());
        assert!(read(r#"{"model":"lambert","albedo":[0,0,2]}"#).unwrap_err().starts_with("albedo is [0, 0, 2]"));
    }
}
