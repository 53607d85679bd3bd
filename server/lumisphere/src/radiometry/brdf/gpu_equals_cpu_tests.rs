//! The WGSL twin against the models, element by element.

use std::f32::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use crate::gpu::layout_check::{assert_same_layout, validated};
use crate::gpu::{Gpu, ReadBack, Shader, binding, storage_buffer, test_gpu, value_buffer};
use crate::images::{Tolerance, count_beyond};

/// `brdf.wgsl` with a kernel that asks it everything about a pair of directions and a pair of numbers.
pub(crate) const SOURCE: &str = concat!(
    include_str!("../../geometry/tangent_frame.wgsl"),
    include_str!("brdf.wgsl"),
    "
struct Question { wo: vec3<f32>, u: f32, wi: vec3<f32>, v: f32 }
struct Reply { value: vec3<f32>, pdf: f32, drawn: vec3<f32>, drawn_pdf: f32 }
@group(0) @binding(0) var<storage, read> brdf: BrdfUniform;
@group(0) @binding(1) var<storage, read> questions: array<Question>;
@group(0) @binding(2) var<storage, read_write> replies: array<Reply>;
@group(0) @binding(3) var<storage, read> measured: array<vec4<f32>>;
fn measured_texel(at: u32) -> vec4<f32> { return measured[at]; }
@compute @workgroup_size(64)
fn ask(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= arrayLength(&questions) { return; }
    let q = questions[id.x];
    let drawn = brdf_sample(brdf, q.wo, vec2(q.u, q.v));
    replies[id.x] = Reply(brdf_eval(brdf, q.wo, q.wi), brdf_pdf(brdf, q.wo, q.wi), drawn.wi, drawn.pdf);
}
"
);

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Question {
    wo: Vec3,
    u: f32,
    wi: Vec3,
    v: f32,
}

#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Reply {
    value: Vec3,
    pdf: f32,
    drawn: Vec3,
    drawn_pdf: f32,
}

fn ask(gpu: &Arc<Gpu>, brdf: &BrdfModel, questions: &[Question]) -> Vec<Reply> {
    let (number, numbers, table) = match brdf {
        BrdfModel::Analytic(brdf) => (brdf.number(), brdf.uniform(), vec![[0.0; 4]]),
        BrdfModel::Measured(table) => (Measured::NUMBER, table.uniform(), table.texels().collect()),
    };
    let bytes = size_of_val(questions) as u64;
    let shader = Shader::new(
        gpu,
        "brdf",
        SOURCE,
        &[&[binding::read_buffer(0), binding::read_buffer(1), binding::write_buffer(2), binding::read_buffer(3)]],
    );
    let pipeline = shader.compute_pipeline(gpu, "ask", &[("BRDF_MODEL", f64::from(number))]);
    let uniform = value_buffer::<BrdfUniform>(gpu, "brdf");
    gpu.queue().write_buffer(&uniform, 0, bytemuck::bytes_of(&numbers));
    let asked = storage_buffer(gpu, "questions", questions, wgpu::BufferUsages::empty());
    let replies = storage_buffer(gpu, "replies", &vec![0u8; bytes as usize], wgpu::BufferUsages::COPY_SRC);
    let table = storage_buffer(gpu, "table", &table, wgpu::BufferUsages::empty());
    let group = shader.bind(gpu, 0, &[&uniform, &asked, &replies, &table].map(wgpu::Buffer::as_entire_binding));
    let back = ReadBack::new(gpu, "replies", bytes);
    let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(questions.len().div_ceil(64) as u32, 1, 1);
    }
    encoder.copy_buffer_to_buffer(&replies, 0, back.buffer(), 0, bytes);
    gpu.queue().submit([encoder.finish()]);
    back.request(0..bytes).finish(gpu, bytemuck::pod_collect_to_vec).unwrap()
}

/// Directions that the model reflects to, any others, and the horizon.
fn questions(brdf: &impl Brdf) -> Vec<Question> {
    let mut random = Pcg32::seed_from_u64(12);
    let direction = |theta: f32, phi: f32| Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
    (0..4096)
        .map(|k| {
            let wo = direction(random.random::<f32>() * if k % 16 == 0 { 1.7 } else { FRAC_PI_2 - 0.02 }, random.random::<f32>() * TAU);
            let any = direction(random.random::<f32>() * 1.7, random.random::<f32>() * TAU);
            let (u, v) = (random.random(), random.random());
            let drawn = brdf.sample(wo, Vec2::new(random.random(), random.random()));
            let wi = if k % 4 == 0 { any } else { drawn.map_or(any, |(wi, _)| wi) };
            Question { wo, u, wi, v }
        })
        .collect()
}

fn models() -> Vec<(AnalyticBrdf, Width)> {
    let grey = Vec3::new(0.5, 0.3, 0.1);
    let lobe = |reflectance, direction, exponent| LafortuneLobe { reflectance: Vec3::splat(reflectance), direction, exponent };
    let lobes = [lobe(0.3, Vec3::new(-1.0, -0.9, 0.7), 20.0), lobe(0.2, Vec3::ONE, 5.0), lobe(0.1, Vec3::new(-1.0, -1.0, 1.0), 1e3)];
    let broad: Vec<AnalyticBrdf> = vec![
        Lambert::new(grey).unwrap().into(),
        Phong::new(grey, Vec3::splat(0.4), 50.0).unwrap().into(),
        AshikhminShirley::new(grey, Vec3::splat(0.2), Vec2::new(10.0, 100.0)).unwrap().into(),
        CookTorrance::new(Vec2::new(0.3, 0.6), grey, Vec3::ONE).unwrap().into(),
        Ward::new(grey, Vec3::splat(0.4), Vec2::new(0.2, 0.3)).unwrap().into(),
        Lafortune::new(Vec3::splat(0.2), &lobes[..2]).unwrap().into(),
    ];
    let narrow: Vec<AnalyticBrdf> = vec![
        Phong::new(Vec3::ZERO, Vec3::ONE, 1e5).unwrap().into(),
        AshikhminShirley::new(grey, Vec3::splat(0.8), Vec2::new(1000.0, 1e5)).unwrap().into(),
        CookTorrance::new(Vec2::new(0.01, 1.0), grey, grey).unwrap().into(),
        Ward::new(Vec3::ZERO, Vec3::ONE, Vec2::new(1e-3, 1.0)).unwrap().into(),
        Lafortune::new(Vec3::ZERO, &lobes).unwrap().into(),
    ];
    let of = |models: Vec<AnalyticBrdf>, width| models.into_iter().map(move |brdf| (brdf, width));
    of(broad, Width::Broad).chain(of(narrow, Width::Narrow)).collect()
}

/// Of a model's narrowest lobe.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Width {
    Broad,
    Narrow,
}

fn agree(what: &str, reference: impl Iterator<Item = f32>, actual: impl Iterator<Item = f32>, known: usize) {
    let (reference, actual): (Vec<f32>, Vec<f32>) = (reference.collect(), actual.collect());
    let report = count_beyond(&reference, &actual, &Tolerance::F32_ARITHMETIC).unwrap();
    assert!(report.beyond <= known, "{what}: {report:?}");
}

// A facet that `wo` sees edge-on is the sum of two nearly opposite vectors, whose direction has lost digits: 2 of 12288 components.
const EDGE_ON: usize = 12;

#[test]
fn every_model_gives_the_same_values_densities_and_directions() {
    let Some(gpu) = test_gpu() else { return };
    for (brdf, width) in models() {
        let questions = questions(&brdf);
        let replies = ask(&gpu, &brdf.into(), &questions);
        let both = || questions.iter().zip(&replies);
        let values = both().flat_map(|(q, _)| brdf.eval(q.wo, q.wi).to_array());
        agree(&format!("value of {brdf:?}"), values, replies.iter().flat_map(|r| r.value.to_array()), 0);
        let pdfs = both().map(|(q, _)| brdf.pdf(q.wo, q.wi));
        agree(&format!("pdf of {brdf:?}"), pdfs, replies.iter().map(|r| r.pdf), 0);
        // Which directions are drawn at all.
        let drawn = both().map(|(_, r)| if r.drawn_pdf > 0.0 { r.drawn } else { Vec3::ZERO });
        let expected = both().map(|(q, _)| brdf.sample(q.wo, Vec2::new(q.u, q.v)).map_or(Vec3::ZERO, |(wi, _)| wi));
        let flat = |directions: Vec<Vec3>| directions.into_iter().flat_map(|d| d.to_array());
        agree(&format!("draws of {brdf:?}"), flat(expected.collect()), flat(drawn.collect()), EDGE_ON);
        // The density at the device's own direction, which may differ in its last digits. A device may take the half vector from before the
        // direction was rounded (wo + (x − wo) is x to it): in a narrow lobe that is another density.
        if width == Width::Broad {
            let pdfs = both().map(|(q, r)| if r.drawn_pdf > 0.0 { brdf.pdf(q.wo, r.drawn) } else { 0.0 });
            agree(&format!("pdf of draws of {brdf:?}"), pdfs, replies.iter().map(|r| r.drawn_pdf), 0);
        }
        assert!(replies.iter().filter(|r| r.drawn_pdf > 0.0).count() > 1000, "{brdf:?}: nothing is compared");
    }
}

// Where rounding decides the cell: of directions drawn from a highlight of a quarter's cells some hundred per mille lie so near an edge.
const AT_EDGES: usize = 60;

#[test]
fn a_table_gives_the_same_values_densities_and_directions() {
    let Some(gpu) = test_gpu() else { return };
    let original = Ward::new(Vec3::new(0.3, 0.2, 0.1), Vec3::new(0.5, 0.6, 0.4), Vec2::splat(0.1)).unwrap();
    let brdf = tests::measured(&original.into());
    let questions = questions(&brdf);
    let replies = ask(&gpu, &brdf, &questions);
    let both = || questions.iter().zip(&replies);
    let values = both().flat_map(|(q, _)| brdf.eval(q.wo, q.wi).to_array());
    agree("value", values, replies.iter().flat_map(|r| r.value.to_array()), AT_EDGES);
    agree("pdf", both().map(|(q, _)| brdf.pdf(q.wo, q.wi)), replies.iter().map(|r| r.pdf), AT_EDGES);
    let expected = both().flat_map(|(q, _)| brdf.sample(q.wo, Vec2::new(q.u, q.v)).map_or(Vec3::ZERO, |(wi, _)| wi).to_array());
    let drawn = both().flat_map(|(_, r)| if r.drawn_pdf > 0.0 { r.drawn } else { Vec3::ZERO }.to_array());
    agree("draws", expected, drawn, EDGE_ON);
    assert!(replies.iter().filter(|r| r.drawn_pdf > 0.0).count() > 1000, "nothing is compared");
    // The comparison notices the neighbouring table.
    let other = tests::measured(&Ward::new(Vec3::splat(0.3), Vec3::splat(0.5), Vec2::splat(0.1)).unwrap().into());
    let (a, b): (Vec<f32>, Vec<f32>) =
        both().map(|(q, r)| (other.eval(q.wo, q.wi).y, r.value.y)).filter(|(a, b)| *a > 0.0 || *b > 0.0).unzip();
    assert!(count_beyond(&a, &b, &Tolerance::F32_ARITHMETIC).unwrap().beyond > 1000);
}

#[test]
fn the_uniform_lies_in_memory_as_the_shader_reads_it() {
    validated(SOURCE);
    assert_same_layout!(SOURCE, "LobeUniform", LobeUniform { reflectance, exponent, direction, share });
    assert_same_layout!(
        SOURCE,
        "BrdfUniform",
        BrdfUniform { diffuse, exponent, specular, specular_share, f90, model, across, highlight, first, second, third }
    );
}
