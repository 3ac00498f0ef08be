//! The benchmark: synthetic captures whose truth is known, the whole pipeline on each of them, and one table
//! of the distances from the truth.
//!
//! [`captures`] lists the captures. [`runs`] is the pipeline that runs on each of them, with the baselines as
//! variants, and [`mod@bench`] runs it for every seed. [`figures`] gathers the results over seeds, [`page`]
//! writes the table for readers, [`picture`] shows one held-out view of a capture side by side, and
//! [`output`] writes the folder with all of it. No scores are computed here: the stage `evaluate` computes
//! them, and the cache keeps them like any other.

pub mod bench;
pub mod captures;
pub mod figures;
pub mod output;
pub mod page;
pub mod picture;
pub mod runs;
