//! The likely time and disk of a stage that never ran here, from the sizes of its inputs. Plans print it. It
//! decides nothing, and a record of an earlier run replaces it.

use std::sync::Arc;

use serde::Serialize;

use crate::stage::inputs::{Named, StageInput};
use crate::stage::parameters::AllParameters;

/// Likely time and disk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Expected {
    /// Seconds on two processors.
    pub seconds: f64,
    /// Bytes that it will add to the cache.
    pub bytes: f64,
}

/// The estimate of a stage, from the parameters of all stages, the files that the pipeline names, and those
/// inputs that exist.
pub(super) type Expect = Arc<dyn Fn(&AllParameters, &Named, &[StageInput]) -> Option<Expected> + Send + Sync>;
