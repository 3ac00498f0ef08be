//! Recipes for the data sets of the paper: the files of each scene, and what they need to become captures.
//!
//! The owners distribute the data, so a recipe begins with a folder that somebody unpacked. What they do not
//! publish, such as the frames that the paper took from films, is this program's choice, and
//! docs/guide/datasets.md says so.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use serde_json::json;
use use3d_capture::{Pixels, Raster};
use use3d_io_colmap::ModelForm;
use use3d_io_image::{ChannelHistogram, read_pixels, write_png16};

use crate::error::PrepareError;
use crate::params::{Matching, PrepareParams};
use crate::photographs::{copy_all, copy_beside};
use crate::prepare::{CAPTURE, Input, write_record};
use crate::process::StepWatch;
use crate::sources::{BALANCED, Sources, holds_inputs, is_film, walk};
use crate::work::Work;

/// Frames of a film of DRUVA: two for each of its about sixty seconds.
const DRUVA_FRAMES: usize = 120;
/// The share of samples that a channel's gain leaves within range.
const QUANTILE: f64 = 0.998;

/// A data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recipe {
    /// The four scenes of SeaThru-NeRF, with cameras.
    SeaThruNerf,
    /// The sequences D3 and D5 of Sea-Thru: linear photographs.
    SeaThru,
    /// The twenty films of DRUVA.
    Druva,
}

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

/// A scene of a data set.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecipeScene {
    /// Its name in the pipeline files.
    pub name: String,
    /// Its files.
    pub work: RecipeWork,
}

impl Recipe {
    /// The recipe of a name on the command line.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "seathru" => Some(Self::SeaThruNerf),
            "d3d5" => Some(Self::SeaThru),
            "druva" => Some(Self::Druva),
            _ => None,
        }
    }

    /// The variable and the file of the pipelines that use the captures.
    pub fn pipeline(self) -> (&'static str, &'static str) {
        match self {
            Self::SeaThruNerf => ("SEATHRU", "seathru4"),
            Self::SeaThru => ("SEATHRU_D", "d3-d5"),
            Self::Druva => ("DRUVA", "druva20"),
        }
    }

    /// The names of its scenes, as they are spelled in the owners' archives.
    fn names(self) -> Vec<String> {
        match self {
            Self::SeaThruNerf => {
                ["IUI3-RedSea", "Curasao", "JapaneseGradens-RedSea", "Panama"].map(String::from).to_vec()
            }
            Self::SeaThru => ["D3", "D5"].map(String::from).to_vec(),
            Self::Druva => (1..=20).map(|i| format!("A{i}")).collect(),
        }
    }

    /// The usual choices for its scenes.
    pub fn choices(self) -> PrepareParams {
        let usual = PrepareParams::default();
        match self {
            Self::Druva => PrepareParams { frames: DRUVA_FRAMES, matching: Matching::Sequential, ..usual },
            _ => usual,
        }
    }

    /// True if a folder has files of one of its scenes.
    pub fn is_in(self, folder: &Path) -> bool {
        self.names().iter().any(|name| !matches!(self.work(folder, name), Ok(None)))
    }

    /// The scenes whose files are in a folder, and the names of the others.
    ///
    /// # Errors
    /// None of them is there, or a scene has two films.
    pub fn scenes(self, folder: &Path) -> Result<(Vec<RecipeScene>, Vec<String>), PrepareError> {
        let (mut found, mut missing) = (Vec::new(), Vec::new());
        for name in self.names() {
            match self.work(folder, &name)? {
                Some(work) => found.push(RecipeScene { name, work }),
                None => missing.push(name),
            }
        }
        if found.is_empty() {
            return Err(PrepareError::input(folder, self.absent()));
        }
        Ok((found, missing))
    }

    fn work(self, folder: &Path, name: &str) -> Result<Option<RecipeWork>, PrepareError> {
        let scene = folder.join(name);
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
                let linear = ["linearPNG", "linear", "png"].map(|n| scene.join(n));
                let photographs = linear.into_iter().find(|path| path.is_dir()).unwrap_or(scene);
                holds_inputs(&photographs).then_some(RecipeWork::Linear(photographs))
            }
            Self::Druva => {
                let films = |dir: &Path| -> Vec<PathBuf> {
                    let mut films: Vec<PathBuf> = walk(dir, 1).flatten().filter(|p| is_film(p)).collect();
                    films.sort();
                    films
                };
                let own = |p: &PathBuf| p.file_stem().is_some_and(|stem| stem.eq_ignore_ascii_case(name));
                let mut inside = films(&scene);
                if inside.len() > 1 {
                    let reason = "there are several films in this folder; keep the one of the scene";
                    return Err(PrepareError::input(&scene, reason));
                }
                films(folder).into_iter().find(own).or_else(|| inside.pop()).map(RecipeWork::Film)
            }
        })
    }

    /// The message for a folder without any scene: what was looked for, and where it comes from.
    fn absent(self) -> &'static str {
        match self {
            Self::SeaThruNerf => {
                "no scene of SeaThru-NeRF is here: expected IUI3-RedSea/images_wb with IUI3-RedSea/sparse/0, and the like; \
                 its authors distribute the archive, so download and unpack it yourself, and give the folder \
                 SeathruNeRF_dataset (docs/guide/datasets.md)"
            }
            Self::SeaThru => {
                "neither D3 nor D5 of Sea-Thru is here: expected D3/ and D5/ with their linear PNGs; its authors distribute \
                 them, so download them yourself, and give the folder above both (docs/guide/datasets.md)"
            }
            Self::Druva => {
                "no film of DRUVA is here: expected A1.MP4 to A20.MP4, or a folder for each with its film; its owners give \
                 them out on a signed agreement, so ask them, and give the folder with the films (docs/guide/datasets.md)"
            }
        }
    }
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
    fn scenes_are_found_by_their_files_and_the_others_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        for (recipe, said) in [
            (Recipe::SeaThruNerf, "SeathruNeRF_dataset"),
            (Recipe::SeaThru, "D3/"),
            (Recipe::Druva, "A1.MP4"),
        ] {
            let error = recipe.scenes(root).unwrap_err().to_string();
            assert!(error.contains(said) && error.contains("docs/guide/datasets.md"), "{error}");
        }
        std::fs::write(root.join("a3.MP4"), "film").unwrap();
        std::fs::create_dir(root.join("A7")).unwrap();
        std::fs::write(root.join("A7/GX01.mp4"), "film").unwrap();
        let (scenes, missing) = Recipe::Druva.scenes(root).unwrap();
        assert_eq!((scenes[0].name.as_str(), scenes[1].name.as_str(), missing.len()), ("A3", "A7", 18));
        assert_eq!(scenes[0].work, RecipeWork::Film(root.join("a3.MP4")));
        let choices = Recipe::Druva.choices();
        assert_eq!((choices.frames, choices.matching), (120, Matching::Sequential));
        // A camera's small copy is no film of its own.
        std::fs::write(root.join("A7/GL01.LRV"), "film").unwrap();
        assert_eq!(Recipe::Druva.scenes(root).unwrap().0[1].work, RecipeWork::Film(root.join("A7/GX01.mp4")));
        std::fs::write(root.join("A7/GX02.mp4"), "film").unwrap();
        let said = Recipe::Druva.scenes(root).unwrap_err().to_string();
        assert!(said.contains("several films") && Recipe::Druva.is_in(root), "{said}");
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
