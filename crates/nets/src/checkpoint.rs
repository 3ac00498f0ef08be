//! Checkpoint files: PyTorch's `.pth` (zip archives and the older pickle streams) and `.safetensors`.
//!
//! Nothing in a file is executed: `pytorch-reader` interprets the pickle's opcodes as data. Opening a file
//! reads only names and shapes. A tensor's values are read when a network requests them and after the shape
//! was found to be the expected one, so a file cannot cause an allocation larger than the network it claims
//! to be. A state dict may be at the root or under `net`, `state_dict`, `model`, `params` or
//! `model_state_dict`; other entries (optimiser state) are skipped. The prefix `module.` of all names, which
//! data-parallel training adds, is dropped.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use pytorch_reader::{DType, PickleValue, PytorchReader};
use safetensors::{Dtype, SafeTensors};
use use3d_numerics::math;

use crate::error::NetError;
use crate::weights::Weights;

/// Keys under which a state dict may be nested.
const NESTED: [&str; 5] = ["net", "state_dict", "model", "params", "model_state_dict"];
/// The largest official file is 1.4 GB.
const LARGEST_FILE: u64 = 8 << 30;

/// An opened checkpoint.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    tensors: BTreeMap<String, Stored>,
    /// The whole file, for safetensors.
    bytes: Vec<u8>,
    taken: BTreeSet<String>,
}

/// The place of a tensor's values.
#[derive(Debug)]
enum Stored {
    Torch(pytorch_reader::Tensor),
    Safe { dtype: Dtype, shape: Vec<usize>, range: std::ops::Range<usize> },
}

/// Floating-point formats that a weight may have.
#[derive(Clone, Copy)]
enum FloatFormat {
    F64,
    F32,
    F16,
    Bf16,
}

impl Checkpoint {
    /// Opens a file. Its format is recognised by the content, not the name.
    pub fn open(path: &Path) -> Result<Self, NetError> {
        let read_error = |source| NetError::Read { path: path.to_path_buf(), source };
        let size = std::fs::metadata(path).map_err(read_error)?.len();
        let damaged = |message: String| NetError::Damaged { path: path.to_path_buf(), message };
        if size > LARGEST_FILE {
            return Err(damaged(format!("{size} bytes are more than any known checkpoint")));
        }
        let mut checkpoint = Self {
            path: path.to_path_buf(),
            tensors: BTreeMap::new(),
            bytes: Vec::new(),
            taken: BTreeSet::new(),
        };
        if is_safetensors(path).map_err(read_error)? {
            let bytes = std::fs::read(path).map_err(read_error)?;
            let (header, metadata) =
                SafeTensors::read_metadata(&bytes).map_err(|e| damaged(e.to_string()))?;
            for (name, info) in metadata.tensors() {
                let (start, end) = info.data_offsets;
                let range = 8 + header + start..8 + header + end;
                checkpoint
                    .tensors
                    .insert(name, Stored::Safe { dtype: info.dtype, shape: info.shape.clone(), range });
            }
            checkpoint.bytes = bytes;
        } else {
            let reader = PytorchReader::new(path).map_err(|e| match e {
                pytorch_reader::PytorchError::Io(source)
                    if source.kind() != std::io::ErrorKind::InvalidData
                        && source.kind() != std::io::ErrorKind::UnexpectedEof =>
                {
                    read_error(source)
                }
                other => damaged(other.to_string()),
            })?;
            for (name, tensor) in reader.into_tensors() {
                checkpoint.tensors.insert(name, Stored::Torch(tensor));
            }
        }
        checkpoint.unnest();
        Ok(checkpoint)
    }

    /// Moves the state dict to the root and drops the prefix `module.`.
    fn unnest(&mut self) {
        for key in NESTED {
            let prefix = format!("{key}.");
            if self.tensors.keys().any(|name| name.starts_with(&prefix)) {
                self.rename(|name| name.strip_prefix(&prefix).map(str::to_string));
                break;
            }
        }
        if !self.tensors.is_empty() && self.tensors.keys().all(|name| name.starts_with("module.")) {
            self.rename(|name| name.strip_prefix("module.").map(str::to_string));
        }
    }

    /// Renames every tensor; those without a new name are dropped.
    pub(crate) fn rename(&mut self, new_name: impl Fn(&str) -> Option<String>) {
        let tensors = std::mem::take(&mut self.tensors);
        self.tensors = tensors.into_iter().filter_map(|(name, t)| Some((new_name(&name)?, t))).collect();
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Texts and whole numbers at the top of the archive, as text; for a safetensors file, the metadata of
    /// its header.
    pub(crate) fn labels(&self) -> Result<BTreeMap<String, String>, NetError> {
        let damaged = |message: String| NetError::Damaged { path: self.path.clone(), message };
        if !self.bytes.is_empty() {
            let (_, metadata) =
                SafeTensors::read_metadata(&self.bytes).map_err(|e| damaged(e.to_string()))?;
            return Ok(metadata.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect());
        }
        let top = PytorchReader::read_pickle_data(&self.path, None).map_err(|e| damaged(e.to_string()))?;
        let PickleValue::Dict(entries) = top else { return Ok(BTreeMap::new()) };
        let labels = entries.into_iter().filter_map(|(name, value)| match value {
            PickleValue::String(text) => Some((name, text)),
            PickleValue::Int(number) => Some((name, number.to_string())),
            _ => None,
        });
        Ok(labels.collect())
    }

    /// Names and shapes of all tensors, by name.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &[usize])> {
        self.tensors.iter().map(|(name, t)| (name.as_str(), t.shape()))
    }

    /// Tensors that were not read so far.
    pub fn unused(&self) -> Vec<&str> {
        self.tensors.keys().filter(|name| !self.taken.contains(*name)).map(String::as_str).collect()
    }

    fn origin(&self) -> String {
        self.path.display().to_string()
    }

    /// The tensor of this name, if it has this shape and holds floating-point numbers.
    fn stored(&self, name: &str, shape: &[usize]) -> Result<(&Stored, FloatFormat), NetError> {
        let Some(stored) = self.tensors.get(name) else {
            return Err(NetError::MissingTensor {
                origin: self.origin(),
                tensor: name.to_string(),
                expected: shape.to_vec(),
            });
        };
        if stored.shape() != shape {
            return Err(NetError::Shape {
                origin: self.origin(),
                tensor: name.to_string(),
                expected: shape.to_vec(),
                found: stored.shape().to_vec(),
            });
        }
        let format = stored.format().map_err(|found| {
            self.values_error(name, format!("holds values of type {found}, expected floating point"))
        })?;
        Ok((stored, format))
    }

    fn values_error(&self, tensor: &str, problem: impl Into<String>) -> NetError {
        NetError::Values { origin: self.origin(), tensor: tensor.to_string(), problem: problem.into() }
    }
}

impl Stored {
    fn shape(&self) -> &[usize] {
        match self {
            Self::Torch(tensor) => tensor.shape(),
            Self::Safe { shape, .. } => shape,
        }
    }

    fn format(&self) -> Result<FloatFormat, String> {
        match self {
            Self::Torch(tensor) => match tensor.dtype() {
                DType::F64 => Ok(FloatFormat::F64),
                DType::F32 => Ok(FloatFormat::F32),
                DType::F16 => Ok(FloatFormat::F16),
                DType::BF16 => Ok(FloatFormat::Bf16),
                other => Err(format!("{other:?}")),
            },
            Self::Safe { dtype, .. } => match dtype {
                Dtype::F64 => Ok(FloatFormat::F64),
                Dtype::F32 => Ok(FloatFormat::F32),
                Dtype::F16 => Ok(FloatFormat::F16),
                Dtype::BF16 => Ok(FloatFormat::Bf16),
                other => Err(format!("{other:?}")),
            },
        }
    }
}

impl Weights for Checkpoint {
    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError> {
        let (stored, format) = self.stored(name, shape)?;
        let values = match stored {
            Stored::Torch(tensor) => {
                let bytes =
                    tensor.read().map_err(|e| self.values_error(name, format!("cannot be read: {e}")))?;
                decode(format, &bytes)
            }
            Stored::Safe { range, .. } => decode(format, &self.bytes[range.clone()]),
        };
        if values.len() != shape.iter().product::<usize>() {
            return Err(self.values_error(name, format!("has {} values for shape {shape:?}", values.len())));
        }
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            return Err(self.values_error(name, format!("holds {} as value {i}", values[i])));
        }
        self.taken.insert(name.to_string());
        Ok(values)
    }
}

/// A checkpoint whose names and shapes are checked and whose values are not read: all are zero.
pub(crate) struct Shapes<'c>(pub(crate) &'c Checkpoint);

impl Weights for Shapes<'_> {
    fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError> {
        self.0.stored(name, shape)?;
        Ok(vec![0.0; shape.iter().product()])
    }
}

/// True for safetensors files: they begin with the length of a JSON header.
fn is_safetensors(path: &Path) -> std::io::Result<bool> {
    use std::io::Read;
    let mut start = Vec::new();
    std::fs::File::open(path)?.take(9).read_to_end(&mut start)?;
    Ok(start.get(8) == Some(&b'{') && start[4..8] == [0; 4])
}

/// Converts little-endian bytes to f32.
fn decode(format: FloatFormat, bytes: &[u8]) -> Vec<f32> {
    match format {
        FloatFormat::F64 => bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
        FloatFormat::F32 => bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
        FloatFormat::F16 => bytes.as_chunks::<2>().0.iter().map(|b| half(u16::from_le_bytes(*b))).collect(),
        FloatFormat::Bf16 => bytes
            .as_chunks::<2>()
            .0
            .iter()
            .map(|b| f32::from_bits(u32::from(u16::from_le_bytes(*b)) << 16))
            .collect(),
    }
}

/// Converts an IEEE half-precision number.
fn half(bits: u16) -> f32 {
    let (exponent, fraction) = (bits >> 10 & 0x1f, f32::from(bits & 0x3ff));
    let magnitude = match exponent {
        0 => fraction * math::powi(2f32, -24),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        _ => (1.0 + fraction / 1024.0) * math::powi(2f32, i32::from(exponent) - 15),
    };
    if bits >> 15 == 1 { -magnitude } else { magnitude }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_precision_numbers() {
        for (bits, value) in [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 5.960_464_5e-8),
            (0x3555, 0.333_251_95),
        ] {
            assert_eq!(half(bits), value);
        }
        assert!(half(0x7c00).is_infinite() && half(0x7e00).is_nan());
    }
}
