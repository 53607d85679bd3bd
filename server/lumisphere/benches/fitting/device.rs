//! Fits whose single lobes a graphics device fits, beside the processor's, in turns: wall time with all threads, and how many texels differ.

use std::sync::Arc;
use std::time::Instant;

use lumisphere::fitting::{Choice, LobeKernel, Model, Outcome, Rung, Settings, fit, fit_on};
use lumisphere::gpu::Gpu;

use crate::maps::Map;
use crate::{RUNS, median, settings};

/// Both, on each of three maps, for the models of one lobe and those that are chosen.
pub fn report() {
    let gpu = Arc::new(Gpu::new().expect("a graphics adapter"));
    println!("\non {} ({}) beside {} threads of the processor, wall time", gpu.adapter(), gpu.driver(), rayon::current_num_threads());
    let kernel = LobeKernel::new(gpu).expect("a device");
    for map in [Map::one_light(73), Map::one_light(289), Map::mixed()] {
        let choices = [("one lobe", Choice::Exactly(Rung::Lobes(1))), ("ladder", Choice::Auto { lobes_at_most: 3 })];
        for (name, choice) in choices {
            compare(&kernel, &map, name, &settings(choice));
        }
    }
}

fn compare(kernel: &LobeKernel, map: &Map, name: &str, settings: &Settings) {
    let batch = map.batch();
    let on_processor = || fit(&batch, settings).expect("sound settings");
    let on_device = || fit_on(kernel, &batch, settings, None).expect("a device that works");
    let timed = |run: &dyn Fn() -> Vec<Outcome>| {
        let begin = Instant::now();
        let outcomes = run();
        (1e6 * begin.elapsed().as_secs_f64() / batch.texels() as f64, outcomes)
    };
    // The first of each warms pipelines and memory.
    let (expected, found) = (on_processor(), on_device());
    let (mut processor, mut device) = (Vec::new(), Vec::new());
    for _ in 0..RUNS {
        processor.push(timed(&on_processor).0);
        device.push(timed(&on_device).0);
    }
    let (processor, device) = (median(processor), median(device));
    let is_other = |(a, b): &(&Outcome, &Outcome)| kind(a) != kind(b);
    let others = found.iter().zip(&expected).filter(is_other).count();
    println!(
        "  {}, {} views, {name}: {processor:.1} us/texel on the processor, {device:.1} with the device: {:.2} times as fast; {others} of {} texels \
         with another model or flag",
        map.name,
        map.views(),
        processor / device,
        found.len()
    );
}

fn kind(outcome: &Outcome) -> Option<(usize, u8)> {
    outcome.fit().map(|fit| (if matches!(fit.model, Model::CosinePower { .. }) { 1 } else { fit.model.floats() }, fit.flags.bits()))
}
