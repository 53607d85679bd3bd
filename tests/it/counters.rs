//! The cache's counters, told in three ways: `cache stats`, `/metrics`, and with every frame. All tell the same.

use std::path::Path;

use serde_json::Value;

use crate::prefetch::has_adapter;
use crate::process::{Server, temporary_folder};
use crate::system::get;
use crate::tiny::{self, DATASET, QUICK};

/// Gauge and key of `cache stats`; of each tier, and, the budget aside, of each dataset's part of it.
const TIER: [(&str, &str); 12] = [
    ("cache_look_ups", "look_ups"),
    ("cache_hits", "hits"),
    ("cache_misses", "misses"),
    ("cache_evictions", "evictions"),
    ("cache_bytes_in", "bytes_in"),
    ("cache_bytes", "used_bytes"),
    ("cache_peak_bytes", "peak_bytes"),
    ("cache_prefetched", "prefetched"),
    ("cache_prefetch_used", "prefetch_used"),
    ("cache_prefetch_wasted", "prefetch_wasted"),
    ("cache_uploads", "uploads"),
    ("cache_budget_bytes", "budget_bytes"),
];

/// The same, of each dataset's texels.
const TEXELS: [(&str, &str); 16] = [
    ("texture_look_ups", "look_ups"),
    ("texture_misses", "misses"),
    ("texture_texel_fetches", "texel_fetches"),
    ("texture_texel_misses", "texel_misses"),
    ("texture_page_visits", "page_visits"),
    ("texture_visit_misses", "visit_misses"),
    ("texture_coalesced", "coalesced"),
    ("texture_blocks_read", "blocks_read"),
    ("texture_bytes_read", "bytes_read"),
    ("texture_rows_decoded", "rows_decoded"),
    ("texture_bytes_decoded", "bytes_decoded"),
    ("texture_rows_redundant", "rows_redundant"),
    ("texture_bytes_redundant", "bytes_redundant"),
    ("texture_read_micros", "read_micros"),
    ("texture_decode_micros", "decode_micros"),
    ("texture_wait_micros", "wait_micros"),
];

/// A frame's key and that of `cache stats`, whatever computed the frame.
const FRAME: [(&str, &str); 13] = [
    ("look_ups", "look_ups"),
    ("misses", "misses"),
    ("read_bytes", "bytes_read"),
    ("texel_fetches", "texel_fetches"),
    ("texel_misses", "texel_misses"),
    ("page_visits", "page_visits"),
    ("visit_misses", "visit_misses"),
    ("coalesced", "coalesced"),
    ("blocks_read", "blocks_read"),
    ("rows_decoded", "rows_decoded"),
    ("bytes_decoded", "bytes_decoded"),
    ("rows_redundant", "rows_redundant"),
    ("bytes_redundant", "bytes_redundant"),
];

/// A frame's key and that of the adapter's tier: what it did for its own dataset.
const ADAPTER_OWN: [(&str, &str); 6] = [
    ("look_ups", "look_ups"),
    ("hits", "hits"),
    ("misses", "misses"),
    ("uploads", "uploads"),
    ("bytes_uploaded", "bytes_in"),
    ("prefetch_used", "prefetch_used"),
];

/// The same; what it did to any dataset.
const ADAPTER_ANY: [(&str, &str); 2] = [("evictions", "evictions"), ("prefetch_wasted", "prefetch_wasted")];

/// Frames of the dataset; what each of them says of the cache.
fn frames(server: &Server, dataset: &str, backend: &str, (count, size): (&str, &str), out: &Path) -> Vec<Value> {
    let base = ["render", "--dataset", dataset, "--backend", backend, "--out", out.to_str().unwrap(), "--force", "--json"];
    let text = server.succeed(&[&base[..], &["--component", "mirror", "--format", "raw", "--frames", count, "--size", size]].concat());
    text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap()["cache"].clone()).collect()
}

const FEW: (&str, &str) = ("3", "64x48");

fn count(counters: &Value, key: &str) -> u64 {
    counters[key].as_u64().unwrap_or_else(|| panic!("no {key} in {counters:#}"))
}

fn sum(frames: &[Value], key: &str) -> u64 {
    frames.iter().map(|frame| count(frame, key)).sum()
}

/// How much a counter has grown.
fn growth(before: &Value, after: &Value, key: &str) -> u64 {
    count(after, key) - count(before, key)
}

fn tier<'a>(stats: &'a Value, name: &str) -> &'a Value {
    stats["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == name).unwrap_or_else(|| panic!("no tier {name} in {stats:#}"))
}

fn dataset<'a>(stats: &'a Value, name: &str) -> &'a Value {
    stats["datasets"].as_array().unwrap().iter().find(|d| d["dataset"] == name).unwrap_or_else(|| panic!("no dataset {name} in {stats:#}"))
}

/// A tier's counters and sizes are the sums of its datasets' parts, and no part's peak is above the tier's.
fn assert_datasets_make_the_tiers(stats: &Value) {
    for whole in stats["tiers"].as_array().unwrap() {
        let datasets = stats["datasets"].as_array().unwrap().iter();
        let parts: Vec<&Value> =
            datasets.filter_map(|d| d["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == whole["tier"])).collect();
        let of_parts = |key| parts.iter().map(|part| count(part, key)).sum::<u64>();
        for (_, key) in TIER.into_iter().filter(|(_, key)| !["peak_bytes", "budget_bytes"].contains(key)).chain([("", "entries")]) {
            assert_eq!(of_parts(key), count(whole, key), "{key} of {stats:#}");
        }
        for part in parts {
            assert!(
                count(part, "used_bytes") <= count(part, "peak_bytes") && count(part, "peak_bytes") <= count(whole, "peak_bytes"),
                "{part}"
            );
            assert_eq!(count(part, "look_ups"), count(part, "hits") + count(part, "misses"), "{part}");
        }
    }
}

#[test]
fn metrics_tell_what_cache_stats_tells_of_every_tier_and_dataset() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    // Room for a few pages, read from their start each time: something leaves, and is decoded again.
    let sizes = ["--memory-budget-bytes", "20000", "--compressed-budget-bytes", "30000", "--strategy", "on_demand_restart"];
    server.json(&[&["cache", "configure"], &sizes[..]].concat());
    frames(&server, DATASET, "cpu", FEW, folder.path());
    if has_adapter(&server) {
        frames(&server, DATASET, "gpu", FEW, folder.path());
    }
    let stats = server.json(&["cache", "stats"]);
    let metrics = get(&server.http, "/metrics").1;
    let gauge = |name: &str, labels: &str| -> u64 {
        let line = format!("lumisphere_{name}{{{labels}}} ");
        let value = metrics.lines().find_map(|l| l.strip_prefix(&line)).unwrap_or_else(|| panic!("no {line}in {metrics}"));
        value.trim().parse().unwrap()
    };
    for tier in stats["tiers"].as_array().unwrap() {
        let labels = format!("tier={}", tier["tier"]);
        for (name, key) in TIER {
            assert_eq!(gauge(name, &labels), count(tier, key), "{name}{{{labels}}} in {tier:#}");
        }
    }
    for dataset in stats["datasets"].as_array().unwrap() {
        let labels = format!("dataset={},version=\"{}\"", dataset["dataset"], dataset["version"]);
        let texels = &dataset["texels"];
        for (name, key) in TEXELS {
            assert_eq!(gauge(name, &labels), count(texels, key), "{name}{{{labels}}} in {texels:#}");
        }
        for part in dataset["tiers"].as_array().unwrap() {
            let labels = format!("tier={},{labels}", part["tier"]);
            for (name, key) in TIER.into_iter().filter(|(_, key)| *key != "budget_bytes") {
                assert_eq!(gauge(&format!("dataset_{name}"), &labels), count(part, key), "{name}{{{labels}}} in {part:#}");
            }
        }
        assert_eq!(gauge("texture_hits", &labels), count(texels, "look_ups") - count(texels, "misses"));
        for (name, key) in [("texture_bytes", "used_bytes"), ("texture_peak_bytes", "peak_bytes"), ("texture_evictions", "evictions")] {
            assert_eq!(gauge(name, &labels), count(dataset, key), "{name} in {dataset:#}");
        }
        // One dataset alone: what was held and what leaves is its own.
        for key in ["evictions", "peak_bytes"] {
            assert_eq!(count(dataset, key), count(tier(&stats, "memory"), key), "{key}");
        }
    }
    assert_datasets_make_the_tiers(&stats);
    for key in ["hits", "misses", "evictions"] {
        assert!(["compressed", "memory"].iter().all(|name| count(tier(&stats, name), key) > 0), "no {key} in {stats:#}");
    }
    assert!(count(&stats["texels"], "rows_redundant") > 0, "{stats:#}");
}

/// What frames say is what the cache has counted meanwhile, and something had to be read again.
fn assert_adds_up(drawn: &[Value], before: &Value, after: &Value) {
    let growth = |key| growth(&before["texels"], &after["texels"], key);
    for (of_frames, key) in FRAME {
        assert_eq!(sum(drawn, of_frames), growth(key), "{of_frames} of {drawn:#?}");
    }
    // A frame's microseconds are whole ones.
    for key in ["read_micros", "decode_micros", "wait_micros"] {
        let (told, all) = (sum(drawn, key), growth(key));
        assert!(told <= all + 1 && all <= told + drawn.len() as u64, "{key}: {told} of {all}");
    }
    for key in ["misses", "read_bytes", "rows_redundant", "read_micros", "decode_micros"] {
        assert!(sum(drawn, key) > 0, "no {key} in {drawn:#?}");
    }
}

#[test]
fn what_frames_say_of_the_cache_adds_up_to_its_counters() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    // Little memory: rows are decoded again.
    let before = server.json(&["cache", "configure", "--memory-budget-bytes", "20000"]);
    let drawn = frames(&server, DATASET, "cpu", FEW, folder.path());
    assert_adds_up(&drawn, &before, &server.json(&["cache", "stats"]));
    assert!(sum(&drawn, "texel_fetches") > 0 && sum(&drawn, "texel_misses") > 0, "{drawn:#?}");
    assert!(drawn.iter().all(|frame| frame["adapter"].is_null()));

    if !has_adapter(&server) {
        return;
    }
    // On the adapter room for one dataset: the second one displaces the first, which comes back. A frame as large as what the adapter draws
    // at once takes all that any frame takes beside its pages.
    tiny::capture_with(&server, folder.path(), "second", &[&QUICK[..], &["--seed", "5"]].concat());
    let large = |dataset: &str| frames(&server, dataset, "gpu", ("1", "720x720"), folder.path());
    large(DATASET);
    let held = count(tier(&server.json(&["cache", "stats"]), "gpu"), "used_bytes");
    let room = (held + held / 2).to_string();
    let mut stats = vec![server.json(&["cache", "configure", "--gpu-budget-bytes", &room])];
    let mut drawn = Vec::new();
    for (drawn_of, other) in [(DATASET, "second"), ("second", DATASET), (DATASET, "second"), (DATASET, "second")] {
        let [frame] = &large(drawn_of)[..] else { panic!("one frame was asked for") };
        let (before, after) = (stats[stats.len() - 1].clone(), server.json(&["cache", "stats"]));
        let adapter = &frame["adapter"];
        assert!(adapter.is_object() && count(adapter, "passes") > 0, "drawn by the CPU: {frame:#}");
        // Where it was never on the adapter, nothing.
        let part = |stats: &Value, name: &str, key: &str| {
            let of_dataset = stats["datasets"].as_array().unwrap().iter().find(|d| d["dataset"] == name);
            let part = of_dataset.and_then(|d| d["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == "gpu"));
            part.map_or(0, |part| count(part, key))
        };
        let grown = |name: &str, key: &str| part(&after, name, key) - part(&before, name, key);
        for (of_frame, key) in ADAPTER_OWN {
            assert_eq!((grown(drawn_of, key), grown(other, key)), (count(adapter, of_frame), 0), "{of_frame} of {drawn_of}");
        }
        for (of_frame, key) in ADAPTER_ANY {
            assert_eq!(grown(drawn_of, key) + grown(other, key), count(adapter, of_frame), "{of_frame} of {drawn_of}");
        }
        // The one that leaves is charged with it.
        assert_eq!(grown(drawn_of, "evictions"), 0, "{after:#}");
        assert_eq!((part(&after, other, "entries"), part(&after, other, "used_bytes")), (0, 0), "{after:#}");
        assert_datasets_make_the_tiers(&after);
        drawn.push(frame.clone());
        stats.push(after);
    }
    assert_adds_up(&drawn, &stats[0], &stats[4]);
    for name in [DATASET, "second"] {
        let on_adapter = dataset(&stats[4], name)["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == "gpu").unwrap();
        assert!(
            ["look_ups", "misses", "uploads", "bytes_in", "evictions", "peak_bytes"].iter().all(|key| count(on_adapter, key) > 0),
            "{on_adapter:#}"
        );
    }
    // The last frame found all that the one before it had brought.
    assert_eq!((count(&drawn[3]["adapter"], "misses"), growth(tier(&stats[3], "gpu"), tier(&stats[4], "gpu"), "uploads")), (0, 0));
}

#[test]
fn peaks_outlast_what_was_held_until_the_counters_are_reset() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    server.json(&["cache", "configure", "--compressed-budget-bytes", "30000"]);
    frames(&server, DATASET, "cpu", FEW, folder.path());
    if has_adapter(&server) {
        frames(&server, DATASET, "gpu", FEW, folder.path());
    }
    let peaks = |stats: &Value| -> Vec<u64> {
        let (tiers, datasets) = (stats["tiers"].as_array().unwrap(), stats["datasets"].as_array().unwrap());
        let parts = datasets.iter().flat_map(|d| d["tiers"].as_array().unwrap());
        tiers.iter().chain(datasets).chain(parts).map(|part| count(part, "peak_bytes")).collect()
    };
    let held = server.json(&["cache", "stats"]);
    assert!(peaks(&held).iter().all(|&peak| peak > 0), "{held:#}");
    let cleared = server.json(&["cache", "clear"]);
    assert_eq!(peaks(&cleared), peaks(&held));
    // What a smaller budget leaves no room for was held all the same.
    let smaller = server.json(&["cache", "configure", "--memory-budget-bytes", "20000"]);
    assert_eq!(peaks(&smaller), peaks(&held));
    let reset = server.json(&["cache", "clear", "--reset-counters"]);
    assert_eq!(peaks(&reset), vec![0; peaks(&held).len()], "{reset:#}");
}
