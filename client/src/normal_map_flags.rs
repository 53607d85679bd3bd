//! The flags of a normal map, and its file's way to the server.

use std::path::Path;

use anyhow::Context as _;
use clap::Args;
use lumisphere::formats::normal_map;
use lumisphere::textures::ContentHash;
use lumisphere_proto::v1alpha1::offset_surface_light_field_settings::NormalMap;

use crate::context::Context;
use crate::exit::Failure;
use crate::progress::Meter;
use crate::upload::{Blob, upload};

/// What turns the normals by which a surface reflects.
#[derive(Debug, Clone, Default, Args)]
pub struct NormalMapFlags {
    /// Map that turns the normals of components mirror, full and glossy: a PNG of 8 or 16 bits, normals in tangent space or, grey, heights; it is
    /// uploaded (a hash names one that was)
    #[arg(long, value_name = "FILE")]
    pub normal_map: Option<String>,
    /// What its x and y, or heights, are multiplied with, -16 to 16 [default: 1]
    #[arg(long, value_name = "FACTOR", requires = "normal_map", allow_negative_numbers = true)]
    pub normal_strength: Option<f32>,
    /// How often it repeats over u and over v, 0.001 to 4096 [default: 1]
    #[arg(long, value_name = "TIMES", requires = "normal_map")]
    pub normal_repeat: Option<f32>,
}

impl NormalMapFlags {
    /// No map.
    pub const NONE: Self = Self { normal_map: None, normal_strength: None, normal_repeat: None };

    /// The wire's form, but for a file, which [`uploaded`] makes a hash.
    pub fn to_wire(&self) -> Option<NormalMap> {
        let map = |image: &String| NormalMap { image: image.clone(), strength: self.normal_strength, repeat: self.normal_repeat };
        self.normal_map.as_ref().map(map)
    }
}

/// The hash of what is named: a hash, or a file, which is uploaded.
pub async fn uploaded(named: &str, context: &Context) -> anyhow::Result<String> {
    if named.parse::<ContentHash>().is_ok() {
        return Ok(named.into());
    }
    let file = Path::new(named);
    let bytes = std::fs::metadata(file).with_context(|| format!("cannot read {named}"))?.len();
    if bytes > normal_map::MOST_FILE_BYTES {
        let problem = format!("{named} has {bytes} bytes, at most {} of a normal map expected", normal_map::MOST_FILE_BYTES);
        return Err(Failure::Usage(problem).into());
    }
    let content = std::fs::read(file).with_context(|| format!("cannot read {named}"))?;
    normal_map::read(&content).map_err(|e| Failure::Usage(format!("{named}: {e}")))?;
    let blob = Blob::from_file(file)?;
    let mut client = context.connect().await?.datasets();
    let mut meter = Meter::new(context.output);
    upload(context, &mut client, &blob, &mut meter, "uploading the normal map").await?;
    meter.finish();
    Ok(blob.blake3)
}
