//! The paired images in operator space: the extractor's operators for each pair and for the proposal for its
//! input image.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::calibrator::{Dataset, PairImages};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::progress::LoopPosition;
use use3d_capture::Image;
use use3d_io_image::{images_by_stem, read_image};
use use3d_workflow::{StageContext, StageError};

use crate::parts::files::{DATASET, go_on, write_json};
use crate::parts::proposer::{ProposerChoice, open};

/// Parameters of the paired data.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct PairsParams {
    /// The 2D enhancer.
    pub(crate) proposer: ProposerChoice,
    /// The settings of the extractor; scenes use the same ones.
    pub(crate) extractor: ExtractorSettings,
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{AllParameters, Lacking, Named, Scope, Stage};

    use crate::parts::files::out_of_range;
    use crate::parts::weights::files_of_proposer;
    use crate::planning::learns_a_calibrator;
    use crate::planning::requirements::{lacking, unfound, weights};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("pairs", Scope::Shared, run)
            .about("read the pairs of pictures, and apply the usual filter to them")
            .promises(&[DATASET])
            .check(|p: &PairsParams| {
                p.extractor.validate().map_err(|wrong| out_of_range(wrong.within("extractor")))
            })
            .external("input", "pairs.input")
            .external("target", "pairs.target")
            .optional_external("models", "models")
            .select(|p: &PairsParams, models| files_of_proposer(p.proposer, models))
            .when_named(learns_a_calibrator)
            .requires(|all, named, _| missing(all, named))
            .usually_costs(1.5, 0.0)
    }

    /// Fewest pairs that show how transitions vary.
    const FEWEST_PAIRS: usize = 2;
    /// The places where pairs are published.
    const PAIRS: &str = "UIEB, LSUI or EUVP, docs/reference/datasets.md says where they are published";

    fn missing(all: &AllParameters, named: &Named) -> Vec<Lacking> {
        let Some(own) = all.of::<PairsParams>() else { return Vec::new() };
        weights(all, named, ("pairs", own.proposer)).into_iter().chain(missing_pairs(named)).collect()
    }

    fn missing_pairs(named: &Named) -> Vec<Lacking> {
        let what = "the pairs of pictures (before and after a correction) that colours are learnt from";
        if !named.has("pairs.input") {
            let remedy =
                format!("name two folders with --pairs INPUT TARGET or `calibrator.pairs` ({PAIRS})");
            return vec![lacking(what, remedy, "--set targets.calibrated=false")];
        }
        let unfound: Vec<String> =
            ["pairs.input", "pairs.target"].iter().filter_map(|name| unfound(named, name)).collect();
        if !unfound.is_empty() {
            return vec![lacking(what, format!("{} ({PAIRS})", unfound.join("; ")), "")];
        }
        let (Some(input), Some(target)) = (named.path("pairs.input"), named.path("pairs.target")) else {
            return Vec::new();
        };
        match stems(input).and_then(|inputs| Ok(inputs.intersection(&stems(target)?).count())) {
            Ok(found) if found >= FEWEST_PAIRS => Vec::new(),
            Ok(found) => {
                let remedy = format!(
                    "{} files of {} have a counterpart of the same stem in {}, and at least {FEWEST_PAIRS} are needed; pairs are matched by file stem",
                    found,
                    input.display(),
                    target.display()
                );
                vec![lacking("pairs with equal names", remedy, "")]
            }
            Err(error) => vec![lacking("the pairs of images", error.to_string(), "")],
        }
    }
}

fn run(context: &StageContext, params: &PairsParams) -> Result<(), StageError> {
    let models = context.optional_input("models");
    let proposer =
        open(params.proposer, models, &mut |line| context.say(line)).map_err(StageError::bad_input)?;
    let (input, target) = (unpacked(context, "input")?, unpacked(context, "target")?);
    let pairs = list(&input, &target)?;
    if pairs.is_empty() {
        return Err(StageError::bad_input_message(format!(
            "no file in {} has a counterpart of the same stem in {}; pairs are matched by file stem",
            input.display(),
            target.display()
        )));
    }
    let total = pairs.len();
    let mut duller = 0;
    let images = pairs.into_iter().map(|(name, a, b)| {
        let images = read_image(&a).and_then(|a| Ok((a, read_image(&b)?))).map_err(Box::from);
        duller += usize::from(images.as_ref().is_ok_and(|(input, target)| is_duller(target, input)));
        PairImages { images, name }
    });
    let dataset = Dataset::build(images, proposer.as_ref(), &params.extractor, &mut |progress| {
        if let LoopPosition::Pair { index, name } = progress {
            context.progress_with(index as u64, total as u64, "pairs", name);
        }
        go_on(context)
    });
    context.alive()?;
    let dataset = dataset?;
    if 2 * duller > total {
        context.say(format_args!(
            "warning: in {duller} of {total} pairs the target has less contrast and a stronger tint than the \
             input; if the two folders are swapped, give them as --pairs INPUT TARGET, where TARGET is the \
             enhanced one"
        ));
    }
    for skipped in &dataset.skipped {
        context.say(format_args!("pair {} is left out: {}", skipped.name, skipped.reason));
    }
    for folder in [input, target].iter().filter(|folder| folder.starts_with(context.output())) {
        std::fs::remove_dir_all(folder).map_err(StageError::failed)?;
    }
    write_json(&context.output().join(DATASET), &dataset)
}

/// The folder of an input: the images of an archive are unpacked into the folder of the result.
fn unpacked(context: &StageContext, role: &str) -> Result<PathBuf, StageError> {
    let path = context.input(role)?;
    if path.is_dir() || !use3d_archive::is_archive(path) {
        return Ok(path.to_path_buf());
    }
    let folder = context.output().join(role);
    let target =
        |name: &str| is_image(name).then(|| Path::new(name).file_name().map(PathBuf::from)).flatten();
    let unpacked = use3d_archive::unpack(path, &folder, &target, &mut |_| match context.cancelled() {
        true => Err(std::io::Error::from(std::io::ErrorKind::Interrupted)),
        false => Ok(()),
    });
    context.alive()?;
    let failed = |e| StageError::bad_input_message(format!("{}: {e}; download it again", path.display()));
    unpacked.map(|_| folder).map_err(failed)
}

/// The endings of images.
const IMAGES: [&str; 5] = ["png", "jpg", "jpeg", "tif", "tiff"];

/// True if a file of an archive is an image, and no hidden one.
fn is_image(name: &str) -> bool {
    let path = Path::new(name);
    let hidden = name.starts_with("__MACOSX")
        || path.file_name().is_none_or(|n| n.as_encoded_bytes().starts_with(b"."));
    !hidden && path.extension().is_some_and(|end| IMAGES.iter().any(|known| end.eq_ignore_ascii_case(known)))
}

/// The stems of the images in a folder or an archive.
fn stems(path: &Path) -> Result<BTreeSet<String>, StageError> {
    if path.is_dir() || !use3d_archive::is_archive(path) {
        let images = images_by_stem(path, &IMAGES).map_err(StageError::bad_input)?;
        return Ok(images.into_keys().collect());
    }
    let failed = |e| StageError::bad_input_message(format!("{}: {e}; download it again", path.display()));
    let names = use3d_archive::names(path).map_err(failed)?;
    let stem = |name: &String| Some(Path::new(name).file_stem()?.to_string_lossy().into_owned());
    Ok(names.iter().filter(|name| is_image(name)).filter_map(stem).collect())
}

/// True if `image` has less contrast and a stronger tint than `other`, as a photograph under water has
/// beside its enhanced version. Contrast is the standard deviation of the mean of the channels. Tint is the
/// largest difference between the means of two channels.
fn is_duller(image: &Image, other: &Image) -> bool {
    let measure = |image: &Image| {
        let n = image.width() * image.height();
        if n == 0 {
            return (0.0, 0.0);
        }
        let mean = |values: &[f32]| values.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64;
        let planes: Vec<&[f32]> = image.data().chunks_exact(n).collect();
        let means = [0, 1, 2].map(|c| mean(planes[c]));
        let grey = means.iter().sum::<f64>() / 3.0;
        let square = |p: usize| {
            let value = planes.iter().map(|plane| f64::from(plane[p])).sum::<f64>() / 3.0 - grey;
            value * value
        };
        let variance = (0..n).map(square).sum::<f64>() / n as f64;
        let tint =
            means.iter().copied().fold(f64::MIN, f64::max) - means.iter().copied().fold(f64::MAX, f64::min);
        (variance.sqrt(), tint)
    };
    let [(contrast, tint), (other_contrast, other_tint)] = [image, other].map(measure);
    contrast < other_contrast && tint > other_tint
}

/// Pairs of image files with equal stems, in name order.
pub(crate) fn list(input: &Path, target: &Path) -> Result<Vec<(String, PathBuf, PathBuf)>, StageError> {
    let images = |dir: &Path| images_by_stem(dir, &IMAGES).map_err(StageError::bad_input);
    let mut targets = images(target)?;
    let pair = |(stem, a): (String, PathBuf)| targets.remove(&stem).map(|b| (stem, a, b));
    Ok(images(input)?.into_iter().filter_map(pair).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_photograph_under_water_is_duller_than_its_enhanced_version() {
        let stripes = |dark: [f32; 3], bright: [f32; 3]| {
            let mut image = Image::new(8, 4);
            for p in 0..32 {
                image.set_pixel(p % 8, p / 8, if p % 2 == 0 { dark } else { bright });
            }
            image
        };
        let under_water = stripes([0.1, 0.4, 0.5], [0.2, 0.5, 0.6]);
        let enhanced = stripes([0.2, 0.2, 0.2], [0.8, 0.8, 0.8]);
        assert!(is_duller(&under_water, &enhanced) && !is_duller(&enhanced, &under_water));
        assert!(!is_duller(&enhanced, &enhanced));
    }
}
