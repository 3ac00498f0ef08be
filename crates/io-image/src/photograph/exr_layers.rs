//! An EXR photograph: its attributes, layers and channels, and new pixels for `R G B` and `A`.
//!
//! All attributes of the picture and of every layer are kept, as are channels that are not colours, further
//! layers, tiles and compression. A channel of half floats stays one. Two attributes change: `software`, and
//! `history`, which gains a line. The `preview` attribute shows the old picture and is left out.

use std::io::{self, Cursor};
use std::path::Path;
use std::result::Result;

use exr::image::FlatImage;
use exr::prelude::*;

use super::history::one_line;
use super::interleaved::SampleRows;
use super::tiff_write::WriteSeek;
use crate::byte_source::ByteSource;
use crate::decoded::{Decoded, Samples};
use crate::error::{FileFormat, ImageError};
use crate::exr_file::pick;
use crate::limits::check_size;

/// The attribute with the history, one line after the other.
const HISTORY: &str = "history";

/// An EXR without the samples of its picture.
#[derive(Clone, Debug)]
pub(crate) struct ExrTags {
    image: FlatImage,
    /// The layer with the picture.
    layer: usize,
    /// The numbers of its channels red, green, blue, and alpha if there is one.
    channels: Vec<usize>,
}

/// A text of an attribute: Latin letters.
fn text(value: &str) -> Text {
    let latin = |c: char| if u32::from(c) < 256 { c } else { '?' };
    Text::new_or_none(one_line(value).chars().map(latin).collect::<String>()).unwrap_or_default()
}

/// The channel's samples as `f32`, and an empty list of their type in their place.
fn take(data: &mut FlatSamples) -> Vec<f32> {
    let values = data.values_as_f32().collect();
    *data = match data {
        FlatSamples::F16(_) => FlatSamples::F16(Vec::new()),
        FlatSamples::F32(_) => FlatSamples::F32(Vec::new()),
        FlatSamples::U32(_) => FlatSamples::U32(Vec::new()),
    };
    values
}

/// The history so far.
fn earlier_history(attributes: &LayerAttributes) -> Option<String> {
    match attributes.other.get(&Text::new_or_none(HISTORY)?) {
        Some(AttributeValue::Text(text)) => Some(text.to_string()),
        _ => None,
    }
}

/// Checks the sizes of all layers together, because all of them are decoded.
fn check_layers(bytes: &[u8], path: &Path) -> Result<(), ImageError> {
    let (format, length) = (FileFormat::Exr, bytes.len() as u64);
    let mut cursor = Cursor::new(bytes);
    let source: &mut dyn ByteSource = &mut cursor;
    let meta = exr::meta::MetaData::read_from_buffered(source, false)
        .map_err(|e| ImageError::decode(path, format, e))?;
    let mut before = 0u64;
    for header in &meta.headers {
        let (width, height) = (header.layer_size.width() as u64, header.layer_size.height() as u64);
        let pixels = width.saturating_mul(height).max(1);
        let per_pixel: usize = header.channels.list.iter().map(|c| c.sample_type.bytes_per_sample()).sum();
        // Bytes of the layers before it count as if they were this layer's.
        let per_pixel = per_pixel as u64 + before.div_ceil(pixels);
        check_size(path, format, width, height, per_pixel, length)?;
        before = pixels.saturating_mul(per_pixel);
    }
    Ok(())
}

impl ExrTags {
    /// Decodes a file; its pixels come without their metadata.
    pub(crate) fn read(
        bytes: &[u8],
        path: &Path,
        notes: &mut Vec<String>,
    ) -> Result<(Self, Decoded), ImageError> {
        let fail = |e: &dyn std::fmt::Display| ImageError::decode(path, FileFormat::Exr, e);
        check_layers(bytes, path)?;
        let mut cursor = Cursor::new(bytes);
        let source: &mut dyn ByteSource = &mut cursor;
        let mut image: FlatImage = read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .all_layers()
            .all_attributes()
            .non_parallel()
            .from_buffered(source)
            .map_err(|e| fail(&e))?;
        let names = |l: &Layer<AnyChannels<FlatSamples>>| -> Vec<String> {
            l.channel_data.list.iter().map(|c| c.name.to_string()).collect()
        };
        let colors = |l: &Layer<_>| ["R", "G", "B"].iter().all(|c| names(l).iter().any(|n| n == c));
        let Some(layer) = image.layer_data.iter().position(colors) else {
            let found = image.layer_data.first().map(|l| names(l).join(" ")).unwrap_or_default();
            return Err(ImageError::Content {
                path: path.to_path_buf(),
                expected: "EXR channels R G B (and A)".into(),
                found: format!("channels {found}"),
            });
        };
        for layer in &mut image.layer_data {
            layer.attributes.preview = None;
            if !writes(layer.encoding.compression) {
                layer.encoding.compression = Compression::ZIP16;
                notes.push("Its compression cannot be written; ZIP, without loss, took its place.".into());
            }
        }
        let picture = &mut image.layer_data[layer];
        let channels = pick(&names(picture), path)?;
        let (width, height) = (picture.size.width(), picture.size.height());
        let mut samples = vec![0.0; width * height * channels.len()];
        for (k, channel) in channels.iter().enumerate() {
            let data = &mut picture.channel_data.list[*channel].sample_data;
            if data.len() != width * height || matches!(data, FlatSamples::U32(_)) {
                return Err(fail(&"its colours are subsampled or whole numbers"));
            }
            let places = samples.iter_mut().skip(k).step_by(channels.len());
            places.zip(take(data)).for_each(|(place, value)| *place = value);
        }
        let decoded = Decoded { width, height, channels: channels.len(), samples: Samples::Float(samples) };
        Ok((Self { image, layer, channels }, decoded))
    }

    /// Writes the file with the given pixels.
    pub(crate) fn write(
        &self,
        out: &mut dyn WriteSeek,
        rows: &SampleRows<'_>,
        software: &str,
        history: &str,
    ) -> io::Result<()> {
        let mut image = self.image.clone();
        let picture = &mut image.layer_data[self.layer];
        let mut line = one_line(history);
        if let Some(before) = &picture.attributes.software_name
            && *before != text(software)
        {
            line = format!("{line} (Software before: {before})");
        }
        if let Some(earlier) = earlier_history(&picture.attributes) {
            line = format!("{earlier}; {line}");
        }
        picture.attributes.software_name = Some(text(software));
        picture.attributes.other.insert(text(HISTORY), AttributeValue::Text(text(&line)));
        let (Samples::Float(pixels), None | Some(Samples::Float(_))) = (rows.pixels, rows.alpha) else {
            return Err(io::Error::other("the pixels are no floats"));
        };
        for (k, channel) in self.channels.iter().enumerate() {
            let plane: Vec<f32> = match rows.alpha {
                Some(Samples::Float(alpha)) if k == 3 => alpha.clone(),
                _ => pixels.iter().skip(k).step_by(3).copied().collect(),
            };
            let data = &mut picture.channel_data.list[*channel].sample_data;
            *data = match data {
                FlatSamples::F16(_) => FlatSamples::F16(plane.into_iter().map(f16::from_f32).collect()),
                _ => FlatSamples::F32(plane),
            };
        }
        (&image).write().non_parallel().to_buffered(out).map_err(io::Error::other)
    }
}

/// True for the compressions that can be written.
fn writes(compression: Compression) -> bool {
    use Compression::{B44, B44A, PIZ, PXR24, RLE, Uncompressed, ZIP1, ZIP16};
    matches!(compression, Uncompressed | RLE | ZIP1 | ZIP16 | PIZ | PXR24 | B44 | B44A)
}
