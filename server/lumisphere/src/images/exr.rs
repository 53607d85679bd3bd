//! OpenEXR: float and half, any named channels, any layers; scanline or tiled; of mip-mapped files the largest level.
//!
//! Called by [`super::decode_image`] for textures and environments, by `evaluate` for truths with distance and normals (`D`,
//! `N.X N.Y N.Z`), and by whoever writes linear frames. Source: the OpenEXR file layout as the `exr` crate implements it.
//!
//! A layer is its data window; the display window only says where that lies and is not applied. Deep data, subsampled channels
//! and DWA compression are refused by name.

use std::io::Cursor;

use ::exr::prelude as foreign;
use foreign::{ReadChannels as _, ReadLayers as _, WritableImage as _};
use half::f16;

use super::read::check_expansion;
use super::{Format, Image, ImageError, ReadLimits};

/// Everything an EXR file holds, widened to f32.
#[derive(Debug, Clone, PartialEq)]
pub struct ExrImage {
    /// In the file's order, at least one.
    pub layers: Vec<ExrLayer>,
}

/// One layer (the format's "part"): equally sized named channels.
#[derive(Debug, Clone, PartialEq)]
pub struct ExrLayer {
    /// The layer's name; files with one layer often have none.
    pub name: Option<String>,
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Sorted by name, as in the file.
    pub channels: Vec<ExrChannel>,
}

/// One named plane.
#[derive(Debug, Clone, PartialEq)]
pub struct ExrChannel {
    /// "R", "D", "N.X", "diffuse.G" …
    pub name: String,
    /// How it is stored in the file; in memory it is f32 either way.
    pub storage: ExrStorage,
    /// `row · width + column`, row 0 is the top.
    pub samples: Vec<f32>,
}

/// Storage of a channel in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExrStorage {
    /// 16-bit float: relative error up to 2⁻¹¹, largest value 65504; greater values become infinite.
    Half,
    /// 32-bit float, exact.
    Float,
}

/// Compression of a written file; all are lossless.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExrCompression {
    /// None: fastest.
    None,
    /// Blocks of 16 rows, zlib: what other programs expect.
    Zip,
    /// Wavelets: smaller than Zip for noisy images.
    Piz,
}

impl ExrImage {
    /// The layer of that name.
    pub fn layer(&self, name: &str) -> Result<&ExrLayer, ImageError> {
        self.layers.iter().find(|layer| layer.name.as_deref() == Some(name)).ok_or_else(|| ImageError::Missing {
            wanted: format!("layer {name}"),
            present: list(self.layers.iter().map(|layer| layer.name.as_deref().unwrap_or("(unnamed)"))),
        })
    }

    /// The first layer's colour as planes R G B, and A where it has alpha (associated, as EXR defines it); a luminance-only
    /// layer (`Y`) gives three equal planes.
    pub fn into_first_rgb(self) -> Result<Image, ImageError> {
        let first = self.layers.into_iter().next();
        first.ok_or_else(|| ImageError::Missing { wanted: "layer".into(), present: "none".into() })?.rgb()
    }
}

impl ExrLayer {
    /// A layer without name from an image's planes, named in the same order.
    pub fn from_planes(image: Image, names: &[&str], storage: ExrStorage) -> Result<Self, ImageError> {
        if names.len() != image.channels() {
            return Err(ImageError::Shape { expected: format!("{} planes", names.len()), actual: format!("{} planes", image.channels()) });
        }
        let channels = names.iter().zip(image.planes).map(|(name, samples)| ExrChannel { name: (*name).to_owned(), storage, samples });
        Ok(Self { name: None, width: image.width, height: image.height, channels: channels.collect() })
    }

    /// Samples of the channel of that name.
    pub fn channel(&self, name: &str) -> Result<&[f32], ImageError> {
        let found = self.channels.iter().find(|channel| channel.name == name);
        found.map(|channel| channel.samples.as_slice()).ok_or_else(|| ImageError::Missing {
            wanted: format!("channel {name}"),
            present: list(self.channels.iter().map(|channel| channel.name.as_str())),
        })
    }

    /// The channels of these names, in this order, as an image.
    pub fn planes(&self, names: &[&str]) -> Result<Image, ImageError> {
        let planes = names.iter().map(|name| self.channel(name).map(<[f32]>::to_vec)).collect::<Result<_, _>>()?;
        Ok(Image { width: self.width, height: self.height, planes })
    }

    /// Planes R G B (or Y three times), and A where there is one.
    pub fn rgb(&self) -> Result<Image, ImageError> {
        let has = |name| self.channel(name).is_ok();
        let colour = if has("Y") && !has("R") { ["Y"; 3] } else { ["R", "G", "B"] };
        match has("A") {
            true => self.planes(&[colour[0], colour[1], colour[2], "A"]),
            false => self.planes(&colour),
        }
    }
}

fn list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: Vec<_> = names.collect();
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

/// Decodes every layer and channel.
pub fn decode_exr(bytes: &[u8], limits: ReadLimits) -> Result<ExrImage, ImageError> {
    check_header(bytes, limits)?;
    let read = foreign::read().no_deep_data().largest_resolution_level().all_channels().all_layers().all_attributes();
    let image = read.from_buffered(Cursor::new(bytes)).map_err(decode_error)?;
    let layers = image.layer_data.into_iter().map(|layer| widen_layer(layer, limits)).collect::<Result<_, _>>()?;
    Ok(ExrImage { layers })
}

/// Bytes of an EXR file. Equal input gives equal bytes for any number of threads.
pub fn encode_exr(image: &ExrImage, compression: ExrCompression) -> Result<Vec<u8>, ImageError> {
    let layers = image.layers.iter().map(|layer| narrow_layer(layer, compression)).collect::<Result<Vec<_>, _>>()?;
    let Some(first) = layers.first() else {
        return Err(ImageError::Shape { expected: "at least one layer".into(), actual: "none".into() });
    };
    let window = foreign::ImageAttributes::with_size(first.size);
    let mut bytes = Cursor::new(Vec::new());
    foreign::Image::from_layers(window, layers).write().to_buffered(&mut bytes).map_err(decode_error)?;
    Ok(bytes.into_inner())
}

/// Bytes of an EXR file with the image's three planes as R G B, or four as R G B A; ZIP-compressed.
pub fn encode_exr_rgb(image: &Image, storage: ExrStorage) -> Result<Vec<u8>, ImageError> {
    let names: &[&str] = match image.channels() {
        3 => &["R", "G", "B"],
        4 => &["R", "G", "B", "A"],
        other => return Err(ImageError::Shape { expected: "3 or 4 planes".into(), actual: format!("{other} planes") }),
    };
    let layer = ExrLayer::from_planes(image.clone(), names, storage)?;
    encode_exr(&ExrImage { layers: vec![layer] }, ExrCompression::Zip)
}

/// Refuses, before the pixels' memory is taken, headers that announce more than the limit or than so short a file can hold.
fn check_header(bytes: &[u8], limits: ReadLimits) -> Result<(), ImageError> {
    let meta = foreign::MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(decode_error)?;
    let mut samples_left = limits;
    let mut decoded_bytes = 0;
    for header in &meta.headers {
        let (width, height, channels) = (header.layer_size.width(), header.layer_size.height(), header.channels.list.len());
        samples_left.check_size(width, height, channels).map_err(|_| ImageError::TooLarge {
            width,
            height,
            channels,
            max_samples: limits.max_samples,
        })?;
        samples_left.max_samples -= width * height * channels;
        decoded_bytes += width * height * header.channels.bytes_per_pixel;
        // A block is decoded through a buffer of its full size, which for tiles is the file's choice.
        if let ::exr::meta::BlockDescription::Tiles(tiles) = header.blocks {
            limits.check_size(tiles.tile_size.width(), tiles.tile_size.height(), channels)?;
        }
        if header.deep {
            return Err(ImageError::Unsupported { format: Format::Exr, feature: "deep data".into() });
        }
        if let Some(channel) = header.channels.list.iter().find(|channel| channel.sampling != foreign::Vec2(1, 1)) {
            return Err(ImageError::Unsupported { format: Format::Exr, feature: format!("subsampled channel {}", channel.name) });
        }
    }
    check_expansion(Format::Exr, decoded_bytes, bytes.len())
}

fn widen_layer(layer: foreign::Layer<foreign::AnyChannels<foreign::FlatSamples>>, limits: ReadLimits) -> Result<ExrLayer, ImageError> {
    let (width, height) = (layer.size.width(), layer.size.height());
    let channels = layer.channel_data.list.into_iter().map(|channel| {
        let (storage, samples) = match channel.sample_data {
            foreign::FlatSamples::F16(samples) => (ExrStorage::Half, samples.into_iter().map(f16::to_f32).collect()),
            foreign::FlatSamples::F32(samples) => (ExrStorage::Float, samples),
            foreign::FlatSamples::U32(samples) => (ExrStorage::Float, samples.into_iter().map(|sample| sample as f32).collect()),
        };
        let name = channel.name.to_string();
        limits.check_samples(&name, width, &samples)?;
        Ok(ExrChannel { name, storage, samples })
    });
    Ok(ExrLayer {
        name: layer.attributes.layer_name.map(|name| name.to_string()),
        width,
        height,
        channels: channels.collect::<Result<_, ImageError>>()?,
    })
}

fn narrow_layer(
    layer: &ExrLayer,
    compression: ExrCompression,
) -> Result<foreign::Layer<foreign::AnyChannels<foreign::FlatSamples>>, ImageError> {
    if layer.width == 0 || layer.height == 0 || layer.channels.is_empty() {
        let actual = format!("{} × {} pixels, {} channels", layer.width, layer.height, layer.channels.len());
        return Err(ImageError::Shape { expected: "at least one pixel and one channel".into(), actual });
    }
    let channels = layer.channels.iter().map(|channel| narrow_channel(channel, layer.width * layer.height)).collect::<Result<_, _>>()?;
    let attributes = match &layer.name {
        Some(name) => foreign::LayerAttributes::named(text(name)?),
        None => foreign::LayerAttributes::default(),
    };
    let compression = match compression {
        ExrCompression::None => foreign::Compression::Uncompressed,
        ExrCompression::Zip => foreign::Compression::ZIP16,
        ExrCompression::Piz => foreign::Compression::PIZ,
    };
    let encoding = foreign::Encoding { compression, blocks: foreign::Blocks::ScanLines, line_order: foreign::LineOrder::Increasing };
    Ok(foreign::Layer::new((layer.width, layer.height), attributes, encoding, foreign::AnyChannels::sort(channels)))
}

fn narrow_channel(channel: &ExrChannel, pixels: usize) -> Result<foreign::AnyChannel<foreign::FlatSamples>, ImageError> {
    if channel.samples.len() != pixels {
        let actual = format!("{} in channel {}", channel.samples.len(), channel.name);
        return Err(ImageError::Shape { expected: format!("{pixels} samples"), actual });
    }
    let samples = match channel.storage {
        ExrStorage::Half => foreign::FlatSamples::F16(channel.samples.iter().map(|&sample| f16::from_f32(sample)).collect()),
        ExrStorage::Float => foreign::FlatSamples::F32(channel.samples.clone()),
    };
    Ok(foreign::AnyChannel::new(text(&channel.name)?, samples))
}

fn text(name: &str) -> Result<foreign::Text, ImageError> {
    foreign::Text::new_or_none(name)
        .ok_or_else(|| ImageError::Shape { expected: "a name in Latin letters".into(), actual: format!("{name:?}") })
}

fn decode_error(error: foreign::Error) -> ImageError {
    match error {
        foreign::Error::Io(error) => ImageError::Io(error),
        foreign::Error::NotSupported(feature) => ImageError::Unsupported { format: Format::Exr, feature: feature.into_owned() },
        foreign::Error::Invalid(reason) => ImageError::Malformed { format: Format::Exr, reason: reason.into_owned() },
        foreign::Error::Aborted => ImageError::Malformed { format: Format::Exr, reason: "decoding stopped".into() },
    }
}
