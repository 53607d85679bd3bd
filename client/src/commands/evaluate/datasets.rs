//! The datasets of a sweep: those that are there, and those that are captured because they are not.

use std::collections::BTreeMap;

use lumisphere_proto::v1alpha1 as wire;
use serde_json::{Value, json};
use wire::job_spec::Spec;
use wire::scene_source::Source;

use super::super::dataset::PAGE_SIZE;
use super::super::job::submit;
use super::super::render::version_of;
use super::super::watch::{Events, watch};
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::scene_source;
use crate::sweep_file::{Capture, SweepFile};

/// Characters of the hash in a name: two captures out of a million share them with a chance below 1 : 10⁶.
const HASH_DIGITS: usize = 16;
/// Longest part of a name that an object gives.
const OBJECT_CHARACTERS: usize = 24;

/// A dataset version to evaluate.
pub struct Dataset {
    /// Its name.
    pub name: String,
    /// Pinned.
    pub version: u64,
    /// Its scene's name or file.
    pub scene: String,
    /// What tells it from the sweep's others.
    pub variant: BTreeMap<String, String>,
}

/// Finds all, then captures what is missing. A dataset that is named and is not there is an error before anything is captured.
pub async fn datasets(context: &Context, server: &Server, file: &SweepFile) -> anyhow::Result<Vec<Dataset>> {
    let mut named = Vec::new();
    for name in &file.datasets {
        named.push((name.clone(), version_of(context, server, name, 0).await?.0));
    }
    let mut found = Vec::new();
    let variants = file.variants();
    for (done, capture) in file.captures.iter().enumerate() {
        let spec = named_spec(context, server, capture).await?;
        let (name, scene) = (spec.dataset.clone(), scene_text(spec.scene.as_ref()));
        let progress = format!("{} of {}", done + 1, file.captures.len());
        let version = captured(context, server, spec, &progress).await?;
        found.push(Dataset { name, version, scene, variant: variants[done].clone() });
    }
    for ((name, version), variant) in named.into_iter().zip(&variants[file.captures.len()..]) {
        let scene = scene_text(version.scene_source.as_ref());
        found.push(Dataset { name, version: version.version, scene, variant: variant.clone() });
    }
    Ok(found)
}

/// The version of the dataset that this specification makes: there already, on its way by an earlier run, or captured now.
async fn captured(context: &Context, server: &Server, spec: wire::CaptureSpec, progress: &str) -> anyhow::Result<u64> {
    let name = spec.dataset.clone();
    if let Some(version) = latest(context, server, &name).await? {
        check_same(&spec, &version)?;
        context.output.say(&format!("{name} is there ({progress})"));
        return Ok(version.version);
    }
    context.output.say(&format!("capturing {name} ({progress})"));
    let job = match running(context, server, &name).await? {
        Some(job) => job,
        None => submit(context, server, Spec::Capture(spec), String::new()).await?.name,
    };
    let job = watch(context, server, &job, Events::Show).await?;
    Ok(job.result.unwrap_or_default().dataset_version)
}

/// None where there is no dataset, or no version of it yet.
async fn latest(context: &Context, server: &Server, name: &str) -> anyhow::Result<Option<wire::DatasetVersion>> {
    match server.datasets().get_dataset(context.request(wire::GetDatasetRequest { name: name.into() })).await {
        Ok(answer) => {
            let dataset = answer.into_inner();
            let latest = dataset.latest_version;
            Ok(dataset.versions.into_iter().find(|v| latest > 0 && v.version == latest))
        }
        Err(status) if status.code() == tonic::Code::NotFound => Ok(None),
        Err(status) => Err(status.into()),
    }
}

/// A capture into this dataset that has not ended: an earlier run was interrupted, its job was not.
async fn running(context: &Context, server: &Server, dataset: &str) -> anyhow::Result<Option<String>> {
    let mut client = server.jobs();
    let mut page_token = String::new();
    loop {
        let page = client.list_jobs(context.request(wire::ListJobsRequest { page_size: PAGE_SIZE, page_token })).await?.into_inner();
        let is_ours = |job: &&wire::Job| {
            let spec = job.spec.as_ref().and_then(|s| s.spec.as_ref());
            let is_alive = matches!(job.state(), wire::JobState::Pending | wire::JobState::Running);
            is_alive && matches!(spec, Some(Spec::Capture(c)) if c.dataset == dataset)
        };
        if let Some(job) = page.jobs.iter().find(is_ours) {
            return Ok(Some(job.name.clone()));
        }
        page_token = page.next_page_token;
        if page_token.is_empty() {
            return Ok(None);
        }
    }
}

/// The scene uploaded, and a name that follows from everything that the capture depends on.
async fn named_spec(context: &Context, server: &Server, capture: &Capture) -> anyhow::Result<wire::CaptureSpec> {
    let scene = scene_source::to_wire(context, &mut server.datasets(), &capture.scene).await?;
    let mut spec = wire::CaptureSpec { scene: Some(scene), ..capture.spec.clone() };
    spec.dataset = dataset_name(&spec);
    Ok(spec)
}

/// "sweep-teapot-" and a hash. Two specifications of one name are equal, so what a dataset of this name holds need not be captured again.
fn dataset_name(spec: &wire::CaptureSpec) -> String {
    let plain = |c: char| if c.is_ascii_lowercase() || c.is_ascii_digit() { c } else { '-' };
    let object: String = spec.object.to_ascii_lowercase().chars().map(plain).take(OBJECT_CHARACTERS).collect();
    // Members sorted: a map of the wire has no order.
    let document = json!({"scene": scene_document(spec.scene.as_ref()), "capture": format!("{:?}", wire::CaptureSpec { scene: None, dataset: String::new(), ..spec.clone() })});
    format!("sweep-{object}-{}", &blake3::hash(document.to_string().as_bytes()).to_hex()[..HASH_DIGITS])
}

fn scene_document(scene: Option<&wire::SceneSource>) -> Value {
    let source = match scene.and_then(|s| s.source.as_ref()) {
        Some(Source::Builtin(b)) => json!({"name": b.name, "parameters": b.parameters.iter().collect::<BTreeMap<_, _>>()}),
        Some(Source::Bundle(b)) => {
            json!({"path": b.scene_path, "files": b.files.iter().map(|f| (&f.path, &f.blake3)).collect::<BTreeMap<_, _>>()})
        }
        None => Value::Null,
    };
    let environment = scene.and_then(|s| s.environment.as_ref());
    json!({"source": source, "environment": environment.map(|e| json!([e.blake3, e.scale, e.rotation_deg]))})
}

/// For people.
fn scene_text(scene: Option<&wire::SceneSource>) -> String {
    match scene.and_then(|s| s.source.as_ref()) {
        Some(Source::Builtin(b)) => {
            let parameters: BTreeMap<_, _> = b.parameters.iter().collect();
            std::iter::once(b.name.clone()).chain(parameters.iter().map(|(k, v)| format!("{k}={v}"))).collect::<Vec<_>>().join(" ")
        }
        Some(Source::Bundle(b)) => b.scene_path.clone(),
        None => "an unknown scene".into(),
    }
}

/// Somebody may have put other light into a dataset of our name.
fn check_same(spec: &wire::CaptureSpec, version: &wire::DatasetVersion) -> Result<(), Failure> {
    let parameters: Value = serde_json::from_str(&version.parameters_json).unwrap_or(Value::Null);
    let numbers = [
        ("face_size_texels", spec.face_size_texels),
        ("samples_per_texel", spec.samples_per_texel),
        ("max_bounces", spec.max_bounces),
        ("sample_map_size_texels", spec.sample_map_size_texels),
    ];
    let asked = numbers.into_iter().filter(|(_, n)| *n != 0).map(|(key, n)| (key, json!(n)));
    for (key, wanted) in asked.chain([("object", json!(spec.object))]) {
        if parameters[key] != wanted {
            let there = &parameters[key];
            let problem = format!("dataset {} has {key} {there}, {wanted} expected; delete it to capture it anew", spec.dataset);
            return Err(Failure::Precondition(problem));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec() -> wire::CaptureSpec {
        let parameters = (0..20).map(|k| (format!("key{k}"), k.to_string())).collect();
        let builtin = wire::BuiltinScene { name: "gazebo".into(), parameters };
        let scene = Some(wire::SceneSource { source: Some(Source::Builtin(builtin)), environment: None });
        wire::CaptureSpec { scene, object: "Tea Pot".into(), face_size_texels: 32, ..Default::default() }
    }

    #[test]
    fn a_name_follows_from_the_specification_and_nothing_else() {
        let name = dataset_name(&spec());
        // A map's order is another in every process, and in every map.
        assert_eq!(dataset_name(&spec()), name);
        assert_eq!(dataset_name(&wire::CaptureSpec { dataset: "other".into(), ..spec() }), name);
        assert!(name.starts_with("sweep-tea-pot-") && name.len() <= 63, "{name}");
        let changed = |change: fn(&mut wire::CaptureSpec)| {
            let mut spec = spec();
            change(&mut spec);
            dataset_name(&spec)
        };
        assert_ne!(changed(|s| s.face_size_texels = 64), name);
        assert_ne!(changed(|s| s.seed = 1), name);
        assert_ne!(changed(|s| s.density = Some(wire::capture_spec::Density::SamplePoints(40))), name);
        assert_ne!(changed(|s| s.scene = None), name);
    }

    #[test]
    fn other_light_under_our_name_is_refused() {
        let version = |text: &str| wire::DatasetVersion { parameters_json: text.into(), ..Default::default() };
        assert!(check_same(&spec(), &version("{\"face_size_texels\": 32, \"object\": \"Tea Pot\"}")).is_ok());
        let error = check_same(&spec(), &version("{\"face_size_texels\": 64, \"object\": \"Tea Pot\"}")).unwrap_err();
        assert!(error.to_string().contains("face_size_texels 64, 32 expected"), "{error}");
    }
}
