//! Named tensors in safetensors files, little-endian.
//!
//! A file may hold one JSON document besides, in its header under the key `3d-use`; the document's `format`
//! and `version` are checked before anything else of it. Bytes are deterministic: one metadata key at most,
//! tensors in the format's own order (type, then name). Whoever reads says which tensors there are to be, of
//! which type and shape; what differs is named.

mod file;
mod writer;

use safetensors::Dtype;

pub use file::TensorFile;
pub use writer::TensorWriter;

/// Where a header keeps its document.
const KEY: &str = "3d-use";

/// What is wrong with a file of tensors.
#[derive(Debug, thiserror::Error)]
pub enum TensorError {
    /// Not a safetensors file, or a truncated one; also what cannot be written as one.
    #[error("not a whole safetensors file ({0}); make it again")]
    Container(#[from] safetensors::SafeTensorError),
    /// The header's document.
    #[error("{0}")]
    Document(String),
    /// A tensor is not there.
    #[error("tensor `{name}` is missing")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor that nobody asked for: a file that says more than is read would be read wrongly.
    #[error("tensor `{name}` is not known here; the file may be of a newer version")]
    Unknown {
        /// Its name.
        name: String,
    },
    /// Another element type.
    #[error("tensor `{name}` holds {found:?}; expected {expected:?}")]
    Type {
        /// Its name.
        name: String,
        /// Its type.
        found: Dtype,
        /// What it should be.
        expected: Dtype,
    },
    /// Another shape.
    #[error("tensor `{name}` has shape {found:?}; expected {expected}")]
    Shape {
        /// Its name.
        name: String,
        /// Its shape.
        found: Vec<usize>,
        /// What it should be.
        expected: String,
    },
    /// A NaN or an infinity.
    #[error("tensor `{name}` is {value} at flat index {index}; expected finite numbers")]
    NotFinite {
        /// Its name.
        name: String,
        /// Where.
        index: usize,
        /// What.
        value: f64,
    },
}

#[cfg(test)]
mod tests;
