//! Finds the cameras of images in three steps: features, matches, mapping.
//!
//! Each step is one or more commands of the program `colmap`, or a call of the Python package `pycolmap`
//! through a script that is part of this program. `colmap` renamed options between its versions, so its own
//! help decides which ones are given. Random seeds are fixed. With several threads the order of some sums and
//! of random numbers still varies, so the last digits of a model do too.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::{Value, json};

use crate::eight_bit::{self, readable};
use crate::error::PrepareError;
use crate::params::{Mapper, Matching, PrepareParams};
use crate::photographs;
use crate::process::{self, ProgramEnd, StepWatch, counts, spelled};
use crate::tools::{self, Program};
use crate::verdict::{models, some};
use crate::work;

/// The script for `pycolmap`.
pub(crate) const SCRIPT: &str = include_str!("sfm.py");
/// The file with the script's input, in the folder of the work. As an argument it could be too long.
pub(crate) const JOB: &str = "job.json";
/// The options of the mapper that keep a known lens.
const FIXED: [&[&str]; 2] = [&["--Mapper.ba_refine_focal_length"], &["--Mapper.ba_refine_extra_params"]];
/// The options of the mapper that keep the focal length with which it begins.
const HELD: [&[&str]; 2] = [FIXED[0], &["--Mapper.abs_pose_refine_focal_length"]];
/// Features of an image on the processor and on a graphics card: comparing them takes the square of their
/// number.
const FEATURES: (usize, usize) = (3000, 8192);
/// The longer side at which features are searched, pixels.
const SIDE: usize = 2000;
/// Neighbours of an image in a sequence that it is compared with, besides those at distances of powers of
/// two.
pub(crate) const OVERLAP: usize = 10;
/// The focal length that is tried first, as a share of the longer side, if a photograph does not say it.
/// Behind a flat port a wide lens sees less than in air; COLMAP's own 1.2 is for telephoto lenses.
const FOCAL: f64 = 0.85;
/// The smallest angle between the rays of the first pair, degrees. COLMAP's own 16 refuses every good first
/// pair of a swim straight ahead.
const FIRST_ANGLE: f64 = 4.0;
/// About how many blocks the images are compared in.
const BLOCKS: usize = 6;
/// Images of the smallest model that is kept.
const SMALLEST: usize = 10;

/// Names inside the folder of the work.
pub(crate) const IMAGES: &str = "capture/images";
/// Masks of what lies over the images: each has the name of its image, and `.png` after it.
pub(crate) const MASKED: &str = "capture/masks";
pub(crate) const FEATURES_DB: &str = "features.db";
pub(crate) const MATCHES_DB: &str = "matches.db";
pub(crate) const MODELS: &str = "models";
/// The models with a usual lens, where the path does not determine the lens.
pub(crate) const USUAL_MODELS: &str = "models-usual-lens";

/// The work of finding cameras.
pub(crate) struct Sfm<'a> {
    pub(crate) program: &'a Program,
    pub(crate) params: &'a PrepareParams,
    pub(crate) work: &'a Path,
    pub(crate) log: &'a Path,
    pub(crate) threads: usize,
    pub(crate) watch: &'a StepWatch<'a>,
    /// The number of images.
    pub(crate) images: usize,
}

/// The commands of a step, as they are recorded.
pub(crate) type Commands = Vec<Vec<String>>;

impl Sfm<'_> {
    fn command(&self) -> Command {
        let mut command = tools::command(&self.program.path);
        command.current_dir(self.work);
        command
    }

    pub(crate) fn is_package(&self) -> bool {
        self.program.name == "pycolmap"
    }

    /// The threads of a step whose result depends on their number: also features, which are stored in the
    /// order in which they are found.
    pub(crate) fn deciding_threads(&self) -> usize {
        if self.params.repeatable { 1 } else { self.threads }
    }

    /// The most features of an image.
    pub(crate) fn feature_count(&self) -> usize {
        self.params.features.unwrap_or(if self.program.card { FEATURES.1 } else { FEATURES.0 })
    }

    /// True if the search for features leaves out what masks hide.
    pub(crate) fn has_masks(&self) -> bool {
        self.work.join(MASKED).is_dir()
    }

    /// The images of a block when all are compared with each other. Progress is told after each pair of
    /// blocks.
    fn block(&self) -> usize {
        (self.images / BLOCKS).clamp(2, 50)
    }

    fn smallest(&self) -> usize {
        SMALLEST.min(self.images / 3).max(3)
    }

    /// Runs the script for `pycolmap`.
    pub(crate) fn script(
        &self,
        step: &str,
        job: &Value,
        heard: impl FnMut(&str),
    ) -> Result<(ProgramEnd, Commands), PrepareError> {
        self.python(&self.program.path, (SCRIPT, step), job, heard)
    }

    /// Runs a step of a script with Python.
    pub(crate) fn python(
        &self,
        python: &Path,
        (script, step): (&str, &str),
        job: &Value,
        heard: impl FnMut(&str),
    ) -> Result<(ProgramEnd, Commands), PrepareError> {
        let path = self.work.join(JOB);
        work::write(&path, job.to_string())?;
        let mut command = tools::command(python);
        command.current_dir(self.work).args(["-c", script, step, JOB]);
        let outcome = process::run(&mut command, self.log, self.watch.stop, heard)?;
        let said = ["python3", "-c", "SCRIPT", step].map(String::from).to_vec();
        Ok((outcome, vec![[said, vec![job.to_string()]].concat()]))
    }

    /// The help of a verb of `colmap`.
    fn help(&self, verb: &str) -> Result<String, PrepareError> {
        let help = self.command().args([verb, "-h"]).stdin(Stdio::null()).output();
        let help = help.map_err(PrepareError::run(&self.program.path))?;
        Ok(String::from_utf8_lossy(&[help.stdout, help.stderr].concat()).into_owned())
    }

    /// Refuses a known lens if the mapper has no option that keeps it.
    ///
    /// # Errors
    /// The error names the flag and the program.
    pub(crate) fn check_calibration(&self) -> Result<(), PrepareError> {
        if self.params.calibration.is_empty() {
            return Ok(());
        }
        let lacking = if self.is_package() {
            let (outcome, _) = self.script("check", &json!({}), |_| {})?;
            (!outcome.status.success()).then(|| process::reason(&outcome))
        } else {
            let help = self.help("mapper")?;
            let lacking = FIXED.iter().find(|names| !names.iter().any(|name| lists(&help, name)));
            lacking.map(|names| format!("its mapper has no option {}", names.join(" or ")))
        };
        let Some(lacking) = lacking else { return Ok(()) };
        let Program { name, version, .. } = self.program;
        let reason = format!(
            "{name} {version} cannot keep a known lens: {lacking}; leave the flag out, or update {name}"
        );
        Err(PrepareError::Choice { flag: "--calibration", reason })
    }

    /// Runs a verb of `colmap`. An option counts with the first of its names that the program's help lists.
    pub(crate) fn verb(
        &self,
        verb: &str,
        arguments: &[(&str, String)],
        options: &[(&[&str], String)],
        heard: impl FnMut(&str),
    ) -> Result<(ProgramEnd, Vec<String>), PrepareError> {
        let help = self.help(verb)?;
        let mut command = self.command();
        command.arg(verb);
        for (name, value) in arguments {
            command.args([*name, value]);
        }
        for (names, value) in options {
            if let Some(name) = names.iter().find(|name| lists(&help, name)) {
                command.args([*name, value]);
            }
        }
        let outcome = process::run(&mut command, self.log, self.watch.stop, heard)?;
        let mut said = spelled(&command);
        said[0] = "colmap".into();
        Ok((outcome, said))
    }

    /// Returns the error of a step if its command failed.
    pub(crate) fn succeeded(&self, step: &'static str, outcome: &ProgramEnd) -> Result<(), PrepareError> {
        if outcome.status.success() {
            return Ok(());
        }
        Err(PrepareError::Step { step, reason: process::reason(outcome), log: self.log.to_path_buf() })
    }

    /// Finds the features of all images. Each group of images has one camera. The second result says in how
    /// many images there are some.
    pub(crate) fn features(&self, groups: &[Vec<String>]) -> Result<(Commands, String), PrepareError> {
        const STEP: &str = "features";
        eight_bit::make(self.work, groups.iter().flatten())?;
        let (card, count) = (self.program.card, self.feature_count());
        let total = self.images as u64;
        let (mut before, mut featured) = (0, Featured::default());
        let mut tell = |before: u64, line: &str| {
            featured.hear(line);
            if let Some((done, _)) = counts(line).filter(|_| line.contains("Processed file")) {
                self.watch.tell(STEP, (before + done, total), "images");
            }
        };
        if self.is_package() {
            let job = json!({
                "database": FEATURES_DB, "images": readable(self.work), "groups": groups, "lens": self.params.lens,
                "calibration": self.params.calibration, "features": count, "side": SIDE,
                "focal": FOCAL, "masks": if self.has_masks() { MASKED } else { "" },
                "threads": self.deciding_threads(), "card": card,
            });
            let (outcome, commands) = self.script(STEP, &job, |line| tell(0, line))?;
            return self.succeeded(STEP, &outcome).map(|()| (commands, featured.words(self.images)));
        }
        let mut commands = Vec::new();
        for (i, group) in groups.iter().enumerate() {
            let list = format!("group-{i}.txt");
            let path = self.work.join(&list);
            work::write(&path, group.join("\n") + "\n")?;
            let mut arguments = vec![
                ("--database_path", FEATURES_DB.to_string()),
                ("--image_path", readable(self.work).to_string()),
                ("--image_list_path", list),
                ("--ImageReader.camera_model", self.params.lens.clone()),
                ("--ImageReader.single_camera", "1".to_string()),
            ];
            if self.has_masks() {
                arguments.push(("--ImageReader.mask_path", MASKED.to_string()));
            }
            if !self.params.calibration.is_empty() {
                let numbers: Vec<String> = self.params.calibration.iter().map(f64::to_string).collect();
                arguments.push(("--ImageReader.camera_params", numbers.join(",")));
            }
            let threads = self.deciding_threads().to_string();
            let options: [(&[&str], String); 6] = [
                (&["--ImageReader.default_focal_length_factor"], FOCAL.to_string()),
                (&["--FeatureExtraction.use_gpu", "--SiftExtraction.use_gpu"], u8::from(card).to_string()),
                (&["--FeatureExtraction.num_threads", "--SiftExtraction.num_threads"], threads),
                (
                    &["--FeatureExtraction.max_image_size", "--SiftExtraction.max_image_size"],
                    SIDE.to_string(),
                ),
                (&["--SiftExtraction.max_num_features"], count.to_string()),
                (&["--random_seed", "--default_random_seed"], "0".to_string()),
            ];
            let (outcome, said) =
                self.verb("feature_extractor", &arguments, &options, |line| tell(before, line))?;
            self.succeeded(STEP, &outcome)?;
            before += group.len() as u64;
            commands.push(said);
        }
        Ok((commands, featured.words(self.images)))
    }

    /// Compares images. The database of features has been copied to that of matches. `loops` are pairs of
    /// names besides those of a sequence.
    pub(crate) fn matches(&self, matching: Matching, loops: &[[&str; 2]]) -> Result<Commands, PrepareError> {
        const STEP: &str = "matches";
        let card = self.program.card;
        let exhaustive = matching == Matching::Exhaustive;
        let tell = |line: &str| {
            if let Some((done, total)) = counts(line).filter(|_| !line.contains("Processed file")) {
                self.watch.tell(STEP, (done, total), if exhaustive { "blocks" } else { "images" });
            }
        };
        let (outcome, commands) = if self.is_package() {
            let job = json!({
                "database": MATCHES_DB, "matching": matching, "overlap": OVERLAP, "block": self.block(),
                "threads": self.deciding_threads(), "card": card,
            });
            self.script(STEP, &job, tell)?
        } else {
            let verb = if exhaustive { "exhaustive_matcher" } else { "sequential_matcher" };
            let threads = self.deciding_threads().to_string();
            let options: [(&[&str], String); 6] = [
                (&["--FeatureMatching.use_gpu", "--SiftMatching.use_gpu"], u8::from(card).to_string()),
                (&["--FeatureMatching.num_threads", "--SiftMatching.num_threads"], threads),
                (&["--ExhaustiveMatching.block_size"], self.block().to_string()),
                (&["--SequentialMatching.overlap"], OVERLAP.to_string()),
                (&["--SequentialMatching.quadratic_overlap"], "1".to_string()),
                (&["--random_seed", "--default_random_seed"], "0".to_string()),
            ];
            let (outcome, said) =
                self.verb(verb, &[("--database_path", MATCHES_DB.to_string())], &options, tell)?;
            (outcome, vec![said])
        };
        self.succeeded(STEP, &outcome)?;
        let more =
            if loops.is_empty() { Vec::new() } else { self.pairs(MATCHES_DB, ("pairs", STEP), loops)? };
        Ok([commands, more].concat())
    }

    /// Compares listed pairs of images in a database. Pairs that have matches are only verified. `script` is
    /// the step of the script for `pycolmap`.
    pub(crate) fn pairs(
        &self,
        database: &str,
        (script, step): (&str, &'static str),
        pairs: &[[&str; 2]],
    ) -> Result<Commands, PrepareError> {
        const LIST: &str = "pairs.txt";
        let path = self.work.join(LIST);
        // COLMAP separates the two names by a space.
        let spaced = |pair: &&[&str; 2]| !pair.iter().any(|name| name.contains(char::is_whitespace));
        let lines: Vec<String> = pairs.iter().filter(spaced).map(|pair| pair.join(" ") + "\n").collect();
        work::write(&path, lines.concat())?;
        let (card, threads) = (self.program.card, self.deciding_threads());
        let tell = |line: &str| {
            if let Some(count) = counts(line).filter(|_| !line.contains("Processed file")) {
                self.watch.tell(step, count, "blocks");
            }
        };
        let (outcome, commands) = if self.is_package() {
            let job = json!({ "database": database, "list": LIST, "threads": threads, "card": card });
            self.script(script, &job, tell)?
        } else {
            let arguments =
                [("--database_path", database), ("--match_list_path", LIST), ("--match_type", "pairs")];
            let options: [(&[&str], String); 3] = [
                (&["--FeatureMatching.use_gpu", "--SiftMatching.use_gpu"], u8::from(card).to_string()),
                (&["--FeatureMatching.num_threads", "--SiftMatching.num_threads"], threads.to_string()),
                (&["--random_seed", "--default_random_seed"], "0".to_string()),
            ];
            let arguments = arguments.map(|(name, value)| (name, value.to_string()));
            let (outcome, said) = self.verb("matches_importer", &arguments, &options, tell)?;
            (outcome, vec![said])
        };
        self.succeeded(step, &outcome).map(|()| commands)
    }

    /// Finds cameras and points from the matches in a database. The models lie in folders of their own in
    /// `folder`. With `usual_lens` the focal length stays that of EXIF data, or the usual one.
    pub(crate) fn map(
        &self,
        database: &str,
        folder: &str,
        usual_lens: bool,
    ) -> Result<Commands, PrepareError> {
        const STEP: &str = "cameras";
        let place = self.work.join(folder);
        std::fs::create_dir_all(&place).map_err(PrepareError::write(&place))?;
        // COLMAP also writes into a database that it reads, so it gets a copy of the finished one.
        let copy = format!("read-{database}");
        photographs::copy_file(&self.work.join(database), &self.work.join(&copy))?;
        let total = self.images as u64;
        let tell = |line: &str| {
            if let Some(done) = registered(line) {
                self.watch.tell(STEP, (done.min(total), total), "images with a place");
            }
        };
        let fixed = !self.params.calibration.is_empty();
        let global = self.params.mapper == Mapper::Global;
        let threads = self.deciding_threads();
        let (outcome, commands) = if self.is_package() {
            let job = json!({
                "database": copy, "images": readable(self.work), "models": folder, "mapper": self.params.mapper,
                "threads": threads, "smallest": self.smallest(), "fixed": fixed, "held": usual_lens,
                "first_angle": FIRST_ANGLE,
            });
            self.script("map", &job, tell)?
        } else {
            let verb = if global { "global_mapper" } else { "mapper" };
            let arguments = [
                ("--database_path", copy.clone()),
                ("--image_path", readable(self.work).to_string()),
                ("--output_path", folder.to_string()),
            ];
            let mut options: Vec<(&[&str], String)> = vec![
                (&["--Mapper.num_threads", "--GlobalMapper.num_threads"], threads.to_string()),
                (&["--Mapper.init_min_tri_angle"], FIRST_ANGLE.to_string()),
                (&["--Mapper.min_model_size"], self.smallest().to_string()),
                (&["--random_seed", "--default_random_seed"], "0".to_string()),
                (&["--Mapper.random_seed", "--GlobalMapper.random_seed"], "0".to_string()),
            ];
            if usual_lens {
                options.extend(HELD.map(|names| (names, "0".to_string())));
            }
            if fixed {
                options.extend(FIXED.map(|names| (names, "0".to_string())));
            }
            let (outcome, said) = self.verb(verb, &arguments, &options, tell)?;
            (outcome, vec![said])
        };
        let none = std::fs::read_dir(&place).is_ok_and(|mut entries| entries.next().is_none());
        // `colmap` also fails when it found no cameras; the caller has a better message for that.
        let unknown =
            outcome.last.iter().any(|l| l.contains("not recognized") || l.contains("no global mapper"));
        if unknown && global {
            let reason = format!(
                "{} {} has no global mapper; leave the flag out",
                self.program.name, self.program.version
            );
            return Err(PrepareError::Choice { flag: "--mapper global", reason });
        }
        if !(none && outcome.status.code() == Some(1) && self.program.name == "colmap") {
            self.succeeded(STEP, &outcome)?;
        }
        work::remove_database(self.work, &copy)?;
        models(&place).map_err(|error| {
            let reason =
                format!("the model that it wrote cannot be read ({error}); run the same command again");
            PrepareError::Step { step: STEP, reason, log: self.log.to_path_buf() }
        })?;
        Ok(commands)
    }
}

/// The images with and without features, from the program's lines.
#[derive(Default)]
struct Featured {
    /// The image that the lines are about, until its features are counted.
    image: Option<String>,
    with: usize,
    without: Vec<String>,
}

impl Featured {
    fn hear(&mut self, line: &str) {
        if line.contains("Processed file") {
            // An image that cannot be read has an error in the place of its count.
            self.without.extend(self.image.take());
        } else if let Some((_, name)) = line.split_once("Name:") {
            self.image = Some(name.trim().into());
        } else if let Some((_, count)) = line.split_once("Features:")
            && count.split_whitespace().next().and_then(|n| n.parse().ok()).is_some_and(|n: u64| n > 0)
            && self.image.take().is_some()
        {
            self.with += 1;
        }
    }

    /// The result in words. Without a line for every image nothing is known about single ones.
    fn words(mut self, images: usize) -> String {
        self.without.extend(self.image.take());
        if self.without.is_empty() || self.with + self.without.len() != images {
            return format!("features: found in {images} image{}", if images == 1 { "" } else { "s" });
        }
        format!("features: found in {} of {images} images, and none in {}", self.with, some(&self.without))
    }
}

/// True if a help lists an option.
fn lists(help: &str, option: &str) -> bool {
    help.split_whitespace().any(|word| word == option)
}

/// The number of images with a place, in a line of the mapper.
fn registered(line: &str) -> Option<u64> {
    let rest = line.split_once("Registering image #")?.1;
    let inside = rest.split_once('(')?.1.split_once(')')?.0;
    inside.rsplit('=').next()?.parse().ok()
}

/// Groups of images by their cameras, in the order of first appearance. COLMAP gives each a camera.
pub(crate) fn groups(images: &[(String, String)]) -> Vec<Vec<String>> {
    let mut order: BTreeMap<&str, usize> = BTreeMap::new();
    let mut groups: Vec<Vec<String>> = Vec::new();
    for (name, camera) in images {
        let at = *order.entry(camera).or_insert(groups.len());
        if at == groups.len() {
            groups.push(Vec::new());
        }
        groups[at].push(name.clone());
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_the_mapper_count_images() {
        assert_eq!(registered("Registering image #27 (6)"), Some(6));
        assert_eq!(registered("I2 x.cc:620] Registering image #36 (num_reg_frames=34)"), Some(34));
        assert_eq!(registered("  => Image sees 20 / 30 points"), None);
    }

    #[test]
    fn images_without_features_are_counted_and_named() {
        let lines = "Processed file [1/3]\n  Name:            a.png\n  Features:        1645\n\
                     I2 x.cc:9] Processed file [2/3]\nI2 x.cc:9]   Name:            left/b c.png\n\
                     I2 x.cc:9]   Features:        0\n\
                     Processed file [3/3]\n  Name:            d.png\n  \
                     ERROR: Failed to read image file format.";
        let heard = |lines: &str, images: usize| {
            let mut featured = Featured::default();
            lines.lines().for_each(|line| featured.hear(line));
            featured.words(images)
        };
        assert_eq!(heard(lines, 3), "features: found in 1 of 3 images, and none in left/b c.png, d.png");
        let first: Vec<&str> = lines.lines().take(3).collect();
        assert_eq!(heard(&first.join("\n"), 1), "features: found in 1 image");
        // A program that says nothing of single images.
        assert_eq!(heard("done", 3), "features: found in 3 images");
    }

    #[test]
    fn images_are_grouped_by_camera() {
        let image = |name: &str, camera: &str| (name.to_string(), camera.to_string());
        let found = groups(&[image("a", "x"), image("b", "y"), image("c", "x")]);
        assert_eq!(found, [vec!["a", "c"], vec!["b"]]);
    }
}
