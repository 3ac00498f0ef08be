//! The judge: synthetic captures whose truth is known, the whole pipeline on each, and one table of
//! how far everything is from it.
//!
//! [`captures`] are the captures, [`runs`] the pipeline that every one of them goes through, with the
//! baselines as variants, [`figures`] what came out, gathered over seeds, [`page`] the table for people,
//! [`picture`] one held-out view of a capture side by side, [`output`] the folder that all of it goes to.
//! Nothing here computes a score: those are `evaluate`'s, kept in the cache like any other.

pub mod captures;
pub mod figures;
pub mod output;
pub mod page;
pub mod picture;
pub mod runs;
