//! Reads a file of tensors.

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use serde::de::DeserializeOwned;

use crate::{KEY, TensorError};

/// A parsed file; each tensor is checked when it is read.
#[derive(Debug)]
pub struct TensorFile<'a> {
    tensors: SafeTensors<'a>,
    document: Option<String>,
}

impl<'a> TensorFile<'a> {
    /// Parses the container.
    pub fn read(bytes: &'a [u8]) -> Result<Self, TensorError> {
        let (_, metadata) = SafeTensors::read_metadata(bytes)?;
        let document = metadata.metadata().as_ref().and_then(|m| m.get(KEY)).cloned();
        Ok(Self { tensors: SafeTensors::deserialize(bytes)?, document })
    }

    /// Returns true if a safetensors file has a document of this program in its header; a damaged file counts
    /// if its beginning contains the key.
    pub fn has_document(bytes: &[u8]) -> bool {
        match SafeTensors::read_metadata(bytes) {
            Ok((_, metadata)) => metadata.metadata().as_ref().is_some_and(|m| m.contains_key(KEY)),
            Err(_) => {
                let needle = format!("\"{KEY}\"");
                bytes[..bytes.len().min(1 << 16)].windows(needle.len()).any(|w| w == needle.as_bytes())
            }
        }
    }

    /// The header's document; its `format` and `version` are checked first.
    pub fn document<D: DeserializeOwned>(&self, format: &str, version: u64) -> Result<D, TensorError> {
        let Some(text) = &self.document else {
            let problem = format!("its header has no `{KEY}` entry, so it was not written by this tool");
            return Err(TensorError::Document(problem));
        };
        let broken = |e: serde_json::Error| TensorError::Document(format!("its header: {e}"));
        let value: serde_json::Value = serde_json::from_str(text).map_err(broken)?;
        let found = &value["format"];
        if *found != format {
            return Err(TensorError::Document(format!("its format is {found}, expected \"{format}\"")));
        }
        let found = &value["version"];
        if *found != version {
            let expected = format!("this tool reads version {version}; make it again with this tool");
            return Err(TensorError::Document(format!("its version is {found}, {expected}")));
        }
        serde_json::from_value(value).map_err(broken)
    }

    /// Names of the tensors, sorted.
    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = self.tensors.names().into_iter().map(str::to_string).collect();
        names.sort();
        names
    }

    /// Fails on the first tensor that `known` does not accept.
    pub fn only(&self, known: impl Fn(&str) -> bool) -> Result<(), TensorError> {
        match self.names().into_iter().find(|name| !known(name)) {
            Some(name) => Err(TensorError::Unknown { name }),
            None => Ok(()),
        }
    }

    fn tensor(&self, name: &str) -> Result<TensorView<'a>, TensorError> {
        self.tensors.tensor(name).map_err(|_| TensorError::Missing { name: name.into() })
    }

    /// The shape of a tensor.
    pub fn shape(&self, name: &str) -> Result<Vec<usize>, TensorError> {
        Ok(self.tensor(name)?.shape().to_vec())
    }

    /// The shape of a tensor with `N` dimensions; `expected` describes the shape in the error.
    pub fn sides<const N: usize>(&self, name: &str, expected: &str) -> Result<[usize; N], TensorError> {
        let found = self.shape(name)?;
        found.as_slice().try_into().map_err(|_| TensorError::Shape {
            name: name.into(),
            found: found.clone(),
            expected: expected.into(),
        })
    }

    fn bytes(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<&'a [u8], TensorError> {
        let tensor = self.tensor(name)?;
        if tensor.dtype() != dtype {
            return Err(TensorError::Type { name: name.into(), found: tensor.dtype(), expected: dtype });
        }
        if tensor.shape() != shape {
            let (found, expected) = (tensor.shape().to_vec(), format!("{shape:?}"));
            return Err(TensorError::Shape { name: name.into(), found, expected });
        }
        Ok(tensor.data())
    }

    /// An f32 tensor of the given shape, finite, row-major.
    pub fn f32(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, TensorError> {
        let values = singles(self.bytes(name, Dtype::F32, shape)?);
        finite(name, values.iter().map(|&v| f64::from(v)))?;
        Ok(values)
    }

    /// An f64 tensor of the given shape, finite, row-major.
    pub fn f64(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>, TensorError> {
        let values = doubles(self.bytes(name, Dtype::F64, shape)?);
        finite(name, values.iter().copied())?;
        Ok(values)
    }

    /// A u32 tensor of the given shape, row-major.
    pub fn u32(&self, name: &str, shape: &[usize]) -> Result<Vec<u32>, TensorError> {
        let bytes = self.bytes(name, Dtype::U32, shape)?;
        Ok(bytes.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect())
    }

    /// Shape and values of an f32 tensor, or of an f64 one rounded to f32, without further checks; for
    /// readers that take the shape from the file.
    pub fn narrowed(&self, name: &str) -> Result<(Vec<usize>, Vec<f32>), TensorError> {
        let tensor = self.tensor(name)?;
        let values = match tensor.dtype() {
            Dtype::F32 => singles(tensor.data()),
            Dtype::F64 => doubles(tensor.data()).into_iter().map(|v| v as f32).collect(),
            found => return Err(TensorError::Type { name: name.into(), found, expected: Dtype::F32 }),
        };
        Ok((tensor.shape().to_vec(), values))
    }
}

fn singles(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

fn doubles(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
}

fn finite(name: &str, values: impl Iterator<Item = f64>) -> Result<(), TensorError> {
    match values.enumerate().find(|(_, value)| !value.is_finite()) {
        None => Ok(()),
        Some((index, value)) => Err(TensorError::NotFinite { name: name.into(), index, value }),
    }
}
