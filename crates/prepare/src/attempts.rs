//! Finds the cameras with the keypoints that were chosen, or with both kinds, and keeps the better model.

use serde_json::{Value, json};
use use3d_io_colmap::Model;

use crate::error::PrepareError;
use crate::learned::{ENOUGH, LEARNED_DB, LEARNED_MODELS, advice, loops};
use crate::params::{Keypoints, Mapper, Matching, PrepareParams};
use crate::photographs;
use crate::sfm::{Commands, FEATURES_DB, MATCHES_DB, MODELS, Sfm, USUAL_MODELS};
use crate::tools::{Program, Programs};
use crate::verdict::{Focal, fits_as_well, least_certain, models};
use crate::work::{Step, Work};

/// The search for cameras after the step of features.
pub(crate) struct Search<'a> {
    pub(crate) sfm: &'a Sfm<'a>,
    pub(crate) programs: &'a Programs,
    /// The images in the order of the sequence.
    pub(crate) names: &'a [String],
    pub(crate) matching: Matching,
}

/// The models by one kind of keypoints, the largest first.
pub(crate) struct Attempt {
    kind: &'static str,
    pub(crate) models: Vec<Model>,
    /// The database with the matches.
    database: &'static str,
    /// The least certain focal length; `None` for a lens that was given.
    pub(crate) focal: Option<Focal>,
    /// The focal length that was found first, if a usual one was taken in its place.
    pub(crate) unusual: Option<f64>,
    /// The folder of the models.
    pub(crate) folder: &'static str,
    /// The commands of matches and cameras.
    pub(crate) commands: [Commands; 2],
    /// The most features of an image.
    pub(crate) features: usize,
}

impl Attempt {
    /// The number of images with a place in the largest model.
    fn placed(&self) -> usize {
        self.models.first().map_or(0, |model| model.images.len())
    }
}

/// The result of a search.
pub(crate) struct SearchResult {
    /// The attempt with the most images in its largest model.
    pub(crate) best: Attempt,
    /// The kind of keypoints that is used, and the images that each kind gave a place.
    pub(crate) record: Value,
    /// The package with the networks, if it was used.
    pub(crate) networks: Option<Program>,
    /// The remark on two attempts.
    pub(crate) remark: Option<String>,
    /// The advice to take learned keypoints.
    pub(crate) advice: Option<String>,
}

impl Search<'_> {
    /// Finds the cameras. `networks` are those of [`Keypoints::Learned`].
    pub(crate) fn run(
        &self,
        work: &mut Work<'_>,
        networks: Option<Program>,
    ) -> Result<SearchResult, PrepareError> {
        let mut found = self.by_keypoints(work, networks)?;
        self.usual_lens(work, &mut found.best)?;
        Ok(found)
    }

    /// Takes a usual lens in place of a rare one that the path does not determine, if it fits as well.
    fn usual_lens(&self, work: &mut Work<'_>, best: &mut Attempt) -> Result<(), PrepareError> {
        let PrepareParams { calibration, mapper, .. } = self.sfm.params;
        let focal =
            |models: &[Model]| models.first().filter(|_| calibration.is_empty()).and_then(least_certain);
        best.focal = focal(&best.models);
        let doubtful = best.focal.filter(Focal::is_doubtful).filter(|_| *mapper == Mapper::Incremental);
        let Some(Focal { length: first, .. }) = doubtful else { return Ok(()) };
        (self.sfm.watch.note)(
            "cameras: the camera hardly turned, so its lens cannot be measured well; a usual lens is tried",
        );
        let step = Step { name: "usual lens", output: USUAL_MODELS, choices: json!(best.database) };
        let commands = work.step(step, |_| self.sfm.map(best.database, USUAL_MODELS, true))?;
        let usual = models(&work.folder.join(USUAL_MODELS))?;
        if usual.first().is_some_and(|usual| fits_as_well(usual, &best.models[0])) {
            (best.models, best.folder, best.unusual) = (usual, USUAL_MODELS, Some(first));
            (best.focal, best.commands[1]) = (focal(&best.models), commands);
        }
        Ok(())
    }

    /// Finds the cameras with the keypoints that were chosen, or with the better ones.
    fn by_keypoints(
        &self,
        work: &mut Work<'_>,
        networks: Option<Program>,
    ) -> Result<SearchResult, PrepareError> {
        let (keypoints, images) = (self.sfm.params.keypoints, self.names.len());
        let found = |best: Attempt, networks, remark, advice| {
            let record = json!({ "used": best.kind, "placed": { best.kind: best.placed() } });
            SearchResult { best, record, networks, remark, advice }
        };
        if let Some(networks) = networks {
            let best = self.learned(work, &networks)?;
            return Ok(found(best, Some(networks), None, None));
        }
        let sift = self.sift(work)?;
        let placed = sift.placed();
        if keypoints == Keypoints::Sift || placed as f64 >= ENOUGH * images as f64 {
            return Ok(found(sift, None, None, Some(advice(true))));
        }
        let Ok(networks) = self.programs.learned() else {
            return Ok(found(sift, None, None, Some(advice(false))));
        };
        let few = format!("SIFT, the usual method, found the places of {placed} of {images} images");
        (self.sfm.watch.note)(&format!(
            "learned keypoints: {few}, so neural networks on this computer look for more; without a graphics card \
             this takes minutes to hours"
        ));
        let learned = match self.learned(work, &networks) {
            Ok(learned) => learned,
            Err(error @ (PrepareError::Step { .. } | PrepareError::Choice { .. })) => {
                let remark = format!("{few}. Learned keypoints were tried as well, and this failed: {error}");
                return Ok(found(sift, None, Some(remark), None));
            }
            Err(error) => return Err(error),
        };
        let more = learned.placed();
        let (best, used) =
            if more > placed { (learned, "these places are") } else { (sift, "those of SIFT are") };
        let remark =
            format!("{few}, and learned keypoints (ALIKED, LightGlue) those of {more}: {used} used.");
        let record = json!({ "used": best.kind, "placed": { "sift": placed, "learned": more } });
        Ok(SearchResult { best, record, networks: Some(networks), remark: Some(remark), advice: None })
    }

    /// Finds the cameras with the keypoints of SIFT.
    fn sift(&self, work: &mut Work<'_>) -> Result<Attempt, PrepareError> {
        let Self { sfm, matching, names, .. } = *self;
        let apart = if matching == Matching::Sequential { loops(names.len()) } else { Vec::new() };
        let choices = json!([matching, sfm.params.repeatable, apart]);
        let matches = work.step(Step { name: "matches", output: MATCHES_DB, choices }, |work| {
            photographs::copy_file(&work.folder.join(FEATURES_DB), &work.folder.join(MATCHES_DB))?;
            let apart: Vec<[&str; 2]> = apart.iter().map(|(a, b)| [&*names[*a], &*names[*b]]).collect();
            let commands = sfm.matches(matching, &apart)?;
            (sfm.watch.note)("matches: the images are compared");
            Ok(commands)
        })?;
        self.placed(work, "cameras", "sift", (MATCHES_DB, MODELS), (matches, sfm.feature_count()))
    }

    /// Finds the cameras with learned keypoints.
    fn learned(&self, work: &mut Work<'_>, networks: &Program) -> Result<Attempt, PrepareError> {
        let Self { sfm, matching, names, .. } = *self;
        let choices = json!([networks, matching, sfm.params.features, sfm.params.repeatable]);
        let matches = work.step(Step { name: "learned keypoints", output: LEARNED_DB, choices }, |work| {
            photographs::copy_file(&work.folder.join(FEATURES_DB), &work.folder.join(LEARNED_DB))?;
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            let commands = sfm.learned(networks, &names, matching)?;
            (sfm.watch.note)("learned keypoints: found and matched");
            Ok(commands)
        })?;
        let made = (matches, sfm.learned_count(networks));
        self.placed(work, "learned cameras", "learned", (LEARNED_DB, LEARNED_MODELS), made)
    }

    /// Finds the cameras from matches in a database. `matches` are the commands that made these, and
    /// `features` is the most features of an image.
    fn placed(
        &self,
        work: &mut Work<'_>,
        step: &'static str,
        kind: &'static str,
        (database, folder): (&'static str, &'static str),
        (matches, features): (Commands, usize),
    ) -> Result<Attempt, PrepareError> {
        let step = Step { name: step, output: folder, choices: json!(self.sfm.params.mapper) };
        let cameras = work.step(step, |_| self.sfm.map(database, folder, false))?;
        let models = models(&work.folder.join(folder))?;
        let commands = [matches, cameras];
        Ok(Attempt { kind, models, database, focal: None, unusual: None, folder, commands, features })
    }
}
