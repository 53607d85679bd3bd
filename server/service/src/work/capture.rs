//! Scene to dataset version. Killed at any moment, it goes on from the pages it has stored, or finds that it had finished.

use lumisphere::progress::Progress;
use lumisphere::representations::Kind;
use lumisphere::representations::offset_surface_light_field::{ConstructSettings, construct};
use lumisphere::textures::{Publication, Staging, StoreError};

use super::Work;
use super::scene::{inputs, load_scene};
use crate::errors::{ApiError, Reason};
use crate::jobs::record::now_millis;
use crate::jobs::{Attempt, Outcome};
use crate::wire::datasets::{ORIGIN, Origin};
use crate::wire::jobs::CaptureSpec;

const KIND: Kind = Kind::OffsetSurfaceLightField;

impl Work {
    pub(super) fn capture(&self, spec: &CaptureSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let staging = match self.stage(spec, attempt)? {
            Ok(staging) => staging,
            // Killed between publishing and recording that.
            Err(version) => return self.captured(&spec.dataset, version),
        };
        let version = match self.fill(spec, &staging, attempt) {
            Ok(publication) => {
                attempt.report("publishing", 0, 1);
                staging.publish(publication)?.manifest().version
            }
            Err(error) => {
                if attempt.is_cancel_asked() {
                    staging.abandon()?;
                }
                return Err(error);
            }
        };
        self.captured(&spec.dataset, version)
    }

    /// The dataset's write lock and what an earlier attempt stored; or the version that it had published.
    fn stage(&self, spec: &CaptureSpec, attempt: &Attempt) -> Result<Result<Staging, u64>, ApiError> {
        let store = self.catalog.store();
        match store.create_dataset(&spec.dataset) {
            Ok(()) | Err(StoreError::AlreadyExists { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        if let Ok(manifest) = store.manifest(&spec.dataset, None)
            && manifest.kind != KIND.name()
        {
            let message = format!("dataset {} holds {:?}, a capture makes {:?}", spec.dataset, manifest.kind, KIND.name());
            return Err(ApiError::new(Reason::DatasetKindMismatch, message));
        }
        match store.stage(&spec.dataset, &attempt.token()) {
            Err(StoreError::AlreadyPublished { version, .. }) => Ok(Err(version)),
            staging => Ok(Ok(staging?)),
        }
    }

    fn fill(&self, spec: &CaptureSpec, staging: &Staging, attempt: &Attempt) -> Result<Publication, ApiError> {
        let scene = load_scene(&spec.scene, self.catalog.store(), self.scene_bytes)?;
        let settings = ConstructSettings {
            object: spec.object.clone(),
            epsilon: spec.epsilon,
            spacing: spec.spacing,
            face_size_texels: spec.face_size_texels,
            sample_map_size_texels: spec.sample_map_size_texels,
            pixel_format: spec.pixel_format,
            codec: spec.codec,
            samples_per_texel: spec.samples_per_texel,
            max_bounces: spec.max_bounces,
            seed: spec.seed,
        };
        let parameters = construct(&scene, &settings, staging, attempt)?;
        let object = scene.object(&spec.object).expect("construct found the object");
        let origin = Origin::new(spec.scene_message.clone(), scene.objects[object].mesh.bounds());
        staging.put_blob(ORIGIN, &origin.to_bytes())?;
        Ok(Publication {
            kind: KIND.name().into(),
            parameters: serde_json::to_value(parameters).map_err(ApiError::internal)?,
            inputs: inputs(&spec.scene),
            code_version: env!("CARGO_PKG_VERSION").into(),
            created_unix_millis: now_millis(),
        })
    }

    fn captured(&self, dataset: &str, version: u64) -> Result<Outcome, ApiError> {
        let manifest = self.catalog.manifest(dataset, version)?;
        let summary = serde_json::json!({
            "dataset": dataset,
            "version": version,
            "pages": manifest.pages.count,
            "stored_bytes": manifest.stored_bytes(),
            "parameters": manifest.parameters,
        });
        Ok(Outcome { published: Some((dataset.into(), version)), blobs: Vec::new(), summary_json: summary.to_string() })
    }
}
