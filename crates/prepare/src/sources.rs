//! The inputs: films and photographs, in the order in which they are given.

use std::path::{Path, PathBuf};

use use3d_capture::FileName;
use use3d_io_image::{FileFormat, image_info, read_exif};

use crate::error::PrepareError;

const FILMS: [&str; 14] =
    ["mp4", "mov", "avi", "mkv", "webm", "m4v", "mts", "m2ts", "mpg", "mpeg", "wmv", "3gp", "lrv", "insv"];
const PHOTOGRAPHS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];
const CONVERTED: [&str; 1] = ["webp"];
const REFUSED: [&str; 13] =
    ["heic", "heif", "avif", "dng", "arw", "cr2", "cr3", "nef", "raf", "orf", "rw2", "gpr", "exr"];
/// Folders of a capture that hold other images of the same names.
const OTHERS: [&str; 6] = ["masks", "depth", "depths", "depthAnythingV2_u16", "truth", "sparse"];
/// Image folders of a capture.
const IMAGES: [&str; 4] = ["images", "images_wb", "Images_wb", "input"];
/// Files and folders that are copied beside the images of a capture without a model.
pub(crate) const BESIDE: [&str; 6] =
    ["masks", "depth", "depths", "depthAnythingV2_u16", "train_list.txt", "test_list.txt"];

fn has(path: &Path, extensions: &[&str]) -> bool {
    path.extension().is_some_and(|e| extensions.iter().any(|known| e.eq_ignore_ascii_case(known)))
}

/// True if a file's name ends like a film's.
pub fn is_film(path: &Path) -> bool {
    has(path, &FILMS)
}

/// True if a file's name ends like a photograph's, also one that must be converted first.
pub fn is_photograph(path: &Path) -> bool {
    has(path, &PHOTOGRAPHS) || has(path, &CONVERTED) || has(path, &REFUSED)
}

/// A photograph.
#[derive(Clone, Debug)]
pub(crate) struct Photograph {
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
    pub(crate) photographs: Vec<Photograph>,
    /// A folder with masks, depth maps or lists beside its photographs.
    pub(crate) capture: Option<PathBuf>,
}

impl Sources {
    /// Sorts the inputs. Only the heads of photographs are read.
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
            } else if is_film(input) {
                sources.films.push(input.clone());
            } else {
                let name = input.file_name().unwrap_or_default().to_string_lossy().into_owned();
                sources.photograph(input, &name)?;
            }
        }
        sources.photographs.sort_by(|a, b| a.name.cmp(&b.name));
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
        if inner.is_some() && !several {
            self.capture = Some(folder.to_path_buf());
        }
        let root = inner.unwrap_or_else(|| folder.to_path_buf());
        let own = folder.file_name().map(|n| n.to_string_lossy().into_owned());
        let prefix = own.filter(|_| several).map(|name| name + "/").unwrap_or_default();
        let visible = |entry: &walkdir::DirEntry| {
            let name = entry.file_name().to_string_lossy();
            entry.depth() == 0
                || !(name.starts_with('.') || OTHERS.contains(&&*name) && entry.file_type().is_dir())
        };
        let (mut count, mut names) = (0, Vec::new());
        for entry in walkdir::WalkDir::new(&root).follow_links(true).into_iter().filter_entry(visible) {
            let entry = entry.map_err(|e| PrepareError::input(&root, e.to_string()))?;
            let path = entry.path();
            if !path.is_file() || !(is_film(path) || is_photograph(path)) {
                continue;
            }
            count += 1;
            if is_film(path) {
                names.push(path.to_path_buf());
                continue;
            }
            let relative = path.strip_prefix(&root).unwrap_or(path).to_string_lossy().replace('\\', "/");
            self.photograph(path, &format!("{prefix}{relative}"))?;
        }
        names.sort();
        self.films.append(&mut names);
        if count == 0 {
            return Err(PrepareError::input(folder, "there are no films or photographs in this folder"));
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
        let mut photograph = Photograph {
            path: path.to_path_buf(),
            name,
            converted,
            camera: "converted".into(),
            orientation: 1,
        };
        if !converted {
            let info = image_info(path)?;
            let size = (info.width, info.height);
            let mut taken = (String::new(), String::new(), 0);
            if info.format == FileFormat::Jpeg {
                let found = read_exif(path).map_err(PrepareError::file(path))?;
                (photograph.orientation, taken) = (found.orientation, found.camera);
            } else if !matches!(info.format, FileFormat::Png | FileFormat::Tiff) {
                return Err(PrepareError::input(path, "expected a JPEG, PNG or TIFF"));
            }
            photograph.camera = format!("{}x{} {} {} {}", size.0, size.1, taken.0, taken.1, taken.2);
        }
        self.photographs.push(photograph);
        Ok(())
    }

    /// True if there are films.
    pub fn has_films(&self) -> bool {
        !self.films.is_empty()
    }

    /// The files whose content is the input, with their names in the record.
    pub(crate) fn files(&self) -> Vec<(String, PathBuf)> {
        let film = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            (name, path.clone())
        };
        let photographs = self.photographs.iter().map(|p| (p.name.to_string(), p.path.clone()));
        self.films.iter().map(film).chain(photographs).collect()
    }
}
