//! A stage as data, the table of all stages, and the data and events of a stage while it works.

pub(crate) mod agree;
pub(crate) mod context;
pub(crate) mod definition;
pub(crate) mod device;
pub(crate) mod events;
pub(crate) mod expected;
pub(crate) mod inputs;
pub(crate) mod parameters;
pub(crate) mod reading;
pub(crate) mod registry;
pub(crate) mod require;
pub(crate) mod result;
