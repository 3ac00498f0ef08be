//! Folders of a capture: their usual names, and the lookup of files by names that never leave the folder.

use std::fs::{DirEntry, FileType};
use std::path::{Component, Path, PathBuf};

use use3d_capture::{FileName, NameError};
use use3d_survey::first_bytes;

use crate::error::ImportError;

/// Image folders, tried in this order.
pub(crate) const IMAGE_DIRS: [&str; 4] = ["images", "images_wb", "Images_wb", "input"];
/// Depth-prior folders, tried in this order.
pub(crate) const DEPTH_DIRS: [&str; 3] = ["depth", "depths", "depthAnythingV2_u16"];
/// Mask folders, tried in this order.
pub(crate) const MASK_DIRS: [&str; 2] = ["masks", "mask"];

/// Extensions of images. Names are compared without case.
pub(crate) const IMAGE_EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "tif", "tiff", "exr"];
/// Extensions of films. `use3d_prepare` has the same list, because neither crate uses the other.
const FILM_EXTENSIONS: [&str; 14] =
    ["mp4", "mov", "avi", "mkv", "webm", "m4v", "mts", "m2ts", "mpg", "mpeg", "wmv", "3gp", "lrv", "insv"];
const MASK_EXTENSIONS: [&str; 7] = ["png", "jpg", "jpeg", "tif", "tiff", "npy", "exr"];
const DEPTH_EXTENSIONS: [&str; 5] = ["png", "npy", "tif", "tiff", "exr"];

/// The extensions of masks, in small and in large letters.
fn mask_extensions() -> impl Iterator<Item = String> {
    MASK_EXTENSIONS.iter().map(|e| e.to_string()).chain(MASK_EXTENSIONS.iter().map(|e| e.to_uppercase()))
}

/// The manifest's name.
pub(crate) const MANIFEST: &str = "capture.json";
/// The format that the manifest names.
pub(crate) const FORMAT: &str = "3d-use capture";

/// True if [`crate::prepare`] finished this folder.
pub fn is_prepared(dir: &Path) -> bool {
    // Another tool may write a file of that name, so its first bytes are checked.
    let head = first_bytes(&dir.join(MANIFEST), 200);
    head.is_some_and(|head| String::from_utf8_lossy(&head).contains(FORMAT))
}

/// False for a folder of a capture that holds other images of the same names: masks, depth priors, the truth
/// of a synthetic capture, and captures that an import wrote.
pub(crate) fn may_hold_photographs(dir: &Path, name: &str) -> bool {
    let is_one_of = |names: &[&str]| names.iter().any(|other| other.eq_ignore_ascii_case(name));
    let other = is_one_of(&MASK_DIRS) || is_one_of(&DEPTH_DIRS) || name == "truth";
    !other && !is_prepared(&dir.join(name))
}

/// True if a file's name ends like a film's.
pub fn is_film(path: &Path) -> bool {
    path.to_str().is_some_and(|name| has_extension(name, &FILM_EXTENSIONS))
}

/// The last part of a name with `/` between its parts.
pub(crate) fn last_part(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// True if a name has one of these extensions, in small or large letters.
pub(crate) fn has_extension(name: &str, extensions: &[&str]) -> bool {
    let own = Path::new(name).extension();
    own.is_some_and(|own| extensions.iter().any(|known| own.eq_ignore_ascii_case(known)))
}

/// A word with a capital first letter.
fn capitalised(word: &str) -> String {
    let mut letters = word.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

/// True if one of the names has one of these extensions.
pub(crate) fn any_has(names: &[String], extensions: &[&str]) -> bool {
    names.iter().any(|name| has_extension(name, extensions))
}

/// Names of the entries of a folder that are of a kind, such as `FileType::is_dir`; a link is what it leads
/// to.
pub(crate) fn names_in(dir: &Path, kind: impl Fn(&FileType) -> bool) -> Vec<String> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().filter_map(Result::ok);
    // Only a link is looked up.
    let of = |entry: &DirEntry| match entry.file_type().ok()? {
        link if link.is_symlink() => Some(std::fs::metadata(entry.path()).ok()?.file_type()),
        kind => Some(kind),
    };
    let chosen = entries.filter(|entry| of(entry).is_some_and(|found| kind(&found)));
    chosen.filter_map(|entry| entry.file_name().into_string().ok()).collect()
}

/// The visible files below a folder, to this depth of folders, sorted, with their names relative to it.
pub(crate) fn visible_files(dir: &Path, depth: usize) -> impl Iterator<Item = (String, PathBuf)> {
    let hidden = |e: &walkdir::DirEntry| e.depth() > 0 && e.file_name().to_string_lossy().starts_with('.');
    let dir = dir.to_path_buf();
    let entries = walkdir::WalkDir::new(&dir).max_depth(depth).sort_by_file_name().into_iter();
    entries.filter_entry(move |e| !hidden(e)).filter_map(move |entry| {
        let entry = entry.ok().filter(|e| !e.file_type().is_dir())?;
        let name = entry.path().strip_prefix(&dir).ok()?.to_str()?.to_string();
        Some((name, entry.into_path()))
    })
}

/// Names of the folders in a folder: numbers first and by value, then the rest by name.
pub(crate) fn subfolders(dir: &Path) -> Vec<String> {
    let mut names = names_in(dir, FileType::is_dir);
    names.sort_by_key(|name| (name.parse::<u64>().unwrap_or(u64::MAX), name.clone()));
    names
}

/// A folder in which files are looked up by names from a model or a manifest.
#[derive(Clone, Debug)]
pub(crate) struct SourceFolder {
    /// The path that is shown to the user, relative to the capture.
    pub(crate) relative: String,
    /// The real path, with symbolic links resolved.
    pub(crate) path: PathBuf,
    /// True if files in it may be links to places outside. That is allowed in a user's own capture, which is
    /// only read, and never in a folder whose manifest lists its files.
    links: bool,
}

/// The kind of the last part of a path below a real folder; `None` if a part before it is a link or a step
/// upwards.
fn kind_without_links(folder: &Path, path: &Path) -> std::io::Result<Option<FileType>> {
    let mut place = folder.to_path_buf();
    let mut kind: Option<FileType> = None;
    for part in path.strip_prefix(folder).into_iter().flat_map(Path::components) {
        if kind.is_some_and(|kind| kind.is_symlink()) || !matches!(part, Component::Normal(_)) {
            return Ok(None);
        }
        place.push(part);
        kind = Some(std::fs::symlink_metadata(&place)?.file_type());
    }
    Ok(kind)
}

impl SourceFolder {
    /// Opens a folder; `None` if it does not exist. Its files may not be links to places outside.
    pub(crate) fn open(root: &Path, relative: &str) -> Option<Self> {
        let path = root.join(relative).canonicalize().ok().filter(|p| p.is_dir())?;
        Some(Self { relative: relative.to_string(), path, links: false })
    }

    /// Like [`open`](Self::open), for a user's own folder, whose files may be links to places outside.
    pub(crate) fn open_own(root: &Path, relative: &str) -> Option<Self> {
        Some(Self { links: true, ..Self::open(root, relative)? })
    }

    /// The file of that name; `None` if it does not exist, an error if it is outside the folder and links are
    /// not allowed.
    pub(crate) fn file(&self, name: &FileName) -> Result<Option<PathBuf>, ImportError> {
        let here = name.below(&self.path);
        // Without a link on the way, the path is the real one. This costs one look at each part of the name,
        // and not one at each part of the whole path.
        match kind_without_links(&self.path, &here) {
            Ok(Some(kind)) if !kind.is_symlink() => return Ok(kind.is_file().then_some(here)),
            Ok(_) => {}
            Err(_) => return Ok(None),
        }
        let Ok(real) = here.canonicalize() else { return Ok(None) };
        if !real.starts_with(&self.path) {
            if self.links {
                // The path keeps the link's own name, because stores of linked files often name the targets
                // by their digests.
                return Ok(real.is_file().then_some(here));
            }
            return Err(ImportError::Name {
                name: name.clone(),
                reason: "is a symbolic link to a place outside (copy the file in)".into(),
                folder: self.path.clone(),
            });
        }
        Ok(real.is_file().then_some(real))
    }

    /// The first of `names` that exists; an invalid name (too long with its extension) counts as missing.
    fn first(
        &self,
        names: impl IntoIterator<Item = Result<FileName, NameError>>,
    ) -> Result<Option<(FileName, PathBuf)>, ImportError> {
        for name in names.into_iter().flatten() {
            if let Some(path) = self.file(&name)? {
                return Ok(Some((name, path)));
            }
        }
        Ok(None)
    }

    /// The path of [`named_image`](Self::named_image).
    pub(crate) fn image(&self, name: &FileName) -> Result<Option<PathBuf>, ImportError> {
        Ok(self.named_image(name)?.map(|(_, path)| path))
    }

    /// An image by its name in the model, or else by its stem with another extension; and the name under
    /// which it was found.
    pub(crate) fn named_image(&self, name: &FileName) -> Result<Option<(FileName, PathBuf)>, ImportError> {
        let spellings: [fn(&str) -> String; 3] = [str::to_string, str::to_uppercase, capitalised];
        let others = spellings.iter().flat_map(|spell| {
            IMAGE_EXTENSIONS.iter().map(|extension| name.with_extension(&spell(extension)))
        });
        self.first(std::iter::once(Ok(name.clone())).chain(others))
    }

    /// A mask of an image: `a.jpg.png` (COLMAP's convention), `a.png`, or one of
    /// [`mask_beside`](Self::mask_beside).
    pub(crate) fn mask(&self, name: &FileName) -> Result<Option<PathBuf>, ImportError> {
        let by_stem = mask_extensions().map(|e| name.with_extension(&e));
        let names = std::iter::once(FileName::new(&format!("{name}.png"))).chain(by_stem);
        match self.first(names)? {
            Some((_, path)) => Ok(Some(path)),
            None => self.mask_beside(name),
        }
    }

    /// A mask of an image whose name says that it is one: `a_mask.png` (of Metashape and OpenDroneMap),
    /// `a.jpg.mask.png` (RealityScan's), `a.mask.png`.
    pub(crate) fn mask_beside(&self, name: &FileName) -> Result<Option<PathBuf>, ImportError> {
        let starts =
            [format!("{}_mask", name.stem()), format!("{name}.mask"), format!("{}.mask", name.stem())];
        let names = starts.iter().flat_map(|start| mask_extensions().map(move |e| format!("{start}.{e}")));
        Ok(self.first(names.map(|name| FileName::new(&name)))?.map(|(_, path)| path))
    }

    /// A depth prior of an image, by its stem.
    pub(crate) fn depth(&self, name: &FileName) -> Result<Option<PathBuf>, ImportError> {
        Ok(self.first(DEPTH_EXTENSIONS.iter().map(|e| name.with_extension(e)))?.map(|(_, path)| path))
    }

    /// Names of the image files below the folder, sorted, with `/` between parts. Hidden files are left out.
    pub(crate) fn images(&self) -> Vec<String> {
        self.names_with(&IMAGE_EXTENSIONS)
    }

    /// The same for the files that may be masks.
    pub(crate) fn masks(&self) -> Vec<String> {
        self.names_with(&MASK_EXTENSIONS)
    }

    fn names_with(&self, extensions: &[&str]) -> Vec<String> {
        let names = visible_files(&self.path, usize::MAX).map(|(name, _)| name);
        names.filter(|name| has_extension(name, extensions)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_never_escape_and_names_are_found_by_their_stem() {
        let dir = tempfile::tempdir().unwrap();
        let outside = dir.path().join("outside.png");
        std::fs::write(&outside, b"x").unwrap();
        let images = dir.path().join("images");
        std::fs::create_dir_all(images.join("sub")).unwrap();
        std::fs::write(images.join("sub/a b.png"), b"x").unwrap();
        let folder = SourceFolder::open(dir.path(), "images").unwrap();
        let name = |text: &str| FileName::new(text).unwrap();
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(&outside, images.join("link.png")).unwrap();
            let message = folder.file(&name("link.png")).unwrap_err().to_string();
            assert!(message.contains("symbolic link"), "{message}");
            std::os::unix::fs::symlink(images.join("sub/a b.png"), images.join("inside.png")).unwrap();
            assert!(folder.file(&name("inside.png")).unwrap().is_some());
            // A user's own folder may hold links to files, under their own names, but links to folders do not
            // count.
            let own = SourceFolder::open_own(dir.path(), "images").unwrap();
            let found = own.file(&name("link.png")).unwrap().unwrap();
            assert_eq!(found, images.canonicalize().unwrap().join("link.png"));
            std::os::unix::fs::symlink(dir.path(), images.join("folder.png")).unwrap();
            assert!(own.file(&name("folder.png")).unwrap().is_none());
            // A link on the way leads outside, too.
            std::os::unix::fs::symlink(dir.path(), images.join("away")).unwrap();
            let message = folder.file(&name("away/outside.png")).unwrap_err().to_string();
            assert!(message.contains("symbolic link"), "{message}");
        }
        assert!(folder.file(&name("sub\\a b.png")).unwrap().is_some());
        assert!(folder.file(&name("sub/none.png")).unwrap().is_none());
        assert!(folder.image(&name("sub/a b.JPG")).unwrap().is_some(), "another extension");
        std::fs::write(images.join("sub/c.Jpg"), b"x").unwrap();
        assert!(folder.images().contains(&"sub/c.Jpg".to_string()), "{:?}", folder.images());
        assert!(folder.image(&name("sub/c.png")).unwrap().is_some(), "another extension in other case");
        assert!(folder.file(&name("sub")).unwrap().is_none(), "a folder is no image");
        // The name has the greatest valid length: with another extension it is invalid, and so counts as
        // missing.
        assert!(folder.mask(&name(&"x".repeat(250))).unwrap().is_none());
    }

    #[test]
    fn folders_are_counted_by_number_then_by_name() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["text", "10", "2", "binary"] {
            std::fs::create_dir(dir.path().join(name)).unwrap();
        }
        assert_eq!(subfolders(dir.path()), ["2", "10", "binary", "text"]);
    }
}
