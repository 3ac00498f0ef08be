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
    let mark: &[u8] = match format {
        FileFormat::Png => b"IEND",
        FileFormat::Jpeg => b"\xFF\xD9",
        _ => return Ok(false),
    };
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
    let mut tail = Vec::new();
    file.take(TAIL).read_to_end(&mut tail)?;
    let marked = tail.windows(mark.len()).any(|bytes| bytes == mark);
    Ok(!marked && crate::read(path).is_err())
}
