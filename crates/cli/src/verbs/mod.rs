//! One file per verb, or per family of verbs.

pub(crate) mod bench;
pub(crate) mod bench_gpu;
pub(crate) mod cache;
pub(crate) mod devices;
pub(crate) mod evaluate;
pub(crate) mod export;
pub(crate) mod film_path;
pub(crate) mod generate;
pub(crate) mod models;
pub(crate) mod outcome;
pub(crate) mod params;
pub(crate) mod remote;
pub(crate) mod render;
pub(crate) mod run;
pub(crate) mod speed;
pub(crate) mod stages;
pub(crate) mod submit;
pub(crate) mod synth;
pub(crate) mod view;
pub(crate) mod water;
pub(crate) mod web;
