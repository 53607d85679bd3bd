//! The texture cache over the wire: counters add up, changes take effect while frames are rendered, traces are recorded and replayed.

use std::fs;

use lumisphere_proto::v1alpha1 as wire;
use serde_json::Value;
use tonic::Code;
use wire::cache_client::CacheClient;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};
use crate::wire::{code_and_reason, frame_request};

fn tier<'a>(stats: &'a Value, name: &str) -> &'a Value {
    stats["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == name).unwrap_or_else(|| panic!("no tier {name} in {stats:#}"))
}

fn count(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value} is no count"))
}

async fn cache(server: &Server) -> CacheClient<tonic::transport::Channel> {
    CacheClient::new(server.channel().await)
}

/// A frame on the CPU, texel by texel through the cache.
fn render(server: &Server, out: &std::path::Path) -> Vec<u8> {
    let out_text = out.to_str().unwrap();
    let flags = ["--backend", "cpu", "--component", "mirror", "--format", "exr", "--frames", "1", "--size", "64x48", "--force"];
    server.succeed(&[&["render", "--dataset", DATASET, "--out", out_text], &flags[..]].concat());
    fs::read(out.join("frame-00000.exr")).unwrap()
}

#[test]
fn every_strategy_policy_and_budget_gives_the_same_pixels_and_counters_that_add_up() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let out = folder.path().join("out");
    let expected = render(&server, &out);
    let mut fetches = 0;
    for (strategy, policy, budget) in [
        ("block", "lru", "1000000"),
        ("full_image", "clock", "9000"),
        ("half_threshold", "arc", "0"),
        ("on_demand", "s3_fifo", "20000"),
        ("on_demand_restart", "frame_lru", "20000"),
    ] {
        let change = ["cache", "configure", "--strategy", strategy, "--memory-policy", policy, "--memory-budget-bytes", budget];
        let now = server.json(&change);
        assert_eq!((now["strategy"].as_str(), tier(&now, "memory")["policy"].as_str()), (Some(strategy), Some(policy)));
        assert_eq!(render(&server, &out), expected, "{strategy}, {policy}, {budget} bytes");
        let now = server.json(&["cache", "stats"]);
        let memory = tier(&now, "memory");
        assert_eq!(count(&memory["look_ups"]), count(&memory["hits"]) + count(&memory["misses"]), "{now:#}");
        assert!(count(&memory["used_bytes"]) <= budget.parse().unwrap(), "{now:#}");
        let texels = &now["datasets"][0]["texels"];
        assert!(count(&texels["texel_misses"]) <= count(&texels["texel_fetches"]));
        assert!(count(&texels["texel_fetches"]) > fetches, "{now:#}");
        fetches = count(&texels["texel_fetches"]);
    }
    let cleared = server.json(&["cache", "clear", "--reset-counters"]);
    assert_eq!((count(&tier(&cleared, "memory")["used_bytes"]), count(&tier(&cleared, "memory")["look_ups"])), (0, 0));
}

#[test]
fn the_compressed_tier_and_one_datasets_strategy_change_alone() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    tiny::capture_with(&server, folder.path(), "second", &QUICK);
    let out = folder.path().join("out");
    // The second one is told once it has been asked for, as the first is.
    for dataset in [DATASET, "second"] {
        let flags = ["--out", out.to_str().unwrap(), "--format", "raw", "--frames", "1", "--size", "16x12", "--backend", "cpu", "--force"];
        server.succeed(&[&["render", "--dataset", dataset], &flags[..]].concat());
    }
    let before = server.json(&["cache", "stats"]);
    let setting = |stats: &Value, name: &str| (tier(stats, name)["policy"].clone(), tier(stats, name)["budget_bytes"].clone());
    let strategies = |stats: &Value| {
        let of = |name: &str| stats["datasets"].as_array().unwrap().iter().find(|d| d["dataset"] == name).unwrap()["strategy"].clone();
        [of(DATASET), of("second"), stats["strategy"].clone()]
    };

    server.json(&["cache", "configure", "--compressed-policy", "clock", "--compressed-budget-bytes", "123456"]);
    let now = server.json(&["cache", "stats"]);
    assert_eq!(setting(&now, "compressed"), ("clock".into(), 123_456.into()));
    assert_eq!(setting(&now, "memory"), setting(&before, "memory"));
    assert_eq!(strategies(&now), strategies(&before));

    server.json(&["cache", "configure", "--strategy", "on_demand_restart", "--dataset", DATASET]);
    let now = server.json(&["cache", "stats"]);
    let [_, of_second, of_others] = strategies(&before);
    assert_ne!(of_second, "on_demand_restart");
    assert_eq!(strategies(&now), ["on_demand_restart".into(), of_second, of_others]);
    assert_eq!(setting(&now, "compressed"), ("clock".into(), 123_456.into()));
}

#[tokio::test(flavor = "multi_thread")]
async fn senseless_changes_are_refused_whole() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut cache = cache(&server).await;
    let refused = [
        wire::ConfigureCacheRequest { memory_budget_bytes: Some(1 << 50), ..Default::default() },
        wire::ConfigureCacheRequest { memory_policy: 77, ..Default::default() },
        wire::ConfigureCacheRequest { strategy: 77, ..Default::default() },
        wire::ConfigureCacheRequest { dataset: "NOT A NAME".into(), strategy: 1, ..Default::default() },
    ];
    for request in refused {
        let status = cache.configure_cache(request).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
    }
    let request = wire::ConfigureCacheRequest {
        dataset: "nothing".into(),
        strategy: wire::ReadStrategy::Block.into(),
        memory_budget_bytes: Some(5),
        ..Default::default()
    };
    assert_eq!(cache.configure_cache(request).await.unwrap_err().code(), Code::NotFound);
    let now = cache.get_cache_stats(wire::GetCacheStatsRequest {}).await.unwrap().into_inner();
    assert!(now.tiers.iter().all(|t| t.budget_bytes != 5), "a refused change changed the budget");
    let too_often = wire::WatchCacheStatsRequest { interval_seconds: 1e-9 };
    assert_eq!(cache.watch_cache_stats(too_often).await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test(flavor = "multi_thread")]
async fn watched_counters_follow_what_is_rendered() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let watch = wire::WatchCacheStatsRequest { interval_seconds: 0.05 };
    let mut changes = cache(&server).await.watch_cache_stats(watch).await.unwrap().into_inner();
    let look_ups = |stats: wire::CacheStats| stats.texels.unwrap().look_ups;
    assert_eq!(look_ups(changes.message().await.unwrap().unwrap()), 0);
    server.rendering().await.render_frame(frame_request(DATASET)).await.unwrap();
    let seen = tokio::time::timeout(crate::process::PATIENCE, async { while look_ups(changes.message().await.unwrap().unwrap()) == 0 {} });
    seen.await.expect("the frame's look-ups are told");
}

#[test]
fn a_recorded_frame_is_replayed_and_charted() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let (trace, csv, chart) = (at("frame.lstr"), at("table.csv"), at("chart.svg"));
    let record = ["cache", "record", "--dataset", DATASET, "--component", "mirror", "--frames", "2", "--size", "64x48", "--out", &trace];
    server.succeed(&record);
    let sizes = ["--sizes", "1,4,16", "--strategies", "on_demand,half_threshold,full_image", "--out", &csv];
    let rows = server.json(&[&["cache", "replay", &trace], &sizes[..]].concat());
    let misses = |strategy: &str, policy: &str, size: u64| {
        let row = rows.as_array().unwrap().iter().find(|r| r["strategy"] == strategy && r["policy"] == policy && r["size_pages"] == size);
        count(&row.unwrap_or_else(|| panic!("no row {strategy} {policy} {size} in {rows:#}"))["misses"])
    };
    for size in [1, 4, 16] {
        assert!(misses("on_demand", "lru", size) >= misses("half_threshold", "lru", size));
        assert!(misses("half_threshold", "lru", size) >= misses("full_image", "lru", size));
        assert!(misses("full_image", "lru", size) >= misses("full_image", "belady", size));
    }
    assert!(misses("full_image", "lru", 1) > misses("full_image", "lru", 16), "{rows:#}");
    server.succeed(&["cache", "report", &csv, "--strategy", "full_image", "--out", &chart]);
    let svg = fs::read_to_string(&chart).unwrap();
    assert!(svg.contains("belady") && svg.contains("cache size in pages"));

    // On the server, while it serves: the real caches miss what was predicted for them and say what it took.
    let on_server =
        ["--json", "cache", "replay", &trace, "--sizes", "1,4,16", "--strategies", "block", "--on-server", "--force", "--out", &csv];
    let counters = server.json(&["cache", "stats"]);
    let rows = server.json(&on_server[1..]);
    for row in rows.as_array().unwrap() {
        let is_real = row["policy"] != "belady";
        assert_eq!((row["millis"].as_f64().is_some_and(|millis| millis > 0.0), row["bytes_read"].is_u64()), (is_real, is_real), "{row}");
    }
    let read = |size: u64| {
        let row = rows.as_array().unwrap().iter().find(|r| r["policy"] == "lru" && r["size_pages"] == size);
        count(&row.unwrap_or_else(|| panic!("no row of {size} in {rows:#}"))["bytes_read"])
    };
    assert!(read(1) > read(16), "{rows:#}");
    assert_eq!(server.json(&["cache", "stats"])["texels"], counters["texels"], "a replay counted as the server's own reads");
    for value in ["time", "excess", "decoded"] {
        server.succeed(&["cache", "report", &csv, "--strategy", "block", "--value", value, "--force", "--out", &chart]);
    }

    // A wandering viewer's first places are not the orbit's.
    let walk = at("walk.lstr");
    server.succeed(&[&record[..record.len() - 1], &[&walk, "--walk"]].concat());
    assert_ne!(fs::read(&walk).unwrap(), fs::read(&trace).unwrap());

    // Not a trace, a cut one, one that lies: each is an error that says so.
    for broken in [b"hello".to_vec(), fs::read(&trace).unwrap()[..40].to_vec()] {
        fs::write(at("broken"), broken).unwrap();
        assert_eq!(server.lumisphere(&["cache", "replay", &at("broken")]).status.code(), Some(2));
    }

    // Over the data itself, which must not be in use.
    let timed = ["--json", "cache", "replay", &trace, "--sizes", "4", "--policies", "lru", "--data-dir", &at("data")];
    let mut timed = server.lumisphere_command(&timed);
    assert!(!timed.output().unwrap().status.success());
    assert_eq!(server.stop(), Some(0));
    let output = timed.output().unwrap();
    let rows: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
    for row in rows.as_array().unwrap() {
        assert_eq!(row["millis"].as_f64().is_some_and(|millis| millis > 0.0), row["policy"] == "lru", "{row}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn traffic_is_recorded_by_one_at_a_time() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let mut cache = cache(&server).await;
    let long = wire::RecordTrafficRequest { seconds: 3000.0 };
    let first = cache.record_traffic(long).await.unwrap();
    let status = cache.record_traffic(long).await.unwrap_err();
    assert_eq!(code_and_reason(&status), (Code::Aborted, "RECORDING_BUSY".into()));
    // Who leaves frees the place.
    drop(first);
    let short = wire::RecordTrafficRequest { seconds: 0.3 };
    let mut second = loop {
        match cache.record_traffic(short).await {
            Ok(stream) => break stream.into_inner(),
            Err(status) => assert_eq!(status.code(), Code::Aborted, "{status:?}"),
        }
    };
    let mut request = frame_request(DATASET);
    request.settings.as_mut().unwrap().backend = wire::Backend::Cpu.into();
    server.rendering().await.render_frame(request).await.unwrap();
    let mut bytes = Vec::new();
    while let Some(chunk) = second.message().await.unwrap() {
        bytes.extend_from_slice(&chunk.data);
    }
    let trace = lumisphere::textures::Trace::from_bytes(&bytes).unwrap();
    assert_eq!(trace.versions[0].dataset, DATASET);
    assert!(trace.events.len() > 10);
}

#[test]
fn a_load_test_reports_latency_and_misses_and_leaves_the_cache_as_it_was() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let out = folder.path().join("load");
    let before = server.json(&["cache", "stats"]);
    let flags = ["--viewers", "2", "--rate", "40", "--requests", "6", "--size", "48x36", "--component", "mirror", "--backend", "cpu"];
    let strategies = ["--strategies", "full_image,block", "--quiet", "--out", out.to_str().unwrap()];
    let report = server.json(&[&["load", "--dataset", DATASET], &flags[..], &strategies].concat());
    let phases = report["phases"].as_array().unwrap();
    assert_eq!(phases.len(), 8, "{report:#}");
    for phase in phases {
        assert_eq!(count(&phase["frames"]) + count(&phase["refused"]), 12, "{phase:#}");
        let at = |p: &str| phase["latency_millis"][p].as_f64().unwrap();
        assert!(0.0 < at("p50") && at("p50") <= at("p99") && at("p99") <= at("max"), "{phase:#}");
    }
    let misses = |phase: &str| count(&phases.iter().find(|p| p["phase"] == phase).unwrap()["misses"]);
    assert!(misses("cold") > 0 && misses("warm") == 0 && misses("larger-than-cache") > 0, "{report:#}");
    assert!(fs::read_to_string(out.join("load.svg")).unwrap().contains("larger-than-cache"));
    let after = server.json(&["cache", "stats"]);
    assert_eq!(after["strategy"], before["strategy"]);
    assert_eq!(tier(&after, "memory")["budget_bytes"], tier(&before, "memory")["budget_bytes"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn replays_are_bounded_one_at_a_time_and_end_when_the_client_leaves() {
    use wire::replay_trace_request::Message;
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let mut cache = cache(&server).await;
    let shape = |height| lumisphere::textures::PageShape { width: 16, height, channels: 4, pixel: lumisphere::textures::PixelFormat::F32 };
    let bytes = |dataset: &str, page_count: u32, height: u32, (page, row, fetches): (u32, u32, u32)| {
        let version = lumisphere::textures::TracedVersion { dataset: dataset.into(), version: 1, page_count, shape: shape(height) };
        let event = lumisphere::textures::TraceEvent::Row { version: 0, page: lumisphere::textures::PageId(page), row, fetches };
        lumisphere::textures::Trace { versions: vec![version], events: vec![event], is_truncated: false }.to_bytes()
    };
    let request = |sizes_pages: Vec<u32>, trace: Vec<u8>| {
        let settings = wire::ReplaySettings { sizes_pages, ..Default::default() };
        [Message::Settings(settings), Message::Trace(trace.into())].map(|message| wire::ReplayTraceRequest { message: Some(message) })
    };
    let good = bytes(DATASET, 10, 16, (0, 3, 5));
    for (sizes, trace, code, reason) in [
        (vec![], good.clone(), Code::InvalidArgument, "FIELD_INVALID"),
        (vec![u32::MAX], good.clone(), Code::InvalidArgument, "FIELD_INVALID"),
        (vec![1], good[..good.len() - 1].to_vec(), Code::InvalidArgument, "FIELD_INVALID"),
        // Pages and rows that the trace claims and the store does not have; more fetches than a replay takes.
        (vec![1], bytes(DATASET, 1 << 20, 16, (1 << 19, 0, 1)), Code::InvalidArgument, "FIELD_INVALID"),
        (vec![1], bytes(DATASET, 10, 64, (0, 63, 1)), Code::InvalidArgument, "FIELD_INVALID"),
        (vec![1], bytes(DATASET, 10, 16, (0, 0, u32::MAX)), Code::InvalidArgument, "FIELD_INVALID"),
        (vec![1], bytes("nothing", 10, 16, (0, 0, 1)), Code::NotFound, "DATASET_NOT_FOUND"),
    ] {
        let mut outcomes = cache.replay_trace(tokio_stream::iter(request(sizes.clone(), trace))).await.unwrap().into_inner();
        let status = outcomes.message().await.unwrap_err();
        assert_eq!(code_and_reason(&status), (code, reason.to_string()), "{sizes:?}: {status:?}");
    }
    // One that has not sent its trace has the place; who leaves frees it.
    let (up, messages) = tokio::sync::mpsc::channel(1);
    let first = cache.replay_trace(tokio_stream::wrappers::ReceiverStream::new(messages)).await.unwrap();
    let status = cache.replay_trace(tokio_stream::iter(request(vec![1], good.clone()))).await.unwrap_err();
    assert_eq!(code_and_reason(&status), (Code::Aborted, "REPLAY_BUSY".into()));
    drop((up, first));
    let mut outcomes = loop {
        match cache.replay_trace(tokio_stream::iter(request(vec![1, 2], good.clone()))).await {
            Ok(outcomes) => break outcomes.into_inner(),
            Err(status) => assert_eq!(status.code(), Code::Aborted, "{status:?}"),
        }
    };
    let mut told = Vec::new();
    while let Some(outcome) = outcomes.message().await.unwrap() {
        let texels = outcome.texels.unwrap();
        assert_eq!((texels.texel_fetches, texels.texel_misses), (5, 1), "{outcome:?}");
        told.push((outcome.done, outcome.total));
    }
    // Two sizes under every strategy and policy.
    let total = (2 * lumisphere::textures::ReadStrategy::ALL.len() * lumisphere::textures::PolicyKind::ALL.len()) as _;
    assert_eq!(told, (1..=total).map(|done| (done, total)).collect::<Vec<_>>());
}
