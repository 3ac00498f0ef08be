//! The report of results. It only lays out what the stages measured and rendered.
//!
//! [`page`] is the page with its sections, [`tables`] are the tables of many scenes as text, LaTeX, CSV and
//! HTML, and [`verdict`] writes sentences about scores.

pub mod batch;
pub mod page;
pub mod tables;
pub mod verdict;
