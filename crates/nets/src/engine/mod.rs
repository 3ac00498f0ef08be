//! The few operations that all networks are made of, on plain slices.

pub(crate) mod activation;
pub(crate) mod attention;
pub(crate) mod convolution;
pub(crate) mod normalise;
pub(crate) mod planes;
pub(crate) mod pool;
pub(crate) mod product;
pub(crate) mod resample;
