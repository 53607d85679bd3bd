//! Maps whose single lobes a graphics device fits: stored like the processor's, stopped and gone on with, and not at all where the device
//! fails.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::construct::{CancelAt, everything_of, observations, publication, settings, source};
use crate::fitting::LobeKernel;
use crate::gpu::{Gpu, test_gpu};
use crate::progress::{Progress, Unattended};
use crate::representations::parameter_map::{ConstructSettings, FitError, FitSource, FitSummary, FollowFit, PartialMap, Solver, construct};
use crate::textures::{PageId, Store, StoreError, StoreOptions};

fn device(gpu: Arc<Gpu>) -> Solver {
    Solver::Device(Arc::new(LobeKernel::new(gpu).unwrap()))
}

/// Loses the device after so many batches.
struct LoseAfter(Arc<Gpu>, usize, AtomicUsize);

impl Progress for LoseAfter {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        false
    }
}

impl FollowFit for LoseAfter {
    fn fitted(&self, _so_far: &FitSummary) {
        if self.2.fetch_add(1, Ordering::SeqCst) + 1 == self.1 {
            self.0.lose();
        }
    }
    fn offer(&self, _partial: &PartialMap<'_>) -> Result<(), FitError> {
        Ok(())
    }
}

type Stored = (Vec<Vec<f32>>, Vec<u8>);

/// Fits into a dataset by one solver after the other; what each attempt but the last ended with is given to `ended`.
fn fitted(
    store: &Store,
    dataset: &str,
    settings: &ConstructSettings,
    attempts: &[(Solver, &dyn FollowFit)],
    ended: impl Fn(FitError),
) -> (Stored, FitSummary) {
    let (map, pages) = observations();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    store.create_dataset(dataset).unwrap();
    let (last, before) = attempts.split_last().unwrap();
    let with = |solver: &Solver| FitSource { solver: solver.clone(), ..source(&map, &read) };
    for (solver, follow) in before {
        let staging = store.stage(dataset, "token").unwrap();
        ended(construct(&with(solver), settings, &staging, *follow).unwrap_err());
        assert_eq!(store.versions(dataset).unwrap(), Vec::<u64>::new());
    }
    let staging = store.stage(dataset, "token").unwrap();
    let (_, summary) = construct(&with(&last.0), settings, &staging, last.1).unwrap();
    (everything_of(&staging.publish(publication()).unwrap()), summary)
}

fn store() -> (tempfile::TempDir, Store) {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    (folder, store)
}

#[test]
fn a_map_from_the_device_has_the_processors_models() {
    let Some(gpu) = test_gpu() else { return };
    let (_folder, store) = store();
    // With a bound, the smaller models are fitted, too.
    for (name, settings) in [("auto", settings()), ("bounded", ConstructSettings { max_bytes: Some(1 << 30), ..settings() })] {
        let maps = [("cpu", Solver::Processor), ("gpu", device(gpu.clone()))].map(|(on, solver)| {
            let attempts: [(_, &dyn FollowFit); 1] = [(solver, &Unattended)];
            fitted(&store, &format!("{name}-{on}"), &settings, &attempts, |error| panic!("{error}"))
        });
        let [((a, texels), told), ((b, expected_texels), expected)] = &maps;
        assert!(texels == expected_texels, "{name}: which model and which flags each texel has");
        assert_eq!((&told.histogram, &told.flags), (&expected.histogram, &expected.flags), "{name}");
        let far = a.concat().iter().zip(b.concat()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // Exact samples: exponents of 12 to a part in a thousand, everything else is below 1.
        assert!(far <= 0.012, "{name}: {far}");
    }
}

#[test]
fn a_fit_on_the_device_that_is_stopped_goes_on_to_the_same_bytes() {
    let Some(gpu) = test_gpu() else { return };
    let (_folder, store) = store();
    let whole = fitted(&store, "whole", &settings(), &[(device(gpu.clone()), &Unattended)], |error| panic!("{error}"));
    for (i, at) in [0, 1].into_iter().enumerate() {
        let stop = CancelAt(at, AtomicUsize::new(0));
        let attempts: [(_, &dyn FollowFit); 2] = [(device(gpu.clone()), &stop), (device(gpu.clone()), &Unattended)];
        let stopped = |error: FitError| assert!(matches!(error, FitError::Cancelled(_)), "{error}");
        let resumed = fitted(&store, &format!("resumed-{i}"), &settings(), &attempts, stopped);
        assert!(resumed.0 == whole.0, "stopped at question {at}");
    }
}

#[test]
fn a_device_that_fails_leaves_nothing_behind_but_what_was_sound() {
    let Some(gpu) = test_gpu() else { return };
    let (_folder, store) = store();
    let failed = |error: FitError| assert!(matches!(error, FitError::Device(_)), "{error}");
    let settings = ConstructSettings { models: "phong:1".parse().unwrap(), ..settings() };
    let whole = fitted(&store, "whole", &settings, &[(device(gpu.clone()), &Unattended)], failed);

    // Numbers that are none are not kept: what goes on with the staging area fits all.
    let source = crate::fitting::LOBE_KERNEL_SOURCE.replace("here.cost, here.amplitude,", "-1.0, here.amplitude,").leak();
    let wrong = Solver::Device(Arc::new(LobeKernel::with_source(gpu.clone(), source).unwrap()));
    let attempts: [(_, &dyn FollowFit); 2] = [(wrong, &Unattended), (device(gpu.clone()), &Unattended)];
    let (stored, told) = fitted(&store, "wrong", &settings, &attempts, failed);
    assert!(stored == whole.0);
    assert_eq!(told.texels_of_this_run, told.texels);

    // Lost behind the first of two batches, which is kept.
    let short_lived = test_gpu().unwrap();
    let lose = LoseAfter(short_lived.clone(), 1, AtomicUsize::new(0));
    let attempts: [(_, &dyn FollowFit); 2] = [(device(short_lived), &lose), (device(gpu), &Unattended)];
    let (stored, told) = fitted(&store, "lost", &settings, &attempts, failed);
    assert!(stored == whole.0);
    assert!(0 < told.texels_of_this_run && told.texels_of_this_run < told.texels, "{told:?}");
}
