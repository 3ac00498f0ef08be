//! Prepares a capture step by step, and keeps finished steps for the next attempt.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};
use serde_json::json;
use use3d_io_colmap::{Model, write_model_binary};

use crate::error::PrepareError;
use crate::film::{self, Choice};
use crate::params::{FEWEST, PrepareParams};
use crate::photographs;
use crate::process::{StepProgress, StepWatch};
use crate::sfm::{Commands, FEATURES_DB, IMAGES, MATCHES_DB, MODELS, Sfm, groups};
use crate::sources::{BESIDE, Sources};
use crate::tools::{Finder, Program, Programs};
use crate::verdict::{CameraVerdict, judge, models, remedies};

/// The record of a preparation, in the capture's folder.
pub const PREPARED: &str = "prepare.json";
/// The finished capture, in the folder of the work.
pub const CAPTURE: &str = "capture";
const STATE: &str = "state.json";
const LOG: &str = "log.txt";
/// Attempts to lock the folder of the work, and the pause between them, milliseconds.
const LOCK_TRIES: u64 = 40;
const LOCK_PAUSE: u64 = 50;
/// Changes when images are chosen or written in another way.
const RULES: u32 = 1;

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

fn hash(value: &impl Serialize) -> String {
    let text = serde_json::to_string(value).unwrap_or_default();
    blake3::hash(text.as_bytes()).to_hex().to_string()
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
    for (name, path) in sources.files() {
        let bad = PrepareError::file(&path);
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
    let digests: Vec<(&str, &str)> = inputs.iter().map(|i| (&*i.name, &*i.digest)).collect();
    let program = match finder {
        Finder::Auto => "auto",
        Finder::Colmap => "colmap",
        Finder::Pycolmap => "pycolmap",
    };
    let key = hash(&json!({ "rules": RULES, "inputs": digests, "params": params, "program": program }));
    let reusable = earlier.is_some_and(|record| record.key == key);
    Ok((key, inputs, reusable))
}

fn digest(path: &Path, watch: &StepWatch<'_>) -> Result<String, PrepareError> {
    let bad = PrepareError::file(path);
    let mut file = File::open(path).map_err(&bad)?;
    let (mut hasher, mut part) = (blake3::Hasher::new(), vec![0; 1 << 20]);
    loop {
        watch.check()?;
        match file.read(&mut part).map_err(&bad)? {
            0 => return Ok(hasher.finalize().to_hex().to_string()),
            n => hasher.update(&part[..n]),
        };
    }
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
    #[serde(skip_serializing_if = "Option::is_none")]
    sharpness: Option<f32>,
    camera: String,
}

/// The finished steps, each with the digest of everything that it depends on.
#[derive(Default, Serialize, Deserialize)]
struct FinishedSteps {
    images: Option<(String, Vec<Taken>, Vec<String>)>,
    features: Option<(String, Commands)>,
    matches: Option<(String, Commands)>,
    cameras: Option<(String, Commands)>,
}

struct Work<'a> {
    folder: &'a Path,
    log: PathBuf,
    state: FinishedSteps,
}

impl Work<'_> {
    fn keep(&self) -> Result<(), PrepareError> {
        let path = self.folder.join(STATE);
        let bytes = serde_json::to_vec(&self.state).unwrap_or_default();
        use3d_files::write_atomically(&path, |w| std::io::Write::write_all(w, &bytes))
            .map_err(PrepareError::file(&path))
    }

    fn remove(&self, name: &str) -> Result<(), PrepareError> {
        let path = self.folder.join(name);
        let removed =
            if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        match removed {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(PrepareError::file(&path)(e)),
            _ => Ok(()),
        }
    }

    /// Removes a database with the files that belong to it.
    fn remove_database(&self, name: &str) -> Result<(), PrepareError> {
        ["", "-wal", "-shm", "-journal"].iter().try_for_each(|end| self.remove(&format!("{name}{end}")))
    }
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
    params.validate()?;
    // Missing programs are named before any work is done.
    let needs_ffmpeg = sources.has_films() || sources.photographs.iter().any(|p| p.converted);
    let ffmpeg = needs_ffmpeg.then(|| programs.film()).transpose()?;
    let program = programs.cameras()?;
    if !sources.has_films() && sources.photographs.len() < FEWEST {
        let path = sources.photographs.first().map_or(folder, |p| &p.path);
        let reason = format!("a scene needs {FEWEST} photographs at least, better 30 to 200");
        return Err(PrepareError::input(path, reason));
    }
    std::fs::create_dir_all(folder).map_err(PrepareError::file(folder))?;
    let lock = File::create(folder.join("lock")).map_err(PrepareError::file(folder))?;
    // A program that another thread has just started may hold a copy of an old lock until it runs, so one
    // refusal says little. A file system without locks is no reason to refuse.
    let taken = |attempt: u64| {
        std::thread::sleep(std::time::Duration::from_millis(attempt.min(1) * LOCK_PAUSE));
        matches!(lock.try_lock(), Err(std::fs::TryLockError::WouldBlock))
    };
    if (0..LOCK_TRIES).all(taken) {
        return Err(PrepareError::Busy { path: folder.to_path_buf() });
    }
    let state = std::fs::read(folder.join(STATE)).ok();
    let state = state.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
    let mut work = Work { folder, log: folder.join(LOG), state };

    let digests: Vec<(&str, &str)> = inputs.iter().map(|i| (&*i.name, &*i.digest)).collect();
    let images_key = hash(&json!({ "rules": RULES, "inputs": digests, "frames": params.frames }));
    if work.state.images.as_ref().is_none_or(|(done, ..)| *done != images_key) {
        let (taken, remarks) = images(sources, params, ffmpeg.as_ref(), &work, watch)?;
        work.state =
            FinishedSteps { images: Some((images_key.clone(), taken, remarks)), ..FinishedSteps::default() };
        work.keep()?;
    } else {
        (watch.note)("images: kept from the last attempt");
    }
    let Some((_, taken, mut remarks)) = work.state.images.clone() else {
        return Err(PrepareError::Interrupted);
    };
    let names: Vec<String> = taken.iter().map(|t| t.image.clone()).collect();
    if names.len() < FEWEST {
        let path = sources.films.first().map_or(folder, |p| p.as_path());
        let reason = format!(
            "{} usable frames were found, and a scene needs {FEWEST} at least: it is too short, too dark, or stands still",
            names.len()
        );
        return Err(PrepareError::input(path, reason));
    }

    let sfm = Sfm {
        program: &program,
        params,
        work: folder,
        log: &work.log.clone(),
        threads,
        watch,
        images: names.len(),
    };
    let cameras: Vec<(String, String)> = taken.iter().map(|t| (t.image.clone(), t.camera.clone())).collect();
    let groups = groups(&cameras);
    if groups.len() > 1 && !params.calibration.is_empty() {
        let reason = format!("the images come from {} cameras, and one calibration was given", groups.len());
        return Err(PrepareError::Choice { flag: "--calibration", reason });
    }
    let matching = params.matching.settle(names.len(), sources.has_films());
    let features_key = hash(&json!({
        "images": images_key, "program": program, "lens": params.lens, "calibration": params.calibration,
        "features": params.features,
    }));
    if work.state.features.as_ref().is_none_or(|(done, _)| *done != features_key) {
        // A step that was interrupted starts again, so that its result does not depend on the interruption.
        work.remove_database(FEATURES_DB)?;
        work.state = FinishedSteps { features: None, matches: None, cameras: None, ..work.state };
        work.keep()?;
        let commands = sfm.features(&groups)?;
        work.state.features = Some((features_key.clone(), commands));
        work.keep()?;
        (watch.note)(&format!("features: found in {} images", names.len()));
    } else {
        (watch.note)("features: kept from the last attempt");
    }
    let matches_key = hash(&json!([features_key, matching, params.repeatable]));
    if work.state.matches.as_ref().is_none_or(|(done, _)| *done != matches_key) {
        work.remove_database(MATCHES_DB)?;
        work.state = FinishedSteps { matches: None, cameras: None, ..work.state };
        work.keep()?;
        let (from, to) = (folder.join(FEATURES_DB), folder.join(MATCHES_DB));
        // A fake or broken program may have written none; the step then says so itself.
        if from.is_file() {
            std::fs::copy(&from, &to).map_err(PrepareError::file(&from))?;
        }
        let commands = sfm.matches(matching)?;
        work.state.matches = Some((matches_key.clone(), commands));
        work.keep()?;
        (watch.note)("matches: the images are compared");
    } else {
        (watch.note)("matches: kept from the last attempt");
    }
    let cameras_key = hash(&json!([matches_key, params.mapper]));
    if work.state.cameras.as_ref().is_none_or(|(done, _)| *done != cameras_key) {
        work.remove(MODELS)?;
        work.state.cameras = None;
        work.keep()?;
        let commands = sfm.map()?;
        work.state.cameras = Some((cameras_key, commands));
        work.keep()?;
    } else {
        (watch.note)("cameras: kept from the last attempt");
    }

    let found: Vec<Model> = models(&folder.join(MODELS))?;
    let Some(verdict) = judge(&found, &names, (params, matching, sources.has_films())) else {
        // The next attempt maps again, perhaps with another version of the program.
        work.state.cameras = None;
        work.keep()?;
        let reason = format!(
            "neighbouring images share too few features, because they are blurred, hazy, empty or too far apart; {}",
            remedies(params, matching, sources.has_films()).join("; ")
        );
        return Err(PrepareError::NoCameras { images: names.len(), reason, log: work.log });
    };
    if found.iter().any(|m| m.check_single(&folder.join(MODELS)).is_err()) {
        remarks.push("a model has numbers beyond single precision; the import will refuse it".into());
    }
    assemble(&work, sources, &found)?;
    let FinishedSteps { features, matches, cameras, .. } = &work.state;
    let steps = [("features", features), ("matches", matches), ("cameras", cameras)];
    let commands: BTreeMap<&str, &Commands> =
        steps.into_iter().filter_map(|(name, step)| Some((name, &step.as_ref()?.1))).collect();
    let programs: Vec<&Program> = ffmpeg.iter().chain([&program]).collect();
    let record = json!({
        "format": "use3d preparation", "schema": 1, "key": key, "programs": programs, "params": params,
        "matching": matching, "inputs": inputs, "images": taken, "cameras": groups.len(), "commands": commands,
        "verdict": verdict, "remarks": remarks,
    });
    let path = folder.join(CAPTURE).join(PREPARED);
    let mut bytes = serde_json::to_vec_pretty(&record).unwrap_or_default();
    bytes.push(b'\n');
    std::fs::write(&path, bytes).map_err(PrepareError::file(&path))?;
    Ok(Prepared { verdict, remarks })
}

/// Writes the images of all inputs, and returns them with remarks.
fn images(
    sources: &Sources,
    params: &PrepareParams,
    ffmpeg: Option<&Program>,
    work: &Work<'_>,
    watch: &StepWatch<'_>,
) -> Result<(Vec<Taken>, Vec<String>), PrepareError> {
    work.remove(CAPTURE)?;
    let folder = work.folder.join(IMAGES);
    std::fs::create_dir_all(&folder).map_err(PrepareError::file(&folder))?;
    let (mut taken, mut remarks) = (Vec::new(), Vec::new());
    let several = sources.films.len() + usize::from(!sources.photographs.is_empty()) > 1;
    for (number, path) in sources.films.iter().enumerate() {
        let Some(ffmpeg) = ffmpeg else { break };
        // Each film gets an equal part of the frames.
        let most = (params.frames / sources.films.len()).max(FEWEST);
        let choice = film::look(ffmpeg, path, most, &work.log, watch)?;
        let prefix = if several { format!("film-{}/", number + 1) } else { String::new() };
        let own = folder.join(&prefix);
        std::fs::create_dir_all(&own).map_err(PrepareError::file(&own))?;
        let name = |number: u64| format!("{prefix}f_{number:06}.jpg");
        let paths: Vec<PathBuf> = choice.frames.iter().map(|f| folder.join(name(f.number))).collect();
        film::write(ffmpeg, &choice, (&own, &paths), &work.log, watch)?;
        let Choice { film, frames, looked_at, overlap } = choice;
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        (watch.note)(&format!("{file}: {} frames taken of {looked_at} that were looked at", frames.len()));
        if overlap == 0.0 {
            remarks.push(format!(
                "{file} is long: {most} frames are too few for neighbours to overlap; allow more with --frames, or cut \
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
        taken.push(Taken { image, film: None, frame: None, seconds: None, sharpness: None, camera });
    }
    taken.sort_by(|a, b| a.image.cmp(&b.image));
    let total = taken.len() as u64;
    (watch.progress)(StepProgress { step: "images", done: total, total, unit: "images" });
    Ok((taken, remarks))
}

/// Puts the models, and what lies beside the photographs, into the capture.
fn assemble(work: &Work<'_>, sources: &Sources, found: &[Model]) -> Result<(), PrepareError> {
    let capture = work.folder.join(CAPTURE);
    work.remove(&format!("{CAPTURE}/sparse"))?;
    for (i, model) in found.iter().enumerate() {
        let folder = capture.join("sparse").join(i.to_string());
        std::fs::create_dir_all(&folder).map_err(PrepareError::file(&folder))?;
        write_model_binary(&folder, model)?;
    }
    if let Some(origin) = &sources.capture {
        for name in BESIDE.iter().filter(|name| origin.join(name).exists()) {
            photographs::copy_all(&origin.join(name), &capture.join(name))?;
        }
    }
    Ok(())
}
