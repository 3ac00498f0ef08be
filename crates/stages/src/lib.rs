//! The stages. Each is a pure function from artifacts and parameters to one artifact.
//!
//! ```text
//! prepare ─▶ import                                  (for films, and photographs without cameras)
//! import ─┬───────────────▶ reconstruct ─┬─▶ targets ─▶ enhance ─┬─▶ render ──┐
//! depth ──┘                              │      ▲                └─▶ evaluate ├─▶ report
//! pairs ─▶ calibrate ────────────────────┴──────┘                             ┘
//! ```
//!
//! Targets need a calibrator only if `targets.calibrated` is true; `pairs` and `calibrate` are left out if no
//! scene needs one.
//!
//! The switch `stage2 = false` leaves out `pairs`, `calibrate`, `targets`, `enhance` and `photographs`.
//!
//! For comparison, `propose` can precede `reconstruct`, which then learns from photographs that were enhanced
//! one by one; `targets` and `enhance` are left out in that case. `pairs` and `calibrate` run once for all
//! scenes, and not at all if every scene has a finished calibrator. `report` runs once, on all results.
//! `baseline` precedes `evaluate`: it does once what the variants of a scene share.
//! `photographs` stands beside `render`: it enhances the held-out photographs by the enhanced scene.

mod baseline;
mod calibrate;
pub mod code;
mod depth;
mod engines;
mod enhance;
mod evaluate;
mod import;
mod pairs;
mod parts;
mod photographs;
mod planning;
mod prepare;
mod propose;
mod reconstruct;
mod render;
pub mod report;
mod side_by_side;
mod targets;

pub use engines::{CardError, Drawn, close_devices};
pub use parts::appearance::Appearance;
pub use parts::files::{
    BATCH, CALIBRATED, CALIBRATOR, CAMERAS, CHOICES, SCORES, SPEED, TARGETS, read_json, stems, write_json,
};
pub use parts::proposer::{ProposerChoice, ProposerError, open as open_proposer};
pub use parts::water;
pub use reconstruct::Choices;

use use3d_workflow::{BuildError, Registry};

use crate::code::built_in;

/// The meaning of the switch `stage2`.
const STAGE_2: &str =
    "False leaves out stage 2: the targets, the enhancement, and what needs them. Tables and report say so.";

/// The table of stages, with the shorthand keys of the pipeline file.
pub fn registry() -> Result<Registry, BuildError> {
    let stages = vec![
        prepare::definition::stage(),
        import::definition::stage(),
        depth::definition::stage(),
        pairs::definition::stage(),
        calibrate::definition::stage(),
        propose::definition::stage(),
        reconstruct::definition::stage(),
        targets::definition::stage(),
        enhance::definition::stage(),
        photographs::definition::stage(),
        render::definition::stage(),
        baseline::definition::stage(),
        evaluate::definition::stage(),
        report::definition::stage(),
    ];
    Ok(Registry::new(stages, built_in())?
        .switch("stage2", &["pairs", "calibrate", "targets", "enhance"], STAGE_2)
        .shorthand("scene", "size", "import", "size")
        .shorthand("calibrator", "proposer", "pairs", "proposer")
        .shorthand("calibrator", "proposer", "targets", "proposer")
        .shorthand("calibrator", "steps", "calibrate", "steps"))
}
