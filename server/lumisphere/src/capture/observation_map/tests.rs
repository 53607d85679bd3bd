//! What the path tracer's photographs put into a map, against closed forms.

use glam::Vec3;

use super::*;
use crate::capture::PartsError;
use crate::formats::photograph_list::PhotographView;
use crate::geometry::{Camera, Distortion, Intrinsics, PhotographCamera, Pose};
use crate::progress::Unattended;
use crate::raytrace::{TraceSettings, Tracer};
use crate::scenes::{BuiltinOptions, LoadOptions, Scene, SceneBundle, builtin, load};
use crate::textures::{Codec, DatasetVersion, PageId, Publication, Staging, Store, StoreOptions};

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

/// What was staged, as a map of the test's dataset.
pub(super) fn published(parameters: ObservationParameters, staging: Staging) -> (ObservationMap, std::sync::Arc<DatasetVersion>) {
    let publication = Publication {
        kind: OBSERVATION_MAP.into(),
        parameters: serde_json::Value::Null,
        inputs: Default::default(),
        code_version: "test".into(),
        created_unix_millis: 0,
    };
    let version = staging.publish(publication).unwrap();
    let map = from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).unwrap())).unwrap();
    (map, version)
}

fn observed(scene: &Scene, settings: &ObserveSettings) -> (ObservationMap, std::sync::Arc<DatasetVersion>, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("seen").unwrap();
    let staging = store.stage("seen", "token").unwrap();
    let parameters = observe(scene, settings, &staging, &Unattended).unwrap();
    let (map, version) = published(parameters, staging);
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

/// A camera at each observer's place whose picture shows the whole square, and that picture by the path tracer.
fn photographs_of(scene: &Scene, map: &ObservationMap) -> Vec<(PhotographCamera, RadiancePhotograph)> {
    let trace = TraceSettings { samples_per_pixel: 64, max_bounces: 1, seed: 5 };
    let tracer = Tracer::new(scene).unwrap();
    let taken = |(k, observer): (usize, &Observer)| {
        let Observer::At(place) = observer else { panic!("cameras") };
        let up = if place.normalize().y > 0.9 { Vec3::Z } else { Vec3::Y };
        let pose = Pose::look_at(*place, Vec3::new(0.05, 0.0, -0.1), up).unwrap();
        let camera = Camera::new(Intrinsics::from_vfov(13.0, 96, 96).unwrap(), pose).unwrap();
        let traced = tracer.render(&camera, &trace, &Unattended).unwrap();
        let states = vec![State::Seen { clipped: 0 }; 96 * 96];
        let distortion = Distortion::new([0.0; 4]).unwrap();
        (PhotographCamera { file: format!("{k}.exr"), camera, distortion }, RadiancePhotograph { radiance: traced.radiance, states })
    };
    map.observers.iter().enumerate().map(taken).collect()
}

/// What importing photographs of an object of the scene gives, its entries.
fn imported(
    scene: &Scene,
    object: &str,
    views: &[(String, PhotographView)],
    pictures: &[RadiancePhotograph],
) -> Result<Vec<(ObservedTexel, Observer, Observation)>, ImportError> {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("seen").unwrap();
    let staging = store.stage("seen", "token").unwrap();
    let (pixel_format, codec) = (PixelFormat::F32, Codec::ZstdChunk);
    let settings = ImportSettings { size_texels: 20, list: "transforms.json".into(), pixel_format, codec };
    let load = |k: usize| Ok(pictures[k].clone());
    let parameters = import(Photographed::Object { scene, object }, views, &load, &settings, &staging, &Unattended)?;
    let (map, version) = published(parameters, staging);
    Ok(entries(&map, &version))
}

#[test]
fn photographs_of_an_object_show_what_the_path_tracer_sees_of_it_texel_by_texel() {
    // Shadows of the sky on two of the square's four sides: turned or mirrored, it would look different.
    let wall = r#"{"name": "wall", "shape": {"type": "rect", "corner": [0.52, 0, 0.3], "edge_u": [0, 0, -0.9], "edge_v": [0, 0.4, 0]}, "material": "black"},
        {"name": "other", "shape": {"type": "rect", "corner": [-0.2, 0, -0.52], "edge_u": [0.7, 0, 0], "edge_v": [0, 0.2, 0]}, "material": "black"},"#;
    let scene = scene(wall);
    let (map, version, _folder) = observed(&scene, &ObserveSettings { samples_per_observation: 256, ..settings() });
    let (cameras, pictures): (Vec<_>, Vec<_>) = photographs_of(&scene, &map).into_iter().unzip();
    let views: Vec<_> = cameras.into_iter().map(|c| (c.file.clone(), PhotographView::Calibrated(c))).collect();
    let (traced, photographed) = (entries(&map, &version), imported(&scene, "plane", &views, &pictures).unwrap());
    let (mut hidden, mut error, mut spread, mut seen) = (0, 0.0, 0.0, 0);
    for ((texel, _, one), (other_texel, _, other)) in traced.iter().zip(&photographed) {
        assert_eq!(texel, other_texel);
        assert_eq!(one.state, other.state, "{texel:?}");
        hidden += usize::from(one.state == State::Missing);
        // The outermost texels' pixels show what is beside the square, too.
        let (column, row) = (texel.index % 20, texel.index / 20);
        if one.state != State::Missing && (1..19).contains(&column) && (1..19).contains(&row) {
            error += f64::from(one.radiance[0] - other.radiance[0]).powi(2);
            spread += f64::from(one.radiance[0] - 0.35).powi(2);
            seen += 1;
        }
    }
    let (error, spread) = ((error / f64::from(seen)).sqrt(), (spread / f64::from(seen)).sqrt());
    assert!(hidden > 200 && seen > 3000, "{hidden} hidden, {seen} compared");
    // 64 paths a pixel, four pixels: .5/√256 of noise, and what pixels beside a wall's edge mix in; the shadows are twice as deep.
    assert!(error < 0.05 && spread > 2.0 * error, "error {error}, shadows {spread}");
}

#[test]
fn photographs_of_an_object_that_cannot_be_used_are_named() {
    let scene = scene("");
    let pose = Pose::look_at(Vec3::new(0.0, 7.0, 1.0), Vec3::ZERO, Vec3::Y).unwrap();
    let camera = Camera::new(Intrinsics::from_vfov(13.0, 4, 4).unwrap(), pose).unwrap();
    let camera = PhotographCamera { file: "a.exr".into(), camera, distortion: Distortion::new([0.0; 4]).unwrap() };
    let picture = RadiancePhotograph { radiance: crate::images::Image::zeros(4, 4, 3), states: vec![State::Seen { clipped: 0 }; 16] };
    let refused = |object: &str, view: PhotographView| {
        imported(&scene, object, &[("a.exr".to_string(), view)], std::slice::from_ref(&picture)).unwrap_err().to_string()
    };
    assert_eq!(refused("pot", PhotographView::Calibrated(camera)), r#"scene has no object "pot"; it has plane"#);
    let lit = refused("plane", PhotographView::Lit { toward: Vec3::Z });
    assert_eq!(lit, "photograph a.exr of an object has no calibrated camera: transforms.json or COLMAP's images.txt expected");
}

#[test]
fn scene_linear_exposures_are_merged_and_clipped_where_they_are_full() {
    let exposure = |scale: f32| {
        let mut picture = crate::images::Image::zeros(3, 1, 3);
        [0.2, 3.0, 40.0].iter().enumerate().for_each(|(at, value)| picture.set_rgb(at, [scale * value; 3].map(|v: f32| v.min(1.0))));
        picture
    };
    let merged = RadiancePhotograph::merged_linear(&[exposure(1.0), exposure(0.125)], &[1.0, 0.125], Some(1.0)).unwrap();
    let close = |at: usize, value: f32| (merged.radiance.rgb(at)[0] / value - 1.0).abs() < 1e-5;
    assert!(close(0, 0.2) && close(1, 3.0), "{:?}", merged.radiance.planes[0]);
    assert_eq!(merged.states, [State::Seen { clipped: 0 }, State::Seen { clipped: 0 }, State::Missing]);
    let file = crate::images::encode_exr_rgb(&exposure(1.0), crate::images::ExrStorage::Float).unwrap();
    let alone = |saturation| RadiancePhotograph::decode(&file, Response::Srgb, saturation).unwrap().states;
    assert_eq!(alone(Some(1.0)), [State::Seen { clipped: 0 }, State::Seen { clipped: 7 }, State::Seen { clipped: 7 }]);
    assert_eq!(alone(None), [State::Seen { clipped: 0 }; 3]);
    // One exposure that stands beside merged ones.
    let dark = crate::images::encode_exr_rgb(&exposure(0.125), crate::images::ExrStorage::Float).unwrap();
    let one = RadiancePhotograph::decode(&dark, Response::Srgb, Some(1.0)).unwrap().exposed_by_one(0.125);
    assert!((one.radiance.rgb(1)[0] / 3.0 - 1.0).abs() < 1e-5 && one.states[2] == State::Seen { clipped: 7 }, "{one:?}");
}

#[test]
fn what_is_black_in_all_exposures_is_seen_black() {
    let exposure = |scale: f32| {
        let mut picture = crate::images::Image::zeros(2, 1, 3);
        picture.set_rgb(0, [scale * 0.2, 0.0, scale * 0.4]);
        picture
    };
    let merged = RadiancePhotograph::merged_linear(&[exposure(1.0), exposure(0.125)], &[1.0, 0.125], Some(1.0)).unwrap();
    assert_eq!(merged.states, [State::Seen { clipped: 0 }; 2]);
    let [r, g, b] = merged.radiance.rgb(0);
    assert!((r - 0.2).abs() < 1e-6 && g == 0.0 && (b - 0.4).abs() < 1e-6 && merged.radiance.rgb(1) == [0.0; 3], "{r} {g} {b}");
}
