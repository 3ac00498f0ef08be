//! Reads and writes named tensors in safetensors files, little-endian. It does not compute with them.
//!
//! A file may also hold one JSON document, in its header under the key `3d-use`; the document's `format` and
//! `version` are checked before anything else in it. The bytes are deterministic: at most one metadata key,
//! and tensors in the format's own order (type, then name). A reader gives the names, types and shapes of the
//! tensors it expects; an error names the first difference.

mod file;
mod writer;

use safetensors::Dtype;

pub use file::TensorFile;
pub use writer::TensorWriter;

/// The key of the document in a header.
const KEY: &str = "3d-use";

/// An error in a file of tensors.
#[derive(Debug, thiserror::Error)]
pub enum TensorError {
    /// The file is not a safetensors file, or is truncated; also an error in writing one.
    #[error("not a whole safetensors file ({0}); make it again")]
    Container(#[from] safetensors::SafeTensorError),
    /// The header's document is wrong.
    #[error("{0}")]
    Document(String),
    /// A tensor is missing.
    #[error("tensor `{name}` is missing")]
    Missing {
        /// Its name.
        name: String,
    },
    /// There is an unknown tensor: ignoring it would misread the file.
    #[error("tensor `{name}` is not known here; the file may be of a newer version")]
    Unknown {
        /// Its name.
        name: String,
    },
    /// A tensor has another element type.
    #[error("tensor `{name}` holds {found:?}; expected {expected:?}")]
    Type {
        /// Its name.
        name: String,
        /// Its type.
        found: Dtype,
        /// The expected type.
        expected: Dtype,
    },
    /// A tensor has another shape.
    #[error("tensor `{name}` has shape {found:?}; expected {expected}")]
    Shape {
        /// Its name.
        name: String,
        /// Its shape.
        found: Vec<usize>,
        /// The expected shape.
        expected: String,
    },
    /// A tensor contains a NaN or an infinity.
    #[error("tensor `{name}` is {value} at flat index {index}; expected finite numbers")]
    NotFinite {
        /// Its name.
        name: String,
        /// The flat index of the value.
        index: usize,
        /// The value.
        value: f64,
    },
}

#[cfg(test)]
mod tests;
