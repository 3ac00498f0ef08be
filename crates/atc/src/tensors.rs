//! The safetensors files of this crate: named tensors, and one JSON document in the header under the key
//! `3d-use`.
//!
//! Bytes are deterministic: one metadata key, tensors in the format's own order (type, then name).

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};

use safetensors::{Dtype, SafeTensors, View};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::error::AtcError;

const KEY: &str = "3d-use";

/// Tensors on their way into a file.
#[derive(Default)]
pub(crate) struct Writer {
    tensors: BTreeMap<String, Raw>,
}

struct Raw {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl View for &Raw {
    fn dtype(&self) -> Dtype {
        self.dtype
    }
    fn shape(&self) -> &[usize] {
        &self.shape
    }
    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }
    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

impl Writer {
    fn add(&mut self, name: &str, dtype: Dtype, shape: &[usize], bytes: Vec<u8>) {
        self.tensors.insert(name.to_string(), Raw { dtype, shape: shape.to_vec(), bytes });
    }

    /// Adds an f32 tensor.
    pub(crate) fn f32(&mut self, name: &str, shape: &[usize], values: &[f32]) {
        self.add(name, Dtype::F32, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect());
    }

    /// Adds an f64 tensor.
    pub(crate) fn f64(&mut self, name: &str, shape: &[usize], values: &[f64]) {
        self.add(name, Dtype::F64, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect());
    }

    /// Adds a u32 tensor.
    pub(crate) fn u32(&mut self, name: &str, shape: &[usize], values: &[u32]) {
        self.add(name, Dtype::U32, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect());
    }

    /// The file's bytes.
    pub(crate) fn finish(&self, what: &str, header: &impl Serialize) -> Result<Vec<u8>, AtcError> {
        let json = serde_json::to_string(header).map_err(|e| AtcError::artifact(what, e.to_string()))?;
        let metadata = HashMap::from([(KEY.to_string(), json)]);
        safetensors::serialize(self.tensors.iter().map(|(k, v)| (k.as_str(), v)), Some(metadata))
            .map_err(|e| AtcError::artifact(what, e.to_string()))
    }
}

/// A parsed file.
pub(crate) struct Reader<'a> {
    what: &'static str,
    tensors: SafeTensors<'a>,
    header: String,
}

impl<'a> Reader<'a> {
    /// Parses the container; `what` names the artifact in errors.
    pub(crate) fn new(what: &'static str, bytes: &'a [u8]) -> Result<Self, AtcError> {
        let broken = |e: safetensors::SafeTensorError| {
            AtcError::artifact(what, format!("not a whole safetensors file ({e}); make it again"))
        };
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(broken)?;
        let header = metadata.metadata().as_ref().and_then(|m| m.get(KEY)).cloned().ok_or_else(|| {
            AtcError::artifact(
                what,
                format!("its header has no `{KEY}` entry, so it was not written by this tool"),
            )
        })?;
        Ok(Self { what, tensors: SafeTensors::deserialize(bytes).map_err(broken)?, header })
    }

    /// Whether a safetensors file has a document of this tool in its header. A damaged file that begins as
    /// one of ours counts.
    pub(crate) fn has_header(bytes: &[u8]) -> bool {
        match SafeTensors::read_metadata(bytes) {
            Ok((_, metadata)) => metadata.metadata().as_ref().is_some_and(|m| m.contains_key(KEY)),
            Err(_) => {
                let needle = format!("\"{KEY}\"");
                bytes[..bytes.len().min(1 << 16)].windows(needle.len()).any(|w| w == needle.as_bytes())
            }
        }
    }

    /// An error about this file.
    pub(crate) fn error(&self, problem: impl Into<String>) -> AtcError {
        AtcError::artifact(self.what, problem)
    }

    /// The JSON document of the header; its `format` and `version` are checked first.
    pub(crate) fn header<H: DeserializeOwned>(&self, format: &str, version: u64) -> Result<H, AtcError> {
        let value: serde_json::Value =
            serde_json::from_str(&self.header).map_err(|e| self.error(format!("its header: {e}")))?;
        if value["format"] != format {
            return Err(self.error(format!("its format is {}, expected \"{format}\"", value["format"])));
        }
        if value["version"] != version {
            return Err(self.error(format!(
                "its version is {}, this tool reads version {version}; make it again with this tool",
                value["version"]
            )));
        }
        serde_json::from_value(value).map_err(|e| self.error(format!("its header: {e}")))
    }

    fn bytes(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<&'a [u8], AtcError> {
        let tensor =
            self.tensors.tensor(name).map_err(|_| self.error(format!("the tensor `{name}` is missing")))?;
        if tensor.dtype() != dtype || tensor.shape() != shape {
            return Err(self.error(format!(
                "the tensor `{name}` is {:?} {:?}, expected {dtype:?} {shape:?}",
                tensor.dtype(),
                tensor.shape()
            )));
        }
        Ok(tensor.data())
    }

    /// The shape of a tensor.
    pub(crate) fn shape(&self, name: &str) -> Result<Vec<usize>, AtcError> {
        let tensor =
            self.tensors.tensor(name).map_err(|_| self.error(format!("the tensor `{name}` is missing")))?;
        Ok(tensor.shape().to_vec())
    }

    /// An f32 tensor of the given shape, finite.
    pub(crate) fn f32(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, AtcError> {
        let bytes = self.bytes(name, Dtype::F32, shape)?;
        let values: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        self.finite(name, values.iter().position(|v| !v.is_finite()))?;
        Ok(values)
    }

    /// An f64 tensor of the given shape, finite.
    pub(crate) fn f64(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>, AtcError> {
        let bytes = self.bytes(name, Dtype::F64, shape)?;
        let values: Vec<f64> = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
        self.finite(name, values.iter().position(|v| !v.is_finite()))?;
        Ok(values)
    }

    /// A u32 tensor of the given shape.
    pub(crate) fn u32(&self, name: &str, shape: &[usize]) -> Result<Vec<u32>, AtcError> {
        let bytes = self.bytes(name, Dtype::U32, shape)?;
        Ok(bytes.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect())
    }

    fn finite(&self, name: &str, first_bad: Option<usize>) -> Result<(), AtcError> {
        match first_bad {
            None => Ok(()),
            Some(i) => Err(self.error(format!("element {i} of the tensor `{name}` is not finite"))),
        }
    }
}
