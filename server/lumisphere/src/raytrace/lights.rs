//! Everything that emits, and the choice of one of them at a surface point (next-event estimation).

use std::f32::consts::PI;

use glam::{Vec2, Vec3};

use super::distribution::{Choice, Discrete};
use super::sky::{Sky, luminance};
use super::sky_cells::NormalBin;
use super::surfaces::{SurfaceTriangle, offset_along};
use super::warp;
use crate::scenes::{Environment, PointLight, Scene};

/// All emitters of a scene.
#[derive(Debug, Clone)]
pub(super) struct Lights {
    pub sky: Sky,
    /// Emitted radiance per object; zero for most.
    emission: Vec<Vec3>,
    points: Vec<PointLight>,
    /// Emitting triangles and the choice among them, by power.
    area: Option<(Vec<u32>, Discrete)>,
    /// Σ luminance · area over the emitting triangles.
    area_power: f32,
    point_choice: Option<Discrete>,
    /// Among sky, area lights, point lights.
    kind: Option<Discrete>,
}

/// Light arriving at a point from one sampled emitter, before asking whether anything is in the way.
#[derive(Debug, Clone, Copy)]
pub(super) struct LightSample {
    /// Unit, from the receiver.
    pub direction: Vec3,
    /// Radiance (or radiant intensity / distance²) over the density with which it was drawn.
    pub radiance_over_pdf: Vec3,
    /// Per steradian at the receiver; None for a point light, which no reflected ray can hit.
    pub pdf: Option<f32>,
    /// Where the shadow ray ends: a point just off the emitter, or None for infinity.
    pub end: Option<Vec3>,
}

// No kind of light is chosen less often than this: power says little about what is close.
const SMALLEST_SHARE: f64 = 0.1;

impl Lights {
    /// `radius`: of a sphere around the geometry, which says how much of the sky's light the scene receives.
    pub fn new(scene: &Scene, triangles: &[SurfaceTriangle], radius: f32) -> Self {
        let emission = scene.objects.iter().map(|o| o.emission.unwrap_or(Vec3::ZERO).max(Vec3::ZERO)).collect();
        Self::gather(Sky::new(&scene.environment), emission, scene.point_lights.clone(), triangles, radius)
    }

    /// The same lights where only these triangles are left.
    pub fn for_triangles(&self, triangles: &[SurfaceTriangle], radius: f32) -> Self {
        Self::gather(self.sky.clone(), self.emission.clone(), self.points.clone(), triangles, radius)
    }

    /// The same lights with another environment, and point lights more.
    pub fn relit(&self, environment: &Environment, added: &[PointLight], triangles: &[SurfaceTriangle], radius: f32) -> Self {
        let points = self.points.iter().chain(added).copied().collect();
        Self::gather(Sky::new(environment), self.emission.clone(), points, triangles, radius)
    }

    fn gather(sky: Sky, emission: Vec<Vec3>, points: Vec<PointLight>, triangles: &[SurfaceTriangle], radius: f32) -> Self {
        let emitting = (0..triangles.len() as u32).filter(|t| emission[triangles[*t as usize].object as usize] != Vec3::ZERO);
        let emitting: Vec<u32> = emitting.collect();
        let power = |t: &u32| {
            let triangle = &triangles[*t as usize];
            f64::from(luminance(emission[triangle.object as usize]) * triangle.area())
        };
        let weights: Vec<f64> = emitting.iter().map(power).collect();
        let area_power = weights.iter().sum::<f64>() as f32;
        let intensities: Vec<f64> = points.iter().map(|p| f64::from(luminance(p.intensity).max(0.0))).collect();
        let sky_power = match &sky {
            Sky::Constant(_) => 0.0,
            Sky::Map(map) => map.power * PI * radius * radius,
        };
        let powers = [f64::from(sky_power), f64::from(area_power * PI), 4.0 * std::f64::consts::PI * intensities.iter().sum::<f64>()];
        Self {
            sky,
            emission,
            points,
            area: Discrete::new(&weights).map(|choice| (emitting, choice)),
            area_power,
            point_choice: Discrete::new(&intensities),
            kind: Discrete::new(&shares(powers)),
        }
    }

    /// Whether `sample` ever gives anything.
    pub fn can_be_sampled(&self) -> bool {
        self.kind.is_some()
    }

    /// Whether a reflected ray can meet an emitting triangle.
    pub fn has_area_lights(&self) -> bool {
        self.area.is_some()
    }

    /// Radiance that the triangle emits toward `wo` (front side only) and the density, per steradian at the other end of a ray of
    /// length `distance`, with which `sample` draws that point.
    pub fn emitted(&self, triangle: &SurfaceTriangle, wo: Vec3, distance: f32) -> (Vec3, f32) {
        let radiance = self.emission[triangle.object as usize];
        let cosine = wo.dot(triangle.front);
        if radiance == Vec3::ZERO || !(cosine > 0.0) {
            return (Vec3::ZERO, 0.0);
        }
        // Chosen by luminance · area, then uniform in the area: the area cancels.
        let per_area = self.kind.as_ref().map_or(0.0, |k| k.probability(AREA)) * luminance(radiance) / self.area_power;
        (radiance, per_area * distance * distance / cosine)
    }

    /// Whether a sky is all that `sample` draws from: then it draws well enough for a Lambertian surface to need nothing else.
    pub fn only_sky(&self) -> bool {
        let sky = matches!(&self.sky, Sky::Map(map) if map.can_be_sampled());
        sky && self.area.is_none() && self.point_choice.is_none()
    }

    /// Radiance from infinity and the density with which `sample` draws that direction for a normal in `bin`.
    pub fn sky_radiance(&self, direction: Vec3, bin: NormalBin) -> (Vec3, f32) {
        let (radiance, pdf) = self.sky.eval(direction, bin);
        (radiance, pdf * self.kind.as_ref().map_or(0.0, |k| k.probability(SKY)))
    }

    /// One emitter, chosen by power, seen from `from` by a surface with a normal in `bin`. `choice` ∈ [0, 1) picks it, `u` the place on it.
    pub fn sample(&self, triangles: &[SurfaceTriangle], from: Vec3, bin: NormalBin, choice: f32, u: Vec2) -> Option<LightSample> {
        let Choice { index: kind, probability: share, rest: choice } = self.kind.as_ref()?.choose(choice);
        match kind {
            SKY => self.sample_sky(share, bin, u),
            AREA => self.sample_area(triangles, share, from, choice, u),
            _ => self.sample_point(share, from, choice),
        }
    }

    fn sample_sky(&self, share: f32, bin: NormalBin, u: Vec2) -> Option<LightSample> {
        let Sky::Map(map) = &self.sky else { return None };
        let sample = map.sample(u, bin)?;
        let pdf = share * sample.pdf;
        Some(LightSample { direction: sample.direction, radiance_over_pdf: sample.radiance / pdf, pdf: Some(pdf), end: None })
    }

    fn sample_area(&self, triangles: &[SurfaceTriangle], share: f32, from: Vec3, choice: f32, u: Vec2) -> Option<LightSample> {
        let (emitting, by_power) = self.area.as_ref()?;
        let Choice { index, probability, .. } = by_power.choose(choice);
        let triangle = &triangles[emitting[index] as usize];
        let weights = warp::triangle(u);
        let position = triangle.position(weights.x, weights.y);
        let to_light = position - from;
        let distance_squared = to_light.length_squared();
        let direction = to_light / distance_squared.sqrt();
        let cosine = -direction.dot(triangle.front);
        if !(cosine > 0.0) {
            return None;
        }
        let pdf = share * probability / triangle.area() * distance_squared / cosine;
        let radiance = self.emission[triangle.object as usize];
        let end = offset_along(position, triangle.front, triangle.rounding, triangle.front);
        (pdf.is_finite() && pdf > 0.0).then_some(LightSample {
            direction,
            radiance_over_pdf: radiance / pdf,
            pdf: Some(pdf),
            end: Some(end),
        })
    }

    fn sample_point(&self, share: f32, from: Vec3, choice: f32) -> Option<LightSample> {
        let Choice { index, probability, .. } = self.point_choice.as_ref()?.choose(choice);
        let light = &self.points[index];
        let to_light = light.position - from;
        let distance_squared = to_light.length_squared();
        if !(distance_squared > 0.0) {
            return None;
        }
        Some(LightSample {
            direction: to_light / distance_squared.sqrt(),
            radiance_over_pdf: light.intensity / (distance_squared * share * probability),
            pdf: None,
            end: Some(light.position),
        })
    }
}

const SKY: usize = 0;
const AREA: usize = 1;

/// Probabilities of the kinds in proportion to power, but none that shines below `SMALLEST_SHARE`.
fn shares(powers: [f64; 3]) -> [f64; 3] {
    let total: f64 = powers.iter().sum();
    powers.map(|p| if p > 0.0 { (p / total).max(SMALLEST_SHARE) } else { 0.0 })
}
