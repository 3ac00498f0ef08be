//! What judges results, and lays out what it found. Knows nothing of stages, keys or caches.
//!
//! [`scoring`] compares pictures and [`truth`] scenes with what is known of them, [`speed`] times drawing,
//! [`strip`] shows a spot in neighbouring views; [`scores`] is what is written down of one scene, [`tables`]
//! of many, [`configuration`] what made them, [`verdict`] puts it into sentences, [`report`] is the page.

pub mod configuration;
pub mod report;
pub mod scores;
pub mod scoring;
pub mod speed;
pub mod strip;
pub mod tables;
pub mod truth;
pub mod verdict;
