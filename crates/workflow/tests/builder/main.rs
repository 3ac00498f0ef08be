//! The build system with synthetic stages: small, fast, and shaped like the real ones.

mod batch;
mod caching;
mod code;
mod crash;
mod devices;
mod economy;
mod far_store;
mod faults;
mod faulty_store;
mod nodes;
mod one_store;
mod reference;
mod remote;
mod sharing;
mod stages;
