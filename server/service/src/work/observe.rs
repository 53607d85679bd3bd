//! Scene or photographs to observation map.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use lumisphere::capture::observation_map::{
    ImportError, ImportSettings, OBSERVATION_MAP, ObservationParameters, Photographed, RadiancePhotograph, import, observe,
};
use lumisphere::capture::{Exposures, ResponseCurve, check_exposures, read_stack};
use lumisphere::formats::photograph_list::{self, ListedPhotograph, PhotographList, PhotographView};
use lumisphere::images::{Image, ImageError, ReadLimits, decode_image};
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
        let list = self.listed(source)?;
        let scene = source.object.as_ref().map(|object| load_scene(&object.scene, self.catalog.store(), self.scene_bytes)).transpose()?;
        let photographed = match (&scene, &source.object) {
            (Some(scene), Some(object)) => Photographed::Object { scene, object: &object.name },
            _ => Photographed::Rectangle(self.rectangle(source, &list)?),
        };
        let settings = ImportSettings {
            size_texels: source.size_texels,
            list: source.list_path.clone(),
            pixel_format: source.pixel_format,
            codec: source.codec,
        };
        let views: Vec<(String, PhotographView)> = list.photographs.iter().map(|p| (p.files.join(", "), p.view.clone())).collect();
        // One camera took all of them: the first that was exposed several times tells its response.
        let curve: OnceLock<ResponseCurve> = OnceLock::new();
        let load = |at: usize| self.radiance(source, &list, at, &curve);
        let parameters = import(photographed, &views, &load, &settings, staging, attempt)?;
        let bounds = match photographed {
            Photographed::Rectangle(size) => {
                let half = 0.5 * glam::Vec2::from(size).extend(0.0);
                (-half, half)
            }
            Photographed::Object { scene, object } => scene.objects[scene.object(object).expect("import found the object")].mesh.bounds(),
        };
        // What its surfaces look like is not in the scene: it is no truth.
        staging.put_blob(ORIGIN, &Origin::new(None, bounds).to_bytes())?;
        let files = source.files.iter().map(|(path, hash)| (format!("photographs/{path}"), *hash));
        publication(parameters, files.chain(source.object.iter().flat_map(|object| inputs(&object.scene))).collect())
    }

    fn radiance(
        &self,
        source: &PhotographSource,
        list: &PhotographList,
        at: usize,
        curve: &OnceLock<ResponseCurve>,
    ) -> Result<RadiancePhotograph, ImportError> {
        let photograph = &list.photographs[at];
        let failed = |reason: String| ImportError::Photograph { file: photograph.files.join(", "), reason };
        if let [file] = &photograph.files[..] {
            let bytes = self.uploaded(source, file).map_err(failed)?;
            let alone = RadiancePhotograph::decode(&bytes, source.response, list.saturation).map_err(|e| failed(e.to_string()))?;
            let exposure = photograph.exposures.as_ref().and_then(|exposures| exposures.first());
            return Ok(match exposure {
                Some(exposure) => alone.exposed_by_one(*exposure),
                None => alone,
            });
        }
        let first = self.uploaded(source, &photograph.files[0]).map_err(failed)?;
        if RadiancePhotograph::is_linear(&first).map_err(|e| failed(e.to_string()))? {
            return self.merged_linear(source, photograph, list.saturation).map_err(failed);
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

    // Exposures that are radiance, up to a factor.
    fn merged_linear(
        &self,
        source: &PhotographSource,
        photograph: &ListedPhotograph,
        saturation: Option<f32>,
    ) -> Result<RadiancePhotograph, String> {
        let exposures = photograph.exposures.as_ref();
        let exposures = exposures.ok_or("scene-linear files do not say how they were exposed: a list with \"exposures\" expected")?;
        let load = |file: &str| self.uploaded(source, file);
        let photographs = linear_stack(&photograph.files, exposures, &load, ReadLimits::SCENE)?;
        RadiancePhotograph::merged_linear(&photographs, exposures, saturation).map_err(|e| e.to_string())
    }

    fn listed(&self, source: &PhotographSource) -> Result<PhotographList, ApiError> {
        let field = "spec.observe.photographs.list_path";
        let bytes = self.uploaded(source, &source.list_path).map_err(|reason| ApiError::field(field, reason))?;
        let beside = |file: &str| self.uploaded(source, file).ok();
        photograph_list::read(&source.list_path, &bytes, &beside).map_err(|e| ApiError::field(field, e.to_string()))
    }

    // What of the rectangle the list or the request says.
    fn rectangle(&self, source: &PhotographSource, list: &PhotographList) -> Result<[f32; 2], ApiError> {
        Ok(match (list.size, source.width, source.height) {
            (_, Some(width), Some(height)) => [width, height],
            (Some(size), None, None) => size,
            (None, width, None) if matches!(list.photographs[0].view, PhotographView::Lit { .. }) => {
                let width = width.unwrap_or(1.0);
                let first = self.radiance(source, list, 0, &OnceLock::new())?;
                [width, width * first.radiance.height as f32 / first.radiance.width as f32]
            }
            (_, width, _) => {
                let missing = if width.is_none() { "width" } else { "height" };
                let message = "missing: both or neither of width and height, and both where the list does not say";
                return Err(ApiError::field(format!("spec.observe.photographs.{missing}"), message));
            }
        })
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

// Scene-linear exposures of one view, all of them together within `limits`.
fn linear_stack(
    files: &[String],
    exposures: &[f64],
    load: &dyn Fn(&str) -> Result<Vec<u8>, String>,
    limits: ReadLimits,
) -> Result<Vec<Image>, String> {
    check_exposures(files.len(), exposures).map_err(|e| e.to_string())?;
    let mut left = limits.max_samples;
    let read = |file: &String| {
        let bytes = load(file)?;
        if !RadiancePhotograph::is_linear(&bytes).map_err(|e| format!("{file}: {e}"))? {
            return Err(format!("{file} holds 8-bit codes, radiance as in the first file expected"));
        }
        let image = decode_image(&bytes, ReadLimits { max_samples: left, ..limits }).map_err(|e| match e {
            ImageError::TooLarge { .. } => format!("{file}: {e}: {} for all exposures of a view together", limits.max_samples),
            _ => format!("{file}: {e}"),
        })?;
        left = left.saturating_sub(image.planes.iter().map(Vec::len).sum());
        Ok(image)
    };
    files.iter().map(read).collect()
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

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use lumisphere::images::{ExrStorage, Rgb8, encode_exr_rgb, encode_png};

    use super::*;

    #[test]
    fn scene_linear_exposures_are_checked_before_they_fill_memory() {
        let exr = encode_exr_rgb(&Image::zeros(4, 2, 3), ExrStorage::Float).unwrap();
        let png = encode_png(&Rgb8::filled(4, 2, [9; 3])).unwrap();
        let loaded = Cell::new(0);
        let load = |file: &str| {
            loaded.set(loaded.get() + 1);
            Ok(if file == "codes" { png.clone() } else { exr.clone() })
        };
        let stack = |files: &[&str], exposures: &[f64], max_samples: usize| {
            loaded.set(0);
            let files: Vec<String> = files.iter().map(|file| (*file).to_string()).collect();
            linear_stack(&files, exposures, &load, ReadLimits { max_samples, ..ReadLimits::SCENE })
        };
        // 24 samples each.
        assert_eq!(stack(&["a", "b", "c"], &[1.0, 0.5, 0.25], 72).unwrap().len(), 3);
        let refused = stack(&["a", "b", "c"], &[1.0, 0.5, 0.25], 71).unwrap_err();
        assert!(refused.contains("c: ") && refused.contains("limit 23 samples: 71 for all exposures"), "{refused}");
        assert_eq!(stack(&["a", "codes"], &[1.0, 0.5], 72).unwrap_err(), "codes holds 8-bit codes, radiance as in the first file expected");
        let many: Vec<&str> = vec!["a"; 256];
        assert!(stack(&many, &[1.0; 256], 1 << 20).unwrap_err().contains("256 photographs") && loaded.get() == 0);
        assert!(stack(&["a", "b"], &[1.0, 0.0], 72).unwrap_err().contains("exposure 1 is 0") && loaded.get() == 0);
        assert!(stack(&["a", "b"], &[1.0], 72).is_err() && loaded.get() == 0);
    }
}
