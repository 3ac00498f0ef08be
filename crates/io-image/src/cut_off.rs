//! Photographs whose file ends too early.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use crate::error::FileFormat;

/// The bytes before the end of a photograph in which the mark of its end is searched.
const TAIL: u64 = 16 << 10;

/// True if a photograph ends before the mark of its end, and cannot be decoded. Only one without the mark
/// near its end, which other data may follow, is read. The end of a TIFF has no mark.
///
/// # Errors
/// The file cannot be read.
pub fn is_cut_off(path: &Path, format: FileFormat) -> std::io::Result<bool> {
    Ok(!is_marked_at_the_end(&mut File::open(path)?, format)? && crate::read(path).is_err())
}

/// True if the mark of its end is near the end of a photograph, or its format has none.
pub(crate) fn is_marked_at_the_end(
    file: &mut (impl Read + Seek),
    format: FileFormat,
) -> std::io::Result<bool> {
    let mark: &[u8] = match format {
        FileFormat::Png => b"IEND",
        FileFormat::Jpeg => b"\xFF\xD9",
        _ => return Ok(true),
    };
    let length = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
    let mut tail = Vec::new();
    file.take(TAIL).read_to_end(&mut tail)?;
    Ok(tail.windows(mark.len()).any(|bytes| bytes == mark))
}
