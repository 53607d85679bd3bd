//! What a sweep over datasets and settings measured, as it is kept (`sweep.json`) and as its rows are named and grouped.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use thiserror::Error;

use super::PictureNames;
use crate::images::Comparison;

/// What `Sweep::format` says.
pub const SWEEP_FORMAT: &str = "lumisphere-sweep/1";

/// All rows of a sweep, and what they have in common.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// [`SWEEP_FORMAT`].
    pub format: String,
    /// What was the same for all rows.
    pub conditions: Conditions,
    /// Dataset by dataset, setting by setting.
    pub rows: Vec<SweepRow>,
}

/// What was the same for all rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Conditions {
    /// Held-out views.
    pub views: usize,
    /// Their size where all have one, "160 × 120".
    pub size: Option<String>,
    /// Paths per pixel of the truth.
    pub truth_samples_per_pixel: u32,
    /// Frames of each setting at each view whose time counts.
    pub timed_frames_per_view: u32,
    /// C_s per channel, of settings that show reflections.
    pub specular_reflectance: [f32; 3],
    /// The server's adapter; None where it has none.
    pub adapter: Option<String>,
    /// The server's version.
    pub server: String,
}

/// One setting of one dataset version against one truth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SweepRow {
    /// The scene's name or file.
    pub scene: String,
    /// Which of its objects.
    pub object: String,
    /// Name of the dataset.
    pub dataset: String,
    /// Its version.
    pub version: u64,
    /// Its representation.
    pub kind: String,
    /// What tells the dataset from the sweep's others, axis by axis ("points" → "40"); empty where it is the only one.
    pub variant: BTreeMap<String, String>,
    /// As captured and constructed.
    pub parameters: Value,
    /// Of the version on disk.
    pub dataset_bytes: u64,
    /// Which term was shown.
    pub component: String,
    /// How reflections were put together; None where there are none.
    #[serde(default)]
    pub blend: Option<String>,
    /// Of the blend, where it has one.
    #[serde(default)]
    pub exponent: Option<f64>,
    /// How stored light was read.
    #[serde(default)]
    pub filter: Option<String>,
    /// Which of the sweep's settings.
    pub setting_index: usize,
    /// What was asked to compute it: `auto`, `gpu` or `cpu`.
    pub asked_backend: String,
    /// What computed it.
    pub backend: String,
    /// What it was compared with.
    pub truth: String,
    /// How many views.
    pub views: usize,
    /// Over the object's pixels of all views.
    #[serde(flatten)]
    pub error: Comparison,
    /// Median time of a frame.
    pub millis_per_frame: f64,
    /// The time that 95 % of the frames do not exceed.
    pub millis_per_frame_p95: f64,
    /// How many frames the two are of.
    pub timed_frames: usize,
    /// See `Row::gpu_bytes`.
    #[serde(default)]
    pub gpu_bytes: Option<u64>,
    /// The first view's pictures; files of these names with the ending `.png` lie in `images/DATASET/`.
    pub pictures: PictureNames,
    /// Figures and settings that this version does not know.
    #[serde(flatten)]
    pub more: BTreeMap<String, Value>,
}

/// Why a text is no sweep.
#[derive(Debug, Error)]
pub enum SweepError {
    /// Not JSON, or members missing or of another type.
    #[error("no sweep: {0}")]
    Malformed(#[from] serde_json::Error),
    /// Written by another version, or another document.
    #[error("format {0:?}, {SWEEP_FORMAT:?} expected")]
    Format(String),
    /// There is nothing to choose from or to show.
    #[error("no rows")]
    Empty,
}

/// Rows that compare with each other: the same object, shown the same in the same light, against the same truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// The scene's name or file.
    pub scene: String,
    /// Which of its objects.
    pub object: String,
    /// Which term is shown.
    pub component: String,
    /// What it is compared with.
    pub truth: String,
    /// Other light than it was captured in ("turned-90").
    pub light: Option<String>,
    /// The clear body that it is ("solid-1.5").
    pub body: Option<String>,
    /// Mirror reflections one after the other ("3 reflections"); None for one, or without a mirror.
    pub reflections: Option<String>,
    /// Indices into the sweep's rows.
    pub rows: Vec<usize>,
}

impl Group {
    /// "mirror of teapot in gazebo, against one_reflection"; "mirror, turned-90, of teapot in gazebo, against one_reflection".
    pub fn name(&self) -> String {
        let told = [&self.light, &self.body, &self.reflections].into_iter().flatten().map(|text| format!(" {text},")).collect::<String>();
        let comma = if told.is_empty() { "" } else { "," };
        format!("{}{comma}{told} of {} in {}, against {}", self.component, self.object, self.scene, self.truth)
    }
}

impl SweepRow {
    /// What reflections are put together by, without exponent; the term where there are none. Rows of one method have one colour.
    pub fn method(&self) -> &str {
        self.blend.as_deref().unwrap_or(&self.component)
    }
}

impl Sweep {
    /// From the JSON that a sweep wrote.
    pub fn from_json(text: &str) -> Result<Self, SweepError> {
        #[derive(Deserialize)]
        struct Head {
            format: String,
        }
        let head: Head = serde_json::from_str(text)?;
        if head.format != SWEEP_FORMAT {
            return Err(SweepError::Format(head.format));
        }
        let sweep: Self = serde_json::from_str(text)?;
        if sweep.rows.is_empty() { Err(SweepError::Empty) } else { Ok(sweep) }
    }

    /// In order of appearance.
    pub fn groups(&self) -> Vec<Group> {
        let mut groups: Vec<Group> = Vec::new();
        for (i, row) in self.rows.iter().enumerate() {
            let told = |key| row.more.get(key).and_then(Value::as_str).map(String::from);
            let (light, body) = (told("light"), told("body"));
            let reflections = row.more.get("reflections").and_then(Value::as_u64).map(|n| format!("{n} reflections"));
            let is_shown_so =
                |g: &Group| g.component == row.component && (&g.light, &g.body, &g.reflections) == (&light, &body, &reflections);
            let is_of = |g: &&mut Group| g.scene == row.scene && g.object == row.object && g.truth == row.truth && is_shown_so(g);
            match groups.iter_mut().find(is_of) {
                Some(group) => group.rows.push(i),
                None => groups.push(Group {
                    scene: row.scene.clone(),
                    object: row.object.clone(),
                    component: row.component.clone(),
                    truth: row.truth.clone(),
                    light,
                    body,
                    reflections,
                    rows: vec![i],
                }),
            }
        }
        groups
    }

    /// A name a row, of what tells it from the others of its group: "normal(4), points 40, bilinear".
    pub fn labels(&self) -> Vec<String> {
        let varies = |text: &dyn Fn(&SweepRow) -> String| self.rows.iter().map(text).collect::<BTreeSet<_>>().len() > 1;
        let filter = |r: &SweepRow| r.filter.clone().unwrap_or_default();
        let backend = |r: &SweepRow| r.backend.clone();
        let (filters_vary, backends_vary) = (varies(&filter), varies(&backend));
        let more: BTreeSet<&String> = self.rows.iter().flat_map(|r| r.more.keys()).collect();
        let more: Vec<&String> = more.into_iter().filter(|key| varies(&|r| scalar(r.more.get(*key)).unwrap_or_default())).collect();
        let label = |row: &SweepRow| {
            let mut parts = vec![match row.exponent {
                Some(n) => format!("{}({n})", row.method()),
                None => row.method().to_string(),
            }];
            parts.extend(row.variant.iter().map(|(axis, value)| format!("{axis} {value}")));
            parts.extend(more.iter().filter_map(|key| Some(format!("{key} {}", scalar(row.more.get(*key))?))));
            parts.extend(Some(filter(row)).filter(|_| filters_vary));
            parts.extend(Some(backend(row)).filter(|_| backends_vary));
            parts.join(", ")
        };
        self.rows.iter().map(label).collect()
    }
}

// A setting that a newer server tells: text or number; figures and lists have no place in a name.
fn scalar(value: Option<&Value>) -> Option<String> {
    match value? {
        Value::String(text) => Some(text.clone()),
        Value::Bool(flag) => Some(flag.to_string()),
        Value::Number(number) if number.is_u64() => Some(number.to_string()),
        _ => None,
    }
}

/// "1.5 MB", powers of ten.
pub fn bytes_text(bytes: u64) -> String {
    const UNITS: [&str; 4] = ["kB", "MB", "GB", "TB"];
    let (mut value, mut unit) = (bytes as f64, "B");
    for next in UNITS {
        if value < 1000.0 {
            break;
        }
        (value, unit) = (value / 1000.0, next);
    }
    if unit == "B" || value >= 100.0 { format!("{value:.0} {unit}") } else { format!("{value:.1} {unit}") }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A row of the mirror term with these figures.
    pub fn row(blend: &str, dataset: &str, delta_e: f64, millis: f64, bytes: u64) -> SweepRow {
        let error = Comparison {
            pixels: 100,
            rmse_rgb: [0.1; 3],
            rmse_lab: [0.1; 3],
            max_abs_error: 1.0,
            psnr_db: None,
            ssim: Some(0.9),
            flip_mean: delta_e / 100.0,
            delta_e_2000_mean: delta_e,
            delta_e_2000_p95: 2.0 * delta_e,
        };
        let picture = |what: &str| format!("view-00-mirror-{blend}-{what}");
        SweepRow {
            scene: "gazebo".into(),
            object: "teapot".into(),
            dataset: dataset.into(),
            version: 1,
            kind: "offset_surface_light_field".into(),
            variant: [("face".to_string(), dataset.to_string())].into(),
            parameters: serde_json::json!({"face_size_texels": 32}),
            dataset_bytes: bytes,
            component: "mirror".into(),
            blend: Some(blend.into()),
            exponent: (blend == "normal").then_some(4.0),
            filter: Some("footprint".into()),
            setting_index: 0,
            asked_backend: "auto".into(),
            backend: "gpu".into(),
            truth: "one_reflection".into(),
            views: 2,
            error,
            millis_per_frame: millis,
            millis_per_frame_p95: 1.5 * millis,
            timed_frames: 8,
            gpu_bytes: None,
            pictures: PictureNames { truth: picture("truth"), frame: picture("frame"), error: picture("error") },
            more: BTreeMap::new(),
        }
    }

    pub fn sweep(rows: Vec<SweepRow>) -> Sweep {
        let conditions = Conditions {
            views: 2,
            size: Some("160 × 120".into()),
            truth_samples_per_pixel: 64,
            timed_frames_per_view: 4,
            specular_reflectance: [1.0; 3],
            adapter: None,
            server: "0.1.0".into(),
        };
        Sweep { format: SWEEP_FORMAT.into(), conditions, rows }
    }

    #[test]
    fn a_sweep_survives_json_with_what_this_version_does_not_know() {
        let mut first = row("normal", "32", 2.0, 5.0, 1000);
        first.more.insert("roughness".into(), serde_json::json!(0.25));
        let before = sweep(vec![first, row("distance", "64", 3.0, 4.0, 4000)]);
        let text = serde_json::to_string(&before).unwrap();
        assert_eq!(Sweep::from_json(&text).unwrap(), before);
        assert!(matches!(Sweep::from_json("{\"format\": \"lumisphere-sweep/9\"}"), Err(SweepError::Format(_))));
        assert!(matches!(Sweep::from_json("{\"format\": 1}"), Err(SweepError::Malformed(_))));
        let none = serde_json::to_string(&sweep(Vec::new())).unwrap();
        assert!(matches!(Sweep::from_json(&none), Err(SweepError::Empty)));
    }

    #[test]
    fn only_rows_that_show_the_same_compare() {
        let mut rows: Vec<SweepRow> = (0..5).map(|_| row("normal", "32", 2.0, 5.0, 1)).collect();
        (rows[1].component, rows[1].blend) = ("reconstruction".into(), None);
        rows[2].truth = "physical_mirror".into();
        rows[4].more.insert("reflections".into(), serde_json::json!(3));
        let groups = sweep(rows).groups();
        assert_eq!(groups.iter().map(|g| g.rows.clone()).collect::<Vec<_>>(), [vec![0, 3], vec![1], vec![2], vec![4]]);
        assert_eq!(groups[2].name(), "mirror of teapot in gazebo, against physical_mirror");
        assert_eq!(groups[3].name(), "mirror, 3 reflections, of teapot in gazebo, against one_reflection");
    }

    #[test]
    fn labels_name_what_varies_and_nothing_else() {
        let mut rows = vec![row("normal", "32", 2.0, 5.0, 1), row("distance", "64", 2.0, 5.0, 1)];
        assert_eq!(sweep(rows.clone()).labels(), ["normal(4), face 32", "distance, face 64"]);
        rows[1].filter = Some("bilinear".into());
        rows[1].backend = "cpu".into();
        rows.iter_mut().for_each(|r| drop(r.more.insert("same".into(), serde_json::json!("x"))));
        rows[0].more.insert("lobe".into(), serde_json::json!("ggx"));
        assert_eq!(sweep(rows).labels(), ["normal(4), face 32, lobe ggx, footprint, gpu", "distance, face 64, bilinear, cpu"]);
    }

    #[test]
    fn bytes_are_told_in_powers_of_ten() {
        assert_eq!([999, 1500, 12_340_000, 345_600_000].map(bytes_text), ["999 B", "1.5 kB", "12.3 MB", "346 MB"]);
    }
}
