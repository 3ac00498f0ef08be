//! Judges results, and lays out the findings. This module does not depend on stages, keys or caches.
//!
//! [`scoring`] compares pictures, [`truth`] compares scenes with their known truth, [`speed`] times drawing,
//! and [`strip`] shows a spot in neighbouring views. [`scores`] is the record of one scene, [`tables`] are
//! the tables of many scenes, [`configuration`] describes the settings behind them, [`verdict`] writes
//! sentences about them, [`report`] is the page, and [`names`] are the names in all of them.

pub mod configuration;
pub mod names;
pub mod report;
pub mod scores;
pub mod scoring;
pub mod speed;
pub mod strip;
pub mod tables;
pub mod truth;
pub mod verdict;
