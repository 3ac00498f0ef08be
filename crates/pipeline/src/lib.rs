//! Stages, keys, cache, plans, batches, tables and report: from captures to results, computing nothing twice.
//!
//! [`engine`] knows what a stage is and when it must run; [`config`] reads pipeline files; [`stages`] is the table of the method's
//! stages. [`scoring`] is what several stages share; [`water`] is a capture's water before any stage; [`truth`], [`strip`] and [`speed`] measure and show; [`tables`] and [`report`] lay out what they found;
//! [`results`] puts it where a person looks, with a [page per scene](scene_page) for a browser; [`mod@bench`] does all of it on captures whose truth is known.

pub mod bench;
pub mod config;
pub mod engine;
pub mod report;
pub mod results;
pub mod scene_page;
pub mod scores;
pub mod scoring;
pub mod speed;
pub mod stages;
pub mod strip;
pub mod tables;
pub mod truth;
pub mod water;
