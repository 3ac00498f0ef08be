//! Recipes for the data sets of the paper: the files of each scene, and what they need to become captures.
//!
//! The owners distribute the data, so a recipe begins with their files: a folder, or an archive. What they do
//! not publish, such as the frames that the paper took from films, is this program's choice, and
//! docs/reference/datasets.md says so.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use serde_json::json;
use use3d_capture::{Pixels, Raster};
use use3d_io_colmap::ModelForm;
use use3d_io_image::{ChannelHistogram, read_pixels, write_png16};

use crate::error::PrepareError;
use crate::origin::{Recipe, SetScene};
use crate::params::{Matching, PrepareParams};
use crate::photographs::{copy_all, copy_beside};
use crate::prepare::{CAPTURE, Input, write_record};
use crate::process::StepWatch;
use crate::sources::{BALANCED, Sources, holds_inputs, is_film, is_photograph, walk};
use crate::work::Work;

/// Frames of a film of DRUVA: two for each of its about sixty seconds.
const DRUVA_FRAMES: usize = 120;
/// The share of samples that a channel's gain leaves within range.
const QUANTILE: f64 = 0.998;

/// The files of a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RecipeWork {
    /// White-balanced photographs and a model, which are copied.
    Published {
        /// The folder of the photographs.
        images: PathBuf,
        /// The folder of the model.
        model: PathBuf,
    },
    /// A folder of linear photographs.
    Linear(PathBuf),
    /// A film.
    Film(PathBuf),
}

impl Recipe {
    /// The usual choices for its scenes. The films of DRUVA are circles, so all of their frames are compared.
    pub fn choices(self) -> PrepareParams {
        let usual = PrepareParams::default();
        match self {
            Self::Druva => PrepareParams { frames: DRUVA_FRAMES, matching: Matching::Exhaustive, ..usual },
            _ => usual,
        }
    }

    /// The files of a scene in a folder; `None` if they are not there.
    ///
    /// # Errors
    /// The scene has two films.
    pub fn work(self, folder: &Path, name: &str) -> Result<Option<RecipeWork>, PrepareError> {
        let scene = inside(folder, name);
        Ok(match self {
            Self::SeaThruNerf => {
                let images =
                    ["images_wb", "Images_wb"].map(|n| scene.join(n)).into_iter().find(|p| p.is_dir());
                let places = ["sparse/0", "colmap/sparse/0"].map(|n| scene.join(n));
                let model = places.into_iter().find(|place| ModelForm::of(place).is_some());
                images.zip(model).map(|(images, model)| RecipeWork::Published { images, model })
            }
            Self::SeaThru => {
                // Some archives have raw files beside the folder of the linear photographs.
                let linear = ["linearPNG", "linear", "png"].map(|n| inside(&scene, n));
                let photographs = linear.into_iter().find(|path| path.is_dir()).unwrap_or(scene);
                holds_inputs(&photographs).then_some(RecipeWork::Linear(photographs))
            }
            Self::Druva => {
                let films = |dir: &Path| -> Vec<PathBuf> {
                    // Most folders of downloads have thousands of photographs and no film: names tell.
                    let mut entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
                    if !entries.any(|entry| is_film(&entry.path())) {
                        return Vec::new();
                    }
                    let mut films: Vec<PathBuf> = walk(dir, 1).flatten().filter(|p| is_film(p)).collect();
                    films.sort();
                    films
                };
                let own = |p: &PathBuf| p.file_stem().is_some_and(|stem| stem.eq_ignore_ascii_case(name));
                let mut within = films(&scene);
                if within.len() > 1 {
                    let reason = "there are several films in this folder; keep the one of the scene";
                    return Err(PrepareError::input(&scene, reason));
                }
                films(folder).into_iter().find(own).or_else(|| within.pop()).map(RecipeWork::Film)
            }
        })
    }

    /// True if an archive has files of a scene. An archive without a list of its files has them if it is
    /// named like the scene or the data set.
    pub fn is_packed(self, archive: &Path, scene: &str) -> bool {
        let Some(stem) = use3d_archive::stem(archive) else { return false };
        if !use3d_archive::has_list(archive) {
            let plain: String = stem.chars().filter(char::is_ascii_alphanumeric).collect();
            let plain = plain.to_ascii_lowercase();
            let of_set = match self {
                Self::SeaThruNerf => plain.starts_with("seathrunerf"),
                Self::SeaThru => plain.starts_with("seathru") && !plain.starts_with("seathrunerf"),
                Self::Druva => plain.starts_with("druva"),
            };
            return of_set || stem.eq_ignore_ascii_case(scene);
        }
        let names = use3d_archive::names(archive).unwrap_or_default();
        names.iter().filter_map(|name| below(name, stem, scene)).any(|path| match self {
            Self::Druva => is_film(&path),
            Self::SeaThru | Self::SeaThruNerf => is_photograph(&path),
        })
    }

    /// The words for a scene that is not there: the files that were looked for, and where they come from.
    pub fn absent(self, scene: &str) -> String {
        let (set, files, from) = match self {
            Self::SeaThruNerf => (
                "SeaThru-NeRF",
                "images_wb/ and sparse/0/",
                "its authors publish the archive, with their terms, at https://sea-thru-nerf.github.io/",
            ),
            Self::SeaThru => (
                "Sea-Thru",
                "linear PNGs or TIFFs of 16 bits",
                "its authors publish it, with their terms, at \
                 https://csms.haifa.ac.il/profiles/tTreibitz/datasets/sea_thru/index.html",
            ),
            Self::Druva => (
                "DRUVA",
                "its film",
                "its owners give it out on a signed agreement: https://github.com/nishavarghese15/DRUVA",
            ),
        };
        format!(
            "{scene} of {set} is not there: expected a folder {scene} with {files}, or the archive that has it; {from} \
             (docs/reference/datasets.md)"
        )
    }
}

/// A folder's entry of a name; capitals do not count if none has exactly this name.
fn inside(folder: &Path, name: &str) -> PathBuf {
    let exact = folder.join(name);
    if exact.exists() {
        return exact;
    }
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut alike: Vec<PathBuf> = entries
        .filter(|entry| entry.file_name().eq_ignore_ascii_case(name))
        .map(|entry| entry.path())
        .collect();
    alike.sort();
    alike.into_iter().next().unwrap_or(exact)
}

/// The place of an archive's file below the folder into which a scene is unpacked; `None` for a file of
/// another scene.
fn below(name: &str, archive: &str, scene: &str) -> Option<PathBuf> {
    let parts: Vec<&str> = name.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".").collect();
    let (file, folders) = parts.split_last()?;
    if parts.iter().any(|part| part.starts_with('.') || *part == "__MACOSX") {
        return None;
    }
    let own = Path::new(file);
    if own.file_stem().is_some_and(|stem| stem.eq_ignore_ascii_case(scene)) && is_film(own) {
        return Some(own.to_path_buf());
    }
    let first = match folders.iter().position(|part| part.eq_ignore_ascii_case(scene)) {
        Some(at) => at + 1,
        None if archive.eq_ignore_ascii_case(scene) => 0,
        None => return None,
    };
    Some(parts[first..].iter().fold(PathBuf::from(scene), |path, part| path.join(part)))
}

/// Unpacks a scene of an archive into a folder, unless an earlier attempt did, and returns its files.
///
/// # Errors
/// The archive cannot be read, or it has not all files of the scene.
pub fn unpack(
    archive: &Path,
    origin: &SetScene,
    folder: &Path,
    watch: &StepWatch<'_>,
) -> Result<RecipeWork, PrepareError> {
    let SetScene { recipe, scene } = origin;
    if !folder.is_dir() {
        let begun = folder.with_extension("begun");
        if begun.is_dir() {
            std::fs::remove_dir_all(&begun).map_err(PrepareError::write(&begun))?;
        }
        std::fs::create_dir_all(&begun).map_err(PrepareError::write(&begun))?;
        let stem = use3d_archive::stem(archive).unwrap_or_default();
        let mut count = 0;
        let unpacked = use3d_archive::unpack(archive, &begun, &|name| below(name, stem, scene), &mut |_| {
            count += 1;
            watch.tell("unpacked", (count, 0), "files");
            watch.check().map_err(std::io::Error::other)
        });
        watch.check()?;
        unpacked.map_err(|e| {
            PrepareError::input(archive, format!("it cannot be unpacked: {e}; download it again"))
        })?;
        std::fs::rename(&begun, folder).map_err(PrepareError::write(folder))?;
    }
    let found = recipe.work(folder, scene)?;
    found.ok_or_else(|| PrepareError::input(archive, recipe.absent(scene)))
}

/// Copies photographs, their model and the masks, depth maps and lists beside them into the folder of the
/// work, as a capture. `key` and `inputs` go into its record.
///
/// # Errors
/// Another process uses the folder, or a file cannot be copied.
pub fn publish(
    (images, model): (&Path, &Path),
    (key, inputs): (&str, &[Input]),
    folder: &Path,
) -> Result<(), PrepareError> {
    let stop = AtomicBool::new(false);
    let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
    let work = Work::open(folder, &watch)?;
    work.remove(CAPTURE)?;
    let capture = folder.join(CAPTURE);
    let sparse = capture.join("sparse");
    std::fs::create_dir_all(&sparse).map_err(PrepareError::write(&sparse))?;
    copy_all(images, &capture.join("images_wb"))?;
    copy_all(model, &sparse.join("0"))?;
    images.parent().map_or(Ok(()), |scene| copy_beside(scene, &capture))?;
    let record = json!({ "format": "use3d preparation", "schema": 1, "key": key, "inputs": inputs });
    write_record(&capture, &record)
}

/// Writes linear photographs as pictures for screens: each channel is divided by its 99.8 % quantile over all
/// of them, and encoded as sRGB, with 16 bits. They lie in a folder of the work, where [`Sources::made_in`]
/// finds them. It should be the [`work_folder`](crate::work_folder) of the capture, whose lock
/// [`prepare`](fn@crate::prepare) takes next.
///
/// # Errors
/// Another process uses the folder of the work, or a photograph cannot be read or written.
pub fn balance(sources: &Sources, folder: &Path, watch: &StepWatch<'_>) -> Result<(), PrepareError> {
    let work = Work::open(folder, watch)?;
    work.remove(BALANCED)?;
    let folder = folder.join(BALANCED);
    let total = 2 * sources.photographs.len() as u64;
    let mut histogram = ChannelHistogram::default();
    let tell = |done: u64| {
        watch.tell("white balance", (done, total), "photographs");
        watch.check()
    };
    for (done, photograph) in (1u64..).zip(&sources.photographs) {
        histogram.count(&read_pixels(&photograph.path)?);
        tell(done)?;
    }
    let gains = histogram.gains(QUANTILE);
    for (done, photograph) in (1 + total / 2..).zip(&sources.photographs) {
        let pixels = read_pixels(&photograph.path)?;
        let shown = match &pixels {
            Pixels::Eight(p) => encoded(p, gains, |v| f32::from(v) / 255.0),
            Pixels::Sixteen(p) => encoded(p, gains, |v| f32::from(v) / 65535.0),
        };
        let name = format!("{}.png", photograph.name.stem());
        let path = folder.join(&name);
        if path.exists() {
            let reason = "another photograph has the same name with another ending; keep one of them";
            return Err(PrepareError::input(&photograph.path, reason));
        }
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).map_err(PrepareError::write(parent))?;
        }
        write_png16(&path, &shown)?;
        tell(done)?;
    }
    Ok(())
}

/// An image with gains, encoded for screens.
fn encoded<T: Copy + Default>(
    image: &Raster<T, 3>,
    gains: [f32; 3],
    value: impl Fn(T) -> f32,
) -> Raster<u16, 3> {
    let mut out = Raster::<u16, 3>::new(image.width(), image.height());
    let size = image.width() * image.height();
    for (i, (to, from)) in out.data_mut().iter_mut().zip(image.data()).enumerate() {
        let light = (value(*from) * gains[i / size.max(1)]).min(1.0);
        let shown = if light <= 0.003_130_8 {
            12.92 * light
        } else {
            1.055 * use3d_numerics::math::powf(light, 1.0 / 2.4) - 0.055
        };
        *to = (shown * 65535.0 + 0.5) as u16;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_are_found_by_their_files_and_those_of_others_are_left() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        for recipe in Recipe::ALL {
            assert_eq!(recipe.work(root, "A3").unwrap(), None);
            assert!(recipe.absent("A3").contains("https://") && recipe.absent("A3").contains("datasets.md"));
            let text = String::from(SetScene { recipe, scene: "A3".into() });
            assert_eq!(SetScene::try_from(text).unwrap().recipe, recipe);
        }
        assert!(SetScene::try_from("druva".to_string()).unwrap_err().to_string().contains("druva/A3"));
        std::fs::write(root.join("a3.MP4"), "film").unwrap();
        std::fs::create_dir(root.join("a7")).unwrap();
        std::fs::write(root.join("a7/GX01.mp4"), "film").unwrap();
        let film = |name: &str| Recipe::Druva.work(root, name).unwrap();
        assert_eq!(film("A3"), Some(RecipeWork::Film(root.join("a3.MP4"))));
        let choices = Recipe::Druva.choices();
        assert_eq!((choices.frames, choices.matching), (120, Matching::Exhaustive));
        // A camera's small copy is no film of its own.
        std::fs::write(root.join("a7/GL01.LRV"), "film").unwrap();
        assert_eq!(film("A7"), Some(RecipeWork::Film(root.join("a7/GX01.mp4"))));
        std::fs::write(root.join("a7/GX02.mp4"), "film").unwrap();
        assert!(Recipe::Druva.work(root, "A7").unwrap_err().to_string().contains("several films"));
    }

    #[test]
    fn files_of_an_archive_belong_to_a_scene_by_folder_film_or_archive() {
        let place = |name: &str, archive: &str, scene: &str| {
            below(name, archive, scene).map(|path| path.to_string_lossy().into_owned())
        };
        assert_eq!(
            place("set/panama/Images_wb/a.png", "set", "Panama").as_deref(),
            Some("Panama/Images_wb/a.png")
        );
        assert_eq!(place("set/Panama/a.png", "set", "Curasao"), None);
        assert_eq!(place("films/A3.MP4", "DRUVA", "A3").as_deref(), Some("A3.MP4"));
        assert_eq!(place("linearPNG/a.png", "d3", "D3").as_deref(), Some("D3/linearPNG/a.png"));
        assert_eq!(place("__MACOSX/D3/._a.png", "x", "D3"), None);
        let tar = |recipe: Recipe, name: &str| recipe.is_packed(Path::new(name), "D3");
        assert!(tar(Recipe::SeaThru, "d3.tar.gz") && tar(Recipe::SeaThru, "Sea-thru.tgz"));
        assert!(!tar(Recipe::SeaThru, "SeathruNeRF_dataset.tar.gz"));
        assert!(tar(Recipe::SeaThruNerf, "SeathruNeRF_dataset.tar.gz"));
    }

    #[test]
    fn linear_photographs_are_balanced_as_a_set_and_encoded() {
        let dir = tempfile::tempdir().unwrap();
        let linear = dir.path().join("D3");
        for (name, level) in [("a.png", 8000u16), ("b.png", 16000)] {
            let mut image = Raster::<u16, 3>::new(8, 4);
            image
                .data_mut()
                .chunks_exact_mut(32)
                .zip([level, level / 2, level / 4])
                .for_each(|(p, v)| p.fill(v));
            write_png16(&linear.join(name), &image).unwrap();
        }
        let sources = Sources::of(&[linear]).unwrap();
        let stop = AtomicBool::new(false);
        let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
        let work = dir.path().join(".D3.preparing");
        balance(&sources, &work, &watch).unwrap();
        let made = sources.made_in(&work).unwrap();
        let names: Vec<String> = made.photographs.iter().map(|p| p.name.to_string()).collect();
        assert_eq!(names, ["a.png", "b.png"]);
        let value = |name: &str| {
            let path = work.join(BALANCED).join(name);
            let Pixels::Sixteen(image) = read_pixels(&path).unwrap() else { panic!("16 bits") };
            [0, 32, 64].map(|at| f64::from(image.data()[at]) / 65535.0)
        };
        // The brighter one is white, and half of its light is 0.735 on a screen.
        assert!(value("b.png").iter().all(|v| (v - 1.0).abs() < 1e-3), "{:?}", value("b.png"));
        assert!(value("a.png").iter().all(|v| (v - 0.7354).abs() < 1e-3), "{:?}", value("a.png"));
    }
    #[test]
    fn a_folder_that_another_process_uses_keeps_its_files() {
        let dir = tempfile::tempdir().unwrap();
        let (images, model) = (dir.path().join("images_wb"), dir.path().join("sparse"));
        write_png16(&images.join("a.png"), &Raster::<u16, 3>::new(8, 4)).unwrap();
        std::fs::create_dir(&model).unwrap();
        let stop = AtomicBool::new(false);
        let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
        let folder = dir.path().join(".D3.preparing");
        let other = Work::open(&folder, &watch).unwrap();
        let theirs = [CAPTURE, BALANCED].map(|name| folder.join(name).join("theirs.png"));
        for path in &theirs {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "theirs").unwrap();
        }
        let sources = Sources::of(std::slice::from_ref(&images)).unwrap();
        for refused in [publish((&images, &model), ("key", &[]), &folder), balance(&sources, &folder, &watch)]
        {
            assert!(matches!(refused, Err(PrepareError::Busy { .. })), "{refused:?}");
        }
        assert!(theirs.iter().all(|path| path.is_file()), "the other process has lost files");
        drop(other);
        publish((&images, &model), ("key", &[]), &folder).unwrap();
        balance(&sources, &folder, &watch).unwrap();
        assert!(theirs.iter().all(|path| !path.exists()), "files of an earlier attempt are left");
        assert!(folder.join(CAPTURE).join("images_wb/a.png").is_file());
    }
}
