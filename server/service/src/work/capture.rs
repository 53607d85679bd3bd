//! Scene to dataset version.

use lumisphere::representations::Kind;
use lumisphere::representations::offset_surface_light_field::{ConstructSettings, construct};
use lumisphere::textures::{Publication, Staging};

use super::Work;
use crate::errors::ApiError;
use crate::jobs::record::now_millis;
use crate::jobs::{Attempt, Outcome};
use crate::scenes::{inputs, load_scene};
use crate::wire::datasets::{ORIGIN, Origin};
use crate::wire::jobs::CaptureSpec;

const KIND: Kind = Kind::OffsetSurfaceLightField;

impl Work {
    pub(super) fn capture(&self, spec: &CaptureSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let version = self.publish_once(&spec.dataset, KIND.name(), attempt, |staging| self.fill(spec, staging, attempt))?;
        self.published(&spec.dataset, version)
    }

    fn fill(&self, spec: &CaptureSpec, staging: &Staging, attempt: &Attempt) -> Result<Publication, ApiError> {
        let scene = load_scene(&spec.scene, self.catalog.store(), self.scene_bytes)?;
        let settings = ConstructSettings {
            object: spec.object.clone(),
            epsilon: spec.epsilon,
            spacing: spec.spacing,
            placing: spec.placing,
            face_size_texels: spec.face_size_texels,
            sample_map_size_texels: spec.sample_map_size_texels,
            pixel_format: spec.pixel_format,
            codec: spec.codec,
            samples_per_texel: spec.samples_per_texel,
            max_bounces: spec.max_bounces,
            seed: spec.seed,
            original: spec.original,
        };
        let parameters = construct(&scene, &settings, staging, attempt)?;
        let object = scene.object(&spec.object).expect("construct found the object");
        let origin = Origin::new(Some(spec.scene_message.clone()), scene.objects[object].mesh.bounds());
        staging.put_blob(ORIGIN, &origin.to_bytes())?;
        Ok(Publication {
            kind: KIND.name().into(),
            parameters: serde_json::to_value(parameters).map_err(ApiError::internal)?,
            inputs: inputs(&spec.scene),
            code_version: env!("CARGO_PKG_VERSION").into(),
            created_unix_millis: now_millis(),
        })
    }
}
