//! The stages, and the places of their artifacts.

use std::sync::Arc;

use crate::cache::artifacts::Cache;
use crate::cache::key;
use crate::share::remote::RemoteStore;
use crate::stage::registry::Registry;

/// Stages and the cache they work on.
#[derive(Clone)]
pub struct Builder {
    /// The stages.
    pub registry: Registry,
    /// The cache.
    pub cache: Cache,
    /// The class of arithmetic of this machine.
    pub numeric_class: String,
    pub(crate) remote: Option<Arc<RemoteStore>>,
    pub(crate) only_looks: bool,
}

impl Builder {
    /// A builder on this machine.
    pub fn new(registry: Registry, cache: Cache) -> Self {
        let cache = cache.with_promises(registry.promises());
        Self { registry, cache, numeric_class: key::numeric_class(), remote: None, only_looks: false }
    }

    /// The same builder, which computes nothing of a scene and so opens no device. It knows the devices that
    /// have computed into the cache.
    #[must_use]
    pub fn only_looking(self) -> Self {
        Self { only_looks: true, ..self }
    }

    /// The same builder, which looks in a store for artifacts that the cache lacks before it computes them,
    /// and uploads the artifacts that it has computed.
    #[must_use]
    pub fn with_remote(self, remote: Arc<RemoteStore>) -> Self {
        Self { remote: Some(remote), ..self }
    }
}
