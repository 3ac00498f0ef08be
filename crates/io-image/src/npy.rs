//! One NumPy array as an image: `[H, W]`, `[1, H, W]`, or `[H, W, C]` with 1 to 4 channels, of any real type,
//! either byte order.

use std::io::Read;
use std::path::Path;

use npyz::{DType, NpyHeader, Order, TypeChar};

use crate::decoded::{Decoded, Samples};
use crate::error::{FileFormat, ImageError};
use crate::limits::check_size;

const MAGIC: &[u8] = b"\x93NUMPY";
/// Largest header, bytes. The header of one plain array is far shorter and has at most four brackets; the
/// parser would recurse once for each bracket.
const MAX_HEADER: usize = 4096;
const MAX_BRACKETS: usize = 16;

/// Parses the header after limiting the work that it can cause in the parser.
pub(crate) fn header(mut reader: impl Read, path: &Path) -> Result<NpyHeader, ImageError> {
    let fail = |reason: String| ImageError::decode(path, FileFormat::Npy, reason);
    let mut head = [0u8; 12];
    reader.read_exact(&mut head[..10]).map_err(|_| fail("it ends within its header".into()))?;
    let (prefix, length) = if head[..6] == *MAGIC && head[6] == 1 {
        (10, usize::from(u16::from_le_bytes([head[8], head[9]])))
    } else {
        reader.read_exact(&mut head[10..]).map_err(|_| fail("it ends within its header".into()))?;
        (12, u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize)
    };
    if length > MAX_HEADER {
        return Err(fail(format!("its header is {length} bytes long; at most {MAX_HEADER} are expected")));
    }
    let mut whole = head[..prefix].to_vec();
    whole.resize(prefix + length, 0);
    reader.read_exact(&mut whole[prefix..]).map_err(|_| fail("it ends within its header".into()))?;
    if whole[prefix..].iter().filter(|b| b"([{".contains(b)).count() > MAX_BRACKETS {
        return Err(fail("its header nests too deeply".into()));
    }
    NpyHeader::from_reader(whole.as_slice()).map_err(|e| fail(e.to_string()))
}

/// `(width, height, channels)` of an array of that shape.
pub(crate) fn dimensions(header: &NpyHeader, path: &Path) -> Result<(u64, u64, u64), ImageError> {
    let shape = header.shape();
    let dimensions = match *shape {
        [h, w] => Some((w, h, 1)),
        [h, w, c @ 1..=4] => Some((w, h, c)),
        [1, h, w] => Some((w, h, 1)),
        _ => None,
    };
    let simple = matches!(header.dtype(), DType::Plain(_)) && !header.uses_pickled_array();
    match dimensions {
        Some(d) if simple => Ok(d),
        _ => Err(ImageError::Content {
            path: path.to_path_buf(),
            expected: "an array [H, W] or [H, W, C] of numbers".into(),
            found: format!("shape {shape:?} of {}", header.dtype().descr()),
        }),
    }
}

/// Bytes of one element on disk.
pub(crate) fn element_size(header: &NpyHeader) -> u64 {
    header.dtype().num_bytes().unwrap_or(0) as u64
}

pub(crate) fn decode(bytes: &[u8], path: &Path) -> Result<Decoded, ImageError> {
    let fail = |reason: String| ImageError::decode(path, FileFormat::Npy, reason);
    let mut rest = bytes;
    let header = header(&mut rest, path)?;
    let (width, height, channels) = dimensions(&header, path)?;
    let (w, h) = check_size(path, FileFormat::Npy, width, height, channels * 4, bytes.len() as u64)?;
    let c = channels as usize;
    let count = w * h * c;
    let size = element_size(&header);
    if count as u64 * size > rest.len() as u64 {
        return Err(fail(format!(
            "{count} values of {size} bytes are announced, {} bytes follow",
            rest.len()
        )));
    }
    let order = header.order();
    let kind = match header.dtype() {
        DType::Plain(t) => (t.type_char(), t.size_field()),
        _ => return Err(fail("its elements are not plain numbers".into())),
    };
    macro_rules! read {
        ($ty:ty) => {
            npyz::NpyFile::with_header(header, rest).into_vec::<$ty>().map_err(|e| fail(e.to_string()))?
        };
    }
    macro_rules! floats {
        ($ty:ty) => {
            Samples::Float(read!($ty).into_iter().map(|v| v as f32).collect())
        };
    }
    let samples = match kind {
        (TypeChar::Uint, 1) => Samples::Eight(read!(u8)),
        (TypeChar::Uint, 2) => Samples::Sixteen(read!(u16)),
        (TypeChar::Bool, 1) => Samples::Eight(read!(bool).into_iter().map(|b| u8::from(b) * 255).collect()),
        (TypeChar::Float, 4) => Samples::Float(read!(f32)),
        (TypeChar::Float, 8) => floats!(f64),
        (TypeChar::Float, 2) => half_floats(&rest[..count * 2], &header),
        (TypeChar::Int, 1) => floats!(i8),
        (TypeChar::Int, 2) => floats!(i16),
        (TypeChar::Int, 4) => floats!(i32),
        (TypeChar::Int, 8) => floats!(i64),
        (TypeChar::Uint, 4) => floats!(u32),
        (TypeChar::Uint, 8) => floats!(u64),
        _ => return Err(fail("its elements are not real numbers of 1 to 8 bytes".into())),
    };
    let samples = match order {
        Order::C => samples,
        Order::Fortran => match samples {
            Samples::Eight(s) => Samples::Eight(row_major(&s, w, h, c)),
            Samples::Sixteen(s) => Samples::Sixteen(row_major(&s, w, h, c)),
            Samples::Float(s) => Samples::Float(row_major(&s, w, h, c)),
        },
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

/// Reads IEEE half precision, for which `npyz` needs another dependency.
fn half_floats(bytes: &[u8], header: &NpyHeader) -> Samples {
    let big = matches!(header.dtype(), DType::Plain(t) if t.endianness() == npyz::Endianness::Big);
    let value = |pair: &[u8]| {
        let bits =
            if big { u16::from_be_bytes([pair[0], pair[1]]) } else { u16::from_le_bytes([pair[0], pair[1]]) };
        exr::prelude::f16::from_bits(bits).to_f32()
    };
    Samples::Float(bytes.chunks_exact(2).map(value).collect())
}
