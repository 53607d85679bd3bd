//! Ground truth on request: scenes that are ready for paths, and the threads that trace them. `frames` has it beside the renderer, on a thread
//! of its own with a queue of its own: whoever looks at what is stored never waits for a path. The paths go on threads of low priority, since
//! software adapters and the CPU renderer need the same processors.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::Context;
use lumisphere::evaluate::{TruthError, TruthPass, TruthPasses};
use lumisphere::progress::Progress;
use lumisphere::render::{Backend, Frame, FrameStats, Outputs, PageUse};
use lumisphere::textures::Store;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::catalog::OpenedVersion;
use crate::errors::{ApiError, Reason};
use crate::frames::FrameOrder;
use crate::scenes::{load_measured, scene_of};
use crate::wire::scenes::SceneSource;
use crate::wire::settings::{GroundTruth, RenderSettings};

/// Added to the threads' niceness: where frames want every processor, paths get about a tenth (Linux' weights 110 and 1024), not nothing.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Traces passes, one at a time.
pub struct Tracers {
    store: Store,
    /// Of all kept scenes together, and of each while it is made ready.
    budget_bytes: u64,
    /// Least recently used first.
    kept: VecDeque<Kept>,
    pool: ThreadPool,
}

struct Kept {
    source: SceneSource,
    bytes: u64,
    passes: TruthPasses,
}

/// Set when nobody waits for a pass any more; it ends between two tiles.
#[derive(Debug, Default)]
pub struct Abandoned(AtomicBool);

impl Abandoned {
    /// From now on.
    pub fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Progress for Abandoned {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Refuses the truth of what was made from no scene.
pub fn check_truth(settings: &RenderSettings, version: &OpenedVersion) -> Result<(), ApiError> {
    match settings.ground_truth {
        Some(_) => scene_of(version).map(drop),
        None => Ok(()),
    }
}

impl Tracers {
    /// Nothing kept yet; what will be takes at most `budget_bytes`.
    pub fn new(store: Store, budget_bytes: u64) -> anyhow::Result<Self> {
        let pool = ThreadPoolBuilder::new().thread_name(|i| format!("trace-pool-{i}")).start_handler(|_| stand_back());
        Ok(Self { store, budget_bytes, kept: VecDeque::new(), pool: pool.build().context("cannot start threads that trace")? })
    }

    /// One pass of what is ordered, unless it is abandoned first.
    pub fn trace(&mut self, order: &FrameOrder, truth: GroundTruth, pass: u32, abandoned: &Abandoned) -> Result<Frame, ApiError> {
        let begun = Instant::now();
        let source = scene_of(&order.version)?;
        let held = order.version.looks.of(&order.settings.settings)?;
        self.make_ready(source)?;
        let prepare_millis = millis_since(begun);
        let captured = order.version.representation.captured();
        let pass = TruthPass {
            object: captured.object,
            max_bounces: captured.max_bounces,
            original: captured.original,
            settings: &order.settings.settings,
            pass,
            paths_per_pixel: truth.paths_per_pixel,
            outputs: Outputs { depth: order.output.depth.is_some(), provenance: order.output.provenance },
            uploads: held.uploads(),
        };
        let kept = self.kept.back_mut().expect("the scene was made ready");
        let pixels = self.pool.install(|| kept.passes.trace(&pass, &order.camera, abandoned)).map_err(refused)?;
        let intrinsics = order.camera.intrinsics();
        let stats = FrameStats {
            backend: Backend::Cpu,
            fallback: None,
            page_use: PageUse::default(),
            pages_needed: 0,
            prepare_millis,
            total_millis: millis_since(begun),
            gpu: None,
            device_bytes: None,
        };
        Ok(Frame { width_px: intrinsics.width_px, height_px: intrinsics.height_px, pixels, stats })
    }

    /// The scene is the last one kept then. Those that leave for it leave when its size is known, before it is made ready.
    fn make_ready(&mut self, source: SceneSource) -> Result<(), ApiError> {
        if let Some(known) = self.kept.iter().position(|k| k.source == source).and_then(|at| self.kept.remove(at)) {
            self.kept.push_back(known);
            return Ok(());
        }
        let (scene, bytes) = load_measured(&source, &self.store, self.budget_bytes)?;
        while self.kept_bytes() + bytes > self.budget_bytes && self.kept.pop_front().is_some() {}
        let passes = self.pool.install(|| TruthPasses::new(&scene))?;
        self.kept.push_back(Kept { source, bytes, passes });
        Ok(())
    }

    fn kept_bytes(&self) -> u64 {
        self.kept.iter().map(|k| k.bytes).sum()
    }
}

fn refused(error: TruthError) -> ApiError {
    match error {
        TruthError::NoObject { .. } => ApiError::new(Reason::SceneInvalid, error.to_string()),
        TruthError::TooManyPaths { .. } => ApiError::field("settings.ground_truth.paths_per_pixel", error),
        TruthError::NoTable | TruthError::NoNormalMap => ApiError::internal(error),
        TruthError::Cancelled(cancelled) => cancelled.into(),
    }
}

/// The calling thread alone.
#[cfg(target_os = "linux")]
fn stand_back() {
    if let Err(error) = rustix::process::nice(NICENESS) {
        tracing::warn!(%error, "paths are traced with the same priority as frames are rendered");
    }
}

/// Elsewhere niceness is the process's.
#[cfg(not(target_os = "linux"))]
fn stand_back() {}

fn millis_since(begun: Instant) -> f64 {
    1e3 * begun.elapsed().as_secs_f64()
}

#[cfg(test)]
mod tests {
    use lumisphere::raytrace::working_bytes;
    use lumisphere::scenes::{BUILTIN_SCENE_PATH, BuiltinOptions, LoadOptions, builtin_files, load};
    use lumisphere::textures::StoreOptions;

    use super::*;
    use crate::wire::scenes::SceneBase;

    fn source(seed: u32) -> SceneSource {
        let options = BuiltinOptions { seed, ..BuiltinOptions::small() };
        SceneSource { base: SceneBase::Builtin { name: "six_colours".into(), options }, environment: None }
    }

    #[test]
    fn scenes_are_kept_as_long_as_all_fit_and_the_one_used_longest_ago_leaves() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        let files = builtin_files("six_colours", &BuiltinOptions::small()).unwrap();
        let bytes = working_bytes(&load(&files, BUILTIN_SCENE_PATH, &LoadOptions::as_written()).unwrap());
        // Two of the same size, and not three.
        let mut tracers = Tracers::new(store.clone(), 2 * bytes + bytes / 2).unwrap();
        let mut kept_after = |seed| {
            tracers.make_ready(source(seed)).unwrap();
            let seed_of = |k: &Kept| match &k.source.base {
                SceneBase::Builtin { options, .. } => options.seed,
                SceneBase::Bundle { .. } => unreachable!("built in"),
            };
            assert!(tracers.kept_bytes() <= tracers.budget_bytes);
            tracers.kept.iter().map(seed_of).collect::<Vec<_>>()
        };
        assert_eq!(kept_after(1), [1]);
        assert_eq!(kept_after(2), [1, 2]);
        assert_eq!(kept_after(1), [2, 1]);
        assert_eq!(kept_after(3), [1, 3]);
        let error = Tracers::new(store, bytes - 1).unwrap().make_ready(source(1)).unwrap_err();
        assert_eq!(error.reason(), Reason::SceneTooLarge);
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn paths_stand_back_and_the_thread_that_asks_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        let tracers = Tracers::new(store, 0).unwrap();
        let niceness = || rustix::process::getpriority_process(None).unwrap();
        let before = niceness();
        assert_eq!(tracers.pool.install(niceness), (before + NICENESS).min(19));
        assert_eq!(niceness(), before);
    }
}
