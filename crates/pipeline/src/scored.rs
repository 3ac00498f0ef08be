//! Tables of scores: of plain folders of images, and of a scene's views.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;
use use3d_capture::{Image, shown};
use use3d_io_image::{image_size, images_by_stem, read_image};
use use3d_judge::scores::{Method, SceneScores, Score, Scores};
use use3d_judge::scoring::Judges;
use use3d_workflow::machine::{available_memory, bytes};

use crate::WorkError;

/// The scores of an image, of a pair of images, or of all of them.
#[derive(Clone, Debug, Serialize)]
pub struct ScoreRow {
    /// The name of the image, the two names of a pair, or `mean`.
    pub image: String,
    /// The method that made it; empty for plain images.
    pub method: String,
    /// Its scores.
    pub scores: Scores,
}

/// Rows of scores; as text, they are a table for people.
#[derive(Clone, Debug, Serialize)]
#[serde(transparent)]
pub struct ScoreRows {
    /// The rows, with their mean behind those that it is of.
    pub rows: Vec<ScoreRow>,
}

impl ScoreRows {
    /// Scores the images in `dir`, with those of equal names in `reference`. `models` is the folder of
    /// networks; `warn` gets the images without a reference.
    ///
    /// # Errors
    /// A folder has no images or an image has another size than its reference, the memory is too small, or
    /// `stop` was set.
    pub fn of_folders(
        dir: &Path,
        reference: Option<&Path>,
        models: Option<&Path>,
        stop: &AtomicBool,
        warn: &mut dyn FnMut(String),
    ) -> Result<Self, WorkError> {
        let judges = Judges::open(models);
        let given = images(dir, "--images")?;
        let references = reference.map(|dir| images(dir, "--reference")).transpose()?;
        if let Some(references) =
            references.as_ref().filter(|r| given.keys().all(|stem| !r.contains_key(stem)))
        {
            let [ours, theirs] =
                [&given, references].map(|images| images.keys().next().map_or("", String::as_str));
            return Err(WorkError::Input(format!(
                "no image of --images ({ours}, …) has a counterpart in --reference ({theirs}, …); they are matched by the name \
                 without its extension"
            )));
        }
        let mut rows = Vec::new();
        for (stem, path) in given {
            if stop.load(Ordering::Relaxed) {
                return Err(WorkError::Stopped);
            }
            let image = read(&path, &judges, false)?;
            let mut scores = judges.alone(&image, None);
            let name = shown(&stem).into_owned();
            match references.as_ref().map(|references| references.get(&stem)) {
                None => {}
                Some(None) => {
                    warn(format!(
                        "{name}: the reference folder has no file of this stem; scored without a reference"
                    ));
                }
                Some(Some(path)) => {
                    let reference = read(path, &judges, true)?;
                    let [(w, h), (wide, high)] =
                        [&image, &reference].map(|image| (image.width(), image.height()));
                    if (w, h) != (wide, high) {
                        return Err(WorkError::Input(format!(
                            "{stem}: the image is {w}x{h}, its reference {wide}x{high}; scores need equal sizes"
                        )));
                    }
                    scores.extend(judges.against(&image, &reference, None));
                }
            }
            rows.push(ScoreRow { method: String::new(), image: name, scores });
        }
        let mut table = Self { rows };
        let mean = |name: &String| Score::mean(table.rows.iter().filter_map(|row| row.scores.get(name)));
        let scores = table.names().into_iter().map(|name| (name.clone(), mean(name))).collect();
        table.rows.push(ScoreRow { method: String::new(), image: "mean".into(), scores });
        Ok(table)
    }

    /// The scores of a scene's views and of their neighbours, by method.
    pub fn of_scene(scores: &SceneScores) -> Self {
        let mut rows = Vec::new();
        for method in Method::ALL {
            let Some(found) = scores.methods.iter().find(|m| m.method == method) else { continue };
            let label = method.name().to_string();
            for view in &found.views {
                let (image, scores) = (view.view.clone(), view.scores.clone());
                rows.push(ScoreRow { method: label.clone(), image, scores });
            }
            for pair in found.neighbours.iter().chain(&found.path) {
                let image = format!("{} → {}", pair.first, pair.second);
                rows.push(ScoreRow { method: label.clone(), image, scores: pair.scores.clone() });
            }
            rows.push(ScoreRow { method: label, image: "mean".into(), scores: found.mean.clone() });
        }
        Self { rows }
    }

    /// The names of all scores.
    fn names(&self) -> BTreeSet<&String> {
        self.rows.iter().flat_map(|row| row.scores.keys()).collect()
    }

    /// Comma-separated values.
    pub fn csv(&self) -> String {
        let names = self.names();
        let quote = |text: &str| match text.contains([',', '"']) {
            true => format!("\"{}\"", text.replace('"', "\"\"")),
            false => text.to_string(),
        };
        let heads: Vec<&str> = names.iter().map(|n| n.as_str()).collect();
        let mut text = format!("method,image,{}\n", heads.join(","));
        for ScoreRow { method, image, scores } in &self.rows {
            let values = names.iter().map(|name| scores.get(*name).and_then(Score::value));
            let cells: Vec<String> =
                values.map(|value| value.map_or_else(String::new, |v| format!("{v:.6}"))).collect();
            text += &format!("{},{},{}\n", quote(method), quote(image), cells.join(","));
        }
        text
    }

    /// The reasons why scores have no value, each once.
    pub fn reasons(&self) -> Vec<String> {
        let mut reasons: Vec<String> = Vec::new();
        for (name, score) in self.rows.iter().flat_map(|r| &r.scores) {
            let reason = score.reason().map(|reason| format!("{name}: {reason}"));
            reasons.extend(reason.filter(|reason| !reasons.contains(reason)));
        }
        reasons
    }
}

impl fmt::Display for ScoreRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (names, rows) = (self.names(), &self.rows);
        let wide = rows.iter().map(|r| r.image.chars().count()).max().unwrap_or(0).max(5);
        let first = rows.iter().map(|r| r.method.chars().count()).max().unwrap_or(0);
        write!(f, "{:first$} {:wide$}", "", "image")?;
        names.iter().try_for_each(|n| write!(f, " {n:>10}"))?;
        writeln!(f)?;
        for row in rows {
            write!(f, "{:first$} {:wide$}", row.method, row.image)?;
            for name in &names {
                match row.scores.get(*name) {
                    Some(Score::Value(value)) => write!(f, " {:>10.4}", value.get())?,
                    Some(Score::NotAvailable(_) | Score::Undefined(_)) => write!(f, " {:>10}", "n/a")?,
                    None => write!(f, " {:>10}", "–")?,
                }
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

/// The images of a folder by stem; `flag` is the flag that named the folder.
fn images(dir: &Path, flag: &str) -> Result<BTreeMap<String, PathBuf>, WorkError> {
    let refused = |what: &str| WorkError::Input(format!("{flag} {}: {what}", dir.display()));
    if !dir.is_dir() {
        return Err(refused("there is no such folder"));
    }
    let found = images_by_stem(dir, &["png", "jpg", "jpeg", "tif", "tiff", "exr"])
        .map_err(|error| WorkError::Input(format!("{flag} {error}")))?;
    if found.is_empty() {
        return Err(refused("no images here; PNG, JPEG, TIFF and EXR are read"));
    }
    Ok(found)
}

/// Bytes per pixel of an image in memory: three channels of f32.
const IMAGE: u64 = 12;
/// Most bytes per pixel that decoding needs beside the image: the samples of a file with four floats.
const DECODING: u64 = 16;

/// Reads an image in display range, if there is enough memory to read and score it. `compared` is true if
/// another image of the same size is in memory already.
fn read(path: &Path, judges: &Judges, compared: bool) -> Result<Image, WorkError> {
    let (width, height) = image_size(path).map_err(WorkError::input)?;
    let beside = judges.bytes_per_pixel(compared).max(DECODING);
    refuse_beyond(path, (width * height) as u64, IMAGE + beside, available_memory())?;
    let mut image = read_image(path).map_err(WorkError::input)?;
    // The clamp works in place; the judges copy values outside the range.
    image.data_mut().iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    Ok(image)
}

/// Fails, before an image is decoded, if the image would take more memory than is free.
fn refuse_beyond(path: &Path, pixels: u64, bytes_per_pixel: u64, free: Option<u64>) -> Result<(), WorkError> {
    let need = bytes_per_pixel * pixels;
    match free {
        Some(free) if need > free => Err(WorkError::Input(format!(
            "{}: scoring its {pixels} pixels needs about {} of memory, and {} are free; scale the image \
             down first",
            path.display(),
            bytes(need),
            bytes(free)
        ))),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_larger_than_the_memory_is_refused_by_name() {
        let path = Path::new("panorama.png");
        assert!(refuse_beyond(path, 1 << 20, 30, Some(1 << 30)).is_ok());
        assert!(refuse_beyond(path, 1 << 27, 30, None).is_ok(), "where the system does not say, it is tried");
        let Err(WorkError::Input(message)) = refuse_beyond(path, 1 << 27, 30, Some(1 << 30)) else {
            panic!("4 GB do not fit into 1 GiB");
        };
        assert!(message.contains("panorama.png") && message.contains("4.0 GB"), "{message}");
    }
}
