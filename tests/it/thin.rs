//! `job submit thin`: a smaller dataset that keeps its bound, and what is refused.

use serde_json::Value;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};

/// Of little work.
fn thin<'a>(into: &'a str, max_error: &'a str) -> Vec<&'a str> {
    let quick = ["--windows", "100", "--truth-samples-per-pixel", "8", "--watch", "--quiet"];
    [&["job", "submit", "thin", "--dataset", DATASET, "--into", into, "--max-error", max_error][..], &quick].concat()
}

#[test]
fn a_thinned_dataset_is_smaller_keeps_its_bound_and_renders() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    // Faces that can be halved.
    let at = QUICK.iter().position(|flag| *flag == "--face-size-texels").unwrap();
    let mut flags = QUICK;
    flags[at + 1] = "32";
    tiny::capture_with(&server, folder.path(), DATASET, &flags);
    let job = server.json(&thin("loose", "40"));
    let summary = &job["result"]["summary"];
    let report = &summary["thinning"]["report"];
    let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("{value} in {job:#}"));
    assert!(number(&report["sample_points"]) < number(&report["sample_points_before"]), "{report:#}");
    assert_eq!((number(&report["face_size_texels_before"]), number(&report["face_size_texels"])), (32.0, 16.0), "{report:#}");
    assert!(number(&report["error_before"]) <= 40.0 && number(&report["error"]) <= 40.0, "{report:#}");
    assert!(number(&summary["stored_bytes"]) < 0.5 * number(&summary["thinning"]["stored_bytes_before"]), "{summary:#}");
    let version = server.json(&["dataset", "get", "loose"])["versions"][0].clone();
    assert_eq!(version["size_bytes"].as_f64().unwrap(), number(&summary["stored_bytes"]));
    let said = server.succeed(&["job", "get", job["name"].as_str().unwrap()]);
    assert!(said.contains("sample points 2") && said.contains("faces 32 -> 16"), "{said}");
    // It is a dataset like any other.
    let out = folder.path().join("frames");
    let render = ["render", "--dataset", "loose", "--frames", "1", "--size", "64x48", "--component", "full", "--blend", "corrected"];
    server.succeed(&[&render[..], &["--out", out.to_str().unwrap()]].concat());
    // A bound between what it has and what it may lose keeps more.
    let own = number(&report["error_before"]);
    let bound = (own + 0.05 * (number(&report["error"]) - own).max(0.1)).to_string();
    let tight = server.json(&thin("tight", &bound));
    let tight_report = &tight["result"]["summary"]["thinning"]["report"];
    let texels = |report: &Value| number(&report["sample_points"]) * number(&report["face_size_texels"]).powi(2);
    assert!(texels(tight_report) > texels(report), "{tight_report:#} is no more than {report:#}");

    let refused = |arguments: &[&str]| {
        let answer = server.lumisphere(arguments);
        assert!(!answer.status.success(), "{arguments:?}");
        String::from_utf8_lossy(&answer.stderr).into_owned()
    };
    let unmet = refused(&thin("never", "0.000001"));
    assert!(unmet.contains("max_error") && unmet.contains("own error is"), "{unmet}");
    for bad in ["0", "NaN", "inf"] {
        let message = refused(&thin("never", bad));
        assert!(message.contains("max_error"), "{bad}: {message}");
    }
    let glossy = refused(&[&thin("never", "40")[..], &["--component", "glossy"]].concat());
    assert!(glossy.contains("spec.thin.settings"), "{glossy}");
    let nothing = refused(&["job", "submit", "thin", "--dataset", "nothing", "--into", "x", "--max-error", "3"]);
    assert!(nothing.contains("nothing"), "{nothing}");
}
