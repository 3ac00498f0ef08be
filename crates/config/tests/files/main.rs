//! Pipeline files, read for synthetic stages: small, fast, and shaped like the real ones.

mod config;
mod named;
mod promises;
mod shipped;
#[path = "../../../workflow/tests/builder/stages.rs"]
#[allow(dead_code, reason = "the build system's own tests use the rest")]
mod stages;
