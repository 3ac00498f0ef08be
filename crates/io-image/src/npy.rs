//! One NumPy array as an image: `[H, W]`, `[1, H, W]`, or `[H, W, C]` with 1 to 4 channels, of any real type,
//! either byte order.
//!
//! A file is `\x93NUMPY`, two bytes of version, the length of the header (two bytes, from version 2 on four),
//! the header, and the elements. The header is a Python literal in ASCII:
//!
//! ```text
//! {'descr': '<f4', 'fortran_order': False, 'shape': (480, 640), }
//! ```
//!
//! `descr` is the byte order (`<` little, `>` big, `|` or `=` none said), the kind (`f`, `i`, `u`, `b`) and
//! the bytes of an element. Only such plain types are read; records and Python objects are refused.

use std::io::Read;
use std::path::Path;

use crate::decoded::{Decoded, Samples};
use crate::error::{FileFormat, ImageError};
use crate::limits::check_size;

const MAGIC: &[u8] = b"\x93NUMPY";
/// Largest header, bytes. The header of one plain array is far shorter.
const MAX_HEADER: usize = 4096;

/// The header of a file.
#[derive(Debug, PartialEq)]
pub(crate) struct Header {
    /// The type of the elements as the file says it.
    descr: String,
    /// True if the first index runs fastest.
    fortran_order: bool,
    shape: Vec<u64>,
}

impl Header {
    /// Parses the literal; `None` if it is no header of a plain array.
    fn parse(literal: &str) -> Option<Self> {
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        let mut rest = literal.trim().strip_prefix('{')?.strip_suffix('}')?.trim();
        while !rest.is_empty() {
            let (key, after) = quoted(rest)?;
            let value = after.trim_start().strip_prefix(':')?.trim_start();
            rest = match key {
                "descr" => {
                    let (text, after) = quoted(value)?;
                    descr = Some(text.to_owned());
                    after
                }
                "fortran_order" => {
                    let said = [("True", true), ("False", false)];
                    let (word, is) = said.into_iter().find(|(word, _)| value.starts_with(word))?;
                    fortran_order = Some(is);
                    &value[word.len()..]
                }
                "shape" => {
                    let (lengths, after) = value.strip_prefix('(')?.split_once(')')?;
                    // A tuple of one length ends with a comma.
                    let lengths = lengths.trim().trim_end_matches(',').split(',');
                    shape = Some(lengths.map(|n| n.trim().parse().ok()).collect::<Option<_>>()?);
                    after
                }
                _ => return None,
            };
            rest = rest.trim_start();
            rest = rest.strip_prefix(',').unwrap_or(rest).trim_start();
        }
        Some(Self { descr: descr?, fortran_order: fortran_order?, shape: shape? })
    }

    /// True for big-endian elements, their kind, and their size in bytes; `None` for other types.
    fn element(&self) -> Option<(bool, char, u64)> {
        let mut letters = self.descr.chars();
        let big = match letters.next()? {
            '<' | '|' => false,
            '=' => cfg!(target_endian = "big"),
            '>' => true,
            _ => return None,
        };
        let kind = letters.next()?;
        Some((big, kind, letters.as_str().parse().ok().filter(|size| (1..=16).contains(size))?))
    }
}

/// Splits a string in quotes off the start.
fn quoted(text: &str) -> Option<(&str, &str)> {
    let quote = text.chars().next().filter(|c| "'\"".contains(*c))?;
    text[1..].split_once(quote)
}

/// Reads the header; its length is checked before it is read.
pub(crate) fn header(mut reader: impl Read, path: &Path) -> Result<Header, ImageError> {
    let fail = |reason: String| ImageError::decode(path, FileFormat::Npy, reason);
    let short = |_| fail("it ends within its header".into());
    let mut head = [0u8; 10];
    reader.read_exact(&mut head).map_err(short)?;
    if head[..6] != *MAGIC {
        return Err(fail("it does not begin like a NumPy file".into()));
    }
    let mut length = usize::from(u16::from_le_bytes([head[8], head[9]]));
    if head[6] > 1 {
        let mut upper = [0u8; 2];
        reader.read_exact(&mut upper).map_err(short)?;
        length += usize::from(u16::from_le_bytes(upper)) << 16;
    }
    if length > MAX_HEADER {
        return Err(fail(format!("its header is {length} bytes long; at most {MAX_HEADER} are expected")));
    }
    let mut literal = vec![0; length];
    reader.read_exact(&mut literal).map_err(short)?;
    let parsed = std::str::from_utf8(&literal).ok().and_then(Header::parse);
    parsed.ok_or_else(|| fail("its header is not that of one array of numbers".into()))
}

/// `(width, height, channels)` of an array of that shape.
pub(crate) fn dimensions(header: &Header, path: &Path) -> Result<(u64, u64, u64), ImageError> {
    let dimensions = match header.shape[..] {
        [h, w] => Some((w, h, 1)),
        [h, w, c @ 1..=4] => Some((w, h, c)),
        [1, h, w] => Some((w, h, 1)),
        _ => None,
    };
    match dimensions {
        Some(d) if header.element().is_some() => Ok(d),
        _ => Err(ImageError::Content {
            path: path.to_path_buf(),
            expected: "an array [H, W] or [H, W, C] of numbers".into(),
            found: format!("shape {:?} of {:?}", header.shape, header.descr),
        }),
    }
}

/// Bytes of one element on disk.
pub(crate) fn element_size(header: &Header) -> u64 {
    header.element().map_or(0, |(_, _, size)| size)
}

pub(crate) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded, ImageError> {
    let fail = |reason: String| ImageError::decode(path, FileFormat::Npy, reason);
    let mut rest = bytes;
    let header = header(&mut rest, path)?;
    let (width, height, channels) = dimensions(&header, path)?;
    let (w, h) = check_size(path, FileFormat::Npy, width, height, channels * 4, bytes.len() as u64)?;
    let c = channels as usize;
    let count = w * h * c;
    let (big, kind, size) = header.element().unwrap_or((false, ' ', 0));
    let Some(elements) = rest.get(..count * size as usize) else {
        return Err(fail(format!(
            "{count} values of {size} bytes are announced, {} bytes follow",
            rest.len()
        )));
    };
    macro_rules! read {
        ($ty:ty) => {
            elements
                .as_chunks()
                .0
                .iter()
                .map(|b| if big { <$ty>::from_be_bytes(*b) } else { <$ty>::from_le_bytes(*b) })
        };
    }
    macro_rules! floats {
        ($ty:ty) => {
            Samples::Float(read!($ty).map(|v| v as f32).collect())
        };
    }
    let samples = match (kind, size) {
        ('u', 1) => Samples::Eight(elements.to_vec()),
        ('u', 2) => Samples::Sixteen(read!(u16).collect()),
        ('b', 1) => Samples::Eight(elements.iter().map(|b| u8::from(*b != 0) * 255).collect()),
        ('f', 2) => {
            Samples::Float(read!(u16).map(|bits| exr::prelude::f16::from_bits(bits).to_f32()).collect())
        }
        ('f', 4) => Samples::Float(read!(f32).collect()),
        ('f', 8) => floats!(f64),
        ('i', 1) => floats!(i8),
        ('i', 2) => floats!(i16),
        ('i', 4) => floats!(i32),
        ('i', 8) => floats!(i64),
        ('u', 4) => floats!(u32),
        ('u', 8) => floats!(u64),
        _ => return Err(fail("its elements are not real numbers of 1 to 8 bytes".into())),
    };
    let samples = match samples {
        samples if !header.fortran_order => samples,
        Samples::Eight(s) => Samples::Eight(row_major(&s, w, h, c)),
        Samples::Sixteen(s) => Samples::Sixteen(row_major(&s, w, h, c)),
        Samples::Float(s) => Samples::Float(row_major(&s, w, h, c)),
    };
    Ok(Decoded { width: w, height: h, channels: c, samples })
}

/// Converts `[H, W, C]` from column-major order (first index fastest) to row-major order.
fn row_major<T: Copy + Default>(samples: &[T], w: usize, h: usize, c: usize) -> Vec<T> {
    let mut out = vec![T::default(); samples.len()];
    for k in 0..c {
        for x in 0..w {
            for y in 0..h {
                out[(y * w + x) * c + k] = samples[(k * w + x) * h + y];
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_are_read_as_numpy_writes_them_and_nothing_else_is() {
        let parsed = |literal: &str| Header::parse(literal).map(|h| (h.element(), h.fortran_order, h.shape));
        let plain = "{'descr': '<f4', 'fortran_order': False, 'shape': (480, 640), }            \n";
        assert_eq!(parsed(plain), Some((Some((false, 'f', 4)), false, vec![480, 640])));
        let other = r#"{"shape":(3,),"fortran_order":True,"descr":">i2"}"#;
        assert_eq!(parsed(other), Some((Some((true, 'i', 2)), true, vec![3])));
        for (descr, element) in [("|u1", Some((false, 'u', 1))), ("<U8", Some((false, 'U', 8))), ("|O", None)]
        {
            let literal = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': (1, 2), }}");
            assert_eq!(parsed(&literal).expect("a header").0, element, "{descr}");
        }
        for broken in [
            "",
            "{}",
            "{'descr': '<f4', 'shape': (1, 2)}",
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1, 2)}",
            "{'descr': '<f4', 'fortran_order': maybe, 'shape': (1, 2)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 2)}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), 'more': 1}",
        ] {
            assert_eq!(parsed(broken), None, "{broken}");
        }
    }
}
