//! The place in the ladder of models that are not lobes: tried last, accepted only where they win clearly.

use super::Model;
use super::ladder::Climb;
use super::tile::Tile;

/// By how much a further rung's criterion must be better.
const CLEARLY: f64 = 10.0;
/// Fewest parameters that a further rung may have: four functions, three channels.
const FEWEST_PARAMETERS: f64 = 12.0;

/// The samples of one texel that weigh anything.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Samples {
    /// Unit, z ≥ 0.
    pub directions: Vec<[f32; 3]>,
    /// In the unit that they came in.
    pub values: Vec<[f32; 3]>,
    /// Of each channel, at most one.
    pub weights: Vec<[f32; 3]>,
}

/// What a further rung made of them.
#[derive(Debug, Clone, PartialEq)]
pub struct Further {
    /// The model.
    pub model: Model,
    /// Weighted sum of squared residuals.
    pub cost: f64,
    /// Parameters that it really uses, in all channels (the trace of its hat matrices).
    pub parameters: f64,
}

/// A model beyond the lobes.
pub trait FurtherRung: Sync {
    /// Fits it to one texel; `None` where it cannot be.
    fn fit(&self, samples: &Samples) -> Option<Further>;
}

/// What `rung` makes of a texel, and the margin by which it wins, if it wins clearly.
pub fn better(tile: &Tile, climb: &Climb, rung: &dyn FurtherRung) -> Option<(Further, f64)> {
    let could_win = climb.criterion.value(0.0, FEWEST_PARAMETERS) < climb.value - CLEARLY;
    let further = could_win.then(|| rung.fit(&samples(tile, climb.texel))).flatten()?;
    let scale = f64::from(tile.texels()[climb.texel].scale);
    let value = climb.criterion.value(further.cost / (scale * scale), further.parameters);
    (value < climb.value - CLEARLY).then_some((further, climb.value - value))
}

fn samples(tile: &Tile, texel: usize) -> Samples {
    let (group, lane) = tile.place(texel);
    let scale = tile.texels()[texel].scale;
    let mut samples = Samples::default();
    for sample in group {
        let weight = sample.root_weight.map(|row| row[lane] * row[lane]);
        if weight.iter().any(|&w| w > 0.0) {
            samples.directions.push(sample.direction.map(|row| row[lane]));
            samples.values.push(sample.value.map(|row| row[lane] * scale));
            samples.weights.push(weight);
        }
    }
    samples
}
