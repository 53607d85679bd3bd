//! Path tracer on `gazebo`: primary rays per second and core beside Embree 3.13 and beside obvhs' own traversals, and the time of
//! 128² cube maps and the noise in them. Figures go to docs/measurements.md.
//!
//! ```text
//! apt-get install libembree-dev
//! g++ -O3 -march=native docs/rivals/embree_primary.cpp -lembree3 -o target/embree_primary
//! cargo bench -p lumisphere --bench path_tracer
//! ```
//! `EMBREE_PRIMARY` names the rival's binary when it lies elsewhere. Without it the benchmark fails.

use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use glam::{Vec3, Vec3A};
use lumisphere::directions::CubeMap;
use lumisphere::geometry::Ray;
use lumisphere::progress::Unattended;
use lumisphere::raytrace::{TraceSettings, Tracer};
use lumisphere::scenes::{BuiltinOptions, Scene, builtin};
use obvhs::BvhBuildParams;
use obvhs::ray::RayHit;
use obvhs::triangle::Triangle;

const WIDTH: usize = 640;
const RUNS: usize = 9;

fn main() {
    let scene = builtin("gazebo", &BuiltinOptions::full()).expect("the built-in scene loads");
    let rays = primary_rays(&scene);
    let start = Instant::now();
    let tracer = Tracer::new(&scene).expect("the built-in scene can be traced");
    let corners = corners(&scene);
    println!("gazebo: {} triangles, tree built in {:.0} ms", corners.len(), 1e3 * start.elapsed().as_secs_f64());

    let ours = rays_per_second(rays.len(), || trace(&rays, |ray| tracer.intersect(ray, f32::INFINITY).map(|h| h.distance)));
    let (hits, distances) = trace(&rays, |ray| tracer.intersect(ray, f32::INFINITY).map(|h| h.distance));
    compare_with_obvhs(&corners, &rays, ours);
    let embree = run_embree(&corners, &rays);
    println!("primary rays/s/core  {:8.2} M  ours (nearest hit, normals, uv)", 1e-6 * ours);
    println!("                     {:8.2} M  Embree 3.13 rtcIntersect1; ours / Embree = {:.2}", 1e-6 * embree.single, ours / embree.single);
    println!(
        "                     {:8.2} M  Embree 3.13 rtcIntersect8; ours / Embree = {:.2}",
        1e-6 * embree.packets,
        ours / embree.packets
    );
    println!("hits {hits} / {}, mean distance {:.6} / {:.6}", embree.hits, distances / hits as f64, embree.distances / embree.hits as f64);
    // Rays through an edge may fall to either side: one in ten thousand.
    assert!(hits.abs_diff(embree.hits) <= rays.len() / 10_000, "ours and Embree do not see the same scene");

    cube_maps(&scene, &tracer);
}

/// 640 × 480 rays through the pixel centres of the scene's first camera.
fn primary_rays(scene: &Scene) -> Vec<Ray> {
    let pose = *scene.cameras[0].camera.pose();
    let intrinsics = lumisphere::geometry::Intrinsics::from_vfov(50.0, WIDTH as u32, 480).expect("a valid field of view");
    let camera = lumisphere::geometry::Camera::new(intrinsics, pose).expect("valid intrinsics");
    (0..480).flat_map(|j| (0..WIDTH as u32).map(move |i| (i, j))).map(|(i, j)| camera.pixel_ray(i, j)).collect()
}

fn corners(scene: &Scene) -> Vec<[Vec3; 3]> {
    scene.objects.iter().flat_map(|o| (0..o.mesh.triangles.len()).map(|t| o.mesh.corners(t))).collect()
}

/// How many rays hit, and the sum of their distances.
fn trace(rays: &[Ray], mut nearest: impl FnMut(&Ray) -> Option<f32>) -> (usize, f64) {
    rays.iter().filter_map(&mut nearest).fold((0, 0.0), |(hits, sum), t| (hits + 1, sum + f64::from(t)))
}

/// Time that this thread has spent on a processor, s: other work on the machine does not count. Wall clock where Linux does not tell.
fn processor_seconds() -> f64 {
    thread_local! {
        static START: Instant = Instant::now();
    }
    let on_processor = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanos = on_processor.and_then(|s| s.split_whitespace().next().and_then(|n| n.parse::<f64>().ok()));
    nanos.map_or_else(|| START.with(|s| s.elapsed().as_secs_f64()), |n| 1e-9 * n)
}

/// Median over the runs, after one to warm up.
fn rays_per_second<T>(count: usize, mut run: impl FnMut() -> T) -> f64 {
    black_box(run());
    let mut seconds: Vec<f64> = (0..RUNS)
        .map(|_| {
            let start = processor_seconds();
            black_box(run());
            processor_seconds() - start
        })
        .collect();
    seconds.sort_by(f64::total_cmp);
    count as f64 / seconds[RUNS / 2]
}

/// The traversals that obvhs brings: why the tracer has its own.
fn compare_with_obvhs(corners: &[[Vec3; 3]], rays: &[Ray], ours: f64) {
    let triangles: Vec<Triangle> = corners
        .iter()
        .map(|c| {
            let [v0, v1, v2] = c.map(Vec3A::from);
            Triangle { v0, v1, v2 }
        })
        .collect();
    let params = BvhBuildParams::slow_build();
    let wide = obvhs::cwbvh::builder::build_cwbvh_from_tris(&triangles, params, &mut Default::default());
    let binary = obvhs::bvh2::builder::build_bvh2_from_tris(&triangles, params, &mut Default::default());
    let in_order = |indices: &[u32]| indices.iter().map(|i| triangles[*i as usize]).collect::<Vec<_>>();
    let (of_wide, of_binary) = (in_order(&wide.primitive_indices), in_order(&binary.primitive_indices));
    let start = |ray: &Ray| obvhs::ray::Ray::new_inf(ray.origin.into(), ray.direction.into());
    let cwbvh = rays_per_second(rays.len(), || {
        trace(rays, |ray| {
            let mut hit = RayHit::none();
            wide.ray_traverse(start(ray), &mut hit, |r, id| of_wide[id].intersect(r)).then_some(hit.t)
        })
    });
    let bvh2 = rays_per_second(rays.len(), || {
        trace(rays, |ray| {
            let mut hit = RayHit::none();
            binary.ray_traverse(start(ray), &mut hit, |r, id| of_binary[id].intersect(r)).then_some(hit.t)
        })
    });
    println!("obvhs' traversals    {:8.2} M  CWBVH; ours / CWBVH = {:.2}", 1e-6 * cwbvh, ours / cwbvh);
    println!("                     {:8.2} M  BVH2; ours / BVH2 = {:.2}", 1e-6 * bvh2, ours / bvh2);
}

struct Embree {
    single: f64,
    packets: f64,
    hits: usize,
    distances: f64,
}

fn run_embree(corners: &[[Vec3; 3]], rays: &[Ray]) -> Embree {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let binary = std::env::var_os("EMBREE_PRIMARY").map_or_else(|| root.join("target/embree_primary"), PathBuf::from);
    assert!(binary.exists(), "no rival at {}: build it as the head of this file says", binary.display());
    let folder = tempfile::tempdir().expect("a temporary folder");
    let write = |name: &str, values: Vec<f32>| {
        let path = folder.path().join(name);
        std::fs::write(&path, values.iter().flat_map(|v| v.to_ne_bytes()).collect::<Vec<u8>>()).expect("room for the rays");
        path
    };
    let triangles = write("triangles", corners.iter().flatten().flat_map(|p| p.to_array()).collect());
    let rays = write("rays", rays.iter().flat_map(|r| [r.origin.to_array(), r.direction.to_array()].concat()).collect());
    let output = Command::new(&binary).args([triangles, rays]).arg(WIDTH.to_string()).output().expect("the rival runs");
    assert!(output.status.success(), "the rival failed: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let fields: Vec<f64> = text.split_whitespace().filter_map(|f| f.parse().ok()).collect();
    let [single, packets, hits, distances] = fields[..] else { panic!("the rival says {text:?}") };
    Embree { single, packets, hits: hits as usize, distances }
}

/// Six 128² faces at 16 paths a texel from beside the teapot, on two threads: time, and the noise that is left.
fn cube_maps(scene: &Scene, tracer: &Tracer) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads");
    let pot = &scene.objects[scene.object("teapot").expect("gazebo has a teapot")].mesh;
    let position = pot.positions[pot.triangles[pot.triangles.len() / 2][0] as usize] + 0.25 * Vec3::Y;
    for max_bounces in [1, 2] {
        let map = |seed| {
            let settings = TraceSettings { samples_per_pixel: 16, max_bounces, seed };
            let processor = || pool.broadcast(|_| processor_seconds()).iter().sum::<f64>();
            let (start, before) = (Instant::now(), processor());
            let map = pool.install(|| tracer.cube_map(position, 128, &settings, &Unattended)).expect("nobody cancels");
            (map, 1e3 * (processor() - before), 1e3 * start.elapsed().as_secs_f64())
        };
        let runs: Vec<_> = (0..RUNS as u64).map(map).collect();
        let sorted = |of: fn(&(CubeMap, f64, f64)) -> f64| {
            let mut values: Vec<f64> = runs.iter().map(of).collect();
            values.sort_by(f64::total_cmp);
            values
        };
        let (processor, wall) = (sorted(|r| r.1), sorted(|r| r.2));
        let maps: Vec<&CubeMap> = runs.iter().map(|r| &r.0).collect();
        let (noise, relative) = noise(&maps);
        println!(
            "cube map 128², 16 paths a texel, {max_bounces} bounces, 2 threads: processor median {:.0} ms, best {:.0} ms; wall median {:.0} ms, \
             best {:.0} ms; noise {noise:.5}, relative {relative:.4}, relative² · processor s {:.6}",
            processor[RUNS / 2],
            processor[0],
            wall[RUNS / 2],
            wall[0],
            relative * relative * 1e-3 * processor[RUNS / 2]
        );
    }
}

/// Standard deviation of a texel's luminance over maps that differ in the seed only, root mean square over the texels: in units of
/// radiance, and relative to the texel's mean (a hundredth of the map's mean is added, so that dark texels do not decide).
fn noise(maps: &[&CubeMap]) -> (f64, f64) {
    let (texels, count) = (maps[0].texels.len(), maps.len() as f64);
    let luminance = |t: [f32; 4]| 0.2126 * f64::from(t[0]) + 0.7152 * f64::from(t[1]) + 0.0722 * f64::from(t[2]);
    let moments = |i: usize| {
        let values: Vec<f64> = maps.iter().map(|m| luminance(m.texels[i])).collect();
        let mean = values.iter().sum::<f64>() / count;
        (mean, values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (count - 1.0))
    };
    let moments: Vec<(f64, f64)> = (0..texels).map(moments).collect();
    let floor = 0.01 * moments.iter().map(|m| m.0).sum::<f64>() / texels as f64;
    let root_mean = |of: &dyn Fn(&(f64, f64)) -> f64| (moments.iter().map(of).sum::<f64>() / texels as f64).sqrt();
    (root_mean(&|m| m.1), root_mean(&|m| m.1 / (m.0 + floor).powi(2)))
}
