//! The errors of this crate, always with the file or argument, what was expected and what to do.

use std::path::PathBuf;

/// An error of this crate.
#[derive(Debug, thiserror::Error)]
pub enum NetError {
    /// The weights of a network are not in the models folder. Tables print this message unchanged.
    #[error("{network} is not available: put {file} into {} (from {origin})", dir.display())]
    NotAvailable {
        /// The network.
        network: &'static str,
        /// The file to get, by its official name.
        file: &'static str,
        /// The models folder.
        dir: PathBuf,
        /// The address where the file is published.
        origin: &'static str,
    },
    /// A file could not be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file is not a checkpoint, or is damaged.
    #[error("{}: not a readable checkpoint ({message}); download it again", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The problem.
        message: String,
    },
    /// The content of a file differs from the official one.
    #[error(
        "{}: the SHA-256 digest is {found}, the official file's is {expected}; download it again",
        path.display()
    )]
    Digest {
        /// The file.
        path: PathBuf,
        /// The official digest, or the first hexadecimal digits of it.
        expected: String,
        /// The file's digest.
        found: String,
    },
    /// A checkpoint lacks a tensor.
    #[error(
        "{origin}: tensor `{tensor}` with shape {expected:?} is missing; is this the file of another network?"
    )]
    MissingTensor {
        /// The source of the weights.
        origin: String,
        /// The name of the missing tensor.
        tensor: String,
        /// The shape it should have.
        expected: Vec<usize>,
    },
    /// A tensor has another shape.
    #[error(
        "{origin}: tensor `{tensor}` has shape {found:?}, expected {expected:?}; is this another variant of the network?"
    )]
    Shape {
        /// The source of the weights.
        origin: String,
        /// The tensor.
        tensor: String,
        /// The shape it should have.
        expected: Vec<usize>,
        /// The shape it has.
        found: Vec<usize>,
    },
    /// A tensor contains a value that cannot be a weight.
    #[error("{origin}: tensor `{tensor}` {problem}")]
    Values {
        /// The source of the weights.
        origin: String,
        /// The tensor.
        tensor: String,
        /// The problem.
        problem: String,
    },
    /// A picture that the network cannot process.
    #[error("{network}: {problem}")]
    Input {
        /// The network.
        network: &'static str,
        /// The problem, and the requirement.
        problem: String,
    },
}
