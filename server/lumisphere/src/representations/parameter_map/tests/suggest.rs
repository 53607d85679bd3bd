//! Directions that are suggested for a fitted map: in the world's space, and only where the map asks for them.

use std::sync::Arc;

use glam::Vec3;

use super::construct::{observed_from, publication, settings, source};
use crate::capture::PartsError;
use crate::capture::observation_map::{Coverage, ObservationMap};
use crate::directions::Scheme;
use crate::progress::{Cancelled, Progress, Unattended};
use crate::representations::parameter_map::{
    MOST_SUGGESTIONS, Paged, ParameterMap, SuggestError, SuggestSettings, Suggestions, construct, from_parts, suggest_directions,
};
use crate::textures::{DatasetVersion, Page, PageId, Store, StoreError, StoreOptions};

fn scheme(name: &str) -> Scheme {
    name.parse().unwrap()
}

fn wanted(count: usize) -> SuggestSettings {
    SuggestSettings { count, candidates: scheme("icosahedron:305"), coverage: Coverage::Hemisphere, axis: None }
}

/// A sheet seen from one side alone, and what was fitted to that.
struct Seen {
    observed: (ObservationMap, Vec<Arc<Page>>),
    fitted: (ParameterMap, Arc<DatasetVersion>),
    _folder: tempfile::TempDir,
}

impl Seen {
    /// World x below `below`.
    fn from_x_below(below: f32) -> Self {
        let directions: Vec<Vec3> = scheme("icosahedron:289").directions().into_iter().filter(|d| d.x < below).collect();
        let (map, pages) = observed_from(&directions);
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        store.create_dataset("map").unwrap();
        let staging = store.stage("map", "token").unwrap();
        let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
        let (parameters, _) = construct(&source(&map, &read), &settings(), &staging, &Unattended).unwrap();
        let version = staging.publish(publication()).unwrap();
        let fitted = from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).unwrap())).unwrap();
        Self { observed: (map, pages), fitted: (fitted, version), _folder: folder }
    }

    fn suggest(&self, settings: &SuggestSettings, progress: &dyn Progress) -> Result<Suggestions, SuggestError> {
        let ((map, pages), (fitted, version)) = (&self.observed, &self.fitted);
        let observations = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
        let models = |page: PageId| version.read_page(page).map(Arc::new);
        suggest_directions(&Paged { map: fitted, read: &models }, &Paged { map, read: &observations }, settings, progress)
    }
}

#[test]
fn what_nobody_has_photographed_is_suggested_in_the_worlds_space() {
    let seen = Seen::from_x_below(0.2);
    let suggested = seen.suggest(&wanted(6), &Unattended).unwrap();
    assert_eq!((suggested.candidates, suggested.texels, suggested.directions.len()), (305, 256, 6));
    // The sheet lies about y = 0: its mean normal, and with it the scheme's zenith, is +Y within its bumps.
    assert!(Vec3::from(suggested.axis).dot(Vec3::Y) > 0.99, "{:?}", suggested.axis);
    for one in &suggested.directions {
        let [x, y, z] = one.direction;
        assert!(x > 0.2 && y > -0.1 && (x * x + y * y + z * z - 1.0).abs() < 1e-5 && one.gain_nats > 0.0, "{suggested:?}");
    }
    assert!(suggested.directions.is_sorted_by(|a, b| a.gain_nats >= b.gain_nats), "{suggested:?}");
    assert_eq!(seen.suggest(&wanted(6), &Unattended).unwrap(), suggested, "the same again");
    // From the other side of the sheet none of its texels is seen, so that no more than the upper ones come.
    let both = SuggestSettings { coverage: Coverage::Sphere, candidates: scheme("icosahedron:17"), ..wanted(MOST_SUGGESTIONS) };
    let both = seen.suggest(&both, &Unattended).unwrap();
    assert_eq!(both.candidates, 34);
    assert!((17..26).contains(&both.directions.len()) && both.directions.iter().all(|d| d.direction[1] > -0.3), "{both:?}");
}

#[test]
fn where_a_photograph_is_clipped_there_is_one() {
    let mut seen = Seen::from_x_below(0.2);
    // A channel of all that lies left of -0.2.
    let clipped: Vec<bool> = scheme("icosahedron:289").directions().into_iter().filter(|d| d.x < 0.2).map(|d| d.x < -0.2).collect();
    for page in &mut seen.observed.1 {
        let (shape, mut numbers) = (page.shape(), page.to_f32());
        for (row, texels) in numbers.chunks_exact_mut(4 * shape.width as usize).enumerate().filter(|(row, _)| clipped[*row]) {
            texels.chunks_exact_mut(4).filter(|texel| texel[3] == 1.0).for_each(|texel| texel[3] = 2.0);
            assert!(row < shape.height as usize);
        }
        *page = Arc::new(Page::from_f32(shape, &numbers).unwrap());
    }
    let suggested = seen.suggest(&wanted(6), &Unattended).unwrap();
    assert!(suggested.directions.iter().all(|one| one.direction[0] > 0.2), "{suggested:?}");
}

#[test]
fn what_can_suggest_nothing_is_named() {
    let mut seen = Seen::from_x_below(2.0);
    let refused = |seen: &Seen, settings: SuggestSettings| seen.suggest(&settings, &Unattended).unwrap_err().to_string();
    assert_eq!(refused(&seen, wanted(0)), "number of directions is 0, 1 to 64 expected");
    let many = SuggestSettings { candidates: scheme("stratified:4096:0"), ..wanted(1) };
    assert_eq!(refused(&seen, many), "number of candidates is 4096, 1 to 2600 expected");
    assert!(refused(&seen, SuggestSettings { axis: Some(Vec3::ZERO), ..wanted(1) }).starts_with("axis is [0, 0, 0]"));
    struct Stopped;
    impl Progress for Stopped {
        fn report(&self, _what: &str, _done: u64, _total: u64) {}
        fn is_cancelled(&self) -> bool {
            true
        }
    }
    assert!(matches!(seen.suggest(&wanted(1), &Stopped), Err(SuggestError::Cancelled(Cancelled))));
    seen.observed.1[0] =
        Arc::new(Page::from_f32(crate::textures::PageShape { height: 2, ..seen.observed.1[0].shape() }, &[0.0; 512]).unwrap());
    assert_eq!(refused(&seen, wanted(1)), "page 0 of the observations is 64x2, which its map does not announce");
    let surface = seen.observed.0.surface.clone();
    seen.observed.0.surface.mesh.positions[0].x += 0.1;
    assert_eq!(refused(&seen, wanted(1)), "the parameter map was fitted to sheet, other observations than these");
    seen.observed.0.surface = surface;
    seen.observed.0.parameters.seed = 7;
    assert_eq!(refused(&seen, wanted(1)), "the parameter map was fitted to sheet, other observations than these");
}
