//! Files of this crate; every error contains the file's name.

use serde::de::DeserializeOwned;
use use3d_tensors::{TensorError, TensorFile};

use crate::error::AtcError;

/// A parsed file.
pub(crate) struct Reader<'a> {
    what: &'static str,
    file: TensorFile<'a>,
}

impl<'a> Reader<'a> {
    /// Parses the container; `what` is the file's name in errors.
    pub(crate) fn new(what: &'static str, bytes: &'a [u8]) -> Result<Self, AtcError> {
        let file = TensorFile::read(bytes).map_err(|e| AtcError::artifact(what, e.to_string()))?;
        Ok(Self { what, file })
    }

    /// An error about this file.
    pub(crate) fn error(&self, problem: impl Into<String>) -> AtcError {
        AtcError::artifact(self.what, problem)
    }

    fn named<T>(&self, result: Result<T, TensorError>) -> Result<T, AtcError> {
        result.map_err(|e| self.error(e.to_string()))
    }

    /// Reads the JSON document of the header; its `format` and `version` are checked first.
    pub(crate) fn header<H: DeserializeOwned>(&self, format: &str, version: u64) -> Result<H, AtcError> {
        self.named(self.file.document(format, version))
    }

    /// The sides of a tensor with `N` dimensions; `expected` describes them in errors.
    pub(crate) fn sides<const N: usize>(&self, name: &str, expected: &str) -> Result<[usize; N], AtcError> {
        self.named(self.file.sides(name, expected))
    }

    /// Reads an f32 tensor of the given shape, with finite values.
    pub(crate) fn f32(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, AtcError> {
        self.named(self.file.f32(name, shape))
    }

    /// Reads an f64 tensor of the given shape, with finite values.
    pub(crate) fn f64(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>, AtcError> {
        self.named(self.file.f64(name, shape))
    }

    /// Reads a u32 tensor of the given shape.
    pub(crate) fn u32(&self, name: &str, shape: &[usize]) -> Result<Vec<u32>, AtcError> {
        self.named(self.file.u32(name, shape))
    }
}
