//! A setting chosen from what a sweep measured: the flags of it, and the chosen row.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use lumisphere::evaluate::{Bounds, ChooseError, Group, Metric, Sweep, SweepRow, choose};
use lumisphere_proto::v1alpha1 as wire;
use wire::capture_spec::Density;

use crate::byte_sizes::parse_bytes;
use crate::exit::Failure;
use crate::render_settings::{Backend, Blend, Component, Filter};
use crate::sweep_file::AskedLooks;

/// What is asked of a setting.
#[derive(Debug, Clone, Args)]
pub struct BoundFlags {
    /// At most this error: the fastest setting that keeps it is chosen
    #[arg(long, value_name = "ERROR")]
    pub max_error: Option<f64>,
    /// Which error: delta-e, delta-e-p95, flip, one-minus-ssim, rmse-rgb, rmse-l, rmse-lab or max-abs
    #[arg(long, value_name = "METRIC", default_value_t = Metric::DeltaE)]
    pub metric: Metric,
    /// At most this median time of a frame: without --max-error, the setting of the least error is chosen
    #[arg(long, value_name = "MILLISECONDS")]
    pub max_millis: Option<f64>,
    /// At most so many bytes of the dataset on disk, such as 200MB or 64MiB
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes)]
    pub max_bytes: Option<u64>,
    /// Where a sweep has rows that do not compare (terms, truths, objects): those whose group's name contains this
    #[arg(long, value_name = "TEXT")]
    pub group: Option<String>,
}

/// The flags of a command that takes what a sweep says.
#[derive(Debug, Clone, Args)]
pub struct ChooseFlags {
    /// Take dataset and settings (a capture: sample points and face size) from a sweep's row that keeps --max-error, --max-millis and --max-bytes
    #[arg(long, value_name = "SWEEP.JSON")]
    pub choose: Option<PathBuf>,
    #[command(flatten)]
    pub bounds: BoundFlags,
}

/// A row, and what it is called.
#[derive(Debug)]
pub struct Chosen {
    /// The row.
    pub row: SweepRow,
    /// Of the row, among the sweep's.
    pub label: String,
    /// What it was compared within.
    pub group: String,
    /// C_s of the sweep.
    pub specular: [f32; 3],
}

impl Chosen {
    /// What the row was rendered with.
    pub fn settings(&self) -> Result<wire::RenderSettings, Failure> {
        let row = &self.row;
        // The names of reports, as flags write them.
        let flag = |name: &str| name.replace('_', "-");
        let unknown =
            |what: &str, name: &str| Failure::Usage(format!("the chosen row has {what} {name:?}, which this client does not know"));
        let component = Component::from_str(&flag(&row.component), false).map_err(|_| unknown("component", &row.component))?;
        let blend = match (&row.blend, row.exponent) {
            // Ignored where nothing is reflected.
            (None, _) => "distance".to_string(),
            (Some(name), None) => flag(name),
            (Some(name), Some(n)) => format!("{}:{n}", flag(name)),
        };
        let blend = blend.parse::<Blend>().map_err(|_| unknown("blend", &blend))?;
        let filter = row.filter.as_deref().unwrap_or("footprint");
        let filter = Filter::from_str(&flag(filter), false).map_err(|_| unknown("filter", filter))?;
        let backend = Backend::from_str(&row.asked_backend, false).map_err(|_| unknown("backend", &row.asked_backend))?;
        let looks = row.more.get("asked_looks").map_or(Ok(AskedLooks::default()), |asked| serde_json::from_value(asked.clone()));
        let looks = looks.map_err(|_| unknown("looks", &row.more["asked_looks"].to_string()))?;
        Ok(looks.settings(component, blend, self.specular, filter, backend))
    }

    /// How the sample points of the row's dataset were placed, and its face size.
    pub fn density(&self) -> Result<(Density, u32), Failure> {
        let parameters = &self.row.parameters;
        let points = parameters["spacing"]["count"].as_u64().and_then(|n| u32::try_from(n).ok()).map(Density::SamplePoints);
        let distance = parameters["spacing"]["distance"].as_f64().map(|d| Density::Spacing(d as f32));
        let face = parameters["face_size_texels"].as_u64().and_then(|n| u32::try_from(n).ok());
        let missing = || Failure::Precondition(format!("dataset {} does not tell its sample points and face size", self.row.dataset));
        points.or(distance).zip(face).ok_or_else(missing)
    }
}

impl ChooseFlags {
    /// The chosen row, where one is to be chosen. Bounds without a sweep are a mistake.
    pub fn chosen(&self) -> anyhow::Result<Option<Chosen>> {
        let Some(path) = &self.choose else {
            let b = &self.bounds;
            let is_bounded = b.max_error.is_some() || b.max_millis.is_some() || b.max_bytes.is_some() || b.group.is_some();
            let problem = "--max-error, --max-millis, --max-bytes and --group choose from a sweep: --choose SWEEP.JSON is missing";
            return if is_bounded { Err(Failure::Usage(problem.into()).into()) } else { Ok(None) };
        };
        self.bounds.choose_from(path).map(Some)
    }
}

impl BoundFlags {
    /// Reads the sweep and chooses.
    pub fn choose_from(&self, path: &Path) -> anyhow::Result<Chosen> {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let sweep = Sweep::from_json(&text).map_err(|e| Failure::Usage(format!("{}: {e}", path.display())))?;
        self.check()?;
        let group = self.group_of(&sweep)?;
        let bounds = Bounds { metric: self.metric, max_error: self.max_error, max_millis: self.max_millis, max_bytes: self.max_bytes };
        let row = choose(&sweep, &group, &bounds).map_err(|e| match e {
            ChooseError::NoBound => Failure::Usage("--max-error, --max-millis or --max-bytes expected".into()),
            ChooseError::NotMeasured(_) | ChooseError::Unmet { .. } => Failure::Precondition(e.to_string()),
        })?;
        let label = sweep.labels().swap_remove(row);
        let specular = sweep.conditions.specular_reflectance;
        Ok(Chosen { row: sweep.rows[row].clone(), label, group: group.name(), specular })
    }

    fn check(&self) -> Result<(), Failure> {
        for (flag, bound) in [("max-error", self.max_error), ("max-millis", self.max_millis)] {
            if bound.is_some_and(|b| !(b >= 0.0 && b.is_finite())) {
                return Err(Failure::Usage(format!("--{flag} is {}, a finite number from 0 expected", bound.unwrap_or_default())));
            }
        }
        Ok(())
    }

    fn group_of(&self, sweep: &Sweep) -> Result<Group, Failure> {
        let groups = sweep.groups();
        let wanted = self.group.as_deref().unwrap_or_default();
        let mut matching: Vec<&Group> = groups.iter().filter(|g| g.name().contains(wanted)).collect();
        match (matching.len(), matching.pop()) {
            (1, Some(group)) => Ok(group.clone()),
            (0, _) => Err(Failure::Usage(format!("--group {wanted:?}: no group's name contains it; there are {}", names(&groups)))),
            _ => Err(Failure::Usage(format!("the sweep has several groups of rows: {}; --group must name one", names(&groups)))),
        }
    }
}

fn names(groups: &[Group]) -> String {
    groups.iter().map(|g| format!("{:?}", g.name())).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_without_a_sweep_are_a_mistake() {
        let bounds = BoundFlags { max_error: Some(1.0), metric: Metric::DeltaE, max_millis: None, max_bytes: None, group: None };
        let flags = |max_error| ChooseFlags { choose: None, bounds: BoundFlags { max_error, ..bounds.clone() } };
        assert_eq!(crate::exit::code(&flags(Some(1.0)).chosen().unwrap_err()), 2);
        assert!(flags(None).chosen().unwrap().is_none());
    }
}
