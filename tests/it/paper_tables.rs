//! The paper's read strategies on pages stored as the paper stored them, and its cache tables.

use std::fs;

use serde_json::Value;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};

const STRATEGIES: [&str; 5] = ["full_image", "half_threshold", "on_demand", "on_demand_restart", "block"];

#[test]
fn every_codec_and_strategy_serves_the_same_pixels() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let out = folder.path().join("out");
    let render = |dataset: &str| {
        let flags = ["--backend", "cpu", "--component", "mirror", "--format", "exr", "--frames", "1", "--size", "64x48", "--force"];
        server.succeed(&[&["render", "--dataset", dataset, "--out", out.to_str().unwrap()], &flags[..]].concat());
        fs::read(out.join("frame-00000.exr")).unwrap()
    };
    tiny::capture(&server, folder.path());
    let expected = render(DATASET);
    for codec in ["zstd-chunk", "zstd-seq", "lzw-seq"] {
        tiny::capture_with(&server, folder.path(), codec, &[&QUICK[..], &["--codec", codec]].concat());
        for strategy in STRATEGIES {
            server.json(&["cache", "clear"]);
            server.json(&["cache", "configure", "--strategy", strategy]);
            assert!(render(codec) == expected, "{codec}, {strategy}");
        }
    }
    // Else the codec was not heeded.
    let stored = |dataset: &str| server.json(&["dataset", "get", dataset])["versions"][0]["size_bytes"].as_u64().unwrap();
    let mut sizes = [DATASET, "zstd-chunk", "zstd-seq", "lzw-seq"].map(stored).to_vec();
    sizes.sort_unstable();
    sizes.dedup();
    assert_eq!(sizes.len(), 4, "{sizes:?}");
    let refused =
        server.lumisphere(&["job", "submit", "capture", "--scene", "gazebo", "--object", "teapot", "--dataset", "d", "--codec", "gif"]);
    let error = String::from_utf8_lossy(&refused.stderr);
    assert!(refused.status.code() == Some(2) && error.contains("lzw-seq"), "{error}");
}

#[test]
fn the_paper_s_tables_have_all_its_lines_and_misses_fall_with_size_and_strategy() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture_with(&server, folder.path(), DATASET, &[&QUICK[..], &["--codec", "lzw-seq"]].concat());
    let printed = server.json(&["load", "--dataset", DATASET, "--paper", "--times", "--size", "64x48", "--quiet"]);
    let of_table = |name: &str| {
        let rows: Vec<&Value> = printed.as_array().unwrap().iter().filter(|row| row["table"].as_str().unwrap().starts_with(name)).collect();
        assert!(!rows.is_empty(), "{name} in {printed:#}");
        rows
    };
    let number = |row: &Value, name: &str| row[name].as_f64().unwrap_or_else(|| panic!("{name} of {row}"));
    let required = [0, 2, 4, 8, 16, 32];
    let faces = ["6.4", "6.5", "6.6 glossy (10, 10)", "6.6 glossy (100, 100)", "6.6 glossy (1000, 1000)"];
    for name in faces {
        let rows = of_table(name);
        let sizes: Vec<u64> = rows.iter().map(|row| row["size"].as_u64().unwrap()).collect();
        assert!(required.iter().all(|size| sizes.contains(size)), "{name}: {sizes:?}");
        for order in ["scanlines_percent", "buckets_percent"] {
            assert_eq!(number(rows[0], order), 100.0, "{name}: without a cache every fetch is a miss");
            let misses: Vec<f64> = rows.iter().map(|row| number(row, order)).collect();
            assert!(misses.is_sorted_by(|larger, smaller| larger >= smaller), "{name}, {order}: {misses:?}");
            assert!(misses[1] < 100.0 && misses[misses.len() - 1] < misses[1], "{name}, {order}: {misses:?}");
        }
        assert!(rows.iter().any(|row| row["scanlines_percent"] != row["buckets_percent"]), "{name}: the order of pixels does not matter");
    }
    assert_eq!(of_table("6.3").iter().map(|row| row["size"].as_u64().unwrap()).collect::<Vec<_>>(), [2, 4, 8, 16, 32, 64]);
    let strategies = of_table("6.7");
    let at_32: Vec<_> = strategies.iter().filter(|row| row["size"] == 32).map(|row| (row["strategy"].as_str().unwrap(), row)).collect();
    assert_eq!(at_32.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["on_demand", "half_threshold", "full_image"]);
    for order in ["scanlines_percent", "buckets_percent"] {
        assert!(at_32.is_sorted_by(|(_, more), (_, fewer)| number(more, order) >= number(fewer, order)), "{at_32:?}");
    }
    let wide: Vec<f64> = of_table("6.6 glossy (10, 10)").iter().map(|row| number(row, "buckets_percent")).collect();
    assert!(wide.is_sorted_by(|larger, smaller| larger > smaller), "every page more helps a wide lobe: {wide:?}");
    // A narrower lobe stays nearer: fewer pages.
    let narrower: Vec<f64> = faces[2..].iter().map(|name| number(of_table(name)[3], "buckets_percent")).collect();
    assert!(narrower.is_sorted_by(|wide, narrow| wide > narrow), "{narrower:?}");
    // Measured where the paper did, but for lobes without a cache.
    for row in printed.as_array().unwrap() {
        let (table, size) = (row["table"].as_str().unwrap(), row["size"].as_u64().unwrap());
        let is_measured = !table.starts_with("6.3") && (size > 0 || !table.contains("glossy")) && row["paper_seconds"].is_number();
        assert_eq!(row["scanlines_seconds"].is_number(), is_measured, "{row}");
    }
}
