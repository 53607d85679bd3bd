//! Radiance along a ray: unidirectional path tracing with next-event estimation and multiple importance sampling (Veach 1997,
//! power heuristic), Russian roulette after a few bounces.

use glam::{Vec2, Vec3};

use super::lights::Lights;
use super::low_discrepancy::SampleSequence;
use super::scattering::{Scatterer, facing};
use super::surfaces::{Reflectance, SurfacePoint, SurfaceTriangle, TexelGrid, offset_along};
use super::traverse::Stack;
use super::warp::power_heuristic;
use super::{bvh::Bvh, scattering::Lobe};

/// Everything a path reads: shared, immutable.
#[derive(Debug)]
pub(super) struct World {
    pub bvh: Bvh,
    pub triangles: Vec<SurfaceTriangle>,
    pub textures: Vec<TexelGrid>,
    pub lights: Lights,
    /// Largest absolute coordinate of the geometry.
    pub extent: f32,
}

/// How each object looks to this tracer.
#[derive(Debug, Clone)]
pub(super) struct Look {
    pub reflectance: Vec<Reflectance>,
    /// Objects that a camera ray sees as a mirror, once.
    pub mirrored_once: Vec<Option<Vec3>>,
}

/// One thread's walk through the world.
#[derive(Debug)]
pub(super) struct PathTracer<'a> {
    pub world: &'a World,
    pub look: &'a Look,
    pub max_bounces: u32,
    pub stack: Stack,
}

/// A ray under way: where it starts, what it will be weighted with.
#[derive(Debug, Clone, Copy)]
struct Segment {
    origin: Vec3,
    direction: Vec3,
    throughput: Vec3,
    // Density with which the direction was drawn, if light sampling could have drawn it too.
    pdf: Option<f32>,
}

// Paths shorter than this are never cut: the first bounces carry most of the light.
const BOUNCES_BEFORE_ROULETTE: u32 = 3;

// Even in a white room a path ends some day.
const LARGEST_SURVIVAL: f32 = 0.95;

impl<'a> PathTracer<'a> {
    /// Nearest surface along a ray.
    pub fn nearest(&mut self, origin: Vec3, direction: Vec3) -> Option<SurfacePoint<'a>> {
        let hit = self.world.bvh.nearest(origin, direction, f32::INFINITY, &mut self.stack)?;
        Some(SurfacePoint::new(&self.world.triangles, hit))
    }

    /// Radiance arriving at `origin` from `direction` (unit): emitters seen directly and up to `max_bounces` reflections.
    pub fn radiance(&mut self, origin: Vec3, direction: Vec3, random: &mut SampleSequence) -> Vec3 {
        self.follow(Segment { origin, direction, throughput: Vec3::ONE, pdf: None }, 0, random)
    }

    /// The same for a ray from the camera, which sees `mirrored_once` objects as mirrors.
    pub fn camera_radiance(&mut self, origin: Vec3, direction: Vec3, random: &mut SampleSequence) -> Vec3 {
        if self.look.mirrored_once.iter().all(Option::is_none) {
            return self.radiance(origin, direction, random);
        }
        let Some(point) = self.nearest(origin, direction) else { return self.radiance(origin, direction, random) };
        let Some(reflectance) = self.look.mirrored_once[point.triangle.object as usize] else {
            return self.radiance(origin, direction, random);
        };
        let (geometric_normal, shading_normal) = facing(&point, -direction);
        let mirror = Scatterer { geometric_normal, shading_normal, wo: -direction, lobe: Lobe::Mirror(reflectance) };
        let reflected = mirror.mirrored();
        let from = leave(&point, reflected);
        reflectance * self.radiance(from, reflected, random)
    }

    /// Irradiance on a surface element facing `normal`, at `position` just off any surface: one sample.
    pub fn irradiance(&mut self, position: Vec3, normal: Vec3, random: &mut SampleSequence) -> Vec3 {
        // A white Lambertian element: E = π · L of its reflection.
        let element = Scatterer { geometric_normal: normal, shading_normal: normal, wo: normal, lobe: Lobe::Lambert(Vec3::ONE) };
        let direct = self.direct(position, &element, random);
        let rest = match element.sample(random.pair()) {
            Some(s) => self.follow(Segment { origin: position, direction: s.wi, throughput: s.weight, pdf: s.pdf }, 0, random),
            None => Vec3::ZERO,
        };
        std::f32::consts::PI * (direct + rest)
    }

    fn follow(&mut self, mut ray: Segment, mut bounces: u32, random: &mut SampleSequence) -> Vec3 {
        let mut radiance = Vec3::ZERO;
        loop {
            let last = bounces == self.max_bounces;
            if last && bounces > 0 && !self.world.lights.has_area_lights() {
                return radiance + self.unoccluded_sky(&ray);
            }
            let Some(point) = self.nearest(ray.origin, ray.direction) else {
                let (sky, pdf) = self.world.lights.sky_radiance(ray.direction);
                return radiance + ray.throughput * sky * weight_against_light(ray.pdf, pdf);
            };
            let (emitted, pdf) = self.world.lights.emitted(point.triangle, -ray.direction, point.distance);
            if emitted != Vec3::ZERO {
                radiance += ray.throughput * emitted * weight_against_light(ray.pdf, pdf);
            }
            if last {
                return radiance;
            }
            let reflectance = self.look.reflectance[point.triangle.object as usize];
            let scatterer = Scatterer::new(&point, reflectance, &self.world.textures, -ray.direction);
            let position = point.triangle.position(point.u, point.v);
            if !matches!(scatterer.lobe, Lobe::Mirror(_)) {
                let from = offset_along(position, scatterer.geometric_normal, point.triangle.rounding, scatterer.geometric_normal);
                radiance += ray.throughput * self.direct(from, &scatterer, random);
            }
            let Some(scattered) = scatterer.sample(random.pair()) else { return radiance };
            bounces += 1;
            let Some(throughput) = survive(ray.throughput * scattered.weight, bounces, random) else { return radiance };
            ray = Segment { origin: leave(&point, scattered.wi), direction: scattered.wi, throughput, pdf: scattered.pdf };
        }
    }

    /// Reflected light of one sampled emitter, weighted against sampling the reflection.
    fn direct(&mut self, from: Vec3, scatterer: &Scatterer, random: &mut SampleSequence) -> Vec3 {
        if !self.world.lights.can_be_sampled() {
            return Vec3::ZERO;
        }
        let (choice, u) = (random.pair().x, random.pair());
        let Some(light) = self.world.lights.sample(&self.world.triangles, from, choice, u) else { return Vec3::ZERO };
        let (value, pdf) = scatterer.eval(light.direction);
        let reflected = value * light.radiance_over_pdf * light.pdf.map_or(1.0, |taken| power_heuristic(taken, pdf));
        if reflected == Vec3::ZERO || self.blocked(from, light.direction, light.end) {
            return Vec3::ZERO;
        }
        reflected
    }

    fn blocked(&mut self, from: Vec3, direction: Vec3, end: Option<Vec3>) -> bool {
        match end {
            Some(end) => self.world.bvh.any(from, end - from, 1.0, &mut self.stack),
            None => self.world.bvh.any(from, direction, f32::INFINITY, &mut self.stack),
        }
    }

    /// The last segment of a path where only the sky emits: no need to know what is hit.
    fn unoccluded_sky(&mut self, ray: &Segment) -> Vec3 {
        let (sky, pdf) = self.world.lights.sky_radiance(ray.direction);
        let arriving = ray.throughput * sky * weight_against_light(ray.pdf, pdf);
        if arriving == Vec3::ZERO || self.blocked(ray.origin, ray.direction, None) { Vec3::ZERO } else { arriving }
    }
}

/// Where a ray leaving the surface starts.
fn leave(point: &SurfacePoint, direction: Vec3) -> Vec3 {
    let triangle = point.triangle;
    offset_along(triangle.position(point.u, point.v), triangle.front, triangle.rounding, direction)
}

/// Weight of a ray that met an emitter, drawn with density `taken` (None: light sampling could not have drawn it) where light
/// sampling would have drawn it with density `light`.
fn weight_against_light(taken: Option<f32>, light: f32) -> f32 {
    taken.map_or(1.0, |taken| power_heuristic(taken, light))
}

/// Russian roulette: the throughput to go on with, or None.
fn survive(throughput: Vec3, bounces: u32, random: &mut SampleSequence) -> Option<Vec3> {
    if bounces <= BOUNCES_BEFORE_ROULETTE {
        return (throughput != Vec3::ZERO).then_some(throughput);
    }
    let survival = throughput.max_element().min(LARGEST_SURVIVAL);
    (random.pair().x < survival).then(|| throughput / survival)
}

impl Look {
    /// Nothing changed: each object as its material says.
    pub fn authored(reflectance: Vec<Reflectance>) -> Self {
        let mirrored_once = vec![None; reflectance.len()];
        Self { reflectance, mirrored_once }
    }
}

/// Fibonacci directions: `count` unit vectors spread evenly over the sphere.
pub(super) fn even_directions(count: u32) -> impl Iterator<Item = Vec3> {
    // 2π(1 − 1/φ): the golden angle.
    const GOLDEN_ANGLE: f32 = 2.399_963_2;
    (0..count).map(move |i| {
        let y = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
        let at = Vec2::from_angle(GOLDEN_ANGLE * i as f32) * (1.0 - y * y).sqrt();
        Vec3::new(at.x, y, at.y)
    })
}
