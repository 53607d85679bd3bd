//! Which dataset is shown and with what settings: as flags say, or as the row of a sweep that `--choose` picks.

use clap::Args;
use lumisphere_proto::v1alpha1 as wire;

use crate::choose_flags::ChooseFlags;
use crate::context::Context;

/// Flags of a command that shows one dataset; the command's arguments need `alone_or_chosen`, too.
#[derive(Debug, Clone, Args)]
pub struct TargetFlags {
    /// Dataset to render
    #[arg(long, value_name = "NAME", required_unless_present = "choose", conflicts_with = "choose")]
    pub dataset: Option<String>,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true, conflicts_with = "choose")]
    pub version: u64,
    #[command(flatten)]
    pub choose: ChooseFlags,
}

/// What a chosen row says is not said by flags, too.
pub fn alone_or_chosen(argument: clap::Arg) -> clap::Arg {
    let of_row = [
        ["component", "blend", "specular", "filter", "backend"].as_slice(),
        &[
            "brdf",
            "integration",
            "directions",
            "passes",
            "integration_order",
            "reflections",
            "environment_turn_deg",
            "point_light",
            "refraction_index",
            "body",
        ],
        &["truth", "truth_paths", "truth_passes"],
    ]
    .concat();
    let is_of_row = of_row.contains(&argument.get_id().as_str());
    if is_of_row { argument.conflicts_with("choose") } else { argument }
}

/// What is rendered, and how.
pub struct Target {
    /// Its name.
    pub dataset: String,
    /// 0: the latest.
    pub version: u64,
    /// As the dataset's kind shows by default where flags do not say.
    pub settings: Option<wire::RenderSettings>,
}

impl TargetFlags {
    /// Reads the sweep where there is one.
    pub fn target(&self, context: &Context) -> anyhow::Result<Target> {
        let Some(chosen) = self.choose.chosen()? else {
            return Ok(Target { dataset: self.dataset.clone().unwrap_or_default(), version: self.version, settings: None });
        };
        context.output.say(&format!("chosen: {} of dataset {}", chosen.label, chosen.row.dataset));
        let settings = Some(chosen.settings()?);
        Ok(Target { dataset: chosen.row.dataset, version: chosen.row.version, settings })
    }
}
