//! Fits of lobes beside Ceres and SciPy: time per texel and residuals, on the same samples, one thread; the whole ladder; two threads
//! against one. Figures go to docs/measurements.md.
//!
//! ```text
//! apt-get install libceres-dev
//! g++ -O3 -march=native -I/usr/include/eigen3 docs/rivals/ceres_lobes.cpp -lceres -lglog -o target/ceres_lobes
//! python3 -m venv target/scipy && target/scipy/bin/pip install scipy==1.17.1 numpy
//! taskset -c 0 cargo bench -p lumisphere --no-default-features --bench fitting
//! cargo bench -p lumisphere --no-default-features --bench fitting -- threads
//! taskset -c 0 cargo bench -p lumisphere --no-default-features --bench fitting -- whole
//! cargo bench -p lumisphere --bench fitting -- gpu
//! ```
//! `CERES_LOBES` and `SCIPY_PYTHON` name the rivals when they lie elsewhere. A missing one fails the benchmark. Times are processor time,
//! medians of several runs; noise is .005 of full scale.

#[cfg(feature = "gpu")]
mod device;
mod maps;
mod rivals;
mod whole;

use std::path::Path;
use std::time::Instant;

use lumisphere::fitting::{Choice, Fit, Noise, Outcome, Precision, Rung, Settings, Starts, fit};

use self::maps::Map;

const RUNS: usize = 7;
/// Processor time of one run.
const LEAST_SECONDS: f64 = 0.2;

fn main() {
    let parts: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with("--")).collect();
    let wants = |part: &str| parts.is_empty() || parts.iter().any(|wanted| wanted == part);
    let folder = maps::folder();
    if wants("one") {
        for (views, bound) in [(17, 40.0), (73, 30.0), (289, 20.0)] {
            rivals_of(&folder, &Map::one_light(views), 1, bound);
        }
    }
    if wants("two") {
        for second in [450.0, -450.0, -1500.0] {
            rivals_of(&folder, &Map::two_lights(second), 2, 10.0);
        }
    }
    if wants("ladder") {
        ladder(&folder);
    }
    if wants("threads") {
        threads();
    }
    if wants("whole") {
        whole::report(&folder);
    }
    // Where there is an adapter.
    #[cfg(feature = "gpu")]
    if parts.iter().any(|part| part == "gpu") {
        device::report();
    }
}

fn settings(choice: Choice) -> Settings {
    Settings::new(choice, Noise { floor: 3e-4, relative: 0.0 })
}

/// Processor time of this thread.
fn cpu_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").expect("Linux tells a thread's CPU time");
    let nanos = text.split(' ').next().and_then(|n| n.parse::<u64>().ok()).expect("its first number is nanoseconds");
    1e-9 * nanos as f64
}

fn pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads")
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Microseconds per texel on one thread, and the fits.
fn measured(map: &Map, settings: &Settings) -> (f64, Vec<Fit>) {
    let batch = map.batch();
    pool(1).install(|| {
        let mut fits = Vec::new();
        // The system counts processor time in ticks of some milliseconds: a run has many of them.
        let run = |_| {
            let (begin, mut texels) = (cpu_seconds(), 0);
            while cpu_seconds() - begin < LEAST_SECONDS {
                fits = fit(&batch, settings).expect("sound settings");
                texels += batch.texels();
            }
            1e6 * (cpu_seconds() - begin) / texels as f64
        };
        let times = (0..RUNS).map(run).collect();
        (median(times), fits.iter().filter_map(Outcome::fit).cloned().collect())
    })
}

fn rms(fits: &[Fit]) -> f64 {
    (fits.iter().map(|fit| f64::from(fit.rms_residual).powi(2)).sum::<f64>() / fits.len() as f64).sqrt()
}

fn verdict(met: bool) -> &'static str {
    if met { "met" } else { "MISSED" }
}

fn rivals_of(folder: &Path, map: &Map, lobes: usize, bound: f64) {
    println!("\n{}, {} views, {lobes} lobes", map.name, map.views());
    let path = map.write(folder);
    let ceres = rivals::ceres(&path, map, lobes);
    let scipy = rivals::scipy(&path, map, lobes);
    let exactly = settings(Choice::Exactly(Rung::Lobes(lobes)));
    let one_start = Settings { starts: Starts::Exactly(1), ..exactly };
    let rows = [
        ("one start", one_start),
        ("as many starts as needed", exactly),
        ("polished", Settings { precision: Precision::Polished, ..exactly }),
    ];
    for (name, settings) in rows {
        let (us, fits) = measured(map, &settings);
        println!("  ours, {name}: {us:.2} us/texel, rms {:.7}", rms(&fits));
        for (rival, values) in [("ceres", &ceres), ("scipy", &scipy)] {
            for kind in ["analytic", "automatic", "two_point"] {
                let Some(theirs) = values.get(&format!("{kind}_us")) else { continue };
                println!(
                    "    {rival} {kind}: {theirs:.1} us/texel, rms {:.7}: {:.1} times ours",
                    values[&format!("{kind}_rms")],
                    theirs / us
                );
            }
        }
        let speed = ceres["analytic_us"] / us;
        let residual = rms(&fits) <= 1.001 * ceres["analytic_rms"] + 2e-6;
        println!("    at least {bound} times Ceres: {}; residual within 1.001 of it: {}", verdict(speed >= bound), verdict(residual));
    }
}

fn ladder(folder: &Path) {
    for map in [Map::mixed(), Map::one_light(289), Map::diffuse()] {
        let ceres = rivals::ceres(&map.write(folder), &map, 1);
        let (us, fits) = measured(&map, &settings(Choice::Auto { lobes_at_most: 3 }));
        let ratio = us / ceres["analytic_us"];
        println!("\nladder, {}, {} views: {us:.1} us/texel, rms {:.6}", map.name, map.views(), rms(&fits));
        println!("  one lobe by Ceres: {:.1} us; {ratio:.2} of it, at most 1: {}", ceres["analytic_us"], verdict(ratio <= 1.0));
    }
}

/// Wall time: to be run where two cores are free.
fn threads() {
    let map = Map::mixed();
    let batch = map.batch();
    let wall = |threads: usize| {
        let run = |_| {
            let begin = Instant::now();
            let outcomes = pool(threads).install(|| fit(&batch, &settings(Choice::Auto { lobes_at_most: 3 })));
            assert_eq!(outcomes.expect("sound settings").len(), batch.texels());
            begin.elapsed().as_secs_f64()
        };
        median((0..RUNS).map(run).collect())
    };
    let speed = wall(1) / wall(2);
    println!("\ntwo threads against one, ladder: {speed:.2} times, at least 1.85: {}", verdict(speed >= 1.85));
}
