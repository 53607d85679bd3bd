//! Compiles the `.proto` files without `protoc`, and keeps their descriptors for the reflection service.

use std::path::PathBuf;
use std::{env, error, fs};

use prost::Message;

/// Relative to this crate.
const PROTOS: [&str; 5] = [
    "lumisphere/v1alpha1/system.proto",
    "lumisphere/v1alpha1/datasets.proto",
    "lumisphere/v1alpha1/rendering.proto",
    "lumisphere/v1alpha1/jobs.proto",
    "lumisphere/v1alpha1/cache.proto",
];

fn main() -> Result<(), Box<dyn error::Error>> {
    println!("cargo:rerun-if-changed=lumisphere");
    let descriptors = protox::compile(PROTOS, ["."])?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(out.join("descriptors.bin"), descriptors.encode_to_vec())?;
    // Bytes: a frame's image is handed to the socket without a copy. BTreeMap: maps are written in one order.
    tonic_prost_build::configure().bytes(".").btree_map(".").compile_fds(descriptors)?;
    Ok(())
}
