//! The inputs: films and photographs, in the order in which they are given.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use use3d_capture::{FileName, masked, natural_order, shown, stem};
use use3d_io_image::{FileFormat, ImageError, image_info, is_cut_off, read_exif};

use crate::error::PrepareError;

/// The record of a preparation, in the capture's folder.
pub const PREPARED: &str = "prepare.json";
/// The pictures that were made of linear photographs, in the folder of the work.
pub(crate) const BALANCED: &str = "balanced";

const FILMS: [&str; 16] = [
    "mp4", "mov", "avi", "mkv", "webm", "m4v", "mts", "m2ts", "ts", "m2t", "mpg", "mpeg", "wmv", "3gp",
    "lrv", "insv",
];
const PHOTOGRAPHS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];
const CONVERTED: [&str; 1] = ["webp"];
const REFUSED: [&str; 13] =
    ["heic", "heif", "avif", "dng", "arw", "cr2", "cr3", "nef", "raf", "orf", "rw2", "gpr", "exr"];
/// Folders of a capture that hold other images of the same names.
const OTHERS: [&str; 9] =
    ["masks", "Masks", "mask", "Mask", "depth", "depths", "depthAnythingV2_u16", "truth", "sparse"];
/// Image folders of a capture.
const IMAGES: [&str; 4] = ["images", "images_wb", "Images_wb", "input"];
/// Files and folders that are copied beside the images of a capture without a model.
pub(crate) const BESIDE: [&str; 9] = [
    "masks",
    "Masks",
    "mask",
    "Mask",
    "depth",
    "depths",
    "depthAnythingV2_u16",
    "train_list.txt",
    "test_list.txt",
];
/// The file in every result of this program, and the formats that its first bytes name.
const RECORD: &str = "manifest.json";
const RECORD_FORMATS: [&str; 2] = ["\"use3d artifact\"", "\"use3d result\""];
/// The file in every folder that a program can make again.
const CACHE_TAG: &str = "CACHEDIR.TAG";

fn has(path: &Path, extensions: &[&str]) -> bool {
    path.extension().is_some_and(|e| extensions.iter().any(|known| e.eq_ignore_ascii_case(known)))
}

/// The recording and the chapter that a GoPro's name of a film has: `GX020001` is the second chapter of
/// recording 1, and so is `GP010001` of an older camera, which calls the first one `GOPR0001`.
fn chapter(name: &str) -> Option<(u32, u32)> {
    let name = name.to_ascii_uppercase();
    let number = |text: &str| text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse().ok()).flatten();
    if let Some(recording) = name.strip_prefix("GOPR") {
        return Some((number(recording.get(..4)?)?, 0));
    }
    let rest = ["GX", "GH", "GL", "GS", "GP"].iter().find_map(|camera| name.strip_prefix(camera))?;
    Some((number(rest.get(2..6)?)?, number(rest.get(..2)?)?))
}

/// The order in which a folder's files were shot: by folder, a GoPro's films by recording and then by
/// chapter, all others by name with numbers as numbers.
fn shot_order(a: &Path, b: &Path) -> Ordering {
    let folder = |path: &Path| path.parent().unwrap_or(Path::new("")).to_path_buf();
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let (left, right) = (name(a), name(b));
    let by_name = || natural_order(&left, &right);
    let chapters = (chapter(&left).filter(|_| is_film(a)), chapter(&right).filter(|_| is_film(b)));
    folder(a).cmp(&folder(b)).then_with(|| match chapters {
        (Some(left), Some(right)) => left.cmp(&right).then_with(by_name),
        _ => by_name(),
    })
}

/// The masks, depth maps and lists that are in a folder, with their names.
fn beside(folder: &Path) -> impl Iterator<Item = (String, PathBuf)> {
    let all = BESIDE.iter().map(|name| (name.to_string(), folder.join(name)));
    all.filter(|(_, path)| path.exists())
}

/// True if a file's first bytes are those of an image.
fn is_image(path: &Path) -> bool {
    image_info(path).is_ok()
}

/// True if a file's name ends like a film's.
pub fn is_film(path: &Path) -> bool {
    has(path, &FILMS)
}

/// True if a file's name ends like a photograph's, also one that must be converted first.
pub fn is_photograph(path: &Path) -> bool {
    has(path, &PHOTOGRAPHS) || has(path, &CONVERTED) || has(path, &REFUSED)
}

/// True for the small copy of a film that a camera stores beside it.
fn is_proxy(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    has(path, &["lrv"]) || has(path, &["insv"]) && name.starts_with("LRV_")
}

/// True if a program made a folder: a prepared capture, a result of this program, or a cache.
fn is_made(folder: &Path) -> bool {
    // Other programs also write a file of the record's name, so its first bytes are checked.
    let recorded = || {
        let mut head = Vec::new();
        let read = File::open(folder.join(RECORD)).and_then(|file| file.take(4096).read_to_end(&mut head));
        let text = String::from_utf8_lossy(&head);
        read.is_ok() && RECORD_FORMATS.iter().any(|format| text.contains(format))
    };
    [PREPARED, CACHE_TAG].iter().any(|name| folder.join(name).is_file()) || recorded()
}

/// The films and photographs in a folder, to this depth of folders. Results of this program, and folders of a
/// capture that hold other images of the same names, are left out.
pub(crate) fn walk(root: &Path, depth: usize) -> impl Iterator<Item = Result<PathBuf, PrepareError>> {
    all_files(root, depth).filter(|file| file.as_ref().map_or(true, |path| is_input(path)))
}

/// True if a file's name ends like a film's or a photograph's, and it is no small copy that a camera stores
/// beside a film.
pub fn is_input(path: &Path) -> bool {
    !is_proxy(path) && (is_film(path) || is_photograph(path))
}

/// The files in a folder, without hidden ones and those of a capture or of this program.
fn all_files(root: &Path, depth: usize) -> impl Iterator<Item = Result<PathBuf, PrepareError>> {
    let visible = |entry: &walkdir::DirEntry| {
        let name = entry.file_name().to_string_lossy();
        let folder = entry.file_type().is_dir();
        entry.depth() == 0
            || !(name.starts_with('.') || folder && (OTHERS.contains(&&*name) || is_made(entry.path())))
    };
    let entries = walkdir::WalkDir::new(root).max_depth(depth).follow_links(true);
    entries.into_iter().filter_entry(visible).filter_map(move |entry| match entry {
        Ok(entry) => entry.path().is_file().then(|| Ok(entry.into_path())),
        Err(e) => Some(Err(PrepareError::walk(root, &e))),
    })
}

/// True if a folder, or a folder in it, has films or photographs.
pub fn holds_inputs(folder: &Path) -> bool {
    walk(folder, 2).any(|found| found.is_ok())
}

const CUT_OFF: &str = "it cannot be read, because the file is cut off; copy it again, or remove it";

/// True if a photograph's file is damaged, or of another format than its name says.
fn is_damage(error: &PrepareError) -> bool {
    match error {
        PrepareError::Image(error) => !matches!(error, ImageError::Open { .. }),
        PrepareError::Input { reason, .. } => reason == CUT_OFF,
        _ => false,
    }
}

/// A photograph.
#[derive(Clone, Debug)]
pub(crate) struct SourcePhotograph {
    pub(crate) path: PathBuf,
    /// Its name in the image folder.
    pub(crate) name: FileName,
    /// True if ffmpeg must convert it.
    pub(crate) converted: bool,
    /// Photographs with the same value were taken by one camera with one lens.
    pub(crate) camera: String,
    /// The EXIF orientation.
    pub(crate) orientation: u16,
}

/// The inputs of a preparation.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    pub(crate) films: Vec<PathBuf>,
    pub(crate) photographs: Vec<SourcePhotograph>,
    /// A folder with masks, depth maps or lists beside its photographs.
    pub(crate) capture: Option<PathBuf>,
    /// Further folders and files whose content counts, with their names in the record.
    others: Vec<(String, PathBuf)>,
    /// Sentences on photographs in folders that are left out, because their files are damaged.
    damaged: Vec<String>,
    /// Files in folders that are neither films nor photographs: their number by extension.
    unused: BTreeMap<String, usize>,
    /// Masks that lie among the photographs, with their names in the capture.
    pub(crate) masks: Vec<(String, PathBuf)>,
    /// Masks, depth maps and lists beside the photographs of several inputs, which are not copied.
    left: BTreeSet<PathBuf>,
    /// True for linear photographs, which are balanced and encoded before they are used.
    pub linear: bool,
}

impl Sources {
    /// Sorts the inputs. Only the heads and the ends of photographs are read.
    ///
    /// # Errors
    /// Returns the first input that is missing or not usable.
    pub fn of(inputs: &[PathBuf]) -> Result<Self, PrepareError> {
        let mut sources = Self::default();
        let several = inputs.len() > 1;
        for input in inputs {
            if input.is_dir() {
                sources.folder(input, several)?;
            } else if !input.is_file() {
                return Err(PrepareError::input(input, "there is no such file or folder"));
            } else if is_film(input) || !(is_photograph(input) || is_image(input)) {
                // What ffmpeg reads is a film, however it is called.
                sources.films.push(input.clone());
            } else {
                let name = input.file_name().unwrap_or_default().to_string_lossy().into_owned();
                sources.photograph(input, &name)?;
                sources.left.extend(beside(input.parent().unwrap_or(Path::new(""))).map(|(_, path)| path));
            }
        }
        sources.photographs.sort_by(|a, b| natural_order(&a.name, &b.name));
        if let Some(pair) = sources.photographs.windows(2).find(|pair| pair[0].name == pair[1].name) {
            let reason = format!(
                "another photograph has the same name ({}); give the folder above both, so that their folders \
                 distinguish them",
                pair[0].path.display()
            );
            return Err(PrepareError::input(&pair[1].path, reason));
        }
        Ok(sources)
    }

    fn folder(&mut self, folder: &Path, several: bool) -> Result<(), PrepareError> {
        let inner = IMAGES.iter().map(|name| folder.join(name)).find(|path| path.is_dir());
        if several {
            // Two inputs can have masks of the same names.
            self.left.extend(beside(folder).map(|(_, path)| path));
        } else {
            self.add_beside(folder);
        }
        let root = inner.unwrap_or_else(|| folder.to_path_buf());
        let own = folder.file_name().map(|n| n.to_string_lossy().into_owned());
        let prefix = own.filter(|_| several).map(|name| name + "/").unwrap_or_default();
        let all = all_files(&root, usize::MAX).collect::<Result<Vec<PathBuf>, PrepareError>>()?;
        let (mut found, unused): (Vec<_>, Vec<_>) = all.into_iter().partition(|file| is_input(file));
        for file in unused {
            let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let kind = file.extension().map(|e| format!(".{}", e.to_string_lossy().to_lowercase()));
            if !BESIDE.contains(&&*name) {
                *self.unused.entry(kind.unwrap_or(name)).or_default() += 1;
            }
        }
        // Cameras can store a raw or HEIC file and a JPEG of the same photograph.
        let readable = |path: &&PathBuf| has(path, &PHOTOGRAPHS) || has(path, &CONVERTED);
        let readable: BTreeSet<PathBuf> =
            found.iter().filter(readable).map(|path| path.with_extension("")).collect();
        found.retain(|path| !(has(path, &REFUSED) && readable.contains(&path.with_extension(""))));
        if found.is_empty() {
            return Err(PrepareError::input(folder, "there are no films or photographs in this folder"));
        }
        found.sort_by(|a, b| shot_order(a, b));
        let name = |path: &Path| {
            let relative = path.strip_prefix(&root).unwrap_or(path).to_string_lossy().replace('\\', "/");
            format!("{prefix}{relative}")
        };
        let names: BTreeSet<String> =
            found.iter().map(|path| name(path)).flat_map(|n| [stem(&n).to_string(), n]).collect();
        let is_mask = |path: &PathBuf| masked(&name(path)).is_some_and(|of| names.contains(of));
        let (masks, found): (Vec<_>, Vec<_>) = found.into_iter().partition(is_mask);
        self.masks.extend(masks.into_iter().map(|path| (format!("masks/{}", name(&path)), path)));
        let mut damaged = Vec::new();
        for path in found {
            if is_film(&path) {
                self.films.push(path);
                continue;
            }
            match self.photograph(&path, &name(&path)) {
                Err(error) if is_damage(&error) => damaged.push(error),
                taken => taken?,
            }
        }
        self.damaged.extend(damaged.iter().map(ToString::to_string));
        if self.count() == 0 && !damaged.is_empty() {
            return Err(damaged.swap_remove(0));
        }
        Ok(())
    }

    fn photograph(&mut self, path: &Path, name: &str) -> Result<(), PrepareError> {
        if has(path, &REFUSED) {
            let reason = "this format is not read; convert it to JPEG or PNG first (HEIC: `heif-convert -q 95 IN.heic \
                 OUT.jpg`, raw: your raw developer, with one white balance for all)";
            return Err(PrepareError::input(path, reason));
        }
        let converted = has(path, &CONVERTED);
        let named =
            if converted { format!("{}.png", use3d_capture::name::stem(name)) } else { name.to_string() };
        let bad = |e: use3d_capture::NameError| PrepareError::input(path, format!("its name {e}; rename it"));
        let name = FileName::new(&named).map_err(bad)?;
        let (mut camera, mut orientation) = ("converted".to_string(), 1);
        if !converted {
            let info = image_info(path)?;
            let mut taken = (String::new(), String::new(), 0);
            if info.format == FileFormat::Jpeg {
                let found = read_exif(path).map_err(PrepareError::read(path))?;
                (orientation, taken) = (found.orientation, found.camera);
            } else if !matches!(info.format, FileFormat::Png | FileFormat::Tiff) {
                return Err(PrepareError::input(path, "expected a JPEG, PNG or TIFF"));
            }
            if is_cut_off(path, info.format).map_err(PrepareError::read(path))? {
                return Err(PrepareError::input(path, CUT_OFF));
            }
            camera = format!("{}x{} {} {} {}", info.width, info.height, taken.0, taken.1, taken.2);
        }
        self.photographs.push(SourcePhotograph {
            path: path.to_path_buf(),
            name,
            converted,
            camera,
            orientation,
        });
        Ok(())
    }

    /// True if there are films.
    pub fn has_films(&self) -> bool {
        !self.films.is_empty()
    }

    /// True if masks come with the photographs.
    pub(crate) fn has_masks(&self) -> bool {
        let folder =
            |origin: &PathBuf| beside(origin).any(|(name, _)| name.to_lowercase().starts_with("mask"));
        !self.masks.is_empty() || self.capture.as_ref().is_some_and(folder)
    }

    /// Adds the masks, depth maps and lists in a folder. They come along, and their content counts.
    fn add_beside(&mut self, folder: &Path) {
        self.capture = Some(folder.to_path_buf());
        self.others.extend(beside(folder));
    }

    /// A remark on the photographs that are left out.
    pub(crate) fn left_out(&self) -> Vec<String> {
        let damaged = (!self.damaged.is_empty()).then(|| {
            let all = shown(&self.damaged.join("; ")).into_owned();
            format!("{} photographs are left out: {all}", self.damaged.len())
        });
        let kinds: Vec<String> =
            self.unused.iter().map(|(kind, count)| format!("{count} {}", shown(kind))).collect();
        let unused = (!kinds.is_empty()).then(|| {
            format!(
                "these files are not used, because they are neither films nor photographs: {}",
                kinds.join(", ")
            )
        });
        damaged.into_iter().chain(unused).collect()
    }

    /// A remark on the masks, depth maps and lists that are not copied.
    pub(crate) fn remark(&self) -> Option<String> {
        let left: Vec<String> =
            self.left.iter().map(|path| shown(&path.to_string_lossy()).into_owned()).collect();
        (!left.is_empty()).then(|| {
            format!(
                "not copied: {}. Masks, depth maps and lists are only taken from a folder that is the single input; put \
                 the photographs into one folder, with masks/ and the like in it, and give that folder",
                left.join(", ")
            )
        })
    }

    /// The same inputs with the photographs that [`balance`](crate::balance) made of these in a folder of the
    /// work.
    ///
    /// # Errors
    /// The error of [`of`](Self::of).
    pub fn made_in(&self, folder: &Path) -> Result<Self, PrepareError> {
        let made = Self::of(&[folder.join(BALANCED)])?;
        let (capture, masks, damaged) = (self.capture.clone(), self.masks.clone(), self.damaged.clone());
        Ok(Self { capture, masks, damaged, linear: self.linear, ..made })
    }

    /// Adds a folder or a file whose content counts.
    pub fn add(&mut self, name: &str, path: &Path) {
        self.others.push((name.into(), path.to_path_buf()));
    }

    /// The number of films and photographs.
    pub(crate) fn count(&self) -> usize {
        self.films.len() + self.photographs.len()
    }

    /// The files whose content is the input, with their names in the record: films and photographs come
    /// first.
    ///
    /// # Errors
    /// A folder cannot be read.
    pub(crate) fn files(&self) -> Result<Vec<(String, PathBuf)>, PrepareError> {
        let film = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            (name, path.clone())
        };
        let photographs = self.photographs.iter().map(|p| (p.name.to_string(), p.path.clone()));
        let mut files: Vec<(String, PathBuf)> = self.films.iter().map(film).chain(photographs).collect();
        for (name, path) in self.others.iter().chain(&self.masks) {
            for entry in walkdir::WalkDir::new(path).follow_links(true).sort_by_file_name() {
                let entry = entry.map_err(|e| PrepareError::walk(path, &e))?;
                if entry.file_type().is_file() {
                    let relative = entry.path().strip_prefix(path).unwrap_or(entry.path());
                    let relative = Path::new(name).join(relative).to_string_lossy().replace('\\', "/");
                    files.push((relative.trim_end_matches('/').into(), entry.into_path()));
                }
            }
        }
        Ok(files)
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::Raster;

    use super::*;

    /// A folder with these files: photographs are written, and other files hold the text beside the name.
    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            if has(&path, &["png"]) {
                use3d_io_image::write_png8(&path, &Raster::<u8, 3>::filled(8, 6, 90)).unwrap();
            } else {
                std::fs::write(&path, text).unwrap();
            }
        }
        dir
    }

    fn names(sources: &Sources) -> Vec<String> {
        sources.files().unwrap().into_iter().map(|(name, _)| name).collect()
    }

    #[test]
    fn results_of_this_program_and_hidden_folders_hold_no_photographs() {
        let dir = folder(&[
            ("a.png", ""),
            ("left/b.png", ""),
            ("other/manifest.json", "{\"name\": \"a web page\"}"),
            ("other/c.png", ""),
            ("use3d-out/captures/reef/prepare.json", "{}"),
            ("use3d-out/captures/reef/images/a.png", ""),
            ("use3d-out/reef/evaluate/manifest.json", "{\n  \"format\": \"use3d result\",\n"),
            ("use3d-out/reef/evaluate/views/a.png", ""),
            ("use3d-out/reef/import/manifest.json", "{\"format\":\"use3d artifact\","),
            ("use3d-out/reef/import/images/a.png", ""),
            ("cache/CACHEDIR.TAG", "Signature: 8a477f597d28d172789f06886806bc55"),
            ("cache/00/a.png", ""),
            (".reef.preparing/capture/images/a.png", ""),
        ]);
        let root = dir.path().to_path_buf();
        assert_eq!(names(&Sources::of(&[root]).unwrap()), ["a.png", "left/b.png", "other/c.png"]);
        // A prepared capture that is named itself is taken.
        let capture = dir.path().join("use3d-out/captures/reef");
        assert_eq!(names(&Sources::of(&[capture]).unwrap()), ["a.png"]);
    }

    #[test]
    fn masks_and_models_that_are_copied_count_as_inputs() {
        let dir = folder(&[("images/a.png", ""), ("masks/left/a.png", ""), ("train_list.txt", "a.png")]);
        let mut sources = Sources::of(&[dir.path().to_path_buf()]).unwrap();
        sources.add("sparse/0", &dir.path().join("masks"));
        assert_eq!(names(&sources), ["a.png", "masks/left/a.png", "train_list.txt", "sparse/0/left/a.png"]);
        assert_eq!(sources.count(), 1);
        assert_eq!(sources.remark(), None);
    }

    #[test]
    fn masks_count_where_photographs_lie_directly_in_the_folder_and_are_named_where_they_are_left() {
        let dir = folder(&[
            ("dive/a.png", ""),
            ("dive/masks/a.png", ""),
            ("dive/test_list.txt", "a.png"),
            ("more/b.png", ""),
            ("more/masks/b.png", ""),
        ]);
        let [dive, more] = ["dive", "more"].map(|name| dir.path().join(name));
        let one = Sources::of(std::slice::from_ref(&dive)).unwrap();
        assert_eq!(names(&one), ["a.png", "masks/a.png", "test_list.txt"]);
        assert_eq!((one.capture.as_ref(), one.remark()), (Some(&dive), None));
        // Two folders, and files by their names, as a shell expands `dive/*`.
        for inputs in [[dive.clone(), more.clone()], [dive.join("a.png"), more.join("b.png")]] {
            let sources = Sources::of(&inputs).unwrap();
            assert_eq!((names(&sources).len(), sources.capture.as_ref()), (2, None));
            let said = sources.remark().unwrap();
            for left in
                ["masks", "test_list.txt"].map(|name| dive.join(name)).iter().chain([&more.join("masks")])
            {
                assert!(said.contains(&left.display().to_string()), "{said}");
            }
        }
    }

    /// The bytes behind a base64 text.
    fn base64(text: &str) -> Vec<u8> {
        const DIGITS: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        let (mut bits, mut count, mut bytes) = (0u32, 0, Vec::new());
        for digit in text.bytes().filter_map(|b| DIGITS.iter().position(|d| *d == b)) {
            (bits, count) = (bits << 6 | digit as u32, count + 6);
            if count >= 8 {
                count -= 8;
                bytes.push((bits >> count) as u8);
            }
        }
        bytes
    }

    #[test]
    fn masks_beside_photographs_are_masks_and_a_damaged_photograph_is_left_out() {
        let dir = folder(&[
            ("a.png", ""),
            ("a_mask.png", ""),
            ("b.png", ""),
            ("b.png.mask.png", ""),
            ("c_mask.png", ""),
            ("empty.jpg", ""),
        ]);
        let found = Sources::of(&[dir.path().to_path_buf()]).unwrap();
        let expected = ["a.png", "b.png", "c_mask.png", "masks/a_mask.png", "masks/b.png.mask.png"];
        assert_eq!(names(&found), expected);
        let said = found.left_out().join(" ");
        assert!(said.contains("empty.jpg") && said.contains("left out"), "{said}");
    }

    #[test]
    fn photographs_that_are_cut_off_are_refused_and_data_after_the_end_is_allowed() {
        let dir = tempfile::tempdir().unwrap();
        let mut image = Raster::<u8, 3>::filled(40, 30, 90);
        image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = (i * 7919 % 251) as u8);
        let png = dir.path().join("b.png");
        use3d_io_image::write_png8(&png, &image).unwrap();
        let address = use3d_io_image::jpeg_address(&image, 90).unwrap();
        let jpeg = base64(address.rsplit(',').next().unwrap());
        for (name, bytes) in [("b.png", std::fs::read(&png).unwrap()), ("b.jpg", jpeg)] {
            let (root, path) = (dir.path().join(name.replace('.', "-")), dir.path().join(name));
            std::fs::create_dir(&root).unwrap();
            let path = root.join(path.file_name().unwrap());
            let said = |bytes: &[u8]| {
                std::fs::write(&path, bytes).unwrap();
                Sources::of(std::slice::from_ref(&root)).map(|_| ()).map_err(|e| e.to_string())
            };
            assert_eq!(said(&bytes), Ok(()), "{name}");
            assert_eq!(said(&[bytes.clone(), vec![0; 40_000]].concat()), Ok(()), "{name}");
            let cut = said(&bytes[..bytes.len() * 3 / 4]).unwrap_err();
            for part in [name, "the file is cut off", "copy it again, or remove it"] {
                assert!(cut.contains(part), "{cut} lacks {part}");
            }
        }
    }

    #[test]
    fn a_folder_holds_inputs_at_its_top_or_one_folder_below() {
        for (file, expected) in [
            ("a.webp", true),
            ("left/a.MTS", true),
            ("images/a.jpg", true),
            ("one/two/a.jpg", false),
            ("notes.txt", false),
            (".hidden/a.jpg", false),
            ("masks/a.jpg", false),
        ] {
            assert_eq!(holds_inputs(folder(&[(file, "x")]).path()), expected, "{file}");
        }
    }

    #[test]
    fn folders_that_cannot_be_walked_are_named_with_the_reason() {
        let root = Path::new("/nowhere/dive");
        let missing = walkdir::WalkDir::new(root).into_iter().next().unwrap().unwrap_err();
        let said = PrepareError::walk(root, &missing).to_string();
        assert!(said.starts_with("/nowhere/dive: cannot be read ("), "{said}");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let dir = folder(&[("a.png", ""), ("left/b.png", "")]);
            let left = dir.path().join("left");
            let rights =
                |mode| std::fs::set_permissions(&left, std::fs::Permissions::from_mode(mode)).unwrap();
            rights(0o000);
            // The system's administrator may read every folder.
            let free = std::fs::read_dir(&left).is_ok();
            let found = Sources::of(&[dir.path().to_path_buf()]);
            rights(0o755);
            if !free {
                let expected = format!("{}: you have no right to read this folder;", left.display());
                assert!(found.unwrap_err().to_string().starts_with(&expected));
            }
        }
    }

    #[test]
    fn files_of_other_kinds_are_counted_and_any_other_file_may_be_a_film() {
        let dir = folder(&[
            ("dive/a.png", ""),
            ("dive/b.png", ""),
            ("dive/GX010001.LRV", ""),
            ("dive/GX010001.THM", ""),
            ("dive/GX020001.THM", ""),
            ("dive/README", ""),
            ("dive/.hidden", ""),
            ("dive/test_list.txt", "a.png"),
            ("recording.dat", "film"),
        ]);
        let sources = Sources::of(&[dir.path().join("dive")]).unwrap();
        let expected = "these files are not used, because they are neither films nor photographs: 1 .lrv, 2 .thm, 1 README";
        assert_eq!(sources.left_out(), [expected]);
        assert!(Sources::of(&[dir.path().join("recording.dat")]).unwrap().has_films());
    }

    #[test]
    fn film_chapters() {
        let order = |names: &[&str]| {
            let mut paths: Vec<PathBuf> = names.iter().map(|name| Path::new("100GOPRO").join(name)).collect();
            paths.sort_by(|a, b| shot_order(a, b));
            let name = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
            paths.iter().map(name).collect::<Vec<_>>()
        };
        let newer = ["GX010001.MP4", "GX020001.MP4", "GX010002.MP4", "gx020002.mp4"];
        assert_eq!(order(&["GX010001.MP4", "GX010002.MP4", "GX020001.MP4", "gx020002.mp4"]), newer);
        let older = ["GOPR0007.MP4", "GP010007.MP4", "GP020007.MP4", "GOPR0008.MP4"];
        assert_eq!(order(&["GOPR0007.MP4", "GOPR0008.MP4", "GP010007.MP4", "GP020007.MP4"]), older);
        assert_eq!(order(&["dive10.mp4", "dive9.mp4", "GPS.mp4"]), ["GPS.mp4", "dive9.mp4", "dive10.mp4"]);
        assert_eq!(chapter("GX0100.MP4"), None);
    }

    #[test]
    fn second_files_of_one_photograph_or_film_are_left_out() {
        let dir = folder(&[
            ("a.png", ""),
            ("a.DNG", "raw"),
            ("a.heic", "heic"),
            ("GX010001.MP4", "film"),
            ("GL010001.LRV", "film"),
            ("VID_1.insv", "film"),
            ("LRV_1.insv", "film"),
        ]);
        let root = dir.path().to_path_buf();
        let found = Sources::of(std::slice::from_ref(&root)).unwrap();
        assert_eq!(names(&found), ["GX010001.MP4", "VID_1.insv", "a.png"]);
        // One that is named itself is taken.
        assert!(Sources::of(&[root.join("GL010001.LRV")]).unwrap().has_films());
        // A raw file alone is refused with the remedy.
        std::fs::write(root.join("b.dng"), "raw").unwrap();
        let refused = Sources::of(&[root]).unwrap_err().to_string();
        assert!(refused.contains("b.dng") && refused.contains("convert it"), "{refused}");
    }
}
