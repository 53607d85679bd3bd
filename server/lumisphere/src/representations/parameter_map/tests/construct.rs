//! From observations to a stored map: what is fitted is shown, interrupted or not.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::Vec3;

use super::fixture::WORLD;
use crate::capture::observation_map::{Observation, ObservationMap, ObservationParameters, ObservedTexel, Observer, State, tiled_order};
use crate::capture::{Background, surface_texels};
use crate::directions::Scheme;
use crate::fitting::{Basis, Lobe, Model, Outliers, Precision};
use crate::progress::{Progress, Unattended};
use crate::representations::parameter_map::construct::compared_pages;
use crate::representations::parameter_map::{
    AllowedModels, ConstructSettings, FitError, FitSource, FitSummary, FollowFit, ModelCode, PartialFit, PartialMap, ReadObservations,
    Solver, construct, from_parts,
};
use crate::scenes::Environment;
use crate::textures::{Codec, DatasetVersion, Page, PageId, PixelFormat, Publication, Staging, Store, StoreError, StoreOptions};

pub(super) const SIZE: usize = 40;

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

pub(super) fn observations() -> (ObservationMap, Vec<Arc<Page>>) {
    observed_from(&"icosahedron:73".parse::<Scheme>().unwrap().directions())
}

/// The scheme's zenith is +Z, the sheet's +Y.
pub(super) fn observed_from(directions: &[Vec3]) -> (ObservationMap, Vec<Arc<Page>>) {
    let radiance = |texel: &ObservedTexel, _: usize, direction: Vec3| {
        truth(texel.index / (SIZE * SIZE) as u32, texel.index).eval(direction.to_array())
    };
    observed_as(directions, &radiance)
}

/// The same of a sheet that shows `radiance(texel, observation, direction)`; the direction is in the texel's frame.
pub(super) fn observed_as(
    directions: &[Vec3],
    radiance: &dyn Fn(&ObservedTexel, usize, Vec3) -> [f32; 3],
) -> (ObservationMap, Vec<Arc<Page>>) {
    let surface = WORLD.surface();
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
            for (row, observer) in map.observers.iter().enumerate() {
                let direction = texel.direction_to(observer);
                if direction.z > 0.02 {
                    let seen = Observation { radiance: radiance(texel, row, direction), state: State::Seen { clipped: 0 } };
                    entries[64 * row + column] = seen.to_texel();
                }
            }
        }
        Arc::new(Page::from_f32(shape, entries.as_flattened()).unwrap())
    });
    let pages = pages.collect();
    (map, pages)
}

pub(super) fn settings() -> ConstructSettings {
    ConstructSettings {
        models: "auto".parse().unwrap(),
        noise_floor: None,
        relative_noise: 0.0,
        outliers: Outliers::Keep,
        precision: Precision::Single,
        max_bytes: None,
        pixel_format: PixelFormat::F32,
        codec: Codec::ZstdChunk,
    }
}

pub(super) fn source<'a>(map: &'a ObservationMap, read: &'a ReadObservations<'a>) -> FitSource<'a> {
    FitSource { map, read, name: "sheet", beside_bytes: 0, solver: Solver::Processor }
}

pub(super) fn publication() -> Publication {
    let (kind, code_version) = ("parameter_map".into(), "test".into());
    Publication { kind, parameters: serde_json::Value::Null, inputs: Default::default(), code_version, created_unix_millis: 0 }
}

/// Cancels at the n-th question.
pub(super) struct CancelAt(pub usize, pub AtomicUsize);

impl Progress for CancelAt {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        self.1.fetch_add(1, Ordering::SeqCst) >= self.0
    }
}

impl FollowFit for CancelAt {
    fn fitted(&self, _so_far: &FitSummary) {}
    fn offer(&self, _partial: &PartialMap<'_>) -> Result<(), FitError> {
        Ok(())
    }
}

pub(super) fn everything_of(version: &DatasetVersion) -> (Vec<Vec<f32>>, Vec<u8>) {
    let pages = (0..version.manifest().pages.count).map(|p| version.read_page(PageId(p)).unwrap().to_f32()).collect();
    (pages, version.blob("texels").unwrap())
}

/// Not stopped, but killed before it was published.
const PACKED: usize = usize::MAX;

// With twelve quads a texel, so that there are several pages of them and batches end within one.
fn fitted(store: &Store, dataset: &str, interruptions: &[usize]) -> Arc<DatasetVersion> {
    let settings = ConstructSettings { models: "sh:16".parse().unwrap(), ..settings() };
    let (map, pages) = observations();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    store.create_dataset(dataset).unwrap();
    let stage = || store.stage(dataset, "token").unwrap();
    for at in interruptions {
        let progress = CancelAt(*at, AtomicUsize::new(0));
        let stopped = construct(&source(&map, &read), &settings, &stage(), &progress);
        assert!(*at == PACKED || matches!(stopped, Err(FitError::Cancelled(_))));
    }
    let staging: Staging = stage();
    construct(&source(&map, &read), &settings, &staging, &Unattended).unwrap();
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
    let (parameters, summary) = construct(&source(&map, &read), &settings(), &staging, &Unattended).unwrap();
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
    let (parameters, summary) = construct(&source(&map, &read), &settings, &staging, &Unattended).unwrap();
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
    for (i, interruptions) in [vec![0], vec![1], vec![0, 1], vec![1, 0], vec![1, PACKED], vec![PACKED]].iter().enumerate() {
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
    let refused = |settings: ConstructSettings| construct(&source(&map, &read), &settings, &staging, &Unattended).unwrap_err().to_string();
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
    let error = construct(&source(&map, &read), &settings(), &staging, &Unattended).unwrap_err();
    assert_eq!(error.to_string(), "page 3 of the observations is 64x2, 64x73 expected");
}

/// Offers of partial maps that were stored, as versions of "partial".
struct StoreOffers<'a>(&'a Store, std::sync::Mutex<Vec<FitSummary>>);

impl Progress for StoreOffers<'_> {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        false
    }
}

impl FollowFit for StoreOffers<'_> {
    fn fitted(&self, so_far: &FitSummary) {
        self.1.lock().unwrap().push(so_far.clone());
    }
    fn offer(&self, partial: &PartialMap<'_>) -> Result<(), FitError> {
        let staging = self.0.stage("partial", "part")?;
        let parameters = serde_json::to_value(partial.store(&staging)?).unwrap();
        staging.publish(Publication { parameters, ..publication() })?;
        Ok(())
    }
}

#[test]
fn what_is_fitted_so_far_is_told_and_can_be_stored_as_a_map() {
    let (map, pages) = observations();
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("map").unwrap();
    store.create_dataset("partial").unwrap();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let follow = StoreOffers(&store, Default::default());
    let staging = store.stage("map", "token").unwrap();
    let (parameters, summary) = construct(&source(&map, &read), &settings(), &staging, &follow).unwrap();
    let whole = staging.publish(Publication { parameters: serde_json::to_value(parameters).unwrap(), ..publication() }).unwrap();

    // 50 pages of observations in two batches: one offer, behind 32 pages of 64 texels.
    let fitted = 32 * 64;
    let told = follow.1.into_inner().unwrap();
    assert_eq!(told.iter().map(|s| s.texels).collect::<Vec<_>>(), [fitted as u64, 2 * (SIZE * SIZE) as u64]);
    assert_eq!((&told[1].histogram, &told[1].flags), (&summary.histogram, &summary.flags));
    let opened = |version: &DatasetVersion| {
        let parameters = serde_json::from_value(version.manifest().parameters.clone()).unwrap();
        from_parts::<PartsOrStore>(parameters, &|name| Ok(version.blob(name)?)).unwrap()
    };
    let partial = store.open_version("partial", Some(1)).unwrap();
    assert_eq!(store.versions("partial").unwrap(), [1]);
    let (part, all) = (opened(&partial), opened(&whole));
    assert_eq!(part.parameters.partial, Some(PartialFit { texels_fitted: fitted as u64, texels: 2 * (SIZE * SIZE) as u64 }));
    assert_eq!(all.parameters.partial, None);
    assert_eq!(part.page_count(), partial.manifest().pages.count as usize);
    for (at, texel) in map.texels.iter().enumerate() {
        let index = texel.index as usize;
        let expected = if at < fitted { all.texels.texels[index].code } else { ModelCode::NONE };
        assert_eq!(part.texels.texels[index].code, expected, "texel {at}");
    }
    // The numbers are those of the whole map, as far as they go.
    let quads = |version: &DatasetVersion| everything_of(version).0.concat();
    let (some, every) = (quads(&partial), quads(&whole));
    let known = 4 * part.texels.quads() as usize;
    assert!(some[..known] == every[..known] && some[known..].iter().all(|c| *c == 0.0));
}

#[derive(Debug)]
struct PartsOrStore;

impl From<crate::capture::PartsError> for PartsOrStore {
    fn from(_: crate::capture::PartsError) -> Self {
        Self
    }
}

impl From<StoreError> for PartsOrStore {
    fn from(_: StoreError) -> Self {
        Self
    }
}

/// Fits with a bound on bytes, stopped now and then; the version, what it takes with all that is beside it, and the summary.
fn bounded(store: &Store, dataset: &str, max_bytes: Option<u64>, stops: &[usize]) -> Result<(Arc<DatasetVersion>, FitSummary), FitError> {
    let (map, pages) = observations();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let settings = ConstructSettings { max_bytes, pixel_format: PixelFormat::F16, ..settings() };
    store.create_dataset(dataset).unwrap();
    let stage = || store.stage(dataset, &format!("token-{dataset}")).unwrap();
    let beside = FitSource { beside_bytes: 100, ..source(&map, &read) };
    for at in stops {
        let progress = CancelAt(*at, AtomicUsize::new(0));
        let stopped = construct(&beside, &settings, &stage(), &progress);
        assert!(*at == PACKED || matches!(stopped, Err(FitError::Cancelled(_))));
    }
    let staging = stage();
    let (_, summary) = construct(&beside, &settings, &staging, &Unattended)?;
    staging.put_blob("beside", &[7; 100]).unwrap();
    Ok((staging.publish(publication()).unwrap(), summary))
}

#[test]
fn a_bound_on_bytes_is_kept_and_a_larger_one_leaves_less() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    let free = bounded(&store, "free", None, &[]).unwrap();
    let all = free.0.manifest().stored_bytes();
    let (roomy, told) = bounded(&store, "roomy", Some(all), &[]).unwrap();
    assert!(everything_of(&roomy) == everything_of(&free.0), "a bound that is no bound changes nothing");
    assert_eq!(told.budget.unwrap().texels_reduced, 0);

    let least = match bounded(&store, "none", Some(1), &[]) {
        Err(FitError::MaxBytes { max_bytes: 1, least }) => least,
        other => panic!("{other:?}"),
    };
    let mut before = f64::INFINITY;
    // How near bytes come to the bound is not told here: texels that are all alike pack better than some of each kind, so bytes do not rise with quads.
    for (i, part) in [0u64, 1, 3, 5, 7, 9].into_iter().enumerate() {
        let max_bytes = least + (all - least) * part / 10;
        let (version, summary) = bounded(&store, &format!("bounded-{i}"), Some(max_bytes), &[]).unwrap();
        let (bytes, budget) = (version.manifest().stored_bytes(), summary.budget.unwrap());
        assert!(bytes <= max_bytes, "{bytes} bytes, {max_bytes} allowed");
        assert_eq!((budget.bytes, budget.max_bytes, budget.bytes_before), (bytes, max_bytes, all));
        assert!(summary.rms_residual <= before && summary.rms_residual >= budget.rms_residual_before);
        before = summary.rms_residual;
        assert_eq!(summary.texels, 2 * (SIZE * SIZE) as u64);
        let dull = summary.histogram.get("constant").unwrap() + summary.histogram.get("cosine_power").unwrap_or(&0);
        assert_eq!(budget.texels_reduced > 0, dull > (SIZE * SIZE) as u64, "{:?}", summary.histogram);
    }
    let (message, least_again) = (bounded(&store, "short", Some(least - 1), &[]).unwrap_err().to_string(), least.to_string());
    assert!(message.contains(&least_again) && message.contains(&(least - 1).to_string()), "{message}");
}

#[test]
fn a_bounded_fit_that_is_stopped_anywhere_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    let all = bounded(&store, "free", None, &[]).unwrap().0.manifest().stored_bytes();
    let whole = everything_of(&bounded(&store, "whole", Some(all * 9 / 10), &[]).unwrap().0);
    // Questions: one a batch, two of them, one for each of 32 pages that are compared, then one for each size that is tried.
    for (i, stops) in [vec![1], vec![20], vec![36], vec![0, 1, 38, PACKED]].iter().enumerate() {
        let resumed = everything_of(&bounded(&store, &format!("resumed-{i}"), Some(all * 9 / 10), stops).unwrap().0);
        assert!(resumed == whole, "{stops:?}");
    }
}

#[test]
fn pages_that_are_compared_lie_all_over_a_map() {
    let (size, first) = (256, tiled_order(256).step_by(64).collect::<Vec<_>>());
    let pages: Vec<usize> = compared_pages(first.len()).collect();
    let distinct = |of: &dyn Fn(usize) -> usize| pages.iter().map(|page| of(first[*page])).collect::<std::collections::BTreeSet<_>>().len();
    let (columns, rows) = (distinct(&|at| at % size / 8), distinct(&|at| at / size / 8));
    assert!(pages.len() == 32 && columns > 16 && rows == 32, "{columns} columns, {rows} rows: {pages:?}");
    assert_eq!(compared_pages(5).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
}

/// Does away with what is kept of the first batch when the models are about to be packed.
struct Loses<'a> {
    folder: &'a std::path::Path,
    lose: fn(&std::path::Path),
}

impl Progress for Loses<'_> {
    fn report(&self, what: &str, _done: u64, _total: u64) {
        let kept = |folder: &std::path::Path| -> Vec<std::path::PathBuf> {
            std::fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path()).collect()
        };
        let mut folders = if what == "packing" { vec![self.folder.to_path_buf()] } else { Vec::new() };
        while let Some(folder) = folders.pop() {
            for path in kept(&folder) {
                if path.is_dir() {
                    folders.push(path);
                } else if path.to_string_lossy().contains("models2-000000") {
                    (self.lose)(&path);
                }
            }
        }
    }
    fn is_cancelled(&self) -> bool {
        false
    }
}

impl FollowFit for Loses<'_> {
    fn fitted(&self, _so_far: &FitSummary) {}
    fn offer(&self, _partial: &PartialMap<'_>) -> Result<(), FitError> {
        Ok(())
    }
}

#[test]
fn models_that_are_lost_before_they_are_packed_are_named_and_fitted_again() {
    let (map, pages) = observations();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("map").unwrap();
    // The first batch again, the second from where it is kept.
    let again = (2 * (SIZE * SIZE) as u64, 32 * 64);
    let remove = |path: &std::path::Path| std::fs::remove_file(path).unwrap();
    let damage = |path: &std::path::Path| std::fs::write(path, b"damaged").unwrap();
    for (token, lose) in [("removed", remove as fn(&std::path::Path)), ("damaged", damage)] {
        let staging = store.stage("map", token).unwrap();
        let lost = construct(&source(&map, &read), &settings(), &staging, &Loses { folder: folder.path(), lose }).unwrap_err();
        assert!(matches!(lost, FitError::Lost { batch: 0 }), "{lost}");
        assert_eq!(lost.to_string(), "the kept models of batch 0 are gone or damaged; fitting again makes them anew");
        let (_, summary) = construct(&source(&map, &read), &settings(), &staging, &Unattended).unwrap();
        assert_eq!((summary.texels, summary.texels_of_this_run), again, "{token}");
        // Whole, but not as models are written now.
        staging.put_scratch("models2-000000", b"of another layout").unwrap();
        let (_, summary) = construct(&source(&map, &read), &settings(), &staging, &Unattended).unwrap();
        assert_eq!((summary.texels, summary.texels_of_this_run), again, "{token}");
    }
}

#[test]
fn an_observation_that_stands_alone_is_left_out_where_that_is_asked_for() {
    let (map, pages) = observations();
    // A glint at one view of the dull part's texels, 40 of each page's 64: a highlight of its own, or nothing.
    let glint = |page: &Arc<Page>| {
        let mut numbers = page.to_f32();
        for column in 0..40 {
            let entry = &mut numbers[4 * (64 * 30 + column)..][..4];
            if entry[3] > 0.0 {
                entry[..3].copy_from_slice(&[3.0; 3]);
            }
        }
        Arc::new(Page::from_f32(page.shape(), &numbers).unwrap())
    };
    let pages: Vec<Arc<Page>> = pages.iter().map(glint).collect();
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let fitted = |dataset: &str, outliers| {
        store.create_dataset(dataset).unwrap();
        let staging = store.stage(dataset, dataset).unwrap();
        let settings = ConstructSettings { outliers, noise_floor: Some(0.001), ..settings() };
        construct(&source(&map, &read), &settings, &staging, &Unattended).unwrap()
    };
    let ((kept, with), (rejected, without)) = (fitted("kept", Outliers::Keep), fitted("rejected", Outliers::Reject));
    assert_eq!((kept.outliers, rejected.outliers), (Outliers::Keep, Outliers::Reject));
    let dull = |summary: &FitSummary| summary.histogram.get("constant").copied().unwrap_or_default();
    let (texels, glints) = ((SIZE * SIZE) as u64, (SIZE * SIZE * 40 / 64) as u64);
    assert!(dull(&with) <= texels - glints, "{with:?}");
    assert!(dull(&without) >= texels - 1 && without.flags["outliers"] >= glints, "{without:?}");
    assert_eq!(with.flags["outliers"], 0);
}
