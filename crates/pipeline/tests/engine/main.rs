//! The engine with synthetic stages: small, fast, and shaped like the real ones.

mod batch;
mod caching;
mod code;
mod config;
mod crash;
mod faults;
mod named;
mod reference;
mod sharing;
mod shipped;
mod stages;
