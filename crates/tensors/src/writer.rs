//! Writes tensors into a file.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};

use safetensors::{Dtype, View};
use serde::Serialize;

use crate::{KEY, TensorError};

/// Collects tensors by name and writes them.
#[derive(Clone, Debug, Default)]
pub struct TensorWriter {
    tensors: BTreeMap<String, Raw>,
}

#[derive(Clone, Debug)]
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

impl TensorWriter {
    /// Creates a writer without tensors.
    pub fn new() -> Self {
        Self::default()
    }

    fn add(&mut self, name: &str, dtype: Dtype, shape: &[usize], bytes: Vec<u8>) {
        self.tensors.insert(name.to_string(), Raw { dtype, shape: shape.to_vec(), bytes });
    }

    /// Adds an f32 tensor, row-major.
    pub fn f32(&mut self, name: &str, shape: &[usize], values: &[f32]) {
        self.add(name, Dtype::F32, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect());
    }

    /// Adds an f64 tensor, row-major.
    pub fn f64(&mut self, name: &str, shape: &[usize], values: &[f64]) {
        self.add(name, Dtype::F64, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect());
    }

    /// Adds a u32 tensor, row-major.
    pub fn u32(&mut self, name: &str, shape: &[usize], values: &[u32]) {
        self.add(name, Dtype::U32, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect());
    }

    /// The bytes of a file that holds only the tensors. Fails if values do not match a shape.
    pub fn finish(&self) -> Result<Vec<u8>, TensorError> {
        self.bytes(None)
    }

    /// The bytes of a file with a document in its header, which contains its `format` and `version`.
    pub fn finish_with(&self, document: &impl Serialize) -> Result<Vec<u8>, TensorError> {
        let json = serde_json::to_string(document).map_err(|e| TensorError::Document(e.to_string()))?;
        self.bytes(Some(HashMap::from([(KEY.to_string(), json)])))
    }

    fn bytes(&self, metadata: Option<HashMap<String, String>>) -> Result<Vec<u8>, TensorError> {
        Ok(safetensors::serialize(self.tensors.iter().map(|(name, raw)| (name.as_str(), raw)), metadata)?)
    }
}
