//! Chapter 16: a surface is photographed, every method is fitted to its texels, and what the fits show is compared with photographs, seen
//! flat: a picture's pixel is a texel. The thesis compares with photographs that the fit knew; here a second fit does not know them.
//!
//! The thesis' two surfaces are not to be had. `patchwork` (scenes) stands for the second, its patch of coated print for the first; both are
//! photographed by the path tracer, in directions of ours: the thesis names only their number.

use glam::Vec3;
use serde::Serialize;
use thiserror::Error;

use super::methods::{Method, MethodError, Samples};
use crate::capture::observation_map::{
    Coverage, Observation, ObservationMap, ObserveError, ObserveSettings, ObservedTexel, State, TEXELS_PER_PAGE, observed,
};
use crate::directions::Scheme;
use crate::fitting::{Model, Noise};
use crate::images::{Exposure, Rgb8, ToneMap};
use crate::progress::Progress;
use crate::representations::parameter_map::AllowedModels;
use crate::scenes::Scene;
use crate::textures::{Codec, PixelFormat};

/// A test of the thesis.
#[derive(Debug, Clone)]
pub struct SurfaceTest {
    /// Section of the thesis.
    pub section: &'static str,
    /// What stands for its surface.
    pub title: &'static str,
    /// What the thesis found, in words.
    pub thesis: &'static str,
    directions: &'static str,
    recording: Recording,
    /// Texels that count, as parts of the sheet: u and v from, to.
    part: [[f32; 2]; 2],
    /// Mean and standard deviation of the thesis' difference pictures, glossy and diffuse view.
    found: &'static [(Method, [[f64; 2]; 2])],
}

/// How the camera holds radiance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Recording {
    /// One exposure: 8 bits, cut at white.
    LowDynamicRange,
    /// All of it.
    HighDynamicRange,
}

/// Which photograph the fits are compared with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum View {
    /// The brightest.
    Glossy,
    /// The one nearest to its opposite, as high above the surface.
    Diffuse,
}

/// A photographed surface: what every texel was seen to look like.
pub struct PhotographedSurface {
    test: SurfaceTest,
    size: usize,
    /// Texels that count: their index in the map, and one sample per photograph.
    texels: Vec<(u32, Samples)>,
    /// Indices of the photographs: glossy, diffuse.
    views: [usize; 2],
    /// How each is shown.
    tones: [ToneMap; 2],
    /// Columns and rows of the texels that count: first, one past the last.
    bounds: [[usize; 2]; 2],
}

/// How one method did in one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhotographRow {
    /// Section of the thesis.
    pub section: &'static str,
    /// Which photograph.
    pub view: View,
    /// Whether the fit knew it.
    pub held_out: bool,
    /// How it was fitted.
    pub method: String,
    /// Numbers a texel, mean.
    pub floats: f64,
    /// Mean of the absolute difference of the 8-bit pictures' codes, all channels: the thesis' measure.
    pub mean: f64,
    /// Its standard deviation.
    pub deviation: f64,
    /// What the thesis has there, for fits that knew the photograph: mean, standard deviation.
    pub thesis: Option<[f64; 2]>,
}

/// Why there is no row.
#[derive(Debug, Error)]
pub enum PhotographError {
    /// No photographs.
    #[error(transparent)]
    Observe(#[from] ObserveError),
    /// No fit.
    #[error(transparent)]
    Method(#[from] MethodError),
}

const BOUNCES: u32 = 3;
/// What some ten paths an observation leave, about.
const HDR_NOISE: Noise = Noise { floor: 1e-3, relative: 0.01 };
const LDR_NOISE: Noise = Noise { floor: 1.0 / 255.0, relative: 0.0 };

/// Both.
pub fn surface_tests() -> Vec<SurfaceTest> {
    use Method::{OptimalProjection, PlainPhong, ZeroHemisphere};
    const FLYER: &[(Method, [[f64; 2]; 2])] = &[
        (PlainPhong, [[12.66, 20.57], [3.66, 12.71]]),
        (ZeroHemisphere(16), [[20.03, 35.87], [4.17, 12.97]]),
        (ZeroHemisphere(64), [[15.95, 30.61], [6.52, 13.50]]),
        (OptimalProjection(16), [[19.67, 35.23], [4.05, 12.74]]),
        (OptimalProjection(64), [[38.29, 36.79], [22.12, 31.50]]),
    ];
    const PATCHWORK: &[(Method, [[f64; 2]; 2])] = &[
        (PlainPhong, [[5.03, 17.92], [7.15, 24.31]]),
        (ZeroHemisphere(16), [[20.22, 38.15], [15.60, 32.16]]),
        (ZeroHemisphere(64), [[15.33, 23.84], [18.98, 31.73]]),
        (OptimalProjection(16), [[21.61, 36.15], [17.60, 32.87]]),
        (OptimalProjection(64), [[12.54, 21.15], [16.03, 32.90]]),
    ];
    vec![
        SurfaceTest {
            section: "16.2",
            title: "coated print, 278 photographs of one exposure",
            thesis: "The lobe is best; LSOP of 64 coefficients is noise.",
            directions: "latitude-longitude:1,10,19,28,36,42,46,48,48",
            recording: Recording::LowDynamicRange,
            // The patch in the middle of the lowest row, without its edges.
            part: [[0.36, 0.64], [0.04, 0.32]],
            found: FLYER,
        },
        SurfaceTest {
            section: "16.3",
            title: "nine materials, 90 photographs of high dynamic range",
            thesis: "The lobe is best, with stains where a highlight was seen once. Harmonics: too wide highlights (16), black beside them (64).",
            directions: "spiral:90:7",
            recording: Recording::HighDynamicRange,
            part: [[0.02, 0.98], [0.02, 0.98]],
            found: PATCHWORK,
        },
    ]
}

/// What both are fitted with: the thesis' methods, then ours.
pub fn surface_methods() -> Vec<Method> {
    let ours =
        [AllowedModels::Constant, AllowedModels::Phong(1), AllowedModels::Harmonics(16), AllowedModels::Harmonics(64), AllowedModels::Auto];
    let theirs = [
        Method::PlainPhong,
        Method::ZeroHemisphere(16),
        Method::ZeroHemisphere(64),
        Method::OptimalProjection(16),
        Method::OptimalProjection(64),
    ];
    theirs.into_iter().chain(ours.map(Method::Job)).collect()
}

/// Photographs the sheet of `scene` (`patchwork`), `size` texels across, by `paths` paths an observation.
pub fn photographed(
    test: &SurfaceTest,
    scene: &Scene,
    size: u32,
    paths: u32,
    progress: &dyn Progress,
) -> Result<PhotographedSurface, PhotographError> {
    let settings = ObserveSettings {
        object: "patchwork".into(),
        size_texels: size,
        directions: test.directions.parse::<Scheme>().expect("a scheme"),
        coverage: Coverage::Hemisphere,
        axis: Some(Vec3::Y),
        distance_radii: 3.0,
        samples_per_observation: paths,
        max_bounces: BOUNCES,
        seed: 1,
        pixel_format: PixelFormat::F32,
        codec: Codec::BitsChunk,
    };
    let [columns, rows] = test.part;
    let counts = |texel: &ObservedTexel| {
        let [u, v] = [texel.index % size, texel.index / size].map(|at| (at as f32 + 0.5) / size as f32);
        (columns[0]..columns[1]).contains(&u) && (rows[0]..rows[1]).contains(&v)
    };
    let (map, pages) = observed(scene, &settings, &counts, progress)?;
    let texels = texels(&map, &pages, test);
    let views = views(&texels);
    let tones = views.map(|view| tone(test.recording, &texels, view));
    let bounds = [|index: usize, size: usize| index % size, |index: usize, size: usize| index / size].map(|of| {
        let places = texels.iter().map(|(index, _)| of(*index as usize, size as usize));
        places.fold([usize::MAX, 0], |[first, end], at| [first.min(at), end.max(at + 1)])
    });
    Ok(PhotographedSurface { test: test.clone(), size: size as usize, texels, views, tones, bounds })
}

fn texels(map: &ObservationMap, pages: &[Vec<[f32; 4]>], test: &SurfaceTest) -> Vec<(u32, Samples)> {
    let of = |k: usize| {
        let (page, column) = (&pages[k / TEXELS_PER_PAGE], k % TEXELS_PER_PAGE);
        let sample = |(row, observer)| {
            let entry = Observation::from_texel(page[row * TEXELS_PER_PAGE + column]);
            (map.texels[k].direction_to(observer).to_array(), recorded(entry, test.recording))
        };
        (map.texels[k].index, map.observers.iter().enumerate().map(sample).collect())
    };
    (0..map.texels.len()).map(of).collect()
}

fn recorded(seen: Observation, recording: Recording) -> Observation {
    if recording == Recording::HighDynamicRange || seen.state == State::Missing {
        return seen;
    }
    let codes = seen.radiance.map(|v| (255.0 * v).round().clamp(0.0, 255.0));
    let clipped = codes.iter().enumerate().map(|(c, &code)| u8::from(code >= 255.0) << c).sum();
    Observation { radiance: codes.map(|code| code / 255.0), state: State::Seen { clipped } }
}

/// Of the photographs that show nearly all texels the one with the largest mean, and the one nearest to its opposite.
fn views(texels: &[(u32, Samples)]) -> [usize; 2] {
    let count = texels.first().map_or(0, |(_, samples)| samples.len());
    let mean = |view: usize| {
        let seen = texels.iter().map(|(_, samples)| samples[view].1).filter(|o| o.state != State::Missing);
        let seen: Vec<f32> = seen.map(|o| o.radiance.iter().sum()).collect();
        // Most of the sheet hidden: no picture to look at.
        if seen.len() * 10 < texels.len() * 9 { f32::NEG_INFINITY } else { seen.iter().sum::<f32>() / seen.len() as f32 }
    };
    let glossy = (0..count).max_by(|&a, &b| mean(a).total_cmp(&mean(b))).unwrap_or_default();
    let direction = |view: usize| texels.first().map_or(Vec3::Z, |(_, s)| Vec3::from(s[view].0));
    // The same height on the other side.
    let across = direction(glossy) * Vec3::new(-1.0, -1.0, 1.0);
    let diffuse = (0..count)
        .filter(|&view| mean(view) > f32::NEG_INFINITY)
        .max_by(|&a, &b| direction(a).dot(across).total_cmp(&direction(b).dot(across)));
    [glossy, diffuse.unwrap_or_default()]
}

/// One exposure is shown as it is; else the photograph's mean becomes middle grey, as the thesis gives each its γ.
fn tone(recording: Recording, texels: &[(u32, Samples)], view: usize) -> ToneMap {
    let seen = texels.iter().map(|(_, samples)| samples[view].1).filter(|o| o.state != State::Missing);
    let values: Vec<f32> = seen.flat_map(|o| o.radiance).collect();
    let mean = values.iter().sum::<f32>() / values.len().max(1) as f32;
    match recording {
        Recording::LowDynamicRange => ToneMap::PLAIN,
        // 1 − exp(−γ · mean) = ½
        Recording::HighDynamicRange => ToneMap::Exponential(Exposure::new(std::f32::consts::LN_2 / mean).unwrap_or(Exposure::ONE)),
    }
}

impl PhotographedSurface {
    /// Fits with and without the two photographs; the rows, and for each view the pictures photograph, fit that knew it, difference.
    pub fn compare(&self, method: Method) -> Result<(Vec<PhotographRow>, [[Rgb8; 3]; 2]), PhotographError> {
        let noise = match self.test.recording {
            Recording::LowDynamicRange => LDR_NOISE,
            Recording::HighDynamicRange => HDR_NOISE,
        };
        let all: Vec<Samples> = self.texels.iter().map(|(_, samples)| samples.clone()).collect();
        let mut fewer = all.clone();
        for samples in &mut fewer {
            self.views.iter().for_each(|&view| samples[view].1 = Observation::MISSING);
        }
        let (known, unknown) = (method.fit(&all, noise)?, method.fit(&fewer, noise)?);
        let of = |(held_out, models): (bool, &Vec<Option<Model>>)| {
            [View::Glossy, View::Diffuse].map(|view| self.row(method, view, held_out, models))
        };
        let rows = [(false, &known), (true, &unknown)].into_iter().flat_map(of).collect();
        Ok((rows, [View::Glossy, View::Diffuse].map(|view| self.pictures(view, &known))))
    }

    fn codes(&self, view: View, radiance: [f32; 3]) -> [u8; 3] {
        radiance.map(|v| (255.0 * self.tones[view as usize].encoded(v)).round() as u8)
    }

    /// Index, photograph and fit of the texels that the photograph shows.
    fn pairs<'a>(&'a self, view: View, models: &'a [Option<Model>]) -> impl Iterator<Item = (u32, [u8; 3], [u8; 3])> + 'a {
        let photograph = self.views[view as usize];
        self.texels.iter().zip(models).filter_map(move |((index, samples), model)| {
            let (direction, seen) = samples[photograph];
            let fitted = model.as_ref().filter(|_| seen.state != State::Missing)?.eval(direction);
            Some((*index, self.codes(view, seen.radiance), self.codes(view, fitted)))
        })
    }

    fn row(&self, method: Method, view: View, held_out: bool, models: &[Option<Model>]) -> PhotographRow {
        let differences: Vec<f64> =
            self.pairs(view, models).flat_map(|(_, a, b)| [0, 1, 2].map(|c| f64::from(a[c].abs_diff(b[c])))).collect();
        let count = differences.len().max(1) as f64;
        let mean = differences.iter().sum::<f64>() / count;
        let variance = differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / count;
        let fitted: Vec<usize> = models.iter().flatten().map(Model::floats).collect();
        let thesis = self.test.found.iter().find(|(known, _)| *known == method && !held_out).map(|(_, views)| views[view as usize]);
        PhotographRow {
            section: self.test.section,
            view,
            held_out,
            method: method.to_string(),
            floats: fitted.iter().sum::<usize>() as f64 / fitted.len().max(1) as f64,
            mean,
            deviation: variance.sqrt(),
            thesis,
        }
    }

    fn pictures(&self, view: View, models: &[Option<Model>]) -> [Rgb8; 3] {
        let [[left, right], [top, bottom]] = self.bounds;
        let (width, height) = (right - left, bottom - top);
        let mut pictures = [0; 3].map(|_| Rgb8::filled(width, height, [0; 3]));
        for (index, photograph, fit) in self.pairs(view, models) {
            let (column, row) = (index as usize % self.size, index as usize / self.size);
            let difference = [0, 1, 2].map(|c| photograph[c].abs_diff(fit[c]));
            // v = 0 is the picture's lower edge.
            let at = 3 * ((height - 1 - (row - top)) * width + column - left);
            for (picture, codes) in pictures.iter_mut().zip([photograph, fit, difference]) {
                picture.bytes[at..at + 3].copy_from_slice(&codes);
            }
        }
        pictures
    }
}
