//! The report of results. It only lays out what the stages measured and rendered.
//!
//! [`page`] is the page with its sections, [`tables`] are the tables of many scenes as text, LaTeX, CSV and
//! HTML, and [`verdict`] writes sentences about scores.

pub mod batch;
pub mod page;
pub mod tables;
pub mod verdict;

use serde::{Deserialize, Serialize};
use use3d_judge::scores::ScoredScene;

use page::Page;

/// The report of a run without what is known only when it is delivered: costs, settings, speeds, and the
/// places of other files.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct BatchReport {
    /// The page.
    pub page: Page,
    /// The scores behind the tables.
    pub scored: Vec<ScoredScene>,
}
