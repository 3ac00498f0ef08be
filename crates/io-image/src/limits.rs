//! Checks of sizes before memory is allocated.

use std::path::Path;

use crate::error::{FileFormat, ImageError};

/// The largest number of pixels of a file: 2^27, about 134 million.
pub const MAX_PIXELS: u64 = 1 << 27;

/// Up to this many decoded bytes, the size in a header is accepted whatever the file's length.
const SMALL: u64 = 64 << 20;

/// Largest plausible compression factor. No coder in use here packs more than about 2600 bytes into one (LZW
/// in TIFF; DEFLATE and JPEG reach about 1030).
const MAX_COMPRESSION: u64 = 4096;

/// Checks an announced size against the limits and against the length of the file that announces it.
pub(crate) fn check_size(
    path: &Path,
    format: FileFormat,
    width: u64,
    height: u64,
    bytes_per_pixel: u64,
    file_length: u64,
) -> Result<(usize, usize), ImageError> {
    let refuse = |why: String| Err(ImageError::Size { path: path.to_path_buf(), format, width, height, why });
    if width == 0 || height == 0 {
        return refuse("that is none at all; write the file again".into());
    }
    let pixels = width.saturating_mul(height);
    if pixels > MAX_PIXELS {
        return refuse(format!("more than the {MAX_PIXELS} that are supported; scale the image down first"));
    }
    let bytes = pixels.saturating_mul(bytes_per_pixel);
    if bytes > SMALL && bytes / MAX_COMPRESSION > file_length {
        return refuse(format!(
            "which cannot be stored in the {file_length} bytes of this file; it is damaged, write it again"
        ));
    }
    Ok((width as usize, height as usize))
}
