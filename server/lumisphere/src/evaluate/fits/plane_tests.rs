//! Chapters 11 to 13: the plane under one, two and many lights, from many and few directions, ever shinier.

use glam::Vec3;
use serde::Serialize;

use super::methods::{Method, MethodError, Samples};
use super::plane::{Gloss, LIGHT, PointLight, SIDE, lit, texels};
use crate::capture::observation_map::{Observation, State};
use crate::directions::Scheme;
use crate::fitting::{Lobe, Model, Noise};
use crate::geometry::TangentFrame;
use crate::representations::parameter_map::AllowedModels;

/// A test of the thesis.
#[derive(Debug, Clone)]
pub struct PlaneTest {
    /// Section of the thesis.
    pub section: &'static str,
    /// What is tried.
    pub title: &'static str,
    /// What the thesis found, in words.
    pub thesis: &'static str,
    cases: Vec<Case>,
    methods: Vec<Method>,
}

#[derive(Debug, Clone)]
struct Case {
    name: String,
    lights: Vec<PointLight>,
    gloss: Gloss,
    directions: Vec<Vec3>,
    /// Mean residuals in % that the thesis gives for a method here.
    thesis: Vec<(Method, [f64; 3])>,
}

/// How one method did in one case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlaneRow {
    /// Section of the thesis.
    pub section: &'static str,
    /// Which lights, gloss or directions.
    pub case: String,
    /// How it was fitted.
    pub method: String,
    /// Directions that were sampled.
    pub directions: usize,
    /// Numbers a texel, mean.
    pub floats: f64,
    /// Mean of |fit − sample|/sample at the sampled directions of texel (8, 8), %, per channel: the thesis' "mean percentage residual", whose
    /// denominator it does not name.
    pub residual_percent: [f64; 3],
    /// What the thesis has there.
    pub thesis_percent: Option<[f64; 3]>,
    /// Root mean squared error against the truth over 1249 directions, all texels and channels; values above 1, which no picture shows, count as 1.
    pub rmse: f64,
    /// The same over directions lower than 15° above the plane.
    pub rmse_low: f64,
    /// Value of the fit at the middle of the strongest highlight over the truth's, mean of the texels, red excluded (it is mostly diffuse).
    pub peak: f64,
    /// Mean exponent of the strongest lobe; None for models without.
    pub exponent: Option<f64>,
    /// How far the parameters are from those of the case with the most directions.
    pub drift: Option<Drift>,
}

/// Differences between the parameters of two one-lobe models, means over texels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Drift {
    /// Of the constant's red channel, %.
    pub diffuse_percent: f64,
    /// Of the axis: its chord, % of the radius.
    pub axis_percent: f64,
    /// Of the lobe's amplitude, %.
    pub specular_percent: f64,
    /// Of the exponent, %.
    pub exponent_percent: f64,
}

/// Green radiance of texel (8, 8) in the plane of normal and mirror direction.
#[derive(Debug, Clone, PartialEq)]
pub struct Slice {
    /// Of which case.
    pub case: String,
    /// Name, and (degrees from the normal toward the mirror direction, radiance): the truth first.
    pub lines: Vec<(String, Vec<(f64, f64)>)>,
}

/// 8-bit pictures, as the thesis': half a step. Where radiance hardly changes, neighbours are rounded alike, so that the usual step/√12 of
/// independent errors is too little.
const NOISE: Noise = Noise { floor: 0.5 / 255.0, relative: 0.0 };
const WHITE: PointLight = PointLight { place: LIGHT, strength: 1.0 };
/// The texel that the thesis plots.
const PLOTTED: usize = 8 * SIDE + 8;
/// Directions that errors are taken over.
const DENSE: usize = 1249;

fn icosahedron(count: usize) -> Vec<Vec3> {
    Scheme::icosahedron(count).expect("a count of the icosahedron").directions()
}

/// So many within `half_angle` of an axis, each for the same solid angle: a spiral's heights moved up.
pub(super) fn cone(axis: Vec3, half_angle: f32, count: usize) -> Vec<Vec3> {
    let (frame, depth) = (TangentFrame::around(axis), 1.0 - half_angle.cos());
    let raised = |d: Vec3| {
        let height = 1.0 - depth * (1.0 - d.z);
        frame.world_from_local((d.truncate().normalize_or_zero() * (1.0 - height * height).sqrt()).extend(height))
    };
    Scheme::spiral(count, 5.0).expect("a spiral").directions().into_iter().map(raised).collect()
}

fn auto() -> Method {
    Method::Job(AllowedModels::Auto)
}

fn ours(count: u32) -> Method {
    Method::Job(AllowedModels::Harmonics(count))
}

impl Case {
    fn new(name: impl Into<String>, lights: Vec<PointLight>) -> Self {
        Self { name: name.into(), lights, gloss: Gloss::USUAL, directions: icosahedron(289), thesis: Vec::new() }
    }

    fn seen_from(mut self, directions: Vec<Vec3>) -> Self {
        self.directions = directions;
        self
    }

    fn found(mut self, method: Method, percent: [f64; 3]) -> Self {
        self.thesis.push((method, percent));
        self
    }
}

/// All of them, in the thesis' order.
pub fn plane_tests() -> Vec<PlaneTest> {
    vec![point_and_area(), two_lights(), harmonics(), shininess(), directions(), around_the_highlight()]
}

fn point_and_area() -> PlaneTest {
    // Eight more lights about the first, in its height; how far the thesis does not say.
    let around = |k: i16| {
        let turn = f32::from(k) * std::f32::consts::FRAC_PI_4;
        PointLight { place: LIGHT + 400.0 * Vec3::new(turn.cos(), turn.sin(), 0.0), strength: 1.0 / 9.0 }
    };
    let area = (0..8).map(around).chain([PointLight { place: LIGHT, strength: 1.0 / 9.0 }]).collect();
    PlaneTest {
        section: "11.3.1",
        title: "point light and area light",
        thesis: "One lobe fits a point light well; under an area light the error is about the highlight, and the exponent is lower.",
        cases: vec![
            Case::new("point light", vec![WHITE]).found(Method::PlainPhong, [0.94, 2.34, 2.34]),
            Case::new("area light", area).found(Method::PlainPhong, [0.69, 4.30, 4.30]),
        ],
        methods: vec![Method::PlainPhong, auto()],
    }
}

fn two_lights() -> PlaneTest {
    let case = |at: f32, percent: [f64; 3]| {
        // "A slightly lower intensity": how low the thesis does not say. Red is clipped about the stronger highlight.
        let lights = vec![WHITE, PointLight { place: Vec3::new(at, at, 2000.0), strength: 0.9 }];
        Case::new(format!("second light at {at}"), lights).found(Method::PlainPhong, percent)
    };
    PlaneTest {
        section: "11.3.2",
        title: "more lights than lobes",
        thesis: "One lobe merges two highlights that are close, and keeps the stronger of two that are not.",
        cases: vec![case(450.0, [0.0, 9.89, 9.89]), case(-450.0, [0.0, 20.58, 20.58]), case(-1500.0, [0.0, 22.07, 22.07])],
        methods: vec![Method::PlainPhong, auto()],
    }
}

fn harmonics() -> PlaneTest {
    // "A little more intense", and "more weak": ours, as in `fitting::harmonics`' tests.
    let lights = vec![PointLight { strength: 1.25, ..WHITE }, PointLight { place: Vec3::new(-1500.0, -1500.0, 2000.0), strength: 0.5 }];
    let case = Case::new("strong and weak light", lights)
        .found(Method::OptimalProjection(100), [11.61, 16.03, 16.03])
        .found(Method::ZeroHemisphere(100), [7.67, 16.72, 16.72]);
    let counts = [16, 25, 49, 64, 81, 100];
    let of = |method: fn(usize) -> Method| counts.map(method);
    PlaneTest {
        section: "12.5.1",
        title: "number of harmonics, ZH and LSOP",
        thesis: "LSOP shows the weak highlight from 25 coefficients on, ZH from 64; both fail near the horizon, LSOP rings from 49 on.",
        cases: vec![case],
        methods: [of(Method::ZeroHemisphere), of(Method::OptimalProjection), of(|count| ours(count as u32))].concat(),
    }
}

fn shininess() -> PlaneTest {
    let case = |exponent: f32| {
        let gloss = Gloss { exponent, ..Gloss::USUAL };
        Case { gloss, ..Case::new(format!("m = {exponent}"), vec![WHITE]).seen_from(icosahedron(305)) }
    };
    PlaneTest {
        section: "13.1",
        title: "increasing shininess",
        thesis: "36 coefficients of LSOP hold to m of about 15, the lobe through all bands.",
        cases: [2.0, 5.0, 10.0, 15.0, 25.0, 50.0, 100.0, 300.0].map(case).to_vec(),
        methods: vec![Method::PlainPhong, Method::OptimalProjection(16), Method::OptimalProjection(36), ours(16), ours(36), auto()],
    }
}

fn directions() -> PlaneTest {
    PlaneTest {
        section: "13.2",
        title: "number of directions",
        thesis: "From 17 to 305 directions diffuse part and direction of the lobe change by less than 1 %, its amplitude by about 15 %, its \
                 exponent by about 5 %; LSOP needs some 300.",
        cases: [17, 73, 305].map(|n| Case::new(format!("{n} directions"), vec![WHITE]).seen_from(icosahedron(n))).to_vec(),
        methods: vec![Method::PlainPhong, auto(), Method::OptimalProjection(36), ours(36)],
    }
}

fn around_the_highlight() -> PlaneTest {
    let mirror = Vec3::new(-LIGHT.x, -LIGHT.y, LIGHT.z).normalize();
    let denser = [icosahedron(73), cone(mirror, 25_f32.to_radians(), 81)].concat();
    PlaneTest {
        section: "13.3",
        title: "directions around the highlight",
        thesis: "For the lobe no difference; with LSOP the highlight is better and the diffuse part worse.",
        cases: vec![
            Case::new("305 directions", vec![WHITE]).seen_from(icosahedron(305)),
            Case::new("73 directions and 81 around the highlight", vec![WHITE]).seen_from(denser),
        ],
        methods: vec![Method::PlainPhong, auto(), Method::OptimalProjection(36), ours(36)],
    }
}

/// Fits every case with every method.
pub fn plane_test(test: &PlaneTest) -> Result<(Vec<PlaneRow>, Vec<Slice>), MethodError> {
    let most = test.cases.iter().map(|case| case.directions.len()).max().unwrap_or_default();
    let (mut rows, mut slices) = (Vec::new(), Vec::new());
    let mut references: Vec<(Method, Vec<Option<Model>>)> = Vec::new();
    // The case with the most directions first: the others drift from it.
    let mut order: Vec<usize> = (0..test.cases.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(test.cases[i].directions.len()));
    for &index in &order {
        let case = &test.cases[index];
        let truth: Vec<Model> = texels().map(|texel| lit(texel, &case.lights, case.gloss)).collect();
        let samples: Vec<Samples> = truth.iter().map(|model| sampled(model, &case.directions)).collect();
        let mut slice = Slice { case: case.name.clone(), lines: vec![("truth".into(), sliced(&truth[PLOTTED], &truth[PLOTTED]))] };
        for &method in &test.methods {
            let models = method.fit(&samples, NOISE)?;
            let reference = references.iter().find(|(known, _)| *known == method).map(|(_, models)| models);
            let drift = reference.filter(|_| case.directions.len() < most).and_then(|reference| drift(&models, reference));
            rows.push((index, row(test, case, method, &truth, &samples, &models, drift)));
            if let Some(model) = &models[PLOTTED] {
                slice.lines.push((method.to_string(), sliced(model, &truth[PLOTTED])));
            }
            if case.directions.len() == most && reference.is_none() {
                references.push((method, models));
            }
        }
        slices.push((index, slice));
    }
    rows.sort_by_key(|(index, _)| *index);
    slices.sort_by_key(|(index, _)| *index);
    Ok((rows.into_iter().map(|(_, row)| row).collect(), slices.into_iter().map(|(_, slice)| slice).collect()))
}

/// As 8-bit pictures hold it.
fn sampled(model: &Model, directions: &[Vec3]) -> Samples {
    let one = |d: &Vec3| {
        let codes = model.eval(d.to_array()).map(|v| (255.0 * v).round().clamp(0.0, 255.0));
        let clipped = codes.iter().enumerate().map(|(c, &code)| u8::from(code >= 255.0) << c).sum();
        (d.to_array(), Observation { radiance: codes.map(|code| code / 255.0), state: State::Seen { clipped } })
    };
    directions.iter().map(one).collect()
}

fn strongest(model: &Model) -> Option<&Lobe> {
    let Model::Lobes { lobes, .. } = model else { return None };
    lobes.iter().max_by(|a, b| a.amplitude[1].total_cmp(&b.amplitude[1]))
}

fn row(
    test: &PlaneTest,
    case: &Case,
    method: Method,
    truth: &[Model],
    samples: &[Samples],
    models: &[Option<Model>],
    drift: Option<Drift>,
) -> PlaneRow {
    let fitted: Vec<(&Model, &Model)> = models.iter().zip(truth).filter_map(|(model, truth)| Some((model.as_ref()?, truth))).collect();
    let count = fitted.len().max(1) as f64;
    let dense = icosahedron(DENSE);
    // sin 15°
    let low: Vec<Vec3> = dense.iter().copied().filter(|d| d.z < 0.258_819).collect();
    let peak = |(model, truth): &(&Model, &Model)| {
        let axis = strongest(truth).map_or([0.0, 0.0, 1.0], |lobe| lobe.axis);
        f64::from(model.eval(axis)[1]) / f64::from(truth.eval(axis)[1])
    };
    let exponents: Vec<f64> = fitted.iter().filter_map(|(model, _)| Some(f64::from(strongest(model)?.exponent))).collect();
    PlaneRow {
        section: test.section,
        case: case.name.clone(),
        method: method.to_string(),
        directions: case.directions.len(),
        floats: fitted.iter().map(|(model, _)| model.floats() as f64).sum::<f64>() / count,
        residual_percent: models[PLOTTED].as_ref().map_or([f64::NAN; 3], |model| residual_percent(model, &samples[PLOTTED])),
        thesis_percent: case.thesis.iter().find(|(known, _)| *known == method).map(|(_, percent)| *percent),
        rmse: rmse(&fitted, &dense),
        rmse_low: rmse(&fitted, &low),
        peak: fitted.iter().map(peak).sum::<f64>() / count,
        exponent: (!exponents.is_empty()).then(|| exponents.iter().sum::<f64>() / exponents.len() as f64),
        drift,
    }
}

pub(super) fn residual_percent(model: &Model, samples: &Samples) -> [f64; 3] {
    let of = |c: usize| {
        let values = samples.iter().filter(|(_, o)| o.radiance[c] > 0.0);
        let (sum, count) = values.fold((0.0, 0u32), |(sum, count), (d, o)| {
            let value = f64::from(o.radiance[c]);
            (sum + (f64::from(model.eval(*d)[c]) - value).abs() / value, count + 1)
        });
        100.0 * sum / f64::from(count.max(1))
    };
    [of(0), of(1), of(2)]
}

fn rmse(fitted: &[(&Model, &Model)], directions: &[Vec3]) -> f64 {
    let of = |(model, truth): &(&Model, &Model)| {
        let squares = directions.iter().map(|d| {
            let (a, b) = (model.eval(d.to_array()), truth.eval(d.to_array()));
            (0..3).map(|c| f64::from(a[c].min(1.0) - b[c].min(1.0)).powi(2)).sum::<f64>()
        });
        squares.sum::<f64>()
    };
    (fitted.iter().map(of).sum::<f64>() / (3 * directions.len() * fitted.len()).max(1) as f64).sqrt()
}

/// None where either is no model of one lobe.
fn drift(models: &[Option<Model>], reference: &[Option<Model>]) -> Option<Drift> {
    let pair = |(a, b): (&Option<Model>, &Option<Model>)| match (a, b) {
        (Some(Model::Lobes { constant: k, lobes: a }), Some(Model::Lobes { constant: l, lobes: b })) if a.len() == 1 && b.len() == 1 => {
            let percent = |a: f32, b: f32| 100.0 * f64::from((a - b).abs() / b);
            let chord = Vec3::from(a[0].axis).distance(Vec3::from(b[0].axis));
            let exponent = percent(a[0].exponent, b[0].exponent);
            Some([percent(k[0], l[0]), 100.0 * f64::from(chord), percent(a[0].amplitude[1], b[0].amplitude[1]), exponent])
        }
        _ => None,
    };
    let pairs: Vec<[f64; 4]> = models.iter().zip(reference).filter_map(pair).collect();
    let mean = |k: usize| pairs.iter().map(|p| p[k]).sum::<f64>() / pairs.len() as f64;
    // Means over a few odd texels would say nothing.
    (pairs.len() * 2 > models.len()).then(|| Drift {
        diffuse_percent: mean(0),
        axis_percent: mean(1),
        specular_percent: mean(2),
        exponent_percent: mean(3),
    })
}

/// Degrees from −89 to 89 in the plane of the normal and the strongest lobe of `truth`.
fn sliced(model: &Model, truth: &Model) -> Vec<(f64, f64)> {
    let axis = strongest(truth).map_or(Vec3::X, |lobe| Vec3::from(lobe.axis));
    let toward = Vec3::new(axis.x, axis.y, 0.0).normalize_or(Vec3::X);
    let at = |degrees: i16| {
        let angle = f32::from(degrees).to_radians();
        let direction = (angle.sin() * toward + angle.cos() * Vec3::Z).to_array();
        (f64::from(degrees), f64::from(model.eval(direction)[1]))
    };
    (-89..=89).map(at).collect()
}
