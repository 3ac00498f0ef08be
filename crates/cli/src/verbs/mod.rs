//! One file per verb, or per family of verbs.

pub(crate) mod bench;
pub(crate) mod bench_gpu;
mod bench_read;
pub(crate) mod cache;
pub(crate) mod check;
pub(crate) mod compare;
pub(crate) mod devices;
pub(crate) mod doctor;
pub(crate) mod drawing;
pub(crate) mod evaluate;
pub(crate) mod export;
pub(crate) mod film_path;
pub(crate) mod found;
pub(crate) mod generate;
pub(crate) mod history;

pub(crate) mod loaded;
pub(crate) mod models;
pub(crate) mod outcome;
pub(crate) mod params;
pub(crate) mod pipelines;
pub(crate) mod prepare;
pub(crate) mod remote;
pub(crate) mod render;
pub(crate) mod results;
pub(crate) mod run;
pub(crate) mod speed;
pub(crate) mod stages;
pub(crate) mod submit;
pub(crate) mod synth;
pub(crate) mod view;
pub(crate) mod water;
pub(crate) mod web;
pub(crate) mod white;
