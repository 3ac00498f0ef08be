//! A store beside the cache that other machines reach as well: a folder, a bucket,
//! whatever keeps bytes under names.
//!
//! ```text
//! v1/blobs/<digest>                   a file of an artifact, by what is in it
//! v1/artifacts/<stage>/<key>.json     its manifest, written last and only once: an artifact is there whole or not at all
//! v1/probe/…                          written and removed when a store is opened
//! ```
//!
//! A store only saves time, and every byte from one is checked: a manifest has to fit the key that was asked
//! for, every file its digest, and what does not is asked for again and then counts as not there. That
//! guards against everything but results that somebody replaced on purpose, manifest and all. What comes in
//! is built in `tmp` and published like the work of a stage, so that a cache holds the same bytes whether
//! they were computed or fetched.

mod folder;
mod memory;
mod receive;
mod shelf;
mod sync;
mod transfer;

use std::io::{self, Read, Write};
use std::time::SystemTime;

use super::digest::Digest;
use super::error::FileError;
use super::key::Key;

pub use folder::Folder;
pub use memory::Memory;
pub use shelf::{Shelf, Swept};
pub use sync::Transferred;
pub use transfer::{Fetched, RemoteStore, Sent};

/// What keeps bytes under names (parts of letters, digits, `-`, `_` and `.`, with `/` between them).
pub trait Remote: Send + Sync {
    /// Where it is, for people. No credentials.
    fn place(&self) -> String;

    /// Passes the bytes of an object on, in order; `false` where there is none of that name.
    ///
    /// # Errors
    /// [`RemoteError::Local`] with the error of `to`; else what the store said.
    fn get(&self, name: &str, to: &mut (dyn Write + Send)) -> Result<bool, RemoteError>;

    /// How large an object is, bytes; nothing where there is none of that name.
    ///
    /// # Errors
    /// What the store said.
    fn size(&self, name: &str) -> Result<Option<u64>, RemoteError>;

    /// Creates or replaces an object, whole or not at all. `from` has `size` bytes.
    ///
    /// # Errors
    /// [`RemoteError::Local`] with the error of `from`; else what the store said.
    fn put(&self, name: &str, from: &mut (dyn Read + Send), size: u64) -> Result<(), RemoteError>;

    /// Creates a small object unless there is one of that name; whether it did. Of all that try at
    /// once it says so to exactly one.
    ///
    /// # Errors
    /// What the store said.
    fn create(&self, name: &str, bytes: &[u8]) -> Result<bool, RemoteError>;

    /// Removes an object. One that is not there is no error.
    ///
    /// # Errors
    /// What the store said.
    fn remove(&self, name: &str) -> Result<(), RemoteError>;

    /// All objects whose names begin with `prefix`, a name with `/` at its end, in no order.
    ///
    /// # Errors
    /// What the store said.
    fn list(&self, prefix: &str) -> Result<Vec<Listed>, RemoteError>;
}

/// An object in a list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Its name.
    pub name: String,
    /// Its size, bytes.
    pub size: u64,
    /// When it was written, by the store's clock.
    pub written: SystemTime,
}

/// Why something could not be fetched or sent.
#[derive(Debug, thiserror::Error)]
pub enum RemoteError {
    /// The store did not do what it was asked.
    #[error("{place}: cannot {doing} {name}: {reason}")]
    Refused {
        /// The store.
        place: String,
        /// What it was asked.
        doing: &'static str,
        /// The object.
        name: String,
        /// What it said, and what to do.
        reason: String,
        /// Whether it may do it when it is asked again.
        passing: bool,
    },
    /// What it holds is not what its name says.
    #[error("{place}: {name} {reason}")]
    Wrong {
        /// The store.
        place: String,
        /// The object.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// The artifact that was to be sent is damaged.
    #[error("it is damaged: {0}; `use3d verify` moves it aside")]
    Damaged(String),
    /// Who takes the bytes, or gives them, failed.
    #[error("{0}")]
    Local(io::Error),
    /// A file here.
    #[error(transparent)]
    File(#[from] FileError),
    /// It was asked to stop.
    #[error("interrupted")]
    Stopped,
}

impl RemoteError {
    /// Whether the store itself is not there, so that nothing of it can be.
    pub(crate) fn is_of_the_whole_store(&self) -> bool {
        matches!(self, Self::Refused { reason, .. } if reason.contains("NoSuchBucket"))
    }

    /// Whether the same may work when it is tried again.
    pub fn passes(&self) -> bool {
        matches!(self, Self::Refused { passing: true, .. } | Self::Wrong { .. })
    }
}

fn blob(digest: &Digest) -> String {
    format!("v1/blobs/{digest}")
}

fn manifest(stage: &str, key: &Key) -> String {
    format!("v1/artifacts/{stage}/{key}.json")
}
