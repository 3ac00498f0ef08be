//! The stages. Each is a pure function from artifacts and parameters to one artifact.
//!
//! ```text
//! import ─┬───────────────▶ reconstruct ─┬─▶ targets ─▶ enhance ─┬─▶ render ──┐
//! depth ──┘                              │      ▲                └─▶ evaluate ├─▶ report
//! pairs ─▶ calibrate ────────────────────┴──────┘                             ┘
//! ```
//!
//! Targets need a calibrator only if `targets.calibrated` is true; `pairs` and `calibrate` are left out if no
//! scene needs one.
//!
//! For comparison, `propose` can precede `reconstruct`, which then learns from photographs that were enhanced
//! one by one; `targets` and `enhance` are left out in that case. `pairs` and `calibrate` run once for all
//! scenes, and not at all if every scene has a finished calibrator. `report` runs once, on all results.

mod calibrate;
pub mod code;
mod depth;
mod engines;
mod enhance;
pub mod evaluate;
mod import;
mod pairs;
mod parts;
mod photographs;
mod propose;
mod reconstruct;
mod render;
pub mod report;
mod targets;

pub use depth::wanted as depth_wanted;
pub use engines::{Drawn, close_devices};
pub use parts::appearance::Appearance;
pub use parts::common::{read_json, write_json};
pub use parts::names::{CALIBRATED, CALIBRATOR, CAMERAS, CHOICES, TARGETS};
pub use parts::proposer::{ProposerChoice, open as open_proposer};
pub use parts::water;
pub use reconstruct::Choices;

use use3d_workflow::{BuildError, Registry};

use crate::code::built_in;

/// The table of stages, with the shorthand keys of the pipeline file.
pub fn registry() -> Result<Registry, BuildError> {
    let stages = vec![
        import::stage(),
        depth::stage(),
        pairs::stage(),
        calibrate::stage(),
        propose::stage(),
        reconstruct::stage(),
        targets::stage(),
        enhance::stage(),
        photographs::stage(),
        render::stage(),
        evaluate::stage(),
        report::stage(),
    ];
    let stages = stages
        .into_iter()
        .map(parts::memory::with_forecast)
        .map(parts::requirements::with_requirements)
        .collect();
    Ok(Registry::new(stages, built_in())?
        .shorthand("scene", "size", "import", "size")
        .shorthand("calibrator", "proposer", "pairs", "proposer")
        .shorthand("calibrator", "proposer", "targets", "proposer")
        .shorthand("calibrator", "steps", "calibrate", "steps"))
}
