//! Prepares a capture step by step, and keeps finished steps for the next attempt.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use use3d_capture::shown;
use use3d_io_colmap::{Model, write_model_binary};

use crate::attempts::{Search, SearchResult};
use crate::cause::why_no_cameras;
use crate::error::PrepareError;
use crate::film::{self, Choice};
use crate::left_out::{self, LookedFilm};
use crate::overlay;
use crate::params::{BALANCE_RULES, FEWEST, Keypoints, PrepareParams};
use crate::photographs;
use crate::process::StepWatch;
use crate::sfm::{FEATURES_DB, IMAGES, Sfm, groups};
use crate::sources::{PREPARED, Sources};
use crate::tools::{Finder, Program, Programs};
use crate::verdict::{CameraVerdict, Grade, ModelContext, judge, remedies};
use crate::work::{self, Step, Work, digest, hash};

/// The finished capture, in the folder of the work.
pub const CAPTURE: &str = "capture";
/// Changes when images are chosen or written in another way.
const RULES: u32 = 2;

/// An input file of a preparation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Input {
    /// Its name.
    pub name: String,
    /// Its size.
    pub bytes: u64,
    /// The time of its last change, nanoseconds since 1970.
    pub modified: u64,
    /// The BLAKE3 digest of its bytes.
    pub digest: String,
}

/// A finished preparation.
#[derive(Debug)]
pub struct Prepared {
    /// The judgement.
    pub verdict: CameraVerdict,
    /// Further remarks.
    pub remarks: Vec<String>,
}

/// The parts of the record that a later preparation reads.
#[derive(Deserialize)]
struct PreparedRecord {
    key: String,
    inputs: Vec<Input>,
}

fn record(capture: &Path) -> Option<PreparedRecord> {
    let bytes = std::fs::read(capture.join(PREPARED)).ok()?;
    serde_json::from_slice(&bytes).ok()
}

/// The rules by which images are written. Those of linear photographs include the balance.
fn rules(sources: &Sources) -> Value {
    if sources.linear { json!([RULES, "balanced", BALANCE_RULES]) } else { json!(RULES) }
}

/// The digest of a preparation's inputs and choices, with the inputs, and true if the capture at `earlier`
/// was made from the same. An input whose size and time have not changed since is not read again.
///
/// # Errors
/// Returns the first input that cannot be read.
pub fn key_of(
    sources: &Sources,
    params: &PrepareParams,
    finder: Finder,
    earlier: &Path,
    watch: &StepWatch<'_>,
) -> Result<(String, Vec<Input>, bool), PrepareError> {
    let earlier = record(earlier);
    let known = earlier.iter().flat_map(|r| &r.inputs).map(|input| (&*input.name, input));
    let known: BTreeMap<&str, &Input> = known.collect();
    let mut inputs = Vec::new();
    for (name, path) in sources.files()? {
        let bad = PrepareError::read(&path);
        let data = std::fs::metadata(&path).map_err(&bad)?;
        let since = data.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
        let (bytes, modified) = (data.len(), since.map_or(0, |t| t.as_nanos() as u64));
        let same = known.get(&*name).filter(|k| k.bytes == bytes && k.modified == modified && modified > 0);
        let digest = match same {
            Some(known) => known.digest.clone(),
            None => digest(&path, watch)?,
        };
        inputs.push(Input { name, bytes, modified, digest });
    }
    let digests = digests(&inputs);
    let key = hash(
        &json!({ "rules": rules(sources), "inputs": digests, "params": params.for_key(), "program": finder }),
    );
    let reusable = earlier.is_some_and(|record| record.key == key);
    Ok((key, inputs, reusable))
}

/// The names of inputs with their digests.
fn digests(inputs: &[Input]) -> Vec<(&str, &str)> {
    inputs.iter().map(|i| (&*i.name, &*i.digest)).collect()
}

/// The folder of the unfinished work for a capture at `out`, beside it.
pub fn work_folder(out: &Path) -> PathBuf {
    let name = out.file_name().unwrap_or_default().to_string_lossy();
    let parent = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    parent.join(format!(".{name}.preparing"))
}

/// An image with its origin.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Taken {
    image: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    film: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    frame: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    seconds: Option<f64>,
    /// True if `seconds` is the frame's own time stamp. Older versions computed it from number and mean rate.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    stamped: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    sharpness: Option<f32>,
    camera: String,
}

/// Refuses choices that cannot be carried out, and names missing programs, without reading the inputs.
///
/// # Errors
/// Returns the first such choice or program.
pub fn check(sources: &Sources, params: &PrepareParams, programs: &Programs) -> Result<(), PrepareError> {
    needed(sources, params, programs)?;
    match params.keypoints {
        Keypoints::Learned => programs.learned().map(|_| ()),
        _ => Ok(()),
    }
}

/// The programs that these inputs need: one for films and conversion, and one for cameras.
fn needed(
    sources: &Sources,
    params: &PrepareParams,
    programs: &Programs,
) -> Result<(Option<Program>, Program), PrepareError> {
    params.validate()?;
    let needs_ffmpeg = sources.has_films() || sources.photographs.iter().any(|p| p.converted);
    let ffmpeg = needs_ffmpeg.then(|| programs.film()).transpose()?;
    if let (false, [first, ..]) = (sources.has_films(), &sources.photographs[..])
        && sources.photographs.len() < FEWEST
    {
        let (count, were) = match sources.photographs.len() {
            1 => ("1 photograph".to_string(), "was"),
            count => (format!("{count} photographs"), "were"),
        };
        let (path, found) = match &sources.capture {
            Some(folder) => (folder, format!("it has {count}")),
            None => (&first.path, format!("{count} {were} given")),
        };
        let reason = format!("{found}; a scene needs at least {FEWEST} photographs, better 30 to 200");
        return Err(PrepareError::input(path, reason));
    }
    if params.repeatable && programs.finder == Finder::Colmap {
        let reason =
            "the program colmap is not repeatable; take pycolmap (`pip install pycolmap`, --with pycolmap)";
        return Err(PrepareError::Choice { flag: "--repeatable", reason: reason.into() });
    }
    Ok((ffmpeg, programs.finding(params)?))
}

/// Prepares a capture in `folder`, the folder of the work: the result is its `capture`. `key` and `inputs`
/// are those of [`key_of`].
///
/// # Errors
/// Returns the first failure. Finished steps are kept in the folder.
pub fn prepare(
    sources: &Sources,
    (key, inputs): (&str, &[Input]),
    params: &PrepareParams,
    programs: &Programs,
    (folder, threads): (&Path, usize),
    watch: &StepWatch<'_>,
) -> Result<Prepared, PrepareError> {
    let (ffmpeg, program) = needed(sources, params, programs)?;
    let mut work = Work::open(folder, watch)?;
    let (log, program) = (work.log.clone(), &program);
    let sfm = Sfm { program, params, work: folder, log: &log, threads, watch, images: 0 };
    sfm.check_calibration()?;
    let networks = match params.keypoints {
        Keypoints::Learned => Some(programs.learned()?),
        _ => None,
    };
    // Other inputs, such as masks, are copied after the last step.
    let digests = digests(&inputs[..sources.count().min(inputs.len())]);
    let choices = json!({
        "rules": rules(sources), "inputs": digests, "frames": params.frames, "overlap": params.overlap,
    });
    let step = Step { name: "images", output: CAPTURE, choices };
    let Images { taken, films, mut remarks, doubts, why_few } =
        work.step(step, |work| images(sources, params, ffmpeg.as_ref(), work, watch))?;
    remarks.extend(sources.left_out().into_iter().chain(sources.remark()));
    if taken.len() < FEWEST {
        let path = sources.films.first().map_or(folder, |p| p.as_path());
        let reason = format!(
            "{} usable frames were found, and a scene needs {FEWEST} at least: {}",
            taken.len(),
            why_few.unwrap_or_else(|| "the inputs hold no more".into())
        );
        return Err(PrepareError::input(path, reason));
    }

    let images = taken.len();
    let sfm = Sfm { images, ..sfm };
    let cameras: Vec<(String, String)> = taken.iter().map(|t| (t.image.clone(), t.camera.clone())).collect();
    let groups = groups(&cameras);
    if groups.len() > 1 && !params.calibration.is_empty() {
        let reason = format!("the images come from {} cameras, and one calibration was given", groups.len());
        return Err(PrepareError::Choice { flag: "--calibration", reason });
    }
    let choices = json!({
        "program": program, "lens": params.lens, "calibration": params.calibration, "features": params.features,
        "repeatable": params.repeatable,
    });
    let features = work.step(Step { name: "features", output: FEATURES_DB, choices }, |_| {
        let (commands, words) = sfm.features(&groups)?;
        (watch.note)(&words);
        Ok(commands)
    })?;
    let matching = params.matching.settle(images, sources.has_films());
    let names: Vec<String> = taken.iter().map(|t| t.image.clone()).collect();
    let search = Search { sfm: &sfm, programs, names: &names, matching };
    let SearchResult { best, record: keypoints, networks, remark, advice } =
        search.run(&mut work, networks)?;
    let found = best.models;
    let from_films = sources.has_films();
    let context = ModelContext {
        params,
        matching,
        films: from_films,
        features: best.features,
        advice,
        focal: best.focal,
        unusual: best.unusual,
    };
    let Some(verdict) = judge(&found, &names, &context) else {
        // The next attempt maps again, perhaps with another version of the program.
        work.forget_last()?;
        let (cause, may_help) = why_no_cameras(&folder.join(IMAGES), &names)?;
        let reason = match may_help {
            true => format!("{cause}. If this does not help: {}", remedies(&context).join("; ")),
            false => cause,
        };
        return Err(PrepareError::NoCameras { images, reason, log });
    };
    if verdict.grade != Grade::Good {
        remarks.extend(doubts);
    }
    remarks.extend(remark);
    if found.iter().any(|m| m.check_single(&folder.join(best.folder)).is_err()) {
        remarks.push("a model has numbers beyond single precision; the import will refuse it".into());
    }
    assemble(&work, sources, &found)?;
    let [matches, cameras] = best.commands;
    let commands = json!({ "features": features, "matches": matches, "cameras": cameras });
    let programs: Vec<&Program> = ffmpeg.iter().chain([program]).chain(&networks).collect();
    let record = json!({
        "format": "use3d preparation", "schema": 1, "key": key, "programs": programs, "params": params.for_key(),
        "matching": matching, "keypoints": keypoints, "inputs": inputs, "images": taken, "films": films,
        "cameras": groups.len(), "commands": commands,
        "verdict": verdict, "remarks": remarks,
    });
    write_record(&folder.join(CAPTURE), &record)?;
    Ok(Prepared { verdict, remarks })
}

/// Writes the record of a preparation into its capture.
pub(crate) fn write_record(capture: &Path, record: &Value) -> Result<(), PrepareError> {
    let path = capture.join(PREPARED);
    work::write(&path, format!("{record:#}\n"))
}

/// The images of a capture.
#[derive(Serialize, Deserialize)]
struct Images {
    taken: Vec<Taken>,
    films: Vec<LookedFilm>,
    /// Remarks on the inputs for the user.
    remarks: Vec<String>,
    /// Remarks that matter only if images have no place.
    doubts: Vec<String>,
    /// The reason why films gave few frames.
    why_few: Option<String>,
}

/// Writes the images of all inputs.
fn images(
    sources: &Sources,
    params: &PrepareParams,
    ffmpeg: Option<&Program>,
    work: &Work<'_>,
    watch: &StepWatch<'_>,
) -> Result<Images, PrepareError> {
    let folder = work.folder.join(IMAGES);
    std::fs::create_dir_all(&folder).map_err(PrepareError::write(&folder))?;
    let (mut taken, mut films, mut why_few) = (Vec::new(), Vec::new(), None);
    let (mut remarks, mut doubts) = (Vec::new(), Vec::new());
    let several = sources.films.len() + usize::from(!sources.photographs.is_empty()) > 1;
    for (number, path) in sources.films.iter().enumerate() {
        let Some(ffmpeg) = ffmpeg else { break };
        // Each film gets an equal part of the frames.
        let most = (params.frames / sources.films.len()).max(FEWEST);
        let mut choice = film::look(ffmpeg, path, (most, params.overlap), &work.log, watch)?;
        let prefix = if several { format!("film-{}/", number + 1) } else { String::new() };
        let own = folder.join(&prefix);
        std::fs::create_dir_all(&own).map_err(PrepareError::write(&own))?;
        let name = |number: u64| format!("{prefix}f_{number:06}.jpg");
        let paths: Vec<PathBuf> = choice.frames.iter().map(|f| folder.join(name(f.number))).collect();
        film::write(ffmpeg, &mut choice, (&own, &paths), &work.log, watch)?;
        if choice.frames.len() < FEWEST || choice.stands {
            why_few.get_or_insert_with(|| choice.why_few());
        }
        if let Some(overlay) = choice.overlay.as_ref().filter(|overlay| !overlay.bars.is_none()) {
            let name = shown(&path.file_name().unwrap_or_default().to_string_lossy()).to_string();
            remarks.push(format!(
                "{name} has black bars at its sides, {:.0} % of its picture; they are cut off the images, and the film stays as it is",
                100.0 * overlay.bar_share()
            ));
        }
        let Choice { film, frames, looked_at, usable, overlap, .. } = choice;
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let said = shown(&file);
        (watch.note)(&format!("{said}: {} frames taken of {looked_at} that were looked at", frames.len()));
        films.push(LookedFilm {
            film: file.clone(),
            looked_at,
            taken: frames.len(),
            dark: looked_at - usable,
            left_out: left_out::write(&work.folder.join(CAPTURE), &prefix, &choice.left_out)?,
        });
        if overlap == 0.0 {
            doubts.push(format!(
                "{said} is long: {most} frames are too few for neighbours to overlap; allow more with --frames, or cut \
                 the film into parts"
            ));
        }
        remarks.extend(film.remarks());
        let size = paths.first().map(|p| use3d_io_image::image_size(p)).transpose()?.unwrap_or_default();
        let camera = format!("film {}x{}", size.0, size.1);
        taken.extend(frames.iter().map(|f| Taken {
            image: name(f.number),
            film: Some(file.clone()),
            frame: Some(f.number),
            seconds: Some(f.seconds),
            stamped: f.stamped,
            sharpness: Some(f.sharpness),
            camera: camera.clone(),
        }));
    }
    photographs::copy(&sources.photographs, &folder, ffmpeg, &work.log, watch)?;
    let turned = sources.photographs.iter().filter(|p| p.orientation != 1).count();
    if turned > 0 {
        remarks.push(format!(
            "{turned} photographs say that they are to be turned (EXIF orientation); they are used as the camera's sensor \
             saw them"
        ));
    }
    for photograph in &sources.photographs {
        let mut camera = photograph.camera.clone();
        if photograph.converted {
            let (w, h) = use3d_io_image::image_size(&photograph.name.below(&folder))?;
            camera = format!("{w}x{h} converted");
        }
        let image = photograph.name.to_string();
        let (film, frame, seconds, sharpness) = (None, None, None, None);
        taken.push(Taken { image, film, frame, seconds, stamped: false, sharpness, camera });
    }
    taken.sort_by(|a, b| a.image.cmp(&b.image));
    // Masks of the user stand alone; the import adds what it finds.
    if !sources.has_masks() {
        remarks.extend(overlay::hide(&work.folder.join(CAPTURE), &taken_by(&taken), watch)?);
    }
    let total = taken.len() as u64;
    watch.tell("images", (total, total), "images");
    Ok(Images { taken, films, remarks, doubts, why_few })
}

/// The images of each camera in each folder.
fn taken_by(taken: &[Taken]) -> Vec<Vec<&str>> {
    let mut cameras: BTreeMap<(&str, &str), Vec<&str>> = BTreeMap::new();
    for Taken { image, camera, .. } in taken {
        let folder = image.rsplit_once('/').map_or("", |(folder, _)| folder);
        cameras.entry((folder, camera)).or_default().push(image);
    }
    cameras.into_values().collect()
}

/// Puts the models, and what lies beside the photographs, into the capture.
fn assemble(work: &Work<'_>, sources: &Sources, found: &[Model]) -> Result<(), PrepareError> {
    let capture = work.folder.join(CAPTURE);
    // An earlier attempt may have put other models and masks there.
    work.remove(&format!("{CAPTURE}/sparse"))?;
    work.remove_others(CAPTURE)?;
    for (i, model) in found.iter().enumerate() {
        let folder = capture.join("sparse").join(i.to_string());
        std::fs::create_dir_all(&folder).map_err(PrepareError::write(&folder))?;
        write_model_binary(&folder, model)?;
    }
    for (name, path) in &sources.masks {
        let to = capture.join(name);
        let folder = use3d_files::folder_of(&to);
        std::fs::create_dir_all(folder).map_err(PrepareError::write(folder))?;
        photographs::copy_file(path, &to)?;
    }
    sources.capture.as_ref().map_or(Ok(()), |origin| photographs::copy_beside(origin, &capture))
}
