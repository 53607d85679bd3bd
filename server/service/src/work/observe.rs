//! Scene or photographs to observation map.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use lumisphere::capture::observation_map::{
    ImportError, ImportSettings, OBSERVATION_MAP, ObservationParameters, RadiancePhotograph, import, observe,
};
use lumisphere::capture::{Exposures, ResponseCurve, read_stack};
use lumisphere::formats::photograph_list::{self, ListedPhotograph, PhotographList, PhotographView};
use lumisphere::textures::{ContentHash, Publication, Staging};

use super::Work;
use crate::errors::ApiError;
use crate::jobs::record::now_millis;
use crate::jobs::{Attempt, Outcome};
use crate::scenes::{inputs, load_scene, read_bounded};
use crate::wire::datasets::{ORIGIN, Origin};
use crate::wire::jobs::{ObserveSource, ObserveSpec, ObservedScene, PhotographSource};

impl Work {
    pub(super) fn observe(&self, spec: &ObserveSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let fill = |staging: &Staging| match &spec.source {
            ObserveSource::Scene(observed) => self.observe_scene(observed, staging, attempt),
            ObserveSource::Photographs(source) => self.import_photographs(source, staging, attempt),
        };
        let version = self.publish_once(&spec.dataset, OBSERVATION_MAP, attempt, fill)?;
        self.published(&spec.dataset, version)
    }

    fn observe_scene(&self, observed: &ObservedScene, staging: &Staging, attempt: &Attempt) -> Result<Publication, ApiError> {
        let scene = load_scene(&observed.scene, self.catalog.store(), self.scene_bytes)?;
        let parameters = observe(&scene, &observed.settings, staging, attempt)?;
        let object = scene.object(&parameters.object).expect("observe found the object");
        let origin = Origin::new(Some(observed.message.clone()), scene.objects[object].mesh.bounds());
        staging.put_blob(ORIGIN, &origin.to_bytes())?;
        publication(parameters, inputs(&observed.scene))
    }

    fn import_photographs(&self, source: &PhotographSource, staging: &Staging, attempt: &Attempt) -> Result<Publication, ApiError> {
        let (list, settings) = self.listed(source)?;
        let views: Vec<(String, PhotographView)> = list.photographs.iter().map(|p| (p.files.join(", "), p.view.clone())).collect();
        // One camera took all of them: the first that was exposed several times tells its response.
        let curve: OnceLock<ResponseCurve> = OnceLock::new();
        let load = |at: usize| self.radiance(source, &list.photographs[at], &curve);
        let parameters = import(&views, &load, &settings, staging, attempt)?;
        let half = 0.5 * glam::Vec2::from(settings.size).extend(0.0);
        staging.put_blob(ORIGIN, &Origin::new(None, (-half, half)).to_bytes())?;
        publication(parameters, source.files.iter().map(|(path, hash)| (format!("photographs/{path}"), *hash)).collect())
    }

    fn radiance(
        &self,
        source: &PhotographSource,
        photograph: &ListedPhotograph,
        curve: &OnceLock<ResponseCurve>,
    ) -> Result<RadiancePhotograph, ImportError> {
        let failed = |reason: String| ImportError::Photograph { file: photograph.files.join(", "), reason };
        if let [file] = &photograph.files[..] {
            let bytes = self.uploaded(source, file).map_err(failed)?;
            return RadiancePhotograph::decode(&bytes, source.response).map_err(|e| failed(e.to_string()));
        }
        let paths: Vec<PathBuf> = photograph.files.iter().map(PathBuf::from).collect();
        let load = |path: &Path| self.uploaded(source, &path.to_string_lossy()).map_err(std::io::Error::other);
        let exposures = photograph.exposures.clone().map_or(Exposures::FromFiles, Exposures::Listed);
        let stack = read_stack(&paths, &load, &exposures).map_err(|e| failed(e.to_string()))?;
        let curve = match curve.get() {
            Some(known) => known,
            None => {
                let recovered = ResponseCurve::recover(&stack).map_err(|e| failed(e.to_string()))?;
                curve.get_or_init(|| recovered)
            }
        };
        RadiancePhotograph::merged(&stack, curve).map_err(|e| failed(e.to_string()))
    }

    // The list, and what of the rectangle it or the request says.
    fn listed(&self, source: &PhotographSource) -> Result<(PhotographList, ImportSettings), ApiError> {
        let field = "spec.observe.photographs.list_path";
        let bytes = self.uploaded(source, &source.list_path).map_err(|reason| ApiError::field(field, reason))?;
        let beside = |file: &str| self.uploaded(source, file).ok();
        let list = photograph_list::read(&source.list_path, &bytes, &beside).map_err(|e| ApiError::field(field, e.to_string()))?;
        let size = match (list.size, source.width, source.height) {
            (_, Some(width), Some(height)) => [width, height],
            (Some(size), None, None) => size,
            (None, width, None) if matches!(list.photographs[0].view, PhotographView::Lit { .. }) => {
                let width = width.unwrap_or(1.0);
                let first = self.radiance(source, &list.photographs[0], &OnceLock::new())?;
                [width, width * first.radiance.height as f32 / first.radiance.width as f32]
            }
            (_, width, _) => {
                let missing = if width.is_none() { "width" } else { "height" };
                let message = "missing: both or neither of width and height, and both where the list does not say";
                return Err(ApiError::field(format!("spec.observe.photographs.{missing}"), message));
            }
        };
        let settings = ImportSettings {
            size,
            size_texels: source.size_texels,
            list: source.list_path.clone(),
            pixel_format: source.pixel_format,
            codec: source.codec,
        };
        Ok((list, settings))
    }

    // A file by its path relative to the list's folder.
    fn uploaded(&self, source: &PhotographSource, file: &str) -> Result<Vec<u8>, String> {
        let folder = source.list_path.rsplit_once('/').map(|(folder, _)| format!("{folder}/")).unwrap_or_default();
        let plain = file.strip_prefix("./").unwrap_or(file);
        let paths = [source.list_path.clone(), format!("{folder}{plain}")];
        let wanted = if file == source.list_path { &paths[0] } else { &paths[1] };
        let (path, hash) = source.files.iter().find(|(path, _)| path == wanted).ok_or(format!("{wanted:?} is not among the files"))?;
        read_bounded(self.catalog.store(), hash, path).map_err(|e| e.to_string())
    }
}

fn publication(parameters: ObservationParameters, inputs: BTreeMap<String, ContentHash>) -> Result<Publication, ApiError> {
    Ok(Publication {
        kind: OBSERVATION_MAP.into(),
        parameters: serde_json::to_value(parameters).map_err(ApiError::internal)?,
        inputs,
        code_version: env!("CARGO_PKG_VERSION").into(),
        created_unix_millis: now_millis(),
    })
}
