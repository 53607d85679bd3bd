//! From observations to a stored map: what is fitted is shown, interrupted or not.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::Vec3;

use super::fixture::WORLD;
use crate::capture::observation_map::{Observation, ObservationMap, ObservationParameters, ObservedTexel, Observer, State, tiled_order};
use crate::capture::{Background, surface_texels};
use crate::directions::Scheme;
use crate::fitting::{Basis, Lobe, Model};
use crate::progress::{Progress, Unattended};
use crate::representations::parameter_map::{AllowedModels, ConstructSettings, FitError, ModelCode, construct};
use crate::scenes::Environment;
use crate::textures::{Codec, DatasetVersion, Page, PageId, PixelFormat, Publication, Staging, Store, StoreError, StoreOptions};

const SIZE: usize = 40;

/// A dull left and a glossy right part, with a few texels of neither kind in a corner; what lies below the horizon is missing.
fn truth(part: u32, index: u32) -> Model {
    let shade = 0.2 + 0.001 * (index % 97) as f32;
    match part {
        0 if index == 0 => {
            let coefficients = (0..16).map(|n| [[2.0; 3], [0.3; 3], [-0.2; 3], [0.1; 3]][n.min(3)]).collect();
            Model::Harmonics { basis: Basis::Hemispherical, coefficients }
        }
        0 => Model::Constant { value: [shade, 0.5 * shade, 0.1] },
        _ => {
            let axis = Vec3::new(0.3, -0.2, 0.9).normalize().to_array();
            Model::Lobes { constant: [shade; 3], lobes: vec![Lobe { axis, exponent: 12.0, amplitude: [0.5, 0.4, 0.3] }] }
        }
    }
}

fn observations() -> (ObservationMap, Vec<Arc<Page>>) {
    let surface = WORLD.surface();
    let directions = "icosahedron:73".parse::<Scheme>().unwrap().directions();
    // The scheme's zenith is +Z, the sheet's +Y.
    let observers: Vec<Observer> = directions.iter().map(|d| Observer::At(50.0 * Vec3::new(d.x, d.z, -d.y))).collect();
    let texels: Vec<ObservedTexel> = (0..2)
        .flat_map(|part| {
            let texels = surface_texels(&surface, part, SIZE);
            tiled_order(SIZE).filter_map(move |at| {
                let texel = texels[at]?;
                let index = part * (SIZE * SIZE) as u32 + at as u32;
                Some(ObservedTexel { index, position: texel.position, normal: texel.normal, tangent: texel.steps[0] })
            })
        })
        .collect();
    let parameters = ObservationParameters {
        object: "sheet".into(),
        size_texels: SIZE as u32,
        directions: "icosahedron:73".into(),
        samples_per_observation: 1,
        max_bounces: 1,
        seed: 0,
    };
    let background = Background { surfaces: vec![], textures: vec![], environment: Environment::Constant(Vec3::ZERO) };
    let map = ObservationMap { parameters, surface, background, observers, texels };
    let shape = map.page_shape(PixelFormat::F32);
    let pages = (0..map.page_count()).map(|page| {
        let mut entries = vec![[0f32; 4]; 64 * map.observers.len()];
        for (column, texel) in map.texels_of_page(page).iter().enumerate() {
            let model = truth(texel.index / (SIZE * SIZE) as u32, texel.index);
            for (row, observer) in map.observers.iter().enumerate() {
                let direction = texel.direction_to(observer);
                if direction.z > 0.02 {
                    let seen = Observation { radiance: model.eval(direction.to_array()), state: State::Seen { clipped: 0 } };
                    entries[64 * row + column] = seen.to_texel();
                }
            }
        }
        Arc::new(Page::from_f32(shape, entries.as_flattened()).unwrap())
    });
    let pages = pages.collect();
    (map, pages)
}

fn settings() -> ConstructSettings {
    let models = "auto".parse().unwrap();
    ConstructSettings { models, noise_floor: None, relative_noise: 0.0, pixel_format: PixelFormat::F32, codec: Codec::ZstdChunk }
}

fn publication() -> Publication {
    let (kind, code_version) = ("parameter_map".into(), "test".into());
    Publication { kind, parameters: serde_json::Value::Null, inputs: Default::default(), code_version, created_unix_millis: 0 }
}

/// Cancels at the n-th question.
struct CancelAt(usize, AtomicUsize);

impl Progress for CancelAt {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        self.1.fetch_add(1, Ordering::SeqCst) >= self.0
    }
}

fn everything_of(version: &DatasetVersion) -> (Vec<Vec<f32>>, Vec<u8>) {
    let pages = (0..version.manifest().pages.count).map(|p| version.read_page(PageId(p)).unwrap().to_f32()).collect();
    (pages, version.blob("texels").unwrap())
}

// With twelve quads a texel, so that there are several pages of them and batches end within one.
fn fitted(store: &Store, dataset: &str, interruptions: &[usize]) -> Arc<DatasetVersion> {
    let settings = ConstructSettings { models: "sh:16".parse().unwrap(), ..settings() };
    let (map, pages) = observations();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    store.create_dataset(dataset).unwrap();
    let stage = || store.stage(dataset, "token").unwrap();
    for at in interruptions {
        let progress = CancelAt(*at, AtomicUsize::new(0));
        assert!(matches!(construct(&map, &read, "sheet", &settings, &stage(), &progress), Err(FitError::Cancelled(_))));
    }
    let staging: Staging = stage();
    construct(&map, &read, "sheet", &settings, &staging, &Unattended).unwrap();
    staging.publish(publication()).unwrap()
}

#[test]
fn each_part_gets_the_smallest_model_that_explains_it() {
    let (map, pages) = observations();
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("map").unwrap();
    let staging = store.stage("map", "token").unwrap();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let (parameters, summary) = construct(&map, &read, "sheet", &settings(), &staging, &Unattended).unwrap();
    let count = (SIZE * SIZE) as u64;
    let expected = [("constant", count - 1), ("phong:1", count), ("sh:16", 1)];
    assert_eq!(parameters.histogram, expected.map(|(name, n)| (name.to_string(), n)).into());
    assert_eq!(summary.texels, 2 * count);
    // Exact data: what is left is f32's rounding in sums of 73.
    assert!(summary.rms_residual < 1e-5, "{}", summary.rms_residual);
    let version = staging.publish(publication()).unwrap();
    let (numbers, _) = everything_of(&version);
    // The last texel is the last in the pages: three quads that end where zeros begin.
    let quads: Vec<[f32; 4]> = numbers.concat().chunks_exact(4).map(|q| [q[0], q[1], q[2], q[3]]).collect();
    let end = SIZE * SIZE * (1 + 3) + 12 - 1;
    let last = map.texels.last().unwrap();
    let model = ModelCode::of(&truth(1, last.index)).unpack(&quads[end - 3..end]).unwrap();
    let (d, expected) = ([0.1, -0.1, 0.98], truth(1, last.index));
    assert!((0..3).all(|c| (model.eval(d)[c] - expected.eval(d)[c]).abs() < 1e-4), "{model:?}");
    assert!(quads[end..].iter().all(|q| *q == [0.0; 4]));
}

#[test]
fn harmonics_are_fitted_to_every_texel_though_some_observers_stand_below_its_horizon() {
    let (map, pages) = observations();
    let below = map.texels.iter().filter(|t| map.observers.iter().any(|o| t.direction_to(o).z < 0.0)).count();
    assert!(below > 100, "{below} texels turn away from an observer");
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("map").unwrap();
    let staging = store.stage("map", "token").unwrap();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let settings = ConstructSettings { models: "sh:36".parse().unwrap(), ..settings() };
    let (parameters, summary) = construct(&map, &read, "sheet", &settings, &staging, &Unattended).unwrap();
    assert_eq!(parameters.histogram, [("sh:36".to_string(), 2 * (SIZE * SIZE) as u64)].into());
    // A lobe of m = 12 and height .5 in 36 functions: a few hundredths of its contrast.
    assert!(summary.rms_residual < 0.02, "{}", summary.rms_residual);
}

#[test]
fn a_fit_that_is_stopped_anywhere_and_goes_on_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    let whole = everything_of(&fitted(&store, "whole", &[]));
    assert_eq!(whole.0.len(), 3);
    // 50 pages of observations, 32 a batch: before any, after the first, with a page of numbers stored and the next begun, and twice.
    for (i, interruptions) in [vec![0], vec![1], vec![0, 1], vec![1, 0]].iter().enumerate() {
        let resumed = everything_of(&fitted(&store, &format!("resumed-{i}"), interruptions));
        assert!(resumed == whole, "{interruptions:?}");
    }
}

#[test]
fn models_and_noise_that_no_fit_can_be_made_with_are_named() {
    let (map, pages) = observations();
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("map").unwrap();
    let staging = store.stage("map", "token").unwrap();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let refused = |settings: ConstructSettings| construct(&map, &read, "sheet", &settings, &staging, &Unattended).unwrap_err().to_string();
    assert!(refused(ConstructSettings { models: AllowedModels::Phong(9), ..settings() }).starts_with("9 lobes"));
    assert!(refused(ConstructSettings { models: AllowedModels::Harmonics(5), ..settings() }).starts_with("5 spherical harmonics"));
    assert!(refused(ConstructSettings { noise_floor: Some(f32::NAN), ..settings() }).starts_with("noise floor NaN"));
    assert!(refused(ConstructSettings { relative_noise: -1.0, ..settings() }).starts_with("relative noise -1"));
}

#[test]
fn pages_of_another_shape_are_named() {
    let (map, mut pages) = observations();
    pages[3] = Arc::new(
        Page::from_f32(crate::textures::PageShape { width: 64, height: 2, channels: 4, pixel: PixelFormat::F32 }, &[0.0; 512]).unwrap(),
    );
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("map").unwrap();
    let staging = store.stage("map", "token").unwrap();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let error = construct(&map, &read, "sheet", &settings(), &staging, &Unattended).unwrap_err();
    assert_eq!(error.to_string(), "page 3 of the observations is 64x2, 64x73 expected");
}
