//! The frames of a capture in the film from which they were taken.
//!
//! `use3d prepare` records film, number and time of each frame in `prepare.json`. For frames that another
//! program took, a table `times.csv` in the capture's folder or beside its images says the times:
//!
//! ```text
//! photograph, seconds            one line for each photograph
//! photograph, seconds, film      the same for several films: the name of the film's file
//! ```
//!
//! Times are seconds from the begin of the film's file. The table comes first, if there are both.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;
use use3d_capture::FileName;
use use3d_survey::{TextRow, TextTable};

use super::info::FilmInfo;
use super::scan;
use crate::error::PrepareError;
use crate::prepare::Input;
use crate::process::StepWatch;
use crate::sources::PREPARED;
use crate::tools::Programs;
use crate::work::digest;

/// The table of times.
pub const TIMES: &str = "times.csv";
/// Folders in which the table is sought, below the capture.
const PLACES: [&str; 2] = ["", "images"];
/// The largest record or table that is read, bytes.
const LARGEST: u64 = 1 << 26;

/// A photograph of a capture that is a frame of a film.
#[derive(Clone, Debug, PartialEq)]
pub struct KnownFrame {
    /// Its name in the capture.
    pub photograph: FileName,
    /// The frame's time, seconds from the begin of the film's file.
    pub seconds: f64,
    /// The frame's number in the film, from 0, if it is recorded.
    pub number: Option<u64>,
}

#[derive(Deserialize)]
struct FilmRecord {
    inputs: Vec<Input>,
    images: Vec<RecordedImage>,
}

#[derive(Deserialize)]
struct RecordedImage {
    image: FileName,
    film: Option<String>,
    frame: Option<u64>,
    seconds: Option<f64>,
    #[serde(default)]
    stamped: bool,
}

/// The bytes of a small file; `None` if it is not there.
fn small(path: &Path) -> Result<Option<Vec<u8>>, PrepareError> {
    match std::fs::metadata(path) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(PrepareError::read(path)(e)),
        Ok(data) if data.len() > LARGEST => Err(PrepareError::input(
            path,
            format!("it has more than {LARGEST} bytes; expected a small text file"),
        )),
        Ok(_) => std::fs::read(path).map(Some).map_err(PrepareError::read(path)),
    }
}

/// The frames of `film` among the photographs of a capture, in the order of their times. A capture that an
/// older version prepared has no exact times; they are then read from the film, which is decoded once.
///
/// # Errors
/// The capture records no times, or not of this film, or the record or the table is damaged.
pub fn known_frames(
    programs: &Programs,
    capture: &Path,
    film: &Path,
    watch: &StepWatch<'_>,
) -> Result<Vec<KnownFrame>, PrepareError> {
    if !film.is_file() {
        return Err(PrepareError::input(film, "there is no such film"));
    }
    let mut frames = match times(capture, film)? {
        Some(frames) => frames,
        None => recorded(programs, capture, film, watch)?,
    };
    frames.sort_by(|a, b| a.seconds.total_cmp(&b.seconds).then_with(|| a.photograph.cmp(&b.photograph)));
    Ok(frames)
}

/// The frames of a film in the table of times; `None` if there is no table.
fn times(capture: &Path, film: &Path) -> Result<Option<Vec<KnownFrame>>, PrepareError> {
    let paths = PLACES.map(|place| capture.join(place).join(TIMES));
    for path in paths {
        if let Some(bytes) = small(&path)? {
            return understand_times(&path, &bytes, film).map(Some);
        }
    }
    Ok(None)
}

fn understand_times(path: &Path, bytes: &[u8], film: &Path) -> Result<Vec<KnownFrame>, PrepareError> {
    let bad = |line: usize, reason: String| PrepareError::input(path, format!("line {line}: {reason}"));
    let table = TextTable::parse(bytes, "#").map_err(|(line, reason)| bad(line, reason))?;
    let column = |name: &str| {
        table.column(&[name]).ok_or_else(|| {
            bad(
                table.first_line,
                format!("there is no column `{name}`; expected this line to be photograph,seconds"),
            )
        })
    };
    let (photograph, seconds, films) = (column("photograph")?, column("seconds")?, table.column(&["film"]));
    let name = film.file_name().unwrap_or_default().to_string_lossy();
    let of_film = |row: &&TextRow| films.is_none_or(|column| [&*name, ""].contains(&row.get(column).trim()));
    let mut found: BTreeMap<FileName, KnownFrame> = BTreeMap::new();
    for row in table.rows.iter().filter(of_film) {
        let name = FileName::new(row.get(photograph).trim()).map_err(|e| bad(row.line, e.to_string()))?;
        let time = row.number(seconds).filter(|s| s.is_finite() && *s >= 0.0).ok_or_else(|| {
            let text = row.get(seconds);
            bad(
                row.line,
                format!("`seconds` is {text:?}; expected seconds from the film's begin, such as 12.48"),
            )
        })?;
        let frame = KnownFrame { photograph: name.clone(), seconds: time, number: None };
        if found.insert(name.clone(), frame).is_some() {
            return Err(bad(row.line, format!("{name} is there twice; expected each photograph once")));
        }
    }
    if found.is_empty() {
        let reason = format!("it has no photograph of {}; add a line for each", use3d_capture::shown(&name));
        return Err(PrepareError::input(path, reason));
    }
    Ok(found.into_values().collect())
}

/// The place of a recorded image's film among the inputs: films come first, and of several inputs with a film
/// each has a folder, `film-2/`.
fn film_of(image: &RecordedImage) -> usize {
    let folder = image.image.split_once('/').and_then(|(folder, _)| folder.strip_prefix("film-"));
    folder.and_then(|number| number.parse::<usize>().ok()).map_or(0, |number| number.saturating_sub(1))
}

/// The frames of a film in the record of a preparation.
fn recorded(
    programs: &Programs,
    capture: &Path,
    film: &Path,
    watch: &StepWatch<'_>,
) -> Result<Vec<KnownFrame>, PrepareError> {
    let path = capture.join(PREPARED);
    let bytes = small(&path)?.ok_or_else(|| no_times(capture, &format!("there is no {PREPARED} in it")))?;
    let record: FilmRecord = serde_json::from_slice(&bytes).map_err(|e| {
        PrepareError::input(
            &path,
            format!("it is not the record of a preparation ({e}); prepare the capture again"),
        )
    })?;
    let images: Vec<&RecordedImage> = record.images.iter().filter(|image| image.film.is_some()).collect();
    if images.is_empty() {
        return Err(no_times(capture, "it was prepared from photographs"));
    }
    let place = same_film(&record, &images, film, watch)?.ok_or_else(|| {
        let mut names: Vec<&str> = images.iter().filter_map(|image| image.film.as_deref()).collect();
        names.dedup();
        let names = names.iter().map(|n| use3d_capture::shown(n)).collect::<Vec<_>>().join(", ");
        let reason = format!(
            "the frames of {} come from {names}, and this is another film or was changed since; give that film, or prepare \
             this one",
            capture.display()
        );
        PrepareError::input(film, reason)
    })?;
    let images: Vec<&RecordedImage> = images.into_iter().filter(|image| film_of(image) == place).collect();
    let broken = |image: &RecordedImage| {
        let reason =
            format!("{} has no usable frame or time; prepare the capture again", image.image.as_str());
        PrepareError::input(&path, reason)
    };
    let stamps = match images.iter().all(|image| image.stamped) {
        true => None,
        false => {
            (watch.note)(
                "the times of the film's frames are read, since an older version prepared this capture",
            );
            Some(scan::decoded_times(&programs.film()?, &FilmInfo::of(programs, film)?, watch)?)
        }
    };
    let known = images.iter().map(|image| {
        let (Some(number), Some(said)) = (image.frame, image.seconds.filter(|s| s.is_finite())) else {
            return Err(broken(image));
        };
        let stamp = stamps.as_ref().map(|all| usize::try_from(number).ok().and_then(|n| all.get(n)).copied());
        let seconds = match stamp {
            None => said,
            Some(Some(stamp)) => stamp,
            Some(None) => return Err(broken(image)),
        };
        Ok(KnownFrame { photograph: image.image.clone(), seconds, number: Some(number) })
    });
    known.collect()
}

fn no_times(capture: &Path, found: &str) -> PrepareError {
    let reason = format!(
        "the times of its photographs in the film are not known: {found}; prepare it from the film (`use3d prepare FILM`), \
         or write a table {TIMES} into this folder, with the columns photograph,seconds"
    );
    PrepareError::input(capture, reason)
}

/// The place among the inputs of the film with the same bytes; `None` if there is none.
fn same_film(
    record: &FilmRecord,
    images: &[&RecordedImage],
    film: &Path,
    watch: &StepWatch<'_>,
) -> Result<Option<usize>, PrepareError> {
    let bytes = std::fs::metadata(film).map_err(PrepareError::read(film))?.len();
    let mut places: Vec<usize> = images.iter().map(|image| film_of(image)).collect();
    places.sort_unstable();
    places.dedup();
    let sized = |place: &usize| record.inputs.get(*place).is_some_and(|input| input.bytes == bytes);
    let candidates: Vec<usize> = places.into_iter().filter(sized).collect();
    if candidates.is_empty() {
        return Ok(None);
    }
    let own = digest(film, watch)?;
    Ok(candidates.into_iter().find(|place| record.inputs[*place].digest == own))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said<T>(result: Result<T, PrepareError>) -> String {
        result.err().map(|e| e.to_string()).unwrap_or_default()
    }

    fn frames(capture: &Path, film: &Path) -> Result<Vec<KnownFrame>, PrepareError> {
        let stop = std::sync::atomic::AtomicBool::new(false);
        let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
        known_frames(&Programs::default(), capture, film, &watch)
    }

    fn brief(frames: &[KnownFrame]) -> Vec<(&str, f64, Option<u64>)> {
        frames.iter().map(|f| (f.photograph.as_str(), f.seconds, f.number)).collect()
    }

    #[test]
    fn a_table_of_times_is_read_and_its_faults_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let film = dir.path().join("dive.mp4");
        std::fs::write(&film, "film").unwrap();
        assert!(said(frames(dir.path(), &film)).contains("columns photograph,seconds"));
        std::fs::create_dir(dir.path().join("images")).unwrap();
        let table = dir.path().join("images/times.csv");
        std::fs::write(&table, "photograph,seconds\nf_0002.jpg,1.5\nleft/f_0001.jpg,0.25\n").unwrap();
        let found = frames(dir.path(), &film).unwrap();
        assert_eq!(brief(&found), [("left/f_0001.jpg", 0.25, None), ("f_0002.jpg", 1.5, None)]);
        std::fs::write(&table, "film,photograph,seconds\nother.mp4,a.jpg,1\ndive.mp4,b.jpg,2\n").unwrap();
        assert_eq!(brief(&frames(dir.path(), &film).unwrap()), [("b.jpg", 2.0, None)]);
        for (text, part) in [
            ("photograph,time\na.jpg,1\n", "line 1: there is no column `seconds`"),
            ("photograph,seconds\na.jpg,x\n", "line 2: `seconds` is \"x\""),
            ("photograph,seconds\na.jpg,-1\n", "line 2"),
            ("photograph,seconds\na.jpg,1\na.jpg,2\n", "line 3: a.jpg is there twice"),
            ("photograph,seconds\n../a.jpg,1\n", "line 2"),
            ("film,photograph,seconds\nother.mp4,a.jpg,1\n", "no photograph of dive.mp4"),
        ] {
            std::fs::write(&table, text).unwrap();
            let said = said(frames(dir.path(), &film));
            assert!(said.contains(part) && said.contains("times.csv"), "{text}: {said}");
        }
    }

    #[test]
    fn the_record_of_a_preparation_finds_each_film_by_its_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let input = |name: &str, text: &str| {
            std::fs::write(at(text), text).unwrap();
            let digest = blake3::hash(text.as_bytes()).to_hex().to_string();
            serde_json::json!({ "name": name, "bytes": text.len(), "modified": 1, "digest": digest })
        };
        let image = |image: &str, frame: u64, seconds: f64| {
            serde_json::json!({ "image": image, "film": "a.mp4", "frame": frame, "seconds": seconds, "stamped": true,
                "camera": "c" })
        };
        // Two films of one name and size, from two folders, and a photograph.
        let mut record = serde_json::json!({
            "inputs": [input("a.mp4", "one"), input("a.mp4", "two"), input("p.jpg", "photograph")],
            "images": [image("film-1/f_000003.jpg", 3, 0.1), image("film-2/f_000009.jpg", 9, 0.3),
                image("film-2/f_000005.jpg", 5, 0.2), { "image": "p.jpg", "camera": "c" }],
        });
        std::fs::write(at(PREPARED), record.to_string()).unwrap();
        assert_eq!(brief(&frames(dir.path(), &at("one")).unwrap()), [("film-1/f_000003.jpg", 0.1, Some(3))]);
        let second = frames(dir.path(), &at("two")).unwrap();
        assert_eq!(
            brief(&second),
            [("film-2/f_000005.jpg", 0.2, Some(5)), ("film-2/f_000009.jpg", 0.3, Some(9))]
        );
        std::fs::write(at("other"), "six").unwrap();
        for other in ["other", "photograph"] {
            let said = said(frames(dir.path(), &at(other)));
            assert!(said.contains("come from a.mp4") && said.contains("give that film"), "{said}");
        }
        assert!(said(frames(dir.path(), &at("nowhere"))).contains("no such film"));
        record["images"][0]["frame"] = serde_json::Value::Null;
        std::fs::write(at(PREPARED), record.to_string()).unwrap();
        assert!(said(frames(dir.path(), &at("one"))).contains("film-1/f_000003.jpg has no usable frame"));
        record["images"] = serde_json::json!([{ "image": "p.jpg", "camera": "c" }]);
        std::fs::write(at(PREPARED), record.to_string()).unwrap();
        assert!(said(frames(dir.path(), &at("one"))).contains("it was prepared from photographs"));
        std::fs::write(at(PREPARED), "{").unwrap();
        assert!(said(frames(dir.path(), &at("one"))).contains("prepare the capture again"));
    }
}
