//! The data set of the calibrator: the extractor's result for each pair of photographs.
//!
//! One pair of images is in memory at a time. A pair that cannot be read, or whose halves do not match, is
//! listed and left out; this is never an error. An example takes a few tens of kilobytes and serialises, so
//! that a caller can store it per pair.

use std::error::Error;

use serde::{Deserialize, Serialize};
use use3d_capture::Image;

use crate::error::AtcError;
use crate::extractor::{Affine, Descriptors, ExtractorSettings, SourceImage, Transition, Workspace};
use crate::progress::{LoopPosition, ProgressCallback, report};
use crate::proposers::{Proposer, ProposerId};

/// A pair of photographs to be added to a data set.
pub struct PairImages {
    /// The pair's name.
    pub name: String,
    /// The underwater image and the enhanced one, or the reason why they could not be read.
    pub images: Result<(Image, Image), Box<dyn Error + Send + Sync>>,
}

/// A pair that was left out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skipped {
    /// The pair's name.
    pub name: String,
    /// The reason.
    pub reason: String,
}

/// One cell of one pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellExample {
    /// Cell descriptor of the source.
    pub descriptor: [f64; 6],
    /// The proposal's local operator.
    pub proposal: [f64; 6],
    /// The paired target's local operator.
    pub target: [f64; 6],
    /// The certainty of the target's operator, `[0, 1]`.
    pub confidence: f64,
}

/// One pair in operator space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairExample {
    /// The pair's name.
    pub name: String,
    /// Image descriptor of the source.
    pub descriptor: [f64; 18],
    /// The proposal's global operator.
    pub proposal: Affine,
    /// The paired target's global operator.
    pub target: Affine,
    /// Cells whose numbers are all finite.
    pub cells: Vec<CellExample>,
}

impl PairExample {
    /// Extracts both transitions of a pair. `proposal` is the proposer's result for `source`, at any size.
    pub fn extract(
        name: &str,
        source: &SourceImage,
        target: &Image,
        proposal: &Image,
        workspace: &mut Workspace,
    ) -> Result<Self, AtcError> {
        let Descriptors { global, local } = source.descriptors();
        let proposed: Transition = source.forward(proposal, workspace)?.clone();
        let wanted: Transition = source.forward(target, workspace)?.clone();
        let confidence = source.confidence(workspace);
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        if !(finite(&global) && finite(&proposed.global) && finite(&wanted.global)) {
            return Err(AtcError::artifact(format!("pair `{name}`"), "an operator is not finite"));
        }
        let cells = (0..local.len())
            .map(|c| CellExample {
                descriptor: local[c],
                proposal: proposed.local[c],
                target: wanted.local[c],
                confidence: confidence[c],
            })
            .filter(|c| {
                finite(&c.descriptor) && finite(&c.proposal) && finite(&c.target) && c.confidence.is_finite()
            })
            .collect();
        Ok(Self {
            name: name.to_string(),
            descriptor: global,
            proposal: proposed.global,
            target: wanted.global,
            cells,
        })
    }
}

/// Pairs in operator space, and the pairs that were left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Dataset {
    /// Settings of the extractor that computed it.
    pub extractor: ExtractorSettings,
    /// The proposer that computed it.
    pub proposer: ProposerId,
    /// Usable pairs, in the given order.
    pub examples: Vec<PairExample>,
    /// Pairs that were left out.
    pub skipped: Vec<Skipped>,
}

impl Dataset {
    /// An empty data set.
    pub fn new(extractor: ExtractorSettings, proposer: ProposerId) -> Self {
        Self { extractor, proposer, examples: Vec::new(), skipped: Vec::new() }
    }

    /// Runs proposer and extractor over `pairs`, one at a time. Fails only if the settings are invalid or
    /// `watch` requests a stop.
    pub fn build(
        pairs: impl IntoIterator<Item = PairImages>,
        proposer: &dyn Proposer,
        extractor: &ExtractorSettings,
        watch: &mut ProgressCallback<'_>,
    ) -> Result<Self, AtcError> {
        extractor.validate()?;
        let mut dataset = Self::new(extractor.clone(), proposer.id());
        let mut workspace = Workspace::default();
        for (index, pair) in pairs.into_iter().enumerate() {
            report(watch, LoopPosition::Pair { index, name: &pair.name })?;
            let made = match &pair.images {
                Ok(images) => example(&pair.name, images, proposer, extractor, &mut workspace)
                    .map_err(|error| error.to_string()),
                Err(error) => Err(error.to_string()),
            };
            match made {
                Ok(example) => dataset.examples.push(example),
                Err(reason) => {
                    tracing::warn!("pair {} is left out: {reason}", pair.name);
                    dataset.skipped.push(Skipped { name: pair.name, reason });
                }
            }
        }
        Ok(dataset)
    }

    /// The data set with only some of its examples.
    pub fn subset(&self, indices: &[usize]) -> Self {
        Self {
            examples: indices.iter().map(|&i| self.examples[i].clone()).collect(),
            ..Self::new(self.extractor.clone(), self.proposer.clone())
        }
    }
}

fn example(
    name: &str,
    (source, target): &(Image, Image),
    proposer: &dyn Proposer,
    extractor: &ExtractorSettings,
    workspace: &mut Workspace,
) -> Result<PairExample, AtcError> {
    check_shapes(source, target)?;
    let source = SourceImage::from_image(source, extractor)?;
    let proposal = proposer.propose(&source.image)?;
    PairExample::extract(name, &source, target, &proposal, workspace)
}

/// Both halves must show the same frame: sizes may differ (one half was scaled), aspect ratios by at most
/// two percent.
fn check_shapes(source: &Image, target: &Image) -> Result<(), AtcError> {
    let (a, b) = ((source.width(), source.height()), (target.width(), target.height()));
    if a.0.min(a.1).min(b.0).min(b.1) < 8 {
        let sizes = format!("{}x{} and {}x{}", a.0, a.1, b.0, b.1);
        return Err(AtcError::artifact(sizes, "both sides must be at least 8 pixels"));
    }
    let ratio = (a.0 as f64 / a.1 as f64) / (b.0 as f64 / b.1 as f64);
    if !(0.98..=1.02).contains(&ratio) {
        let sizes = format!("the input is {}x{} and the target {}x{}", a.0, a.1, b.0, b.1);
        return Err(AtcError::artifact(sizes, "different shapes cannot be the same photograph"));
    }
    Ok(())
}
