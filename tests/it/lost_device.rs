//! A graphics device that is lost while viewers look (by a Vulkan layer, `tests/lost_device`): the CPU draws until another is opened, and
//! nobody's stream ends. A fit on such a device fails.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use lumisphere_proto::v1alpha1 as wire;
use wire::offset_surface_light_field_settings::{Blend, Component};

use crate::fits;
use crate::killed::follow_until;
use crate::prefetch::has_adapter;
use crate::process::{PATIENCE, Server, binary, temporary_folder};
use crate::tiny;
use crate::viewers::{TRANSPORTS, Viewer, opening};
use crate::wire::{camera_around, raw_pixels, settings};

/// In a folder, with a name that the loader finds it by.
fn install_layer(folder: &Path) {
    let library = binary("examples/liblost_device.so");
    let layer = serde_json::json!({
        "file_format_version": "1.2.0",
        "layer": {
            "name": "VK_LAYER_LUMISPHERE_lost_device", "type": "GLOBAL", "library_path": library, "api_version": "1.3.0",
            "implementation_version": "1", "description": "Loses the device",
        },
    });
    fs::write(folder.join("lost_device.json"), layer.to_string()).unwrap();
}

/// Another one for each pose.
fn camera(pose_id: u64) -> wire::Camera {
    camera_around(0.1 * pose_id as f32, 64, 48)
}

/// The last frame of that pose.
async fn shown(viewer: &mut Viewer, pose_id: u64, camera: wire::Camera) -> wire::Frame {
    viewer.pose(pose_id, camera).await;
    loop {
        let frame = viewer.frame().await;
        viewer.acknowledge(frame.frame_id).await;
        if frame.pose_id == pose_id && frame.is_final {
            return frame;
        }
    }
}

/// A server whose device is lost while the file is there.
fn start(folder: &Path, lost: &Path) -> Server {
    install_layer(folder);
    let mut command = Command::new(binary("lumisphere-server"));
    command.env("VK_LAYER_PATH", folder).env("VK_INSTANCE_LAYERS", "VK_LAYER_LUMISPHERE_lost_device").env("LOST_DEVICE", lost);
    Server::spawn(&mut command, &folder.join("data"))
}

#[tokio::test]
async fn a_fit_whose_graphics_device_is_lost_fails_and_leaves_nothing() {
    let folder = temporary_folder();
    let lost = folder.path().join("lost");
    let server = start(folder.path(), &lost);
    if !has_adapter(&server) {
        return;
    }
    fits::observe(&server, folder.path());
    let flags = ["--model", "phong:1", "--backend", "gpu", "--publish-every", "0.001"];
    let name = fits::submit(&server, "map", &flags);
    let job = follow_until(&server, &name, |job| !fits::fit_of(job).partial_dataset.is_empty()).await;
    assert!(fits::fit_of(&job).texels < fits::TEXELS, "not lost half-way: {job:?}");
    fs::write(&lost, "").unwrap();
    let job = follow_until(&server, &name, |_| false).await;
    let error = job.error.clone().unwrap_or_default();
    assert_eq!((job.state(), error.reason.as_str()), (wire::JobState::Failed, "GPU_UNAVAILABLE"), "{job:?}");
    assert!(error.message.starts_with("the fit's graphics device:"), "{error:?}");
    assert_eq!((fits::latest(&server, "map"), fits::latest(&server, "map-partial")), (Some(0), None));
    assert!(fs::read_dir(folder.path().join("data/staging")).unwrap().next().is_none(), "a failed fit leaves something behind");
    fs::remove_file(&lost).unwrap();
    let name = fits::submit(&server, "map", &flags);
    assert_eq!(follow_until(&server, &name, |_| false).await.state(), wire::JobState::Succeeded);
}

#[tokio::test]
async fn viewers_see_on_while_the_graphics_device_is_lost_and_after_another_was_opened() {
    let folder = temporary_folder();
    let lost = folder.path().join("lost");
    let server = start(folder.path(), &lost);
    if !has_adapter(&server) {
        return;
    }
    tiny::capture(&server, folder.path());
    let mut viewers = Vec::new();
    for transport in TRANSPORTS {
        let open = wire::OpenInteraction { settings: Some(settings(Component::Full, Blend::Average)), ..opening(1) };
        viewers.push(Viewer::open_as(&server, open, transport).await.unwrap());
    }
    let mut pose_id = 0;
    for round in 1..=2 {
        pose_id += 1;
        let mut before = Vec::new();
        for viewer in &mut viewers {
            before.push(shown(viewer, pose_id, camera(pose_id)).await);
            assert_eq!(before.last().unwrap().backend(), wire::Backend::Gpu, "round {round}");
        }
        fs::write(&lost, "").unwrap();
        for _ in 0..3 {
            pose_id += 1;
            for viewer in &mut viewers {
                let frame = shown(viewer, pose_id, camera(pose_id)).await;
                assert_eq!((frame.backend(), frame.adapter.as_str()), (wire::Backend::Cpu, ""), "round {round}, pose {pose_id}");
            }
        }
        fs::remove_file(&lost).unwrap();
        // As soon as it is tried again.
        let begun = Instant::now();
        loop {
            assert!(begun.elapsed() < PATIENCE, "round {round}: no device after {:?}", begun.elapsed());
            pose_id += 1;
            if shown(&mut viewers[0], pose_id, camera(pose_id)).await.backend() == wire::Backend::Gpu {
                break;
            }
        }
        // What stands on the new device is what stood on the old one.
        pose_id += 1;
        for (viewer, before) in viewers.iter_mut().zip(&before) {
            let frame = shown(viewer, pose_id, before.camera.unwrap()).await;
            assert_eq!(frame.backend(), wire::Backend::Gpu, "round {round}");
            let (now, then) = (raw_pixels(&frame.color), raw_pixels(&before.color));
            // Pages lie elsewhere in its memory, where coordinates are rounded otherwise.
            let differs = |(now, then): &(&f32, &f32)| (*now - *then).abs() > 1e-5 * then.max(1.0);
            assert_eq!((now.len(), now.iter().zip(&then).find(differs)), (then.len(), None), "round {round}");
        }
    }
    assert!(server.log_text().contains("the graphics device was lost; another was opened"), "{}", server.log_text());
}
