//! The report of results. It only lays out what the stages measured and rendered.
//!
//! [`page`] is a page with its sections, [`index`] the overview of a batch, [`tables`] are the tables of many
//! scenes as text, LaTeX, CSV and HTML, [`verdict`] writes sentences about scores, and [`story`] says
//! the same in short and plain words.
//!
//! A batch of one result has one page with everything. Otherwise the page at the top is the overview, and
//! every scene has a page in every variant.

pub mod index;
pub mod page;
pub mod story;
pub mod tables;
pub mod verdict;

use std::path::Path;

use serde::{Deserialize, Serialize};
use use3d_judge::configuration::Configuration;

use page::CalibratorSection;
use tables::means::MeanScores;
use verdict::Sentence;

/// The format of the data beside a result's page.
const FORMAT: &str = "3d-use result";

/// The parts of a batch's report that belong to no single scene. The others are known only when results are
/// delivered.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct BatchReport {
    /// The title.
    pub title: String,
    /// The section on the calibrator, if one was trained.
    pub calibrator: Option<CalibratorSection>,
    /// Results that could not be made, by scene, variant and stage.
    pub missing: Vec<String>,
    /// The program, its version, and the place of date and command.
    pub made_with: String,
}

/// The data beside a result's page: what the overview and the tables need of it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct ResultData {
    /// Always `3d-use result`.
    pub format: String,
    /// A digest of everything that page and data follow from.
    pub source: String,
    /// The verdict on its scores, in sentences.
    pub verdict: Vec<Sentence>,
    /// Seconds of computation, without stages that another result has already.
    pub seconds: f64,
    /// The configuration behind it.
    pub configuration: Option<Configuration>,
    /// Its mean scores.
    pub scores: Option<MeanScores>,
    /// A small picture, as a data address.
    pub thumbnail: String,
}

impl ResultData {
    /// Reads a file of data; `None` if there is none, or one of another form.
    pub fn read(path: &Path) -> Option<Self> {
        let data: Self = serde_json::from_slice(&std::fs::read(path).ok()?).ok()?;
        (data.format == FORMAT).then_some(data)
    }

    /// The data as JSON.
    ///
    /// # Errors
    /// A number is not finite.
    pub fn json(self) -> serde_json::Result<String> {
        serde_json::to_string(&Self { format: FORMAT.into(), ..self })
    }
}
