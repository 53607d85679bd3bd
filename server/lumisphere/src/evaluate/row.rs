//! What is measured of one setting: gathered view by view, then told in a row a truth.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::{Rendered, Truth};
use crate::images::Comparison;
use crate::representations::SettingName;

/// One setting against one truth, over all views.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Which of the plan's settings.
    pub setting_index: usize,
    /// What was shown and how: component, blend, exponent, light.
    #[serde(flatten)]
    pub setting: SettingName,
    /// What computed it: `gpu`, `cpu`, or `cpu+gpu` where the CPU stood in for some frames.
    pub backend: String,
    /// What it was compared with.
    pub truth: Truth,
    /// How many views.
    pub views: usize,
    /// Over the object's pixels of all views; FLIP, SSIM, PSNR and percentiles are means of the views' own, weighted by pixels.
    #[serde(flatten)]
    pub error: Comparison,
    /// Median time of a frame.
    pub millis_per_frame: f64,
    /// The time that 95 % of the frames do not exceed.
    pub millis_per_frame_p95: f64,
    /// How many frames the two are of.
    pub timed_frames: usize,
    /// The most that was held on the device for the dataset while these frames were made: geometry, sample maps, and the pages that they and the
    /// settings before them brought. None on the CPU.
    pub gpu_bytes: Option<u64>,
    /// Names of the first view's pictures.
    pub pictures: PictureNames,
}

/// Names of a view's pictures, without ending: `view-00-mirror-reflection-4-one_reflection-error` and the like. Unique within an evaluation,
/// but for what settings share.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PictureNames {
    /// What is true; shared by all settings of one component, glossy ones, those in other light and those with a normal map aside.
    pub truth: String,
    /// What was rendered.
    pub frame: String,
    /// Their absolute difference.
    pub error: String,
}

impl PictureNames {
    /// `slug` names the setting among those of the evaluation.
    pub(super) fn new(view: usize, setting: &SettingName, slug: &str, truth: Truth) -> Self {
        // What is true of a BRDF, in other light, or of turned normals, is so of one setting.
        let is_its_own = matches!(truth, Truth::OneGlossyReflection | Truth::OneRefraction | Truth::SeveralReflections)
            || setting.light.is_some()
            || setting.normal_map.is_some();
        let of = if is_its_own { slug } else { setting.component };
        let truth = truth.name();
        Self {
            truth: format!("view-{view:02}-{of}-{truth}-truth"),
            frame: format!("view-{view:02}-{slug}-frame"),
            error: format!("view-{view:02}-{slug}-{truth}-error"),
        }
    }
}

/// What was measured of one setting so far.
pub(super) struct Total {
    millis: Vec<f64>,
    backends: BTreeSet<&'static str>,
    gpu_bytes: Option<u64>,
    views: Vec<(Truth, Vec<Comparison>)>,
}

impl Total {
    pub(super) fn new(truths: Vec<Truth>) -> Self {
        let views = truths.into_iter().map(|truth| (truth, Vec::new())).collect();
        Self { millis: Vec::new(), backends: BTreeSet::new(), gpu_bytes: None, views }
    }

    pub(super) fn add_frame(&mut self, frame: &Rendered) {
        self.millis.push(frame.millis);
        self.backends.insert(frame.backend.name());
        self.gpu_bytes = self.gpu_bytes.max(frame.device_bytes);
    }

    /// `truth` is one that it was made with.
    pub(super) fn add(&mut self, truth: Truth, comparison: Comparison) {
        let of_truth = self.views.iter_mut().filter(|(t, _)| *t == truth).take(1);
        of_truth.for_each(|(_, views)| views.push(comparison.clone()));
    }

    /// A row a truth; at least one frame and one view were added.
    pub(super) fn rows(mut self, setting_index: usize, setting: SettingName, slug: &str) -> Vec<Row> {
        self.millis.sort_by(f64::total_cmp);
        let backend = self.backends.iter().copied().collect::<Vec<_>>().join("+");
        let row = |(truth, views): (Truth, Vec<Comparison>)| Row {
            setting_index,
            pictures: PictureNames::new(0, &setting, slug, truth),
            setting: setting.clone(),
            backend: backend.clone(),
            truth,
            views: views.len(),
            error: over_views(&views),
            millis_per_frame: quantile(&self.millis, 0.5),
            millis_per_frame_p95: quantile(&self.millis, 0.95),
            timed_frames: self.millis.len(),
            gpu_bytes: self.gpu_bytes,
        };
        self.views.into_iter().map(row).collect()
    }
}

// The least value that a share of the sorted values do not exceed (nearest rank); `sorted` has at least one.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted[rank.clamp(1, sorted.len()) - 1]
}

// One comparison for several, each weighted by its pixels. Root mean squares are exact; the others are means of the views' own.
fn over_views(views: &[Comparison]) -> Comparison {
    let pixels: usize = views.iter().map(|c| c.pixels).sum();
    let mean = |value: &dyn Fn(&Comparison) -> f64| views.iter().map(|c| value(c) * c.pixels as f64).sum::<f64>() / pixels as f64;
    let root_mean_square = |value: &dyn Fn(&Comparison) -> f64| mean(&|c| value(c).powi(2)).sqrt();
    let optional_mean = |value: &dyn Fn(&Comparison) -> Option<f64>| {
        views.iter().all(|c| value(c).is_some()).then(|| mean(&|c| value(c).unwrap_or_default()))
    };
    Comparison {
        pixels,
        rmse_rgb: [0, 1, 2].map(|k| root_mean_square(&|c| c.rmse_rgb[k])),
        rmse_lab: [0, 1, 2].map(|k| root_mean_square(&|c| c.rmse_lab[k])),
        max_abs_error: views.iter().map(|c| c.max_abs_error).fold(0.0, f64::max),
        psnr_db: optional_mean(&|c| c.psnr_db),
        ssim: optional_mean(&|c| c.ssim),
        flip_mean: mean(&|c| c.flip_mean),
        delta_e_2000_mean: mean(&|c| c.delta_e_2000_mean),
        delta_e_2000_p95: mean(&|c| c.delta_e_2000_p95),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images::Image;
    use crate::render::Backend;

    fn frame(millis: f64, backend: Backend, device_bytes: Option<u64>) -> Rendered {
        Rendered { color: Image::zeros(1, 1, 3), millis, backend, device_bytes }
    }

    fn compared(pixels: usize, error: f64) -> Comparison {
        Comparison {
            pixels,
            rmse_rgb: [error; 3],
            rmse_lab: [error; 3],
            max_abs_error: error,
            psnr_db: Some(error),
            ssim: None,
            flip_mean: error,
            delta_e_2000_mean: error,
            delta_e_2000_p95: error,
        }
    }

    const NAME: SettingName = SettingName {
        component: "mirror",
        blend: Some("normal"),
        exponent: Some(4.0),
        filter: "footprint",
        light: None,
        integration: None,
        directions: None,
        body: None,
        reflections: None,
        order: None,
        normal_map: None,
    };

    #[test]
    fn times_are_the_median_and_the_95th_percentile_of_all_views() {
        let mut total = Total::new(vec![Truth::OneReflection]);
        total.add(Truth::OneReflection, compared(1, 0.0));
        // 1 to 20 in another order: 10 do not exceed 10, 19 do not exceed 19.
        (0..20).for_each(|k| total.add_frame(&frame(f64::from((7 * k) % 20 + 1), Backend::Gpu, Some(k as u64))));
        let row = &total.rows(0, NAME, "s")[0];
        assert_eq!((row.millis_per_frame, row.millis_per_frame_p95, row.timed_frames), (10.0, 19.0, 20));
        assert_eq!((row.backend.as_str(), row.gpu_bytes), ("gpu", Some(19)));
    }

    #[test]
    fn a_row_a_truth_with_the_views_weighted_by_their_pixels() {
        let mut total = Total::new(vec![Truth::OneReflection, Truth::PhysicalMirror]);
        total.add_frame(&frame(1.0, Backend::Gpu, Some(5)));
        total.add_frame(&frame(1.0, Backend::Cpu, None));
        for (pixels, error) in [(3, 1.0), (1, 5.0)] {
            total.add(Truth::OneReflection, compared(pixels, error));
            total.add(Truth::PhysicalMirror, compared(pixels, 0.0));
        }
        let rows = total.rows(0, NAME, "mirror-normal-4");
        assert_eq!((rows.len(), rows[0].views, rows[0].error.pixels), (2, 2, 4));
        // (3 · 1 + 1 · 5) / 4; √((3 · 1 + 1 · 25) / 4).
        assert_eq!((rows[0].error.delta_e_2000_mean, rows[0].error.rmse_rgb[0]), (2.0, 7f64.sqrt()));
        assert_eq!((rows[1].error.delta_e_2000_mean, rows[1].error.ssim), (0.0, None));
        assert_eq!(rows[0].backend, "cpu+gpu");
        assert_eq!(rows[1].pictures.error, "view-00-mirror-normal-4-physical_mirror-error");
    }
}
