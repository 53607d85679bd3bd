//! A job as text.

use serde_json::Value;

use crate::output::{bytes_text, table};
use crate::views;

/// Field by field, what its kind tells behind what all have.
pub fn job_text(job: &views::Job) -> String {
    let mut text = format!("{}  {}  {}  {}", job.name, job.kind, job.dataset, job.state);
    if let Some(settings) = &job.fit {
        text.push_str(&format!("\n{}", fit_settings_text(settings)));
    }
    if let Some(p) = job.progress.as_ref().filter(|p| !p.stage.is_empty() && job.result.is_none()) {
        text.push_str(&format!("\n{}: {}/{}", p.stage, p.done, p.total));
        if let Some(fit) = &p.fit {
            text.push_str(&format!("\n{}", fit.text()));
        }
    }
    if let Some(error) = &job.error {
        text.push_str(&format!("\n{} ({})", error.message, error.reason));
    }
    if let Some(result) = &job.result {
        if !result.dataset.is_empty() {
            text.push_str(&format!("\ndataset {} version {}", result.dataset, result.dataset_version));
        }
        if let Some(fit) = result.summary.get("fit") {
            text.push_str(&format!("\n{}", fit_text(fit)));
        }
        if let Some(suggested) = result.summary.get("suggested") {
            text.push_str(&format!("\n{}", suggested_text(suggested)));
        }
        if let Some(saved) = result.summary.get("thinning") {
            text.push_str(&format!("\n{}", thinned_text(saved, &result.summary)));
        }
        if let Some(replacing) = result.summary.get("replacing") {
            text.push_str(&format!("\n{}", replaced_text(replacing)));
        }
        for blob in &result.blobs {
            text.push_str(&format!("\n{}  {}", blob.name, bytes_text(blob.size_bytes)));
        }
    }
    text
}

/// How a fit was asked for.
fn fit_settings_text(settings: &views::FitSettings) -> String {
    let is_on_gpu = settings.backend == "gpu";
    let switches = [(settings.reject_outliers, "outliers rejected"), (settings.polish, "polished"), (is_on_gpu, "on the GPU")];
    let bound = settings.max_bytes.map(|bytes| format!("at most {}", bytes_text(bytes)));
    let models = std::iter::once(format!("models {}", settings.models));
    let on = switches.iter().filter(|(is_on, _)| *is_on).map(|(_, name)| name.to_string());
    models.chain(on).chain(bound).collect::<Vec<_>>().join(", ")
}

/// Which models the texels have, and what fits flagged.
fn fit_text(fit: &Value) -> String {
    let counts = |of: &str| {
        let entries = fit[of].as_object().into_iter().flatten().filter(|(_, n)| n.as_u64() != Some(0));
        entries.map(|(name, n)| format!("{name} {n}")).collect::<Vec<_>>().join(", ")
    };
    let number = |name: &str| fit[name].as_f64().unwrap_or(f64::NAN);
    let flagged = Some(counts("flags")).filter(|f| !f.is_empty()).map(|f| format!("; {f}")).unwrap_or_default();
    let budget = fit.get("budget").map(|b| {
        let bytes = |name: &str| bytes_text(b[name].as_u64().unwrap_or_default());
        let (asked, got, before) = (bytes("max_bytes"), bytes("bytes"), bytes("bytes_before"));
        let residual = b["rms_residual_before"].as_f64().unwrap_or(f64::NAN);
        format!(
            "\nbytes: {asked} asked, {got} got ({before} before); {} texels reduced, rms residual {residual:.5} before",
            b["texels_reduced"]
        )
    });
    let shifted = fit.get("registration").filter(|r| r["shifted"].as_u64() != Some(0)).map(shifted_text);
    format!(
        "models: {}{flagged}; {:.0} texels/s\nresidual: rms {:.5}, median {:.5}, p95 {:.5}{}{}",
        counts("histogram"),
        number("texels_per_second"),
        number("rms_residual"),
        number("median_residual"),
        number("p95_residual"),
        shifted.unwrap_or_default(),
        budget.unwrap_or_default()
    )
}

/// A row a direction, best first.
fn suggested_text(suggested: &Value) -> String {
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let head = ["X", "Y", "Z", "NATS A TEXEL"].map(String::from).to_vec();
    let row = |one: &Value| {
        let place = (0..3).map(|axis| format!("{:.4}", number(&one["direction"][axis])));
        place.chain([format!("{:.3}", number(&one["gain_nats"]))]).collect()
    };
    let rows = suggested["directions"].as_array().into_iter().flatten().map(row);
    table(&std::iter::once(head).chain(rows).collect::<Vec<_>>(), &[0, 1, 2, 3])
}

/// Photographs that lie beside the others.
fn shifted_text(registration: &Value) -> String {
    let one = |s: &Value| format!("{} by {}, {} texels", s["observation"], s["texels"][0], s["texels"][1]);
    let worst = registration["worst"].as_array().into_iter().flatten().map(one).collect::<Vec<_>>().join("; ");
    format!("\nmisregistered: {} of {} photographs lie beside the others ({worst})", registration["shifted"], registration["compared"])
}

/// Where the light of the new cube maps came from.
fn replaced_text(replacing: &Value) -> String {
    let shares = replacing["shares"].as_object().into_iter().flatten();
    let share =
        |(name, share): (&String, &Value)| format!("{} {:.1} %", name.replace('_', " "), 100.0 * share.as_f64().unwrap_or(f64::NAN));
    format!(
        "light of {} version {}: {}",
        replacing["dataset"].as_str().unwrap_or("?"),
        replacing["version"],
        shares.map(share).collect::<Vec<_>>().join(", ")
    )
}

/// What thinning left out, and what that did to the error.
fn thinned_text(thinning: &Value, summary: &Value) -> String {
    let (report, bytes) = (&thinning["report"], |bytes: &Value| bytes_text(bytes.as_u64().unwrap_or_default()));
    let error = |error: &Value| format!("{:.4}", error.as_f64().unwrap_or(f64::NAN));
    format!(
        "sample points {} -> {}, faces {} -> {} texels, {} -> {}, {} {} -> {} (at most {})",
        report["sample_points_before"],
        report["sample_points"],
        report["face_size_texels_before"],
        report["face_size_texels"],
        bytes(&thinning["stored_bytes_before"]),
        bytes(&summary["stored_bytes"]),
        thinning["metric"].as_str().unwrap_or("error"),
        error(&report["error_before"]),
        error(&report["error"]),
        thinning["max_error"],
    )
}
