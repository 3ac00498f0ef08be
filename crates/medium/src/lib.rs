//! MediumRBF and the media it is compared with
