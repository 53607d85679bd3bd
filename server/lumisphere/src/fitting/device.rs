//! Single lobes looked for and polished on a graphics device: host side of `lobes/one_lobe.wgsl`, one invocation a texel or a start.
//!
//! Samples are uploaded as a tile holds them, 16 texels side by side, so that neighbouring invocations read neighbouring numbers; they stay
//! until the tile's weights change or others need the room. One tile at a time is at work there; the threads prepare others meanwhile. What
//! comes back is checked: numbers that are no lobe are the device's failure, and nothing is fitted.

use std::borrow::Cow;
use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::{Pod, Zeroable};

use super::candidate::Candidate;
use super::ladder::{Climb, Task};
use super::lane_list::in_groups;
use super::lanes::GROUP;
use super::lobes::question::Stop;
use super::lobes::scan::{EXPONENTS, Look, MAX_PLACES, Scratch};
use super::one_lobe::OneLobe;
use super::sample::Sample;
use super::settings::{Rung, Settings, Termination};
use super::tile::{self, Tile};
use crate::gpu::{Gpu, GpuError, ReadBack, Shader, binding, value_buffer};

/// All of `one_lobe.wgsl`.
pub(crate) const SOURCE: &str = include_str!("lobes/one_lobe.wgsl");

/// Samples' bytes that a tile may hold: a dispatch and its upload outweigh what it costs to begin them.
const TILE_BYTES: usize = 16 << 20;
/// So that a dispatch stays short: nine tasks a texel at most.
const GROUPS_AT_MOST: usize = 256;
/// Tiles that stay on the device.
const TILES_KEPT: usize = 8;
/// Invocations of a workgroup.
const WORKGROUP: usize = 64;
/// How far from 1 the squared length of a unit direction may lie, and ln m from its range: rounding, and that of the samples' directions.
const UNIT_TOLERANCE: f32 = 2e-3;
/// Rows of a sample.
const ROWS: usize = size_of::<Sample>() / size_of::<[f32; GROUP]>();

/// Layout as WGSL's.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Terms {
    pub log_exponent: f32,
    pub shape_pull: f32,
    pub amplitude_pull: f32,
    pub tolerance: f32,
    pub iterations: u32,
    pub count: u32,
    pub peaks: u32,
    pub padding: u32,
}

/// Layout as WGSL's.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Start {
    pub axis: [f32; 3],
    pub log_exponent: f32,
    pub constant: [f32; 3],
    pub observed: f32,
    pub amplitude: [f32; 3],
    pub least_variance: f32,
    pub first: u32,
    pub samples: u32,
    pub padding_0: u32,
    pub padding_1: u32,
}

/// Layout as WGSL's.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Fitted {
    pub axis: [f32; 3],
    pub log_exponent: f32,
    pub constant: [f32; 3],
    pub cost: f32,
    pub amplitude: [f32; 3],
    pub initial_cost: f32,
    pub carried: f32,
    pub log_exponent_variance: f32,
    pub iterations: u32,
    pub converged: u32,
}

/// Layout as WGSL's `Look`.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Looked {
    pub places: [[f32; 4]; MAX_PLACES],
    pub gains: [[f32; EXPONENTS.len()]; MAX_PLACES],
}

/// Fits single lobes on a device, for any number of fits and threads.
#[derive(Debug)]
pub struct LobeKernel {
    gpu: Arc<Gpu>,
    shader: Shader,
    looking: wgpu::ComputePipeline,
    polishing: wgpu::ComputePipeline,
    terms: wgpu::Buffer,
    // Those used last come last.
    tiles: Mutex<Vec<Resident>>,
}

/// What a tile has on the device.
#[derive(Debug)]
struct Resident {
    /// The tile's, where all of it is there.
    stamp: Option<u64>,
    samples: wgpu::Buffer,
    starts: wgpu::Buffer,
    fits: wgpu::Buffer,
    looks: wgpu::Buffer,
    read_back: ReadBack,
}

/// Samples of some texels, and where each texel's are.
struct Upload<'a> {
    stamp: Option<u64>,
    groups: Vec<Cow<'a, [Sample]>>,
    places: Vec<Place>,
}

/// Of a texel's samples.
#[derive(Clone, Copy, Default)]
struct Place {
    /// Number of the first, in 16 lanes.
    first: usize,
    lane: usize,
    samples: usize,
}

/// One of the kernel's two entry points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Entry {
    Look,
    Polish,
}

impl LobeKernel {
    /// On a device of its own, as a rule: failures of others are told to whoever asks first.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, GpuError> {
        Self::with_source(gpu, SOURCE)
    }

    /// The same of another source.
    pub(crate) fn with_source(gpu: Arc<Gpu>, source: &'static str) -> Result<Self, GpuError> {
        let read = [0, 1, 2].map(binding::read_buffer);
        let write = [3, 4].map(binding::write_buffer);
        let shader = Shader::new(&gpu, "one lobe", source, &[&[read.as_slice(), &write].concat()]);
        let looking = shader.compute_pipeline(&gpu, "look_for_one_lobe", &[]);
        let polishing = shader.compute_pipeline(&gpu, "fit_one_lobe", &[]);
        let terms = value_buffer::<Terms>(&gpu, "terms");
        gpu.check()?;
        Ok(Self { gpu, shader, looking, polishing, terms, tiles: Mutex::default() })
    }

    /// What `entry` makes of each start.
    fn run<T: Pod>(&self, entry: Entry, upload: &Upload<'_>, starts: &[Start], terms: &Terms) -> Result<Vec<T>, GpuError> {
        let mut tiles = self.tiles.lock().unwrap_or_else(PoisonError::into_inner);
        let is_this = |tile: &Resident| upload.stamp.is_some() && tile.stamp == upload.stamp;
        let known = tiles.iter().position(is_this).or((tiles.len() == TILES_KEPT).then_some(0));
        // Only what worked is used again: a buffer that failed may still be mapped.
        let held = known.map(|at| tiles.remove(at));
        let tile = Resident::ensure(&self.gpu, held, upload, starts.len())?;
        let queue = self.gpu.queue();
        queue.write_buffer(&self.terms, 0, bytemuck::bytes_of(terms));
        queue.write_buffer(&tile.starts, 0, bytemuck::cast_slice(starts));
        if !is_this(&tile) {
            let mut offset = 0;
            for group in &upload.groups {
                queue.write_buffer(&tile.samples, offset, bytemuck::cast_slice(group));
                offset += size_of_val(&**group) as u64;
            }
        }
        let buffers = [&self.terms, &tile.samples, &tile.starts, &tile.fits, &tile.looks];
        let resources = self.shader.bind(&self.gpu, 0, &buffers.map(wgpu::Buffer::as_entire_binding));
        let (pipeline, results) = match entry {
            Entry::Look => (&self.looking, &tile.looks),
            Entry::Polish => (&self.polishing, &tile.fits),
        };
        let mut encoder = self.gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("one lobe") });
        let bytes = (starts.len() * size_of::<T>()) as u64;
        // What the tile before found must not be taken for what this one does.
        encoder.clear_buffer(results, 0, Some(bytes));
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &resources, &[]);
        pass.dispatch_workgroups(starts.len().div_ceil(WORKGROUP) as u32, 1, 1);
        drop(pass);
        encoder.copy_buffer_to_buffer(results, 0, tile.read_back.buffer(), 0, bytes);
        queue.submit([encoder.finish()]);
        let found = tile.read_back.request(0..bytes).finish(&self.gpu, |bytes| bytemuck::cast_slice(bytes).to_vec())?;
        tiles.push(Resident { stamp: upload.stamp, ..tile });
        Ok(found)
    }
}

impl OneLobe for LobeKernel {
    type Error = GpuError;

    fn groups_per_tile(&self, observations: usize, groups: usize) -> usize {
        let room = (TILE_BYTES / (observations.max(1) * size_of::<Sample>())).min(GROUPS_AT_MOST);
        // What the device does not do is the threads'.
        groups.div_ceil(rayon::current_num_threads()).min(room).max(tile::groups_per_tile(observations))
    }

    fn look(
        &self,
        tile: &Tile,
        climbs: &[Climb],
        climbing: &[usize],
        peaks: usize,
        _scratch: &mut Vec<Scratch>,
    ) -> Result<Vec<Look>, GpuError> {
        if climbing.is_empty() {
            return Ok(Vec::new());
        }
        let texels: Vec<usize> = climbing.iter().map(|&i| climbs[i].texel).collect();
        let upload = Upload::new(tile, &texels);
        let beside_constant = climbing.iter().zip(&upload.places).map(|(&i, place)| {
            let first = place.first()?;
            Ok(Start { constant: climbs[i].top.linear[0], first, samples: place.samples as u32, ..Start::zeroed() })
        });
        let starts = beside_constant.collect::<Result<Vec<_>, GpuError>>()?;
        let terms = Terms { count: starts.len() as u32, peaks: peaks.min(MAX_PLACES - 1) as u32, ..Terms::zeroed() };
        let looks = self.run(Entry::Look, &upload, &starts, &terms)?;
        looks.iter().map(|looked| look(looked, peaks)).collect()
    }

    fn polish(&self, tile: &Tile, tasks: &[Task], settings: &Settings, stop: Stop) -> Result<Vec<Candidate>, GpuError> {
        if tasks.is_empty() {
            return Ok(Vec::new());
        }
        // Starts of one texel follow each other.
        let texels: Vec<usize> = tasks.chunk_by(|a, b| a.texel == b.texel).map(|of_texel| of_texel[0].texel).collect();
        let upload = Upload::new(tile, &texels);
        let of_texels = tasks.chunk_by(|a, b| a.texel == b.texel).zip(&upload.places);
        let starts = of_texels.flat_map(|(tasks, place)| tasks.iter().map(move |task| start(tile, task, *place, settings)));
        let starts = starts.collect::<Result<Vec<_>, _>>()?;
        let fits = self.run(Entry::Polish, &upload, &starts, &terms(settings, stop, tasks.len()))?;
        fits.iter().map(candidate).collect()
    }
}

impl<'a> Upload<'a> {
    /// All of the tile where half of its groups take part; else only these texels, packed.
    fn new(tile: &'a Tile<'_>, texels: &[usize]) -> Self {
        let taking_part = texels.chunk_by(|a, b| a / GROUP == b / GROUP).count();
        if 2 * taking_part >= tile.groups().len() { Self::whole(tile, texels) } else { Self::packed(tile, texels) }
    }

    fn whole(tile: &'a Tile<'_>, texels: &[usize]) -> Self {
        let mut firsts = Vec::with_capacity(tile.groups().len());
        let mut first = 0;
        for group in tile.groups() {
            firsts.push(first);
            first += group.len();
        }
        let place = |&texel: &usize| {
            let group = texel / GROUP;
            Place { first: firsts[group], lane: texel % GROUP, samples: tile.groups()[group].len() }
        };
        let places = texels.iter().map(place).collect();
        Self { stamp: Some(tile.stamp()), groups: tile.groups().iter().map(|g| Cow::Borrowed(&g[..])).collect(), places }
    }

    fn packed(tile: &'a Tile<'_>, texels: &[usize]) -> Self {
        let (mut groups, mut places, mut first) = (Vec::new(), vec![Place::default(); texels.len()], 0);
        for lanes in in_groups(texels.iter().copied()) {
            let (samples, _) = tile.gather(&lanes.texels);
            for (lane, i) in lanes.wanted() {
                places[i] = Place { first, lane, samples: samples.len() };
            }
            first += samples.len();
            groups.push(samples);
        }
        Self { stamp: None, groups, places }
    }

    fn bytes(&self) -> u64 {
        self.groups.iter().map(|group| size_of_val(&**group) as u64).sum()
    }
}

impl Place {
    /// Where its first number is.
    fn first(self) -> Result<u32, GpuError> {
        let first = self.first * ROWS * GROUP + self.lane;
        let beyond = |_| GpuError::BeyondLimit { what: SAMPLES, needed: first as u64, limit: u64::from(u32::MAX) };
        u32::try_from(first).map_err(beyond)
    }
}

/// In errors.
const SAMPLES: &str = "samples that are fitted together";

impl Resident {
    fn ensure(gpu: &Gpu, held: Option<Self>, upload: &Upload<'_>, starts: usize) -> Result<Self, GpuError> {
        // A texel without samples has none to upload, but no buffer is empty.
        let samples = upload.bytes().max(size_of::<Sample>() as u64);
        let of_starts = |bytes: usize| (starts * bytes) as u64;
        let [starts, fits, looks] = [size_of::<Start>(), size_of::<Fitted>(), size_of::<Looked>()].map(of_starts);
        gpu.check_binding(SAMPLES, samples)?;
        gpu.check_binding("starts that are fitted together", looks)?;
        let is_large_enough = |held: &Self| held.samples.size() >= samples && held.starts.size() >= starts;
        if let Some(held) = held.filter(is_large_enough) {
            return Ok(held);
        }
        let buffer = |label, size, usage| {
            let usage = usage | wgpu::BufferUsages::STORAGE;
            gpu.device().create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
        };
        let made = Self {
            stamp: None,
            samples: buffer("samples", samples, wgpu::BufferUsages::COPY_DST),
            starts: buffer("starts", starts, wgpu::BufferUsages::COPY_DST),
            fits: buffer("fits", fits, wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST),
            looks: buffer("looks", looks, wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST),
            read_back: ReadBack::new(gpu, "found", looks.max(fits)),
        };
        gpu.check()?;
        Ok(made)
    }
}

fn terms(settings: &Settings, stop: Stop, count: usize) -> Terms {
    Terms {
        log_exponent: settings.prior.map_or(0.0, |prior| prior.log_exponent),
        shape_pull: settings.prior.map_or(0.0, |prior| prior.deviation.powi(-2)),
        amplitude_pull: settings.prior.map_or(0.0, |prior| prior.amplitude.powi(-2)),
        tolerance: stop.tolerance as f32,
        iterations: stop.iterations as u32,
        count: count as u32,
        ..Terms::zeroed()
    }
}

fn start(tile: &Tile, task: &Task, place: Place, settings: &Settings) -> Result<Start, GpuError> {
    let known = tile.texels()[task.texel];
    Ok(Start {
        axis: task.start.axis[0],
        log_exponent: task.start.log_exponent[0],
        constant: task.linear[0],
        observed: known.numbers as f32,
        amplitude: task.linear[1],
        least_variance: (settings.noise.floor / known.scale).powi(2),
        first: place.first()?,
        samples: place.samples as u32,
        ..Start::zeroed()
    })
}

/// What the device found at `peaks` peaks and the centroid of the first, if these are places and gains.
fn look(looked: &Looked, peaks: usize) -> Result<Look, GpuError> {
    let is_unit = |[x, y, z, _]: &[f32; 4]| (x * x + y * y + z * z - 1.0).abs() < UNIT_TOLERANCE;
    let mut found = looked.places.iter().zip(&looked.gains).take(peaks + 1);
    if !found.all(|(place, gains)| is_unit(place) && gains.iter().all(|gain| gain.is_finite() && *gain >= 0.0)) {
        return Err(GpuError::Failed { reason: format!("what it calculated is no place for a lobe: {looked:?}") });
    }
    Ok(Look { place: looked.places.map(|[x, y, z, _]| [x, y, z]), gain: looked.gains })
}

/// What the device says, if it is a lobe.
fn candidate(fitted: &Fitted) -> Result<Candidate, GpuError> {
    let length = fitted.axis.iter().map(|x| x * x).sum::<f32>();
    let is_not_negative = |value: &f32| value.is_finite() && *value >= 0.0;
    let linear = [fitted.constant, fitted.amplitude];
    let others = [fitted.cost, fitted.initial_cost, fitted.carried, fitted.log_exponent_variance];
    let is_lobe = (length - 1.0).abs() < UNIT_TOLERANCE
        && fitted.axis[2] > -UNIT_TOLERANCE
        && (0.0..=1000_f32.ln() + UNIT_TOLERANCE).contains(&fitted.log_exponent)
        && linear.as_flattened().iter().chain(&others).all(is_not_negative);
    if !is_lobe {
        return Err(GpuError::Failed { reason: format!("what it calculated is no lobe: {fitted:?}") });
    }
    let mut candidate = Candidate::flat(Rung::Lobes(1), fitted.constant, 0.0, fitted.cost);
    candidate.shape.axis[0] = fitted.axis;
    candidate.shape.log_exponent[0] = fitted.log_exponent;
    candidate.linear[1] = fitted.amplitude;
    candidate.initial_cost = f64::from(fitted.initial_cost);
    candidate.iterations = fitted.iterations;
    candidate.termination = if fitted.converged == 1 { Termination::Converged } else { Termination::IterationLimit };
    candidate.log_exponent_variance[0] = fitted.log_exponent_variance;
    candidate.carried[0] = fitted.carried;
    Ok(candidate)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::layout_check::assert_same_layout;

    #[test]
    fn structs_lie_in_memory_as_wgsl_has_them() {
        assert_same_layout!(
            SOURCE,
            "Terms",
            Terms { log_exponent, shape_pull, amplitude_pull, tolerance, iterations, count, peaks, padding }
        );
        assert_same_layout!(SOURCE, "Look", Looked { places, gains });
        assert_same_layout!(
            SOURCE,
            "Start",
            Start { axis, log_exponent, constant, observed, amplitude, least_variance, first, samples, padding_0, padding_1 }
        );
        assert_same_layout!(
            SOURCE,
            "Fitted",
            Fitted { axis, log_exponent, constant, cost, amplitude, initial_cost, carried, log_exponent_variance, iterations, converged }
        );
        assert_eq!(ROWS, 9, "direction, value and root of the weight of three channels");
    }

    #[test]
    fn numbers_that_are_no_place_or_gain_are_not_taken_for_one() {
        let good = Looked { places: [[0.6, 0.0, 0.8, 0.0]; 4], gains: [[0.5; 5]; 4] };
        assert_eq!(look(&good, 3), Ok(Look { place: [[0.6, 0.0, 0.8]; 4], gain: [[0.5; 5]; 4] }));
        let broken: [fn(&mut Looked); 4] =
            [|l| l.places[3] = [0.0; 4], |l| l.places[0][1] = f32::NAN, |l| l.gains[2][4] = f32::INFINITY, |l| l.gains[1][0] = -1e-3];
        for (i, breaks) in broken.iter().enumerate() {
            let mut looked = good;
            breaks(&mut looked);
            let error = look(&looked, 3).unwrap_err();
            assert!(matches!(&error, GpuError::Failed { reason } if reason.contains("no place")), "{i}: {error}");
        }
        // What was not asked for is not looked at.
        assert!(look(&Looked { places: [good.places[0], good.places[1], [0.0; 4], [0.0; 4]], ..good }, 1).is_ok());
    }

    #[test]
    fn numbers_that_are_no_lobe_are_not_taken_for_one() {
        let good = Fitted {
            axis: [0.6, 0.0, 0.8],
            log_exponent: 3.0,
            constant: [0.1; 3],
            cost: 0.2,
            amplitude: [0.3, 0.0, 0.3],
            initial_cost: 0.4,
            carried: 5.0,
            log_exponent_variance: 1e30,
            iterations: 7,
            converged: 1,
        };
        let found = candidate(&good).unwrap();
        assert_eq!((found.shape.axis[0], found.shape.log_exponent[0]), (good.axis, 3.0));
        assert_eq!((found.linear[0], found.linear[1], found.iterations), (good.constant, good.amplitude, 7));
        assert_eq!((found.cost, found.initial_cost, found.termination), (f64::from(0.2_f32), f64::from(0.4_f32), Termination::Converged));
        assert_eq!((found.carried[0], found.log_exponent_variance[0]), (5.0, 1e30));
        let broken: [fn(&mut Fitted); 12] = [
            |f| f.axis = [0.0; 3],
            |f| f.axis = [0.6, f32::NAN, 0.8],
            |f| f.axis = [0.6, 0.0, -0.8],
            |f| f.log_exponent = f32::NAN,
            |f| f.log_exponent = -0.1,
            |f| f.log_exponent = 7.0,
            |f| f.constant[1] = -1e-3,
            |f| f.amplitude[2] = f32::INFINITY,
            |f| f.cost = f32::NAN,
            |f| f.initial_cost = f32::INFINITY,
            |f| f.carried = f32::NAN,
            |f| f.log_exponent_variance = -1.0,
        ];
        for (i, breaks) in broken.iter().enumerate() {
            let mut fitted = good;
            breaks(&mut fitted);
            let error = candidate(&fitted).map(|found| found.shape).unwrap_err();
            assert!(matches!(&error, GpuError::Failed { reason } if reason.contains("no lobe")), "{i}: {error}");
        }
    }
}
