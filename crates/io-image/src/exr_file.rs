//! Reading and writing of OpenEXR: 32-bit float, unclamped, ZIP-compressed scan lines in increasing order
//! (the same bytes every time).

use std::io::{Cursor, Seek, Write};
use std::path::Path;
use std::result::Result;

use exr::image::Image as Layers;
use exr::prelude::*;
use use3d_capture::{Image, Map};
use use3d_files::write_atomically;

use crate::byte_source::ByteSource;
use crate::decoded::{Decoded, Samples};
use crate::error::{FileFormat, ImageError};
use crate::limits::check_size;

/// Names under which a single channel of interest is looked for, best first.
const SINGLE: [&str; 5] = ["Z", "Y", "depth", "depth.Z", "A"];

/// Width, height and channel names of the first flat layer, and the bytes per pixel of all flat layers; only
/// the header is read.
pub(crate) fn header(
    reader: &mut dyn ByteSource,
    path: &Path,
) -> Result<(u64, u64, Vec<String>, usize), ImageError> {
    let fail = |reason: String| ImageError::decode(path, FileFormat::Exr, reason);
    let meta = exr::meta::MetaData::read_from_buffered(reader, false).map_err(|e| fail(e.to_string()))?;
    let flat = meta.headers.iter().find(|h| !h.deep);
    let header = flat.ok_or_else(|| fail("it has no flat layer (deep data is not supported)".into()))?;
    let names: Vec<String> = header.channels.list.iter().map(|c| c.name.to_string()).collect();
    let size = header.layer_size;
    // Every flat layer is decoded until one is valid, so all of them count.
    let channels = meta.headers.iter().flat_map(|h| &h.channels.list);
    let bytes_per_pixel = channels.map(|c| c.sample_type.bytes_per_sample()).sum();
    Ok((size.width() as u64, size.height() as u64, names, bytes_per_pixel))
}

/// The channels that form the picture: `R G B` (and `A`), or one that holds depth, brightness or coverage.
pub(crate) fn pick(names: &[String], path: &Path) -> Result<Vec<usize>, ImageError> {
    let find = |name: &str| names.iter().position(|n| n == name);
    if let (Some(r), Some(g), Some(b)) = (find("R"), find("G"), find("B")) {
        return Ok([r, g, b].into_iter().chain(find("A")).collect());
    }
    if let Some(one) = SINGLE.iter().find_map(|n| find(n)) {
        return Ok(vec![one]);
    }
    if names.len() == 1 {
        return Ok(vec![0]);
    }
    Err(ImageError::Content {
        path: path.to_path_buf(),
        expected: "EXR channels R G B (and A), or one of Z, Y, depth, A".into(),
        found: format!("channels {}", names.join(" ")),
    })
}

pub(crate) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded, ImageError> {
    let (width, height, _, bytes_per_pixel) = header(&mut Cursor::new(bytes), path)?;
    check_size(path, FileFormat::Exr, width, height, bytes_per_pixel as u64, bytes.len() as u64)?;
    let mut cursor = Cursor::new(bytes);
    let source: &mut dyn ByteSource = &mut cursor;
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_buffered(source)
        .map_err(|e| ImageError::decode(path, FileFormat::Exr, e))?;
    let layer = &image.layer_data;
    let (width, height) = (layer.size.width(), layer.size.height());
    let list = &layer.channel_data.list;
    let names: Vec<String> = list.iter().map(|c| c.name.to_string()).collect();
    let picked = pick(&names, path)?;
    let n = width * height;
    let mut samples = vec![0.0f32; n * picked.len()];
    for (k, &channel) in picked.iter().enumerate() {
        let data = &list[channel].sample_data;
        if data.len() != n {
            return Err(ImageError::decode(path, FileFormat::Exr, "a channel is subsampled"));
        }
        for (p, value) in data.values_as_f32().enumerate() {
            samples[p * picked.len() + k] = value;
        }
    }
    Ok(Decoded { width, height, channels: picked.len(), samples: Samples::Float(samples) })
}

fn encode(
    writer: &mut (impl Write + Seek),
    width: usize,
    height: usize,
    planes: &[(&str, &[f32])],
) -> std::io::Result<()> {
    let channels =
        planes.iter().map(|(name, plane)| AnyChannel::new(*name, FlatSamples::F32(plane.to_vec()))).collect();
    let encoding = Encoding {
        compression: Compression::ZIP16,
        blocks: Blocks::ScanLines,
        line_order: LineOrder::Increasing,
    };
    let layer =
        Layer::new((width, height), LayerAttributes::default(), encoding, AnyChannels::sort(channels));
    Layers::from_layer(layer).write().non_parallel().to_buffered(writer).map_err(std::io::Error::other)
}

/// Writes an RGB image with unchanged values (not clamped); the channels are `B G R` in the file, as EXR
/// sorts them.
pub fn write_exr(path: &Path, image: &Image) -> Result<(), ImageError> {
    let [r, g, b] = image.planes();
    write_exr_channels(path, image.width(), image.height(), &[("R", r), ("G", g), ("B", b)])
}

/// Writes one channel under a name: `"Z"` for depth, `"A"` for alpha.
pub fn write_exr_map(path: &Path, map: &Map, channel: &str) -> Result<(), ImageError> {
    write_exr_channels(path, map.width(), map.height(), &[(channel, map.data())])
}

/// Writes any named f32 planes (row-major, `width * height` each) as one EXR layer.
pub fn write_exr_channels(
    path: &Path,
    width: usize,
    height: usize,
    planes: &[(&str, &[f32])],
) -> Result<(), ImageError> {
    if width == 0 || height == 0 || planes.is_empty() || planes.iter().any(|(_, p)| p.len() != width * height)
    {
        return Err(ImageError::write(path, format!("planes do not fill {width}x{height} pixels")));
    }
    write_atomically(path, |writer| encode(writer, width, height, planes))
        .map_err(|e| ImageError::write(path, e))
}
