//! Judges a capture before any training, and says what will go wrong and what to do about it.
//!
//! ```text
//! measure ─▶ findings ─▶ report ─▶ page
//! figures     rules        text      HTML with small pictures
//! ```
//!
//! [`measure()`] computes figures from the cameras, the tracks and, if pixels are at hand, the photographs;
//! [`figures`] gathers all of a folder, and [`few_figures`] those that take seconds.
//! [`Reach`](use3d_capture::Reach) says which parts of the pictures the tracks reach. Each rule of
//! `findings` compares figures with a limit. A [`CheckReport`] holds what the rules found, the gravest
//! first. Nothing here changes a capture, and no result of a training depends on it.

mod above;
mod agreement;
mod depth;
mod findings;
mod gather;
mod grain;
mod measure;
mod page;
mod passers;
mod report;
mod shown;

pub use agreement::{ModelAgreement, ViewAgreement, ViewOverlap};
pub use depth::DepthAgreement;
pub use findings::{WaterSight, examine};
pub use gather::{few_figures, figures};
pub use measure::{Figures, GroupExposure, ViewFigures, measure};
pub use page::{Gallery, Picture, page};
pub use report::{CheckReport, Finding, Severity};
pub use shown::Exchanged;
