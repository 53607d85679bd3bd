//! What the path tracer's photographs put into a map, against closed forms.

use glam::Vec3;

use super::*;
use crate::capture::PartsError;
use crate::progress::Unattended;
use crate::scenes::{BuiltinOptions, LoadOptions, Scene, SceneBundle, builtin, load};
use crate::textures::{Codec, DatasetVersion, PageId, Publication, Store, StoreOptions};

/// A dull square in the plane y = 0, a wall beside it that hides it from some cameras.
fn scene(wall: &str) -> Scene {
    let json = format!(
        r#"{{"format": "neutral-scene/1",
        "materials": {{"red": {{"type": "phong", "diffuse": [0.5, 0.2, 0.1], "specular": [0, 0, 0], "exponent": 20}},
            "black": {{"type": "diffuse", "albedo": [0, 0, 0]}}}},
        "objects": [{wall}
            {{"name": "plane", "shape": {{"type": "rect", "corner": [-0.5, 0, 0.5], "edge_u": [1, 0, 0], "edge_v": [0, 0, -1]}}, "material": "red"}}],
        "environment": {{"radiance": [1, 1, 1]}},
        "cameras": [{{"name": "a", "origin": [0, 1, 5], "target": [0, 0, 0], "vfov_deg": 25, "width": 24, "height": 24}}]}}"#
    );
    let mut files = SceneBundle::default();
    files.insert("scene.json", json.into_bytes()).unwrap();
    load(&files, "scene.json", &LoadOptions::as_written()).unwrap()
}

fn settings() -> ObserveSettings {
    ObserveSettings {
        object: "plane".into(),
        size_texels: 20,
        directions: "icosahedron:17".parse().unwrap(),
        coverage: Coverage::Hemisphere,
        axis: None,
        distance_radii: 10.0,
        samples_per_observation: 64,
        max_bounces: 1,
        seed: 3,
        pixel_format: PixelFormat::F32,
        codec: Codec::ZstdChunk,
    }
}

fn observed(scene: &Scene, settings: &ObserveSettings) -> (ObservationMap, std::sync::Arc<DatasetVersion>, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("seen").unwrap();
    let staging = store.stage("seen", "token").unwrap();
    let parameters = observe(scene, settings, &staging, &Unattended).unwrap();
    let publication = Publication {
        kind: OBSERVATION_MAP.into(),
        parameters: serde_json::Value::Null,
        inputs: Default::default(),
        code_version: "test".into(),
        created_unix_millis: 0,
    };
    let version = staging.publish(publication).unwrap();
    let map = from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).unwrap())).unwrap();
    (map, version, folder)
}

// Texel, observation, entry.
fn entries(map: &ObservationMap, version: &DatasetVersion) -> Vec<(ObservedTexel, Observer, Observation)> {
    (0..map.page_count())
        .flat_map(|number| {
            let page = version.read_page(PageId(number as u32)).unwrap();
            let columns = map.texels_of_page(number).to_vec().into_iter().enumerate();
            let rows = map.observers.clone();
            columns.flat_map(move |(column, texel)| {
                let at = |row: usize| Observation::from_texel(page.texel(column as u32, row as u32));
                rows.iter().enumerate().map(|(row, observer)| (texel, *observer, at(row))).collect::<Vec<_>>()
            })
        })
        .collect()
}

#[test]
fn a_dull_square_under_an_even_sky_is_its_albedo_from_everywhere() {
    let (map, version, _folder) = observed(&scene(""), &settings());
    assert_eq!((map.texels.len(), map.observers.len(), map.page_count()), (400, 17, 7));
    let seen = entries(&map, &version);
    assert_eq!(seen.len(), 400 * 17);
    let mut sum = Vec3::ZERO;
    for (texel, observer, observation) in &seen {
        let direction = texel.direction_to(observer);
        // All 17 stand above the square's horizon.
        assert!(direction.z > 0.02 && observation.state == State::Seen { clipped: 0 }, "{direction}");
        sum += Vec3::from(observation.radiance);
    }
    // The sky's irradiance is π: radiance = albedo. 435 000 paths of variance below 1: standard error .0015.
    let mean = sum / seen.len() as f32;
    assert!((mean - Vec3::new(0.5, 0.2, 0.1)).abs().max_element() < 0.006, "{mean}");
}

#[test]
fn directions_are_those_of_the_scheme_in_the_squares_frame() {
    let (map, ..) = observed(&scene(""), &settings());
    let middle = map.texels.iter().min_by(|a, b| a.position.length().total_cmp(&b.position.length())).unwrap();
    // u grows along +X, the normal is +Y.
    assert!((middle.frame().tangent - Vec3::X).length() < 1e-5 && (middle.normal - Vec3::Y).length() < 1e-5);
    let zenith = map.observers.iter().filter(|o| middle.direction_to(o).z > 0.99).count();
    let mut heights: Vec<f32> = map.observers.iter().map(|o| middle.direction_to(o).z).collect();
    let mut scheme: Vec<f32> = settings().directions.directions().iter().map(|d| d.z).collect();
    heights.sort_by(f32::total_cmp);
    scheme.sort_by(f32::total_cmp);
    // The nearest texel lies .035 off the centre, cameras 7 away.
    assert!(heights.iter().zip(&scheme).all(|(a, b)| (a - b).abs() < 0.01), "{heights:?}");
    assert_eq!(zenith, 1);
}

#[test]
fn what_a_wall_hides_or_lies_below_the_horizon_is_missing() {
    let wall = r#"{"name": "wall", "shape": {"type": "rect", "corner": [0.6, 0, 5], "edge_u": [0, 0, -10], "edge_v": [0, 50, 0]}, "material": "black"},"#;
    let both = ObserveSettings { coverage: Coverage::Sphere, samples_per_observation: 1, ..settings() };
    let (map, version, _folder) = observed(&scene(wall), &both);
    assert_eq!(map.observers.len(), 34);
    for (texel, observer, observation) in entries(&map, &version) {
        let Observer::At(camera) = observer else { panic!("cameras") };
        // The wall stands at x = .6 and is higher than any camera.
        let expected = camera.y > 0.0 && camera.x < 0.6;
        assert_eq!(observation.state != State::Missing, expected, "{texel:?} {camera}");
    }
}

#[test]
fn the_same_settings_give_the_same_bytes_and_go_on_from_what_is_stored() {
    let (map, version, _folder) = observed(&scene(""), &settings());
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("seen").unwrap();
    let staging = store.stage("seen", "token").unwrap();
    let made = version.read_page(PageId(2)).unwrap();
    staging.append_page(PageId(2), &made.shape(), &vec![9.0; made.shape().values()]).unwrap();
    observe(&scene(""), &settings(), &staging, &Unattended).unwrap();
    let publication = Publication {
        kind: OBSERVATION_MAP.into(),
        parameters: serde_json::Value::Null,
        inputs: Default::default(),
        code_version: "test".into(),
        created_unix_millis: 0,
    };
    let resumed = staging.publish(publication).unwrap();
    for page in (0..map.page_count() as u32).map(PageId) {
        let same = resumed.read_page(page).unwrap().to_f32() == version.read_page(page).unwrap().to_f32();
        assert_eq!(same, page != PageId(2), "what is there is kept, whatever it is");
    }
}

#[test]
fn senseless_settings_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("seen").unwrap();
    let staging = store.stage("seen", "token").unwrap();
    let refused = |settings: ObserveSettings| observe(&scene(""), &settings, &staging, &Unattended).unwrap_err().to_string();
    assert_eq!(refused(ObserveSettings { object: "pot".into(), ..settings() }), r#"scene has no object "pot"; it has plane"#);
    assert_eq!(refused(ObserveSettings { size_texels: 0, ..settings() }), "texels along an edge is 0, 1 to 4096 expected");
    // The gazebo's teapot has 28 parts and more: with 1024² texels each they would not fit into memory.
    let gazebo = builtin("gazebo", &BuiltinOptions::small()).unwrap();
    let teapot = ObserveSettings { object: "teapot".into(), size_texels: 1024, ..settings() };
    let many = observe(&gazebo, &teapot, &staging, &Unattended).unwrap_err().to_string();
    assert!(many.starts_with("texels along an edge is 1024, at most 16777216 in its"), "{many}");
    let near = ObserveSettings { distance_radii: f32::NAN, ..settings() };
    assert_eq!(refused(near), "distance in radii is NaN, a finite number above 1 expected");
    let aslant = ObserveSettings { axis: Some(Vec3::splat(1.0)), ..settings() };
    assert!(refused(aslant).contains("a unit vector expected"));
}

#[test]
fn entries_survive_their_page_and_nonsense_is_missing() {
    for clipped in 0..8 {
        let seen = Observation { radiance: [0.5, -0.25, 7.0], state: State::Seen { clipped } };
        assert_eq!(Observation::from_texel(seen.to_texel()), seen);
    }
    assert_eq!(Observation::from_texel(Observation::MISSING.to_texel()), Observation::MISSING);
    for broken in [[1.0, 1.0, 1.0, f32::NAN], [f32::INFINITY, 0.0, 0.0, 1.0], [1.0, 1.0, 1.0, 9.0], [1.0, 1.0, 1.0, 0.5]] {
        assert_eq!(Observation::from_texel(broken), Observation::MISSING);
    }
    let dark = Observation { radiance: [f32::NAN, 0.0, 0.0], state: State::Seen { clipped: 0 } };
    assert_eq!(dark.to_texel(), [0.0; 4]);
}

#[test]
fn tiles_hold_every_texel_once() {
    for size in [1, 8, 20] {
        let mut all: Vec<usize> = tiled_order(size).collect();
        assert!(all.iter().take(64.min(size * size)).all(|at| at / size < 8 && at % size < 8));
        all.sort_unstable();
        assert!(all.into_iter().eq(0..size * size));
    }
}

#[test]
fn parts_that_contradict_each_other_are_refused() {
    let (map, ..) = observed(&scene(""), &ObserveSettings { samples_per_observation: 1, ..settings() });
    let reload = |map: &ObservationMap| {
        let parts: std::collections::HashMap<_, _> = to_parts(map).unwrap().into_iter().collect();
        from_parts::<PartsError>(map.parameters.clone(), &|name| Ok(parts[name].clone())).map(drop).map_err(|e| e.part)
    };
    assert_eq!(reload(&map), Ok(()));
    let mut twice = map.clone();
    twice.texels[5] = twice.texels[4];
    let mut beyond = map.clone();
    beyond.texels[399].index = 400;
    let mut aslant = map.clone();
    aslant.texels[0].normal = Vec3::ZERO;
    let mut blind = map.clone();
    blind.observers[2] = Observer::Toward(Vec3::ZERO);
    assert_eq!([twice, beyond, aslant, blind].map(|m| reload(&m)), [Err("texels"), Err("texels"), Err("texels"), Err("observers")]);
}
