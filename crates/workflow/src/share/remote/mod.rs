//! A store beside the cache that other machines can also reach: a folder, a bucket, or anything else that
//! keeps bytes under names.
//!
//! ```text
//! v1/blobs/<digest>                   a file of an artifact, named by its digest
//! v1/artifacts/<stage>/<key>.json     its manifest, written last and only once, so that an artifact is
//!                                     complete or absent
//! v1/claims/<key>                    written by the process that computes the key now
//! v1/probe/…                          written and removed when a store is opened
//! ```
//!
//! A store only saves time, and every byte from one is checked. A manifest has to match the requested key,
//! and every file its digest. Data that do not match are requested again, and then count as missing. This
//! guards against everything except results that were replaced on purpose, manifest included. Fetched files
//! are assembled in `tmp` and published like the work of a stage, so that a cache holds the same bytes for
//! computed and for fetched artifacts.

mod claim;
mod folder;
mod memory;
mod receive;
mod shelf;
pub(crate) mod transfer;

use std::io::{self, Read, Write};
use std::time::SystemTime;

use crate::cache::key::Key;
use crate::error::FileError;
use use3d_code::digest::Digest;

pub(crate) use claim::{ClaimRequest, StoreClaim};
pub use folder::FolderStore;
pub use memory::Memory;
pub use shelf::{Shelf, Swept};
pub use transfer::{Fetched, RemoteStore, Sent};

/// A store of bytes under names (parts of letters, digits, `-`, `_` and `.`, with `/` between them).
pub trait Remote: Send + Sync {
    /// Its address, for display. It contains no credentials.
    fn place(&self) -> String;

    /// Writes the bytes of an object to `to`, in order; returns `false` if there is no object of that name.
    ///
    /// # Errors
    /// [`RemoteError::Local`] with the error of `to`; else the store's error.
    fn get(&self, name: &str, to: &mut (dyn Write + Send)) -> Result<bool, RemoteError>;

    /// The size of an object in bytes; `None` if there is no object of that name.
    ///
    /// # Errors
    /// The store's error.
    fn size(&self, name: &str) -> Result<Option<u64>, RemoteError>;

    /// Creates or replaces an object, whole or not at all. `from` has `size` bytes.
    ///
    /// # Errors
    /// [`RemoteError::Local`] with the error of `from`; else the store's error.
    fn put(&self, name: &str, from: &mut (dyn Read + Send), size: u64) -> Result<(), RemoteError>;

    /// Creates a small object if none has that name and returns whether it did. Of several concurrent callers
    /// exactly one gets `true`.
    ///
    /// # Errors
    /// The store's error.
    fn create(&self, name: &str, bytes: &[u8]) -> Result<bool, RemoteError>;

    /// Removes an object. A missing object is no error.
    ///
    /// # Errors
    /// The store's error.
    fn remove(&self, name: &str) -> Result<(), RemoteError>;

    /// Lists all objects whose names begin with `prefix`, which ends with `/`, in no order.
    ///
    /// # Errors
    /// The store refuses or does not answer.
    fn list(&self, prefix: &str) -> Result<Vec<Listed>, RemoteError>;
}

/// An object in a list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Its name.
    pub name: String,
    /// Its size, bytes.
    pub size: u64,
    /// The time of its last change, by the store's clock.
    pub written: SystemTime,
}

/// The reason why something could not be fetched or sent.
#[derive(Debug, thiserror::Error)]
pub enum RemoteError {
    /// The store refused an operation.
    #[error("{place}: cannot {doing} {name}: {reason}")]
    Refused {
        /// The store.
        place: String,
        /// The operation, as a verb.
        doing: &'static str,
        /// The object.
        name: String,
        /// The store's error, and the next step for the user.
        reason: String,
        /// True if the operation may succeed when it is repeated.
        passing: bool,
    },
    /// There is no such store.
    #[error("{place}: there is no such store: {reason}")]
    NoStore {
        /// The store.
        place: String,
        /// The server's answer.
        reason: String,
    },
    /// The content of an object does not match its name.
    #[error("{place}: {name} {reason}")]
    Wrong {
        /// The store.
        place: String,
        /// The object.
        name: String,
        /// The problem.
        reason: String,
    },
    /// The artifact that was to be sent is damaged.
    #[error("it is damaged: {0}; `use3d verify` moves it aside")]
    Damaged(String),
    /// The local reader or writer of the bytes failed.
    #[error("{0}")]
    Local(io::Error),
    /// A local file operation failed.
    #[error(transparent)]
    File(#[from] FileError),
    /// The operation was stopped.
    #[error("interrupted")]
    Stopped,
}

impl RemoteError {
    /// Returns true if the same operation may succeed when it is repeated.
    pub fn passes(&self) -> bool {
        matches!(self, Self::Refused { passing: true, .. } | Self::Wrong { .. })
    }
}

/// The folder of the claims.
const CLAIMS: &str = "v1/claims/";

fn blob(digest: &Digest) -> String {
    format!("v1/blobs/{digest}")
}

fn manifest(stage: &str, key: &Key) -> String {
    format!("v1/artifacts/{stage}/{key}.json")
}
