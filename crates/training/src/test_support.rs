//! The state that the tests of this crate train: it holds only its run and its step.

use serde::{Deserialize, Serialize};

use crate::Resumable;

/// A checkpoint's content.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct SavedStep {
    pub(crate) fingerprint: [u8; 32],
    pub(crate) step: u64,
}

impl Resumable for SavedStep {
    fn fingerprint(&self) -> &[u8; 32] {
        &self.fingerprint
    }
    fn step(&self) -> u64 {
        self.step
    }
}
