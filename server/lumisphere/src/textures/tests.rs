//! The room as its users see it: write, publish, read; then everything that can go wrong.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use super::laboratory::{Order, Setting, compare, replay, simulate};
use super::*;

mod crash;
mod damage;
mod disks;
mod laboratory;
mod roundtrip;
mod sharing;
mod uploads;

/// A page's texels: every number different, neighbours alike, as in a picture.
fn texels(shape: &PageShape, seed: u32) -> Vec<f32> {
    let wave = |i: usize| 0.5 + 0.4 * ((i as f32 * 0.37 + seed as f32).sin() + (i as f32 * 0.011).cos() * 0.2);
    (0..shape.values()).map(wave).collect()
}

fn shape(width: u32, height: u32, channels: u32, pixel: PixelFormat) -> PageShape {
    PageShape { width, height, channels, pixel }
}

/// Two blocks and a part of a third, four channels.
fn small() -> PageShape {
    shape(24, 40, 4, PixelFormat::F32)
}

fn open(root: &Path) -> (Store, OpenReport) {
    Store::open(root, StoreOptions::local()).unwrap()
}

fn publication() -> Publication {
    Publication {
        kind: "test".into(),
        parameters: serde_json::json!({"spacing": 0.25}),
        inputs: BTreeMap::from([("scene".into(), ContentHash::of(b"scene"))]),
        code_version: "0.1.0".into(),
        created_unix_millis: 1_700_000_000_000,
    }
}

fn append(staging: &Staging, pages: std::ops::Range<u32>) {
    for page in pages {
        staging.append_page(PageId(page), &small(), &texels(&small(), page)).unwrap();
    }
}

/// A dataset "d" whose version 1 has `pages` small pages and a blob.
fn publish(store: &Store, pages: u32) -> Arc<DatasetVersion> {
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "first").unwrap();
    append(&staging, 0..pages);
    staging.put_blob("geometry", b"four corners").unwrap();
    staging.publish(publication()).unwrap()
}

/// Every page and blob of "d" version 1 is what [`publish`] wrote.
fn assert_whole(version: &DatasetVersion, pages: u32) {
    assert_eq!(version.page_count(), pages);
    for page in 0..pages {
        assert_eq!(version.read_page(PageId(page)).unwrap().to_f32(), texels(&small(), page));
    }
    assert_eq!(version.blob("geometry").unwrap(), b"four corners");
}
