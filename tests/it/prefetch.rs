//! Pages brought ahead of a moving viewer's next frame, through the real server.

use std::cell::Cell;
use std::time::{Duration, Instant};

use lumisphere_proto::v1alpha1 as wire;
use serde_json::Value;
use wire::cache_client::CacheClient;
use wire::offset_surface_light_field_settings::{Blend, Component, Filter};
use wire::render_settings::Representation;

use crate::process::{PATIENCE, Server, temporary_folder};
use crate::system::{get, metric};
use crate::tiny;
use crate::viewers::Viewer;
use crate::wire::{camera_around, settings};

const STEPS: u64 = 8;

/// Once around the box.
fn around(step: u64) -> wire::Camera {
    camera_around(std::f32::consts::TAU * step as f32 / STEPS as f32, 64, 48)
}

/// Without one nothing is brought to it.
pub fn has_adapter(server: &Server) -> bool {
    let has = server.json(&["system", "info"])["adapter"] != "";
    assert!(has || std::env::var_os("REQUIRE_GPU").is_none(), "no adapter");
    has
}

/// Every read wants a page: without filtering none is coarse.
fn mirror() -> wire::RenderSettings {
    let mut settings = settings(Component::Mirror, Blend::Distance);
    if let Some(Representation::OffsetSurfaceLightField(field)) = &mut settings.representation {
        field.filter = Filter::Bilinear.into();
    }
    settings
}

fn gpu(server: &Server) -> Value {
    let stats = server.json(&["cache", "stats"]);
    stats["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == "gpu").expect("an adapter").clone()
}

fn count(tier: &Value, key: &str) -> u64 {
    tier[key].as_u64().unwrap_or_else(|| panic!("no {key} in {tier:#}"))
}

/// Until the server has looked ahead so often.
fn wait_for_looks(server: &Server, looks: u64) {
    let (begin, told) = (Instant::now(), format!("lumisphere_looks_ahead_total {looks}"));
    while !get(&server.http, "/metrics").1.lines().any(|line| line == told) {
        assert!(begin.elapsed() < PATIENCE, "not {looks} looks ahead in time");
    }
}

/// Until the server has done nothing for a tenth of a second.
fn wait_until_idle(server: &Server) {
    let (begin, mut idle_since, mut seconds) = (Instant::now(), Instant::now(), server.cpu_seconds());
    while idle_since.elapsed() < Duration::from_millis(100) {
        assert!(begin.elapsed() < PATIENCE, "always busy");
        std::thread::yield_now();
        let now = server.cpu_seconds();
        if now != seconds {
            (idle_since, seconds) = (Instant::now(), now);
        }
    }
}

/// The frames of the path, each asked for once the one before has come and `between(frames so far)` has passed.
async fn walk(viewer: &mut Viewer, cameras: impl Iterator<Item = wire::Camera>, between: impl Fn(u64)) -> Vec<bytes::Bytes> {
    walk_from(1, viewer, cameras, between).await
}

/// The same for a viewer that has walked before.
async fn walk_from(
    first_pose_id: u64,
    viewer: &mut Viewer,
    cameras: impl Iterator<Item = wire::Camera>,
    between: impl Fn(u64),
) -> Vec<bytes::Bytes> {
    let mut colors = Vec::new();
    for (pose_id, camera) in (first_pose_id..).zip(cameras) {
        viewer.pose(pose_id, camera).await;
        let frame = viewer.frame().await;
        assert_eq!((frame.pose_id, frame.is_final), (pose_id, true));
        viewer.acknowledge(frame.frame_id).await;
        colors.push(frame.color);
        between(pose_id);
    }
    colors
}

#[tokio::test(flavor = "multi_thread")]
async fn a_moving_viewer_misses_less_with_pages_brought_ahead_and_sees_the_same() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let off = Server::start_with(&data, &["--prefetch", "off"]);
    tiny::capture(&off, folder.path());
    if !has_adapter(&off) {
        return;
    }
    let without = walk(&mut Viewer::open_with(&off, 1, mirror()).await, (0..STEPS).map(around), |_| {}).await;
    let missed_without = count(&gpu(&off), "misses");
    assert_eq!(count(&gpu(&off), "prefetched"), 0);
    assert_eq!(off.stop(), Some(0));

    let server = Server::start(&data);
    // After the second frame there is motion.
    let looked = |frames: u64| {
        if frames > 1 {
            wait_for_looks(&server, frames - 1)
        }
    };
    let with = walk(&mut Viewer::open_with(&server, 1, mirror()).await, (0..STEPS).map(around), looked).await;
    assert!(with == without, "other frames");
    let tier = gpu(&server);
    let (missed, ahead, used) = (count(&tier, "misses"), count(&tier, "prefetched"), count(&tier, "prefetch_used"));
    // The first two frames find nothing brought; extrapolation on a circle of eight steps is rough.
    assert!(missed < missed_without, "{missed} after {missed_without}: {tier:#}");
    assert!(0 < used && used + count(&tier, "prefetch_wasted") <= ahead, "{tier:#}");
    assert_eq!(missed_without - missed, used, "every page of use is a miss less");
    assert_eq!(count(&tier, "look_ups"), count(&tier, "hits") + count(&tier, "misses"));
    // Once around again, where every page is: there is nothing to look for, and a look would keep the renderer from the next frame.
    let looks = metric(&server, "looks_ahead_total");
    walk(&mut Viewer::open_with(&server, 1, mirror()).await, (0..STEPS).map(around), |_| wait_until_idle(&server)).await;
    assert_eq!((count(&gpu(&server), "misses"), metric(&server, "looks_ahead_total")), (missed, looks));
}

#[tokio::test(flavor = "multi_thread")]
async fn two_viewers_at_once_are_served_while_pages_are_brought_ahead() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    if !has_adapter(&server) {
        return;
    }
    let alone = walk(&mut Viewer::open_with(&server, 1, mirror()).await, (0..STEPS).map(around), |_| {}).await;
    server.json(&["cache", "clear"]);
    let (mut first, mut second) = (Viewer::open_with(&server, 2, mirror()).await, Viewer::open_with(&server, 2, mirror()).await);
    let backwards = (0..STEPS).rev().map(around);
    let (forth, back) = tokio::join!(walk(&mut first, (0..STEPS).map(around), |_| {}), walk(&mut second, backwards, |_| {}));
    assert!(forth == alone && back.into_iter().rev().collect::<Vec<_>>() == alone);
    let tier = gpu(&server);
    assert_eq!(count(&tier, "look_ups"), count(&tier, "hits") + count(&tier, "misses"), "{tier:#}");
    assert!(count(&tier, "prefetch_used") + count(&tier, "prefetch_wasted") <= count(&tier, "prefetched"), "{tier:#}");
}

/// Between no room at all and the budget as it was, and emptied each time; without end.
async fn upset(mut cache: CacheClient<tonic::transport::Channel>, budget: u64, rounds: &Cell<u32>) {
    let size = |bytes| wire::ConfigureCacheRequest { gpu_budget_bytes: Some(bytes), ..Default::default() };
    loop {
        for bytes in [1, budget, budget / 2, budget] {
            cache.configure_cache(size(bytes)).await.unwrap();
            cache.clear_cache(wire::ClearCacheRequest { reset_counters: false }).await.unwrap();
        }
        rounds.set(rounds.get() + 1);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_goes_on_while_the_adapters_tier_is_cleared_and_shrunk() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    if !has_adapter(&server) {
        return;
    }
    let path = || (0..STEPS).map(around);
    let undisturbed = walk(&mut Viewer::open_with(&server, 1, mirror()).await, path(), |_| {}).await;
    let budget = count(&gpu(&server), "budget_bytes");

    let mut viewer = Viewer::open_with(&server, 1, mirror()).await;
    let (cache, rounds) = (CacheClient::new(server.channel().await), Cell::new(0));
    // Again and again, until the tier has been emptied and shrunk under it a few times. Meanwhile the CPU may have drawn some of it.
    let walked = async {
        let mut first_pose_id = 1;
        while rounds.get() < 3 {
            walk_from(first_pose_id, &mut viewer, path(), |_| {}).await;
            first_pose_id += STEPS;
        }
        first_pose_id
    };
    let first_pose_id = tokio::select! {
        first_pose_id = walked => first_pose_id,
        () = upset(cache, budget, &rounds) => unreachable!("it has no end"),
    };

    // In peace: the first time after what was left of that, the second time after it was shrunk to nothing.
    for pose_id in [first_pose_id, first_pose_id + STEPS] {
        server.json(&["cache", "configure", "--gpu-budget-bytes", &budget.to_string()]);
        let afterwards = walk_from(pose_id, &mut viewer, path(), |_| {}).await;
        assert!(afterwards == undisturbed, "other frames than before");
        assert!(count(&gpu(&server), "used_bytes") > 0);
        server.json(&["cache", "configure", "--gpu-budget-bytes", "1"]);
        assert_eq!(count(&gpu(&server), "used_bytes"), 0);
    }
    let tier = gpu(&server);
    assert_eq!(count(&tier, "look_ups"), count(&tier, "hits") + count(&tier, "misses"), "{tier:#}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_at_rest_brings_nothing_ahead() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    if !has_adapter(&server) {
        return;
    }
    let mut viewer = Viewer::open_with(&server, 1, mirror()).await;
    // The same pose again and again: a look would come before the next frame's answer, or beside it.
    walk(&mut viewer, (0..6).map(|_| around(0)), |_| {}).await;
    // Then two steps: the look after the second is the first of all.
    walk(&mut viewer, (0..2).map(around), |_| {}).await;
    wait_for_looks(&server, 1);
}
