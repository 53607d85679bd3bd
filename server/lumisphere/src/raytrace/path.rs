//! Radiance along rays: unidirectional path tracing with next-event estimation and multiple importance sampling (Veach 1997, power
//! heuristic), Russian roulette after a few bounces.
//!
//! Many paths go side by side, bounce by bounce (a wavefront: Laine, Karras & Aila 2013): in packets of eight to their next surfaces, one
//! after the other through shading, then their shadow rays in packets, sorted by direction. A path draws its own numbers, so what it
//! finds does not depend on its neighbours.

use std::sync::Arc;

use glam::Vec3;

use super::bvh::Bvh;
use super::coherence::{direction_key, sort_by_key};
use super::lights::Lights;
use super::low_discrepancy::SampleSequence;
use super::packets::{PacketStack, RAYS, RayPacket};
use super::scattering::{Lobe, Scatterer, facing, facing_bumped};
use super::sky_cells::NormalBin;
use super::surfaces::{Bumps, Reflectance, SurfacePoint, SurfaceTriangle, TexelGrid, offset_along, rounding_at};
use super::tracer::{Mirrors, Under};
use super::traverse::{RawHit, Stack};
use super::warp::power_heuristic;
use crate::radiometry::brdf::BrdfModel;
use crate::radiometry::dielectric::{BodyPoint, Dielectric, outward};

/// Everything a path reads: shared, immutable.
#[derive(Debug)]
pub(super) struct World {
    pub bvh: Arc<Bvh>,
    pub triangles: Arc<[SurfaceTriangle]>,
    pub textures: Arc<[TexelGrid]>,
    pub lights: Lights,
    /// Largest absolute coordinate of the geometry.
    pub extent: f32,
}

/// How each object looks to this tracer.
#[derive(Debug, Clone)]
pub(super) struct Look {
    pub reflectance: Vec<Reflectance>,
    /// Objects that a camera ray sees otherwise, once.
    pub once: Vec<Option<Once>>,
    /// Objects whose normals are turned where they are mirrors, or are seen otherwise.
    pub bumps: Vec<Option<Bumps>>,
    /// Named by `Reflectance::Glossy` and `Once::Glossy`.
    pub brdfs: Vec<BrdfModel>,
}

/// What a camera ray sees of an object that all other rays see as its `reflectance`.
#[derive(Debug, Clone, Copy)]
pub(super) enum Once {
    Mirror(Mirrors),
    /// Index into `Look::brdfs`.
    Glossy(usize),
    Clear(Dielectric),
}

/// One thread's walk through the world: put paths in, `trace` them, read `radiance`, `clear`.
#[derive(Debug)]
pub(super) struct PathTracer<'a> {
    world: &'a World,
    look: &'a Look,
    max_bounces: u32,
    paths: Vec<Path>,
    /// Indices of the paths that go on.
    live: Vec<u32>,
    shadows: Vec<ShadowRay>,
    order: Vec<u32>,
    stack: PacketStack,
}

/// A path under way: where its next ray starts, what that will be weighted with, what was gathered so far.
#[derive(Debug, Clone, Copy)]
struct Path {
    origin: Vec3,
    direction: Vec3,
    throughput: Vec3,
    /// Density with which the direction was drawn, if light sampling could have drawn it too.
    pdf: Option<f32>,
    /// How light sampling drew where the ray starts.
    bin: NormalBin,
    radiance: Vec3,
    random: SampleSequence,
}

/// What became of a path that comes from a camera.
enum Turned {
    /// Nothing more is to be seen.
    Ends,
    /// It is a path as others are.
    GoesOn,
    /// It may meet the mirror that turned it.
    MayBeAgain,
}

/// Light on its way to a path, unless something is in between.
#[derive(Debug, Clone, Copy)]
struct ShadowRay {
    origin: Vec3,
    /// To the light's end at 1, or a direction when the light is infinitely far.
    direction: Vec3,
    limit: f32,
    arriving: Vec3,
    path: u32,
}

// Paths shorter than this are never cut: the first bounces carry most of the light.
const BOUNCES_BEFORE_ROULETTE: u32 = 3;

// Even in a white room a path ends some day.
const LARGEST_SURVIVAL: f32 = 0.95;

impl<'a> PathTracer<'a> {
    pub fn new(world: &'a World, look: &'a Look, max_bounces: u32) -> Self {
        let (paths, live, shadows, order) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        Self { world, look, max_bounces, paths, live, shadows, order, stack: PacketStack::default() }
    }

    /// Nearest surface along each ray, in order.
    pub fn nearest(&mut self, rays: impl Iterator<Item = (Vec3, Vec3)>, mut met: impl FnMut(usize, Option<SurfacePoint<'a>>)) {
        let mut rays = rays.enumerate().peekable();
        while let Some((first, _)) = rays.peek().copied() {
            let mut packet = RayPacket::EMPTY;
            let count =
                (&mut rays).take(RAYS).map(|(i, (origin, direction))| packet.set(i - first, origin, direction, f32::INFINITY)).count();
            let hits = self.world.bvh.nearest_of_packet(&packet, &mut self.stack);
            for (lane, hit) in hits.into_iter().enumerate().take(count) {
                met(first + lane, hit.map(|hit| SurfacePoint::new(&self.world.triangles, hit)));
            }
        }
    }

    /// Forgets all paths.
    pub fn clear(&mut self) {
        self.paths.clear();
        self.live.clear();
    }

    /// A path that asks for the radiance arriving at `origin` from `direction` (unit): emitters seen directly and up to `max_bounces`
    /// reflections.
    pub fn push(&mut self, origin: Vec3, direction: Vec3, random: SampleSequence) {
        self.live.push(self.paths.len() as u32);
        self.paths.push(Path { origin, direction, throughput: Vec3::ONE, pdf: None, bin: NormalBin::ANY, radiance: Vec3::ZERO, random });
    }

    /// A path that asks for the irradiance on a surface element facing `normal`, at `position` just off any surface.
    pub fn push_element(&mut self, position: Vec3, normal: Vec3, random: SampleSequence) {
        // A white Lambertian element: E = π · L of its reflection.
        let element = Scatterer { geometric_normal: normal, shading_normal: normal, wo: normal, lobe: Lobe::Lambert(Vec3::ONE) };
        let index = self.paths.len() as u32;
        let throughput = Vec3::splat(std::f32::consts::PI);
        self.paths.push(Path {
            origin: position,
            direction: normal,
            throughput,
            pdf: None,
            bin: NormalBin::ANY,
            radiance: Vec3::ZERO,
            random,
        });
        if self.scatter(index, position, &element, 0) {
            self.live.push(index);
        }
    }

    /// The paths, which come from a camera, see objects that look otherwise `once`. What is reflected there costs no bounce.
    pub fn reflect_once(&mut self) {
        if self.look.once.iter().all(Option::is_none) {
            return;
        }
        let mut turned = std::mem::take(&mut self.live);
        let mut next = Vec::with_capacity(turned.len());
        let mut reflections = 0;
        while !turned.is_empty() {
            let mut again = Vec::new();
            self.for_each_hit(&turned, |tracer, index, hit| match tracer.reflect_first(index, hit, reflections) {
                Turned::Ends => {}
                Turned::GoesOn => next.push(index),
                Turned::MayBeAgain => again.push(index),
            });
            turned = again;
            reflections += 1;
        }
        self.live = next;
    }

    /// Turns a path that comes from a camera, mirrored so often, at the object that it meets.
    fn reflect_first(&mut self, index: u32, hit: Option<RawHit>, reflections: u32) -> Turned {
        let Some(point) = hit.map(|hit| SurfacePoint::new(&self.world.triangles, hit)) else { return Turned::GoesOn };
        let Some(once) = self.look.once[point.triangle.object as usize] else { return Turned::GoesOn };
        let goes_on = match once {
            Once::Mirror(mirrors) => return self.mirror(index, &point, &mirrors, reflections),
            // In a mirror what looks otherwise once is as it looks to others.
            _ if reflections > 0 => true,
            Once::Clear(dielectric) => self.pass_through(index, &point, &dielectric),
            Once::Glossy(brdf) => self.scatter_first(index, &point, brdf),
        };
        if goes_on { Turned::GoesOn } else { Turned::Ends }
    }

    /// Turns a path at a mirror, or, in reflections, lets it see what is under it.
    fn mirror(&mut self, index: u32, point: &SurfacePoint<'a>, mirrors: &Mirrors, reflections: u32) -> Turned {
        let path = &mut self.paths[index as usize];
        // Frames know of no back: it ends the reflections.
        if reflections > 0 && point.triangle.front.dot(path.direction) > 0.0 {
            return Turned::GoesOn;
        }
        if reflections > 0 && mirrors.under == Under::Diffuse {
            // One of both, for both.
            path.throughput *= 2.0;
            if path.random.pair().x < 0.5 {
                return Turned::GoesOn;
            }
        }
        let (geometric_normal, shading_normal) = facing_bumped(point, -path.direction, self.look.bumps_of(point));
        let scatterer = Scatterer { geometric_normal, shading_normal, wo: -path.direction, lobe: Lobe::Mirror(mirrors.reflectance) };
        path.direction = scatterer.mirrored();
        path.origin = leave(point, path.direction);
        path.throughput *= mirrors.reflectance;
        if reflections + 1 < mirrors.reflections { Turned::MayBeAgain } else { Turned::GoesOn }
    }

    /// Turns a path that comes from a camera at an object of that BRDF. Whether it goes on.
    fn scatter_first(&mut self, index: u32, point: &SurfacePoint<'a>, brdf: usize) -> bool {
        let look = self.look;
        let path = &mut self.paths[index as usize];
        let (geometric_normal, shading_normal) = facing_bumped(point, -path.direction, look.bumps_of(point));
        let lobe = Lobe::Glossy { brdf: &look.brdfs[brdf], tangent: point.triangle.tangent() };
        let scatterer = Scatterer { geometric_normal, shading_normal, wo: -path.direction, lobe };
        let from = leave(point, geometric_normal);
        path.bin = scatterer.normal_bin();
        self.light(index, from, &scatterer, Strategy::LightAndReflection);
        let path = &mut self.paths[index as usize];
        let Some(scattered) = scatterer.sample(path.random.pair()) else { return false };
        (path.origin, path.direction, path.throughput, path.pdf) = (from, scattered.wi, scattered.weight, scattered.pdf);
        scattered.weight != Vec3::ZERO
    }

    /// Turns a path that comes from a camera at a clear body: it is reflected outside, or goes through. Whether it goes on.
    fn pass_through(&mut self, index: u32, point: &SurfacePoint<'a>, dielectric: &Dielectric) -> bool {
        let world = self.world;
        let path = &mut self.paths[index as usize];
        let (geometric_normal, normal) = facing(point, -path.direction);
        let reflected = dielectric.reflectance(-normal.dot(path.direction));
        if path.random.pair().x < reflected {
            let scatterer = Scatterer { geometric_normal, shading_normal: normal, wo: -path.direction, lobe: Lobe::Mirror(Vec3::ONE) };
            path.direction = scatterer.mirrored();
            path.origin = leave(point, path.direction);
            return true;
        }
        let object = point.triangle.object;
        let entry = BodyPoint { position: point.triangle.position(point.u, point.v), normal };
        let next = |from: &BodyPoint, direction: Vec3| world.next_of_object(object, from, direction);
        let Some(passage) = dielectric.passage(&entry, path.direction, next) else { return false };
        path.throughput = Vec3::splat(passage.transmittance / (1.0 - reflected));
        path.direction = passage.direction;
        path.origin = leave(passage.exit.as_ref().map_or(point, |exit| &exit.point), passage.direction);
        true
    }

    /// Follows all paths to their ends.
    pub fn trace(&mut self) {
        self.resolve_shadows();
        for bounces in 0..=self.max_bounces {
            if self.live.is_empty() {
                return;
            }
            if bounces > 0 {
                let paths = &self.paths;
                sort_by_key(&mut self.live, &mut self.order, |index| direction_key(paths[*index as usize].direction));
            }
            let live = std::mem::take(&mut self.live);
            let mut next = Vec::with_capacity(live.len());
            self.for_each_hit(&live, |tracer, index, hit| {
                if tracer.meet(index, hit, bounces) {
                    next.push(index);
                }
            });
            self.live = next;
            self.resolve_shadows();
        }
    }

    /// What each path found, in the order of pushing.
    pub fn radiance(&self) -> impl Iterator<Item = Vec3> {
        self.paths.iter().map(|p| p.radiance)
    }

    fn for_each_hit(&mut self, paths: &[u32], mut met: impl FnMut(&mut Self, u32, Option<RawHit>)) {
        for indices in paths.chunks(RAYS) {
            let mut packet = RayPacket::EMPTY;
            for (lane, index) in indices.iter().enumerate() {
                let path = &self.paths[*index as usize];
                packet.set(lane, path.origin, path.direction, f32::INFINITY);
            }
            let hits = self.world.bvh.nearest_of_packet(&packet, &mut self.stack);
            indices.iter().zip(hits).for_each(|(index, hit)| met(self, *index, hit));
        }
    }

    /// Takes in what a path's ray met after so many reflections. Whether the path goes on.
    fn meet(&mut self, index: u32, hit: Option<RawHit>, bounces: u32) -> bool {
        let path = &mut self.paths[index as usize];
        let Some(hit) = hit else {
            let (sky, pdf) = self.world.lights.sky_radiance(path.direction, path.bin);
            path.radiance += path.throughput * sky * weight_against_light(path.pdf, pdf);
            return false;
        };
        let point = SurfacePoint::new(&self.world.triangles, hit);
        let (emitted, pdf) = self.world.lights.emitted(point.triangle, -path.direction, point.distance);
        if emitted != Vec3::ZERO {
            path.radiance += path.throughput * emitted * weight_against_light(path.pdf, pdf);
        }
        if bounces == self.max_bounces {
            return false;
        }
        let look = self.look;
        let reflectance = look.reflectance[point.triangle.object as usize];
        let mut scatterer = Scatterer::new(&point, reflectance, &self.world.textures, &look.brdfs, -path.direction);
        if let (Lobe::Mirror(_), bumps @ Some(_)) = (scatterer.lobe, look.bumps_of(&point)) {
            (_, scatterer.shading_normal) = facing_bumped(&point, scatterer.wo, bumps);
        }
        self.scatter(index, leave(&point, scatterer.geometric_normal), &scatterer, bounces + 1)
    }

    /// Light at a vertex, and the way on from it: `from` lies just off the surface, on the side of all that `scatterer` reflects to.
    /// `bounces`: reflections before the next ray. Whether the path goes on.
    fn scatter(&mut self, index: u32, from: Vec3, scatterer: &Scatterer, bounces: u32) -> bool {
        let path = &mut self.paths[index as usize];
        path.bin = scatterer.normal_bin();
        // The path ends here where light sampling alone does: a last ray would cost more than it calms.
        let last = bounces == self.max_bounces && self.world.lights.only_sky() && matches!(scatterer.lobe, Lobe::Lambert(_));
        let strategy = if last { Strategy::LightAlone } else { Strategy::LightAndReflection };
        if !matches!(scatterer.lobe, Lobe::Mirror(_)) {
            self.light(index, from, scatterer, strategy);
        }
        if last {
            return false;
        }
        let path = &mut self.paths[index as usize];
        let Some(scattered) = scatterer.sample(path.random.pair()) else { return false };
        let Some(throughput) = survive(path.throughput * scattered.weight, bounces, &mut path.random) else { return false };
        (path.origin, path.direction, path.throughput, path.pdf) = (from, scattered.wi, throughput, scattered.pdf);
        if bounces < self.max_bounces || self.world.lights.has_area_lights() {
            return true;
        }
        // The last ray, where only the sky emits: no need to know what is hit.
        let (sky, pdf) = self.world.lights.sky_radiance(path.direction, path.bin);
        let arriving = path.throughput * sky * weight_against_light(path.pdf, pdf);
        if arriving != Vec3::ZERO {
            self.shadows.push(ShadowRay { origin: from, direction: path.direction, limit: f32::INFINITY, arriving, path: index });
        }
        false
    }

    /// Light of one emitter at a vertex of the path, on its way.
    fn light(&mut self, index: u32, from: Vec3, scatterer: &Scatterer, strategy: Strategy) {
        let path = &mut self.paths[index as usize];
        if let Some(mut shadow) = self.world.direct(from, scatterer, strategy, &mut path.random) {
            shadow.arriving *= path.throughput;
            shadow.path = index;
            self.shadows.push(shadow);
        }
    }

    /// Lets the light through that nothing blocks.
    fn resolve_shadows(&mut self) {
        sort_by_key(&mut self.shadows, &mut self.order, |shadow| direction_key(shadow.direction));
        for rays in self.shadows.chunks(RAYS) {
            let mut packet = RayPacket::EMPTY;
            rays.iter().enumerate().for_each(|(lane, ray)| packet.set(lane, ray.origin, ray.direction, ray.limit));
            let blocked = self.world.bvh.any_of_packet(&packet, &mut self.stack);
            for (_, ray) in rays.iter().enumerate().filter(|(lane, _)| blocked >> lane & 1 == 0) {
                self.paths[ray.path as usize].radiance += ray.arriving;
            }
        }
        self.shadows.clear();
    }
}

/// What finds the light that arrives at a vertex.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Strategy {
    /// A sampled light and a sampled reflection, each weighted against the other.
    LightAndReflection,
    LightAlone,
}

/// Where a ray meets the inside of a body.
struct InnerPoint<'a> {
    point: SurfacePoint<'a>,
    body: BodyPoint,
}

impl AsRef<BodyPoint> for InnerPoint<'_> {
    fn as_ref(&self) -> &BodyPoint {
        &self.body
    }
}

impl World {
    /// The next surface of one object alone along a ray from a point of it.
    fn next_of_object(&self, object: u32, from: &BodyPoint, direction: Vec3) -> Option<InnerPoint<'_>> {
        let mut stack = Stack::new();
        let mut origin = offset_along(from.position, from.normal, rounding_at(from.position, self.extent), direction);
        loop {
            let hit = self.bvh.nearest(origin, direction, f32::INFINITY, &mut stack)?;
            let point = SurfacePoint::new(&self.triangles, hit);
            let (triangle, position) = (point.triangle, point.triangle.position(point.u, point.v));
            if triangle.object == object {
                let normal = outward(triangle.shading_normal(point.u, point.v), triangle.front, direction);
                return Some(InnerPoint { body: BodyPoint { position, normal }, point });
            }
            origin = leave(&point, direction);
        }
    }

    /// Reflected light of one sampled emitter; whose path it is, the caller fills in.
    fn direct(&self, from: Vec3, scatterer: &Scatterer, strategy: Strategy, random: &mut SampleSequence) -> Option<ShadowRay> {
        if !self.lights.can_be_sampled() {
            return None;
        }
        let choice = if self.lights.only_sky() { 0.0 } else { random.pair().x };
        let light = self.lights.sample(&self.triangles, from, scatterer.normal_bin(), choice, random.pair())?;
        let (value, pdf) = scatterer.eval(light.direction);
        let weight = match (strategy, light.pdf) {
            (Strategy::LightAndReflection, Some(taken)) => power_heuristic(taken, pdf),
            _ => 1.0,
        };
        let arriving = value * light.radiance_over_pdf * weight;
        let (direction, limit) = light.end.map_or((light.direction, f32::INFINITY), |end| (end - from, 1.0));
        (arriving != Vec3::ZERO).then_some(ShadowRay { origin: from, direction, limit, arriving, path: 0 })
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
    pub fn authored(reflectance: Vec<Reflectance>, brdfs: Vec<BrdfModel>) -> Self {
        let (once, bumps) = (vec![None; reflectance.len()], vec![None; reflectance.len()]);
        Self { reflectance, once, bumps, brdfs }
    }

    fn bumps_of(&self, point: &SurfacePoint<'_>) -> Option<&Bumps> {
        self.bumps[point.triangle.object as usize].as_ref()
    }
}
