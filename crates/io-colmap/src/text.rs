//! COLMAP's text files: `#` begins a comment line; one line per camera and point, two lines per image.
//!
//! ```text
//! cameras.txt   CAMERA_ID MODEL WIDTH HEIGHT PARAMS…
//! images.txt    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME
//!               (X Y POINT3D_ID)…                                 may be an empty line
//! points3D.txt  POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_IDX)…
//! ```
//!
//! A name is the rest of its line, so it may contain spaces. Numbers are written in the shortest form that
//! reads back to the same bits.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::Path;
use std::str::{FromStr, SplitAsciiWhitespace};

use use3d_capture::{FileName, shown};

use crate::camera::ModelCamera;
use crate::error::ModelError;
use crate::lens::LensModel;
use crate::{Keypoint, ModelImage, ModelPoint};

type Result<T> = std::result::Result<T, ModelError>;

/// A line with its words.
struct Line<'a> {
    text: &'a str,
    words: SplitAsciiWhitespace<'a>,
    number: usize,
    path: &'a Path,
}

impl Line<'_> {
    /// True if the line is neither empty nor a comment.
    fn has_data(&self) -> bool {
        !self.text.is_empty() && !self.text.starts_with('#')
    }

    fn fail<T>(&self, reason: String) -> Result<T> {
        Err(ModelError::broken(self.path, format!("line {}", self.number), reason))
    }

    fn next<T: FromStr>(&mut self, field: &str) -> Result<T> {
        let Some(word) = self.words.next() else {
            return self.fail(format!("it ends where {field} was expected"));
        };
        self.parse(word, field)
    }

    fn parse<T: FromStr>(&self, word: &str, field: &str) -> Result<T> {
        word.parse().or_else(|_| {
            let start: String = word.chars().take(40).collect();
            self.fail(format!("`{start}` is not a valid {field}", start = shown(&start)))
        })
    }

    fn array<T: FromStr + Copy + Default, const N: usize>(&mut self, field: &str) -> Result<[T; N]> {
        let mut out = [T::default(); N];
        for v in &mut out {
            *v = self.next(field)?;
        }
        Ok(out)
    }
}

/// The lines of a file.
fn lines<'a>(bytes: &'a [u8], path: &'a Path) -> Result<impl Iterator<Item = Line<'a>>> {
    let text = use3d_survey::text(bytes)
        .map_err(|(line, reason)| ModelError::broken(path, format!("line {line}"), reason))?;
    let lines = (1..).zip(text.lines().map(str::trim));
    Ok(lines.map(move |(number, text)| Line { text, words: text.split_ascii_whitespace(), number, path }))
}

/// Parses `cameras.txt`; `path` is for the messages only.
pub fn cameras(bytes: &[u8], path: &Path) -> Result<Vec<ModelCamera>> {
    let mut out = Vec::new();
    for mut line in lines(bytes, path)?.filter(Line::has_data) {
        let id = line.next("camera id")?;
        let name: String = line.next("camera model")?;
        let Some(model) = LensModel::from_name(&name) else {
            let start: String = name.chars().take(40).collect();
            return Err(ModelError::unknown_lens(path, format!("line {}", line.number), &shown(&start), -1));
        };
        let (width, height) = (line.next("width")?, line.next("height")?);
        let parameters: Vec<f64> =
            line.words.clone().map(|w| line.parse(w, "camera parameter")).collect::<Result<_>>()?;
        let (found, expected) = (parameters.len(), model.parameter_count());
        if found != expected {
            return line.fail(format!("{found} parameters; {} has {expected}", model.name()));
        }
        out.push(ModelCamera { id, model, width, height, parameters });
    }
    Ok(out)
}

/// The rest of a line after `count` words.
fn after_words(text: &str, count: usize) -> &str {
    let mut rest = text;
    for _ in 0..count {
        rest = rest.trim_start();
        rest = rest.find(|c: char| c.is_ascii_whitespace()).map_or("", |end| &rest[end..]);
    }
    rest.trim()
}

/// True if a line begins as that of an image: nine numbers, whose rotation is of unit length, and a name. In
/// a line of keypoints the name is a number too.
fn is_image(line: &Line<'_>) -> bool {
    let words: Vec<&str> = line.words.clone().take(10).collect();
    let [_, quaternion @ .., name] = words.as_slice() else { return false };
    let numbers: Vec<f64> = quaternion.iter().take(4).filter_map(|word| word.parse().ok()).collect();
    let length = numbers.iter().map(|v| v * v).sum::<f64>();
    words.len() == 10 && name.parse::<f64>().is_err() && (length - 1.0).abs() < 0.01
}

/// Parses `images.txt`.
pub fn images(bytes: &[u8], path: &Path) -> Result<Vec<ModelImage>> {
    let mut lines = lines(bytes, path)?;
    let (mut out, mut names) = (Vec::new(), BTreeSet::new());
    while let Some(mut line) = lines.find(Line::has_data) {
        let id = line.next("image id")?;
        let quaternion = line.array("quaternion entry")?;
        let translation = line.array("translation entry")?;
        let camera = line.next("camera id")?;
        let name = after_words(line.text, 9);
        if name.is_empty() {
            return line.fail("it ends where the image's name was expected".into());
        }
        let name = FileName::new(name).or_else(|e| line.fail(e.to_string()))?;
        if !names.insert(name.clone()) {
            return line.fail(format!("its name occurs twice ({name}); expected each image once"));
        }
        let mut keypoints = Vec::new();
        if let Some(mut line) = lines.next() {
            if is_image(&line) {
                return line.fail(
                    "it is the next image, and the keypoints of the last one were expected; each image has two \
                     lines, and the second may be empty: put an empty line after each image"
                        .into(),
                );
            }
            while let Some(word) = line.words.next() {
                let x = line.parse(word, "keypoint x")?;
                let y = line.next("keypoint y")?;
                let point: i64 = line.next("point id")?;
                keypoints.push(Keypoint { x, y, point: point as u64 });
            }
        }
        out.push(ModelImage { id, quaternion, translation, camera, name, keypoints });
    }
    Ok(out)
}

/// Parses `points3D.txt`.
pub fn points(bytes: &[u8], path: &Path) -> Result<Vec<ModelPoint>> {
    let mut out = Vec::new();
    for mut line in lines(bytes, path)?.filter(Line::has_data) {
        let id = line.next("point id")?;
        let position = line.array("coordinate")?;
        let color = line.array("colour of 0 to 255")?;
        let error = line.next("error")?;
        let mut track = Vec::new();
        while let Some(word) = line.words.next() {
            let image = line.parse(word, "image id")?;
            track.push((image, line.next("keypoint index")?));
        }
        out.push(ModelPoint { id, position, color, error, track });
    }
    Ok(out)
}

/// Numbers with a space before each.
fn put(w: &mut impl Write, values: &[f64]) -> io::Result<()> {
    values.iter().try_for_each(|v| write!(w, " {v}"))
}

/// Writes `cameras.txt`.
pub fn write_cameras(w: &mut impl Write, cameras: &[ModelCamera]) -> io::Result<()> {
    writeln!(w, "# {} cameras, one per line: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", cameras.len())?;
    for c in cameras {
        write!(w, "{} {} {} {}", c.id, c.model.name(), c.width, c.height)?;
        put(w, &c.parameters)?;
        writeln!(w)?;
    }
    Ok(())
}

/// Writes `images.txt`.
pub fn write_images(w: &mut impl Write, images: &[ModelImage]) -> io::Result<()> {
    writeln!(w, "# {} images, two lines each: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", images.len())?;
    writeln!(w, "# and its keypoints (X Y POINT3D_ID)[], where -1 is no point")?;
    for image in images {
        if image.name != image.name.trim() {
            let message = format!("the image name {:?} cannot be written as text", image.name);
            return Err(io::Error::new(io::ErrorKind::InvalidData, message));
        }
        write!(w, "{}", image.id)?;
        put(w, &image.quaternion)?;
        put(w, &image.translation)?;
        writeln!(w, " {} {}", image.camera, image.name)?;
        for (i, k) in image.keypoints.iter().enumerate() {
            let space = if i == 0 { "" } else { " " };
            write!(w, "{space}{} {} {}", k.x, k.y, k.point as i64)?;
        }
        writeln!(w)?;
    }
    Ok(())
}

/// Writes `points3D.txt`.
pub fn write_points(w: &mut impl Write, points: &[ModelPoint]) -> io::Result<()> {
    let count = points.len();
    writeln!(w, "# {count} points, one per line: POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_IDX)[]")?;
    for p in points {
        write!(w, "{}", p.id)?;
        put(w, &p.position)?;
        let [r, g, b] = p.color;
        write!(w, " {r} {g} {b} {}", p.error)?;
        p.track.iter().try_for_each(|(image, keypoint)| write!(w, " {image} {keypoint}"))?;
        writeln!(w)?;
    }
    Ok(())
}
