//! Several processes on one cache, and several caches on one store.
//!
//! A lease tells other processes that a key is being computed; its pulse tells that the holder is alive. A
//! remote store holds artifacts for other machines.

pub(crate) mod killed;
pub(crate) mod lease;
pub(crate) mod pulse;
pub mod remote;
pub(crate) mod sweep;
