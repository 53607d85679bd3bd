//! `lumisphere load`: what it measures of a server that cannot keep up, and where its viewers look.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::process::{Server, binary, temporary_folder};
use crate::tiny::{self, DATASET};

const SMALL: [&str; 6] = ["--component", "mirror", "--backend", "cpu", "--size", "64x48"];

/// The first phase of a load test of one viewer.
fn first_phase(server: &Server, flags: &[&str]) -> Value {
    let report = server.json(&[&["load", "--dataset", DATASET, "--viewers", "1", "--quiet"], &SMALL[..], flags].concat());
    report["phases"][0].clone()
}

fn count(of: &Value, key: &str) -> u64 {
    of[key].as_u64().unwrap_or_else(|| panic!("no {key} in {of:#}"))
}

#[test]
fn a_frame_is_late_from_when_it_was_due_so_that_a_backlog_shows_in_the_percentiles() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let millis = |phase: &Value, percentile: &str| phase["latency_millis"][percentile].as_f64().unwrap();
    let at_ease = first_phase(&server, &["--phases", "warm", "--rate", "4", "--requests", "4"]);
    // All due within six milliseconds, fewer than the queue refuses: the last one waits for all others.
    let backlog = first_phase(&server, &["--phases", "warm", "--rate", "10000", "--requests", "60"]);
    assert_eq!((count(&backlog, "frames"), count(&backlog, "refused")), (60, 0), "{backlog:#}");
    // Timed from when each was begun, in turn, it would be a sixtieth of the phase, and as long as one that had no other before it.
    let phase_millis = 1e3 * backlog["seconds"].as_f64().unwrap();
    assert!(millis(&backlog, "p99") > 0.5 * phase_millis, "{backlog:#}");
    assert!(millis(&backlog, "p99") > 5.0 * millis(&at_ease, "p50"), "{at_ease:#} {backlog:#}");
}

/// On one thread: two that want a page at once would both miss it.
fn server_on_one_thread(data: &Path) -> Server {
    Server::spawn(Command::new(binary("lumisphere-server")).env("RAYON_NUM_THREADS", "1"), data)
}

#[test]
fn replayed_cameras_cost_what_the_same_cameras_cost_when_rendered() {
    let folder = temporary_folder();
    let server = server_on_one_thread(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let cameras = folder.path().join("scene/scene.json");
    let cameras = cameras.to_str().unwrap();
    // The file has two cameras.
    let replay = ["--motion", "replayed", "--cameras", cameras, "--phases", "cold", "--rate", "4", "--requests", "2"];
    let phase = first_phase(&server, &replay);
    server.json(&["cache", "clear", "--reset-counters"]);
    let out = folder.path().join("out");
    let flags = ["--cameras", cameras, "--out", out.to_str().unwrap(), "--format", "raw", "--component", "mirror", "--backend", "cpu"];
    server.succeed(&[&["render", "--dataset", DATASET], &flags[..]].concat());
    let rendered = &server.json(&["cache", "stats"])["texels"];
    assert!(count(&phase, "misses") > 0);
    for key in ["look_ups", "misses", "texel_fetches", "texel_misses", "bytes_read", "bytes_decoded"] {
        assert_eq!(count(&phase, key), count(rendered, key), "{key}");
    }
}

#[test]
fn walks_and_jumps_look_elsewhere_each_by_its_seed() {
    let folder = temporary_folder();
    let server = server_on_one_thread(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let fetches = |motion: &str, seed: &str| {
        let flags = ["--motion", motion, "--seed", seed, "--phases", "cold", "--rate", "50", "--requests", "4"];
        let phase = first_phase(&server, &flags);
        assert_eq!((count(&phase, "frames"), count(&phase, "refused")), (4, 0), "{motion}: {phase:#}");
        assert!(count(&phase, "misses") > 0, "{motion}: {phase:#}");
        count(&phase, "texel_fetches")
    };
    let seen = [("orbit", "1"), ("walk", "1"), ("walk", "2"), ("jump", "1"), ("jump", "2")].map(|(motion, seed)| fetches(motion, seed));
    let mut different = seen.to_vec();
    different.sort_unstable();
    different.dedup();
    assert_eq!(different.len(), seen.len(), "two of them looked at the same: {seen:?}");
    assert_eq!(fetches("walk", "1"), seen[1], "a walk is not its seed's alone");
}
