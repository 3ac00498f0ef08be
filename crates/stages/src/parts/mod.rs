//! The parts that several stages share.

pub(crate) mod appearance;
pub(crate) mod calibrated;
pub(crate) mod calibrator;
pub(crate) mod captured;
pub(crate) mod choices;
pub(crate) mod common;
pub(crate) mod contact_sheet;
pub(crate) mod drawn;
pub(crate) mod judgement;
pub(crate) mod kept_water;
pub(crate) mod memory;
pub(crate) mod names;
pub(crate) mod proposals;
pub(crate) mod proposer;
pub(crate) mod requirements;
pub(crate) mod scenes;
pub(crate) mod sights;
pub(crate) mod starts;
pub(crate) mod watch;
pub mod water;
pub(crate) mod weights;
