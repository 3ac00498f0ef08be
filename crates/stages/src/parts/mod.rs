//! The parts that several stages share.

pub(crate) mod appearance;
pub(crate) mod baselines;
pub(crate) mod calibrator;
pub(crate) mod captured;
pub(crate) mod contact_sheet;
pub(crate) mod curves;
pub(crate) mod files;
pub(crate) mod judgement;
pub(crate) mod kept_water;
pub(crate) mod proposer;
pub(crate) mod published_clear;
pub(crate) mod reference;
pub(crate) mod scene;
pub(crate) mod sights;
pub(crate) mod target_params;
pub(crate) mod transition_sources;
pub(crate) mod visits;
pub(crate) mod watch;
pub mod water;
pub(crate) mod water_words;
pub(crate) mod weights;
