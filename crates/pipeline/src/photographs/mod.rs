//! All photographs of a scene as files: the originals, enhanced at full size, as they were named.
//!
//! ```text
//! scene folder (originals.json) + the folder of the photographs ─▶ OUT/<relative path>, OUT/photographs.csv
//! ```
//!
//! A photograph is read, graded on its small grid through its own lens ([`use3d_photographs`]), and written
//! in its own format with its own metadata ([`use3d_io_image::Photograph`]). Photographs without a camera are
//! changed by the mean of the views, so that none is missing. Nothing is stored twice: a record in the folder
//! says which photographs are finished, and an interrupted run continues with the others ([`record`]).

pub mod film;
pub mod record;
mod table;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use use3d_capture::{Camera, FileName, Image, Intrinsics, Map};
use use3d_import::{Original, Originals, pinhole_of};
use use3d_io_image::{Photograph, Samples, photograph_info, write_png_map};
use use3d_numerics::order::{Ascending, median};
use use3d_photographs::{
    ColourMap, Development, Graded, Grid, Photographer, ViewMap, shrink, small_size, straight, strange,
};
use use3d_render::Mode;
use use3d_scene::Scene;

use crate::WorkError;

pub use record::{FinishedPhotograph, Overwrite, Record};
pub use table::{TABLE, write_table};
pub use use3d_stages::Appearance;
use use3d_stages::Drawn;

/// The program's name in the files that it writes.
pub const SOFTWARE: &str = concat!("3D-USE ", env!("CARGO_PKG_VERSION"));

/// Longer side of the small grid, pixels. Factors are smooth, so a larger grid shows nothing more.
pub const SIDE: usize = 640;

/// Endings of files of another development.
const ENDINGS: [&str; 12] =
    ["tif", "tiff", "TIF", "TIFF", "png", "PNG", "jpg", "JPG", "jpeg", "JPEG", "exr", "EXR"];
/// The most photographs that are compared to find another development.
const FITTED: usize = 24;
/// Differences from the scene with and without a change, whose ratio is still that of the same photographs.
const SAME: f64 = 1.5;

/// Below this share of knowledge a pixel counts as unknown.
const UNKNOWN: f32 = 0.5;
/// Above this median share of unknown pixels the user is told.
const MOSTLY: f64 = 0.8;

/// The names of the files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FileLayout {
    /// The names of the originals.
    #[default]
    Same,
    /// A folder `.texture` beside the place of the originals, as RealityScan reads texture layers.
    Texture,
}

impl FileLayout {
    /// The file of a photograph below the folder of results.
    pub fn place(self, relative: &FileName) -> PathBuf {
        let own = Path::new(relative.as_str());
        match (self, own.parent(), own.file_name()) {
            (Self::Texture, Some(folder), Some(name)) => folder.join(".texture").join(name),
            _ => own.to_path_buf(),
        }
    }
}

/// A set of photographs to enhance.
pub struct PhotographWork<'a, 's> {
    /// The scene.
    pub scene: &'a Drawn<'s>,
    /// Metres per scene unit; `None` if they are not known.
    pub metres: Option<f64>,
    /// The photographs of the scene.
    pub originals: &'a Originals,
    /// The folder with their files, at their relative names.
    pub folder: &'a Path,
    /// True if the files may be another development: of other colours, and with other endings of their names.
    pub developed: bool,
    /// Names in that folder of photographs without a camera.
    pub without_camera: &'a [FileName],
    /// The folder of the results.
    pub out: &'a Path,
    /// The way they are shown.
    pub appearance: Appearance,
    /// The names of the results.
    pub layout: FileLayout,
    /// True if they are resampled to pinholes, for programs that know no distortion.
    pub undistorted: bool,
    /// A folder for masks of the unknown; white is known.
    pub unknown: Option<&'a Path>,
    /// A text that differs between settings with different results: the scene's digest and the flags.
    pub settings: String,
    /// The permission to replace files.
    pub overwrite: Overwrite,
}

/// The numbers of a finished set.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Photographs that were written now.
    pub written: usize,
    /// Photographs that were finished before.
    pub kept: usize,
    /// Photographs among them without a camera.
    pub without_camera: usize,
    /// Photographs of the scene whose file is not there.
    pub missing: usize,
}

/// One photograph of a set.
enum PhotographJob<'a> {
    /// With a camera, and its place among the training views.
    Posed(&'a Original, Option<usize>),
    /// Without a camera.
    Mean(&'a FileName),
}

impl PhotographJob<'_> {
    fn relative(&self) -> &FileName {
        match self {
            Self::Posed(original, _) => &original.relative,
            Self::Mean(name) => name,
        }
    }
}

/// The place of a mask, and its name in the record.
struct MaskPlace {
    key: String,
    file: PathBuf,
}

impl PhotographWork<'_, '_> {
    /// Enhances all photographs that are not finished yet. `progress` gets the number of finished
    /// photographs, their total and a name before each one; `false` stops. `say` gets sentences for the user.
    ///
    /// # Errors
    /// The first photograph that cannot be read, graded or written. Those before it stay, and the same call
    /// continues.
    pub fn run(
        &self,
        progress: &mut dyn FnMut(usize, usize, &str) -> bool,
        say: &mut dyn FnMut(&str),
    ) -> Result<Totals, WorkError> {
        let mut trained = 0;
        let jobs = self.originals.photographs.iter().map(|original| {
            let own = original.train.then_some(trained);
            trained += usize::from(original.train);
            PhotographJob::Posed(original, own)
        });
        let jobs: Vec<PhotographJob<'_>> =
            jobs.chain(self.without_camera.iter().map(PhotographJob::Mean)).collect();
        let mut record = Record::open(self.out, &self.settings, self.overwrite)?;
        self.check_mask_folder()?;
        record.check_file(TABLE, &self.out.join(TABLE))?;
        let mut totals = Totals::default();
        let mut open = Vec::new();
        for job in jobs {
            let Some(file) = self.file(job.relative()) else {
                totals.missing += 1;
                let missing =
                    format!("{} is not in {}; it is left out", job.relative(), self.folder.display());
                say(&missing);
                continue;
            };
            let source = file.below(self.folder);
            totals.without_camera += usize::from(matches!(job, PhotographJob::Mean(_)));
            let target = self.out.join(self.layout.place(&file));
            let mask = match &job {
                PhotographJob::Posed(original, _) => self.mask(original)?,
                PhotographJob::Mean(_) => None,
            };
            let mask_there = mask.as_ref().is_none_or(|mask| record.holds(&mask.key, &mask.file));
            if record.has(&file, &source, &target) && mask_there {
                totals.kept += 1;
                continue;
            }
            record.check(&file, &source, &target)?;
            if let Some(mask) = &mask {
                record.check_file(&mask.key, &mask.file)?;
            }
            open.push((job, file, (source, target), mask));
        }
        if totals.missing == self.originals.photographs.len() {
            return Err(WorkError::Input(format!(
                "{}: none of the {} photographs of the scene is there (the first one is {}); give the folder of \
                 the original photographs with --images",
                self.folder.display(),
                totals.missing,
                self.originals.photographs.first().map_or_else(String::new, |o| o.relative.to_string())
            )));
        }
        record.start()?;
        let total = totals.kept + open.len();
        let training = training_cameras(self.originals);
        let mut photographer = None;
        let mut grids: BTreeMap<String, Option<Grid>> = BTreeMap::new();
        let mut development = None;
        for (job, file, (source, target), mask) in open {
            let name = file.to_string();
            if !progress(totals.kept + totals.written, total, &name) {
                self.table(&mut record)?;
                return Err(WorkError::Interrupted);
            }
            let photographer = match &mut photographer {
                Some(photographer) => photographer,
                empty => {
                    let made = self.appearance.photographer(self.scene, &training);
                    let made = empty.insert(made.map_err(|e| WorkError::Failed(e.to_string()))?);
                    development = self.development(made, &mut grids, say)?.map(Arc::new);
                    made
                }
            };
            record.begin(file.as_str())?;
            if let Some(mask) = &mask {
                record.begin(&mask.key)?;
            }
            let mut entry = match &job {
                PhotographJob::Posed(original, own) => {
                    let how = (own.as_ref().copied(), development.clone());
                    let places = (&*source, &*target, mask.as_ref());
                    self.posed((photographer, &mut grids), (original, how), places)?
                }
                PhotographJob::Mean(name) => {
                    let views: Vec<ViewMap> =
                        record.entries().filter_map(FinishedPhotograph::view_map).collect();
                    self.by_mean((ViewMap::mean(&views), development.clone()), name, &source, &target)?
                }
            };
            entry.name.clone_from(&name);
            for note in &entry.notes {
                say(&format!("{name}: {note}"));
            }
            if let Some(mask) = &mask {
                record.end(&mask.key, &mask.file)?;
            }
            record.add(entry, &source, &target)?;
            totals.written += 1;
        }
        self.table(&mut record)?;
        if let Some(share) = mostly_unknown(&record) {
            say(&format!(
                "the scene knows little of these photographs: in half of them, {:.0} % of the pixels or more are \
                 unknown; their colours are those of the whole view",
                100.0 * share
            ));
        }
        Ok(totals)
    }

    /// Writes the table, and notes it as the program's own.
    fn table(&self, record: &mut Record) -> Result<(), WorkError> {
        record.begin(TABLE)?;
        write_table(self.out, record, self.metres).map_err(WorkError::failed)?;
        record.end(TABLE, &self.out.join(TABLE))
    }

    /// Refuses a folder of masks in which they would stand among photographs.
    fn check_mask_folder(&self) -> Result<(), WorkError> {
        let Some(masks) = self.unknown else { return Ok(()) };
        let real =
            |path: &Path| path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_default();
        let (place, own) = (real(masks), real(self.folder));
        if !place.starts_with(&own) && place != real(self.out) {
            return Ok(());
        }
        Err(WorkError::Input(format!(
            "--unknown {}: masks would stand among the photographs there; choose a folder of their own",
            masks.display()
        )))
    }

    /// The place of a photograph's mask; `None` if no masks are wanted.
    fn mask(&self, original: &Original) -> Result<Option<MaskPlace>, WorkError> {
        let Some(folder) = self.unknown else { return Ok(None) };
        let failed = |e: &dyn std::fmt::Display| WorkError::input(e);
        let name = original.relative.with_extension("png").map_err(|e| failed(&e))?;
        let file = std::path::absolute(name.below(folder)).map_err(|e| failed(&e))?;
        Ok(Some(MaskPlace { key: format!("mask {}", file.display()), file }))
    }

    /// The file of a photograph in the folder: by its name, or for another development with another ending.
    fn file(&self, name: &FileName) -> Option<FileName> {
        if name.below(self.folder).is_file() {
            return Some(name.clone());
        }
        let endings = ENDINGS.iter().filter(|_| self.developed);
        let named = endings.filter_map(|ending| name.with_extension(ending).ok());
        named.into_iter().find(|name| name.below(self.folder).is_file())
    }

    /// The change of colours from another development; `None` if these photographs have the scene's colours.
    fn development(
        &self,
        photographer: &mut Photographer<'_>,
        grids: &mut BTreeMap<String, Option<Grid>>,
        say: &mut dyn FnMut(&str),
    ) -> Result<Option<Development>, WorkError> {
        if !self.developed {
            return Ok(None);
        }
        let there: Vec<&Original> = self
            .originals
            .photographs
            .iter()
            .filter(|original| self.file(&original.relative).is_some())
            .collect();
        let (mut names, mut pairs) = (Vec::new(), Vec::new());
        for original in there.iter().step_by(there.len().div_ceil(FITTED).max(1)) {
            let Some(file) = self.file(&original.relative) else { continue };
            let source = file.below(self.folder);
            let grid = self.grid(grids, original, &source)?.0;
            let photograph = Photograph::read(&source).map_err(WorkError::input)?;
            let small = self.small(&photograph);
            if (small.width(), small.height()) == grid.size() {
                let of = photographer.pairs(&small, &grid).map_err(WorkError::failed)?;
                names.push(file);
                pairs.push(of);
            }
        }
        let found = Development::fit(&pairs);
        let mean = |by: Option<&Development>| {
            pairs.iter().map(|pairs| pairs.apart(by)).sum::<f64>() / pairs.len().max(1) as f64
        };
        let (before, after) = (mean(None), mean(Some(&found)));
        let other = strange(&pairs, &found);
        let strange: Vec<&FileName> =
            names.iter().zip(other).filter(|(_, other)| *other).map(|(name, _)| name).collect();
        if let Some(first) = strange.first() {
            return Err(WorkError::Input(format!(
                "{}: {} of {} photographs that were compared do not show what their cameras see ({first} is the \
                 first); --images expects the photographs that the scene was made from, or others of the same \
                 cameras at the same size",
                self.folder.display(),
                strange.len(),
                names.len()
            )));
        }
        if before <= SAME * after + 0.004 {
            return Ok(None);
        }
        say(&format!(
            "these photographs were developed in another way: their colours were matched to the scene's (mean \
             difference {before:.3} before, {after:.3} after)"
        ));
        Ok(Some(found))
    }

    /// The small grid of a photograph, and the pinhole that it is resampled to.
    fn grid(
        &self,
        grids: &mut BTreeMap<String, Option<Grid>>,
        original: &Original,
        source: &Path,
    ) -> Result<(Grid, Option<Intrinsics>), WorkError> {
        let info = photograph_info(source).map_err(WorkError::input)?;
        let file = (original.width, original.height);
        if (info.width, info.height) != file {
            return Err(WorkError::Input(format!(
                "{}: it has {} x {} pixels, and the scene was made from a photograph of {} x {}; give the original \
                 photographs with --images, or run the scene again with these",
                source.display(),
                info.width,
                info.height,
                file.0,
                file.1
            )));
        }
        let straight = self.undistorted.then(|| pinhole_of(&original.lens, file.0, file.1)).transpose();
        let straight = straight.map_err(|e| WorkError::Input(format!("{}: {e}", original.relative)))?;
        // Photographs of one camera share the rays of its lens.
        let key = format!("{:?} {file:?}", original.lens);
        let grid = grids.entry(key).or_insert_with(|| match straight {
            Some(k) => Some(Grid::straight(&k, original.pose, SIDE)),
            None => Grid::new(&original.lens, file, original.pose, SIDE),
        });
        let grid = grid.as_ref().map(|grid| grid.at(original.pose)).ok_or_else(|| {
            WorkError::Input(format!(
                "{}: no ray of its lens lies in front of the camera; import the capture again",
                original.relative
            ))
        })?;
        Ok((grid, straight))
    }

    /// The gains of the import. Those of another development are part of its change.
    fn gains(&self) -> [f32; 3] {
        self.originals.gains.filter(|_| !self.developed).unwrap_or([1.0; 3])
    }

    /// A photograph at the size of its small grid, with the gains of the import.
    fn small(&self, photograph: &Photograph) -> Image {
        balanced(small_of(photograph), self.gains())
    }

    /// Enhances a photograph with a camera.
    fn posed(
        &self,
        (photographer, grids): (&mut Photographer<'_>, &mut BTreeMap<String, Option<Grid>>),
        (original, (own, development)): (&Original, (Option<usize>, Option<Arc<Development>>)),
        (source, target, mask): (&Path, &Path, Option<&MaskPlace>),
    ) -> Result<FinishedPhotograph, WorkError> {
        let (grid, straight) = self.grid(grids, original, source)?;
        let mut photograph = Photograph::read(source).map_err(WorkError::input)?;
        if let Some(pinhole) = straight.filter(|_| !original.lens.is_pinhole()) {
            photograph = undistorted(photograph, original, &pinhole);
        }
        let small = developed(self.small(&photograph), development.as_deref());
        let graded = photographer
            .grade(&small, &grid, own, None)
            .map_err(|e| WorkError::Failed(format!("{}: {e}", original.relative)))?;
        let entry = self.entry(&original.relative, &photograph, &graded);
        let grade = graded.grade;
        change(&mut photograph, &grade.map.after(self.gains()).developed(development));
        if let Some(mask) = mask {
            let known = large(&grade.known, (photograph.width, photograph.height));
            write_png_map(&mask.file, &known).map_err(WorkError::failed)?;
        }
        self.write(&photograph, target)?;
        Ok(entry)
    }

    /// Changes a photograph without a camera by the mean of the views.
    fn by_mean(
        &self,
        (mean, development): (ViewMap, Option<Arc<Development>>),
        name: &FileName,
        source: &Path,
        target: &Path,
    ) -> Result<FinishedPhotograph, WorkError> {
        let mut photograph = Photograph::read(source).map_err(WorkError::input)?;
        let gains = self.gains();
        let small = developed(self.small(&photograph), development.as_deref());
        change(&mut photograph, &mean.grade(&small).after(gains).developed(development));
        self.write(&photograph, target)?;
        Ok(FinishedPhotograph::without_camera(name, &photograph))
    }

    fn write(&self, photograph: &Photograph, target: &Path) -> Result<(), WorkError> {
        let failed = |e: &dyn std::fmt::Display| WorkError::Failed(e.to_string());
        if let Some(folder) = target.parent() {
            std::fs::create_dir_all(folder)
                .map_err(|e| WorkError::Failed(format!("{}: cannot be made: {e}", folder.display())))?;
        }
        let history = format!(
            "colours changed by {SOFTWARE}: look {}, strength {}, water {}, keep-light {}",
            self.appearance.mode.name(),
            self.appearance.strength,
            self.appearance.water,
            self.appearance.keep_light
        ) + if self.undistorted { ", undistorted" } else { "" };
        photograph.write(target, SOFTWARE, &history).map_err(|e| failed(&e))
    }

    /// The row of a graded photograph in the record.
    fn entry(&self, name: &FileName, photograph: &Photograph, graded: &Graded) -> FinishedPhotograph {
        let known = &graded.grade.known;
        let unknown = known.data().iter().filter(|k| **k < UNKNOWN).count() as f64;
        let distances = distances(&graded.depth);
        let scale = self.scene.scene.frame.scale;
        let mut entry = FinishedPhotograph::without_camera(name, photograph);
        entry.unknown = Some(unknown / known.data().len().max(1) as f64);
        entry.distances = distances.map(|d| d.map(|v| v / scale));
        entry.view = Some(graded.grade.own.rows);
        entry
    }
}

/// The median share of unknown pixels, if it is so large that the scene says little of the photographs.
fn mostly_unknown(record: &Record) -> Option<f64> {
    let shares = record.entries().filter_map(|entry| entry.unknown);
    median(shares).filter(|share| *share > MOSTLY)
}

/// The cameras that a scene was learnt from.
fn training_cameras(originals: &Originals) -> Vec<Camera> {
    let learnt = originals.photographs.iter().filter(|original| original.train);
    learnt.map(|original| Camera { intrinsics: original.camera, pose: original.pose }).collect()
}

/// The median and the 90 % quantile of the distances along the axis, scene units; `None` without a surface.
fn distances(depth: &Map) -> Option<[f64; 2]> {
    let known = Ascending::of(depth.data().iter().copied().filter(|d| *d > 0.0));
    Some([known.below(0.5)?, known.below(0.9)?].map(f64::from))
}

/// A photograph at the size of its small grid.
pub fn small_of(photograph: &Photograph) -> Image {
    let size = small_size((photograph.width, photograph.height), SIDE);
    match &photograph.pixels {
        Samples::Eight(pixels) => shrink(pixels, photograph.width, size),
        Samples::Sixteen(pixels) => shrink(pixels, photograph.width, size),
        Samples::Float(pixels) => shrink(pixels, photograph.width, size),
    }
}

/// Changes the colours of a photograph.
pub fn change(photograph: &mut Photograph, map: &ColourMap) {
    match &mut photograph.pixels {
        Samples::Eight(pixels) => map.apply(pixels, photograph.width),
        Samples::Sixteen(pixels) => map.apply(pixels, photograph.width),
        Samples::Float(pixels) => map.apply(pixels, photograph.width),
    }
}

/// A photograph as a pinhole would have taken it.
fn undistorted(photograph: Photograph, original: &Original, pinhole: &Intrinsics) -> Photograph {
    let size = (photograph.width, photograph.height);
    let of = |samples: &Samples, channels: usize| match samples {
        Samples::Eight(pixels) => Samples::Eight(straight((pixels, channels), size, &original.lens, pinhole)),
        Samples::Sixteen(pixels) => {
            Samples::Sixteen(straight((pixels, channels), size, &original.lens, pinhole))
        }
        Samples::Float(pixels) => Samples::Float(straight((pixels, channels), size, &original.lens, pinhole)),
    };
    let pixels = of(&photograph.pixels, 3);
    let alpha = photograph.alpha.as_ref().map(|alpha| of(alpha, 1));
    photograph.with_pixels((pinhole.width, pinhole.height), pixels, alpha)
}

/// A small photograph in the colours of the scene.
fn developed(small: Image, by: Option<&Development>) -> Image {
    match by {
        Some(by) => by.on(&small),
        None => small,
    }
}

/// An image multiplied by the gains of the import's white balance.
fn balanced(mut image: Image, gains: [f32; 3]) -> Image {
    for (c, gain) in gains.into_iter().enumerate().filter(|(_, gain)| *gain != 1.0) {
        image.plane_mut(c).iter_mut().for_each(|v| *v *= gain);
    }
    image
}

/// A map at a larger size, each pixel the nearest small one.
fn large(map: &Map, size: (usize, usize)) -> Map {
    let mut out = Map::new(size.0, size.1);
    for y in 0..size.1 {
        let v = (y * map.height() / size.1).min(map.height().saturating_sub(1));
        for x in 0..size.0 {
            let u = (x * map.width() / size.0).min(map.width().saturating_sub(1));
            out.set_pixel(x, y, map.pixel(u, v));
        }
    }
    out
}

/// The default look of a scene for photographs: enhanced if it has an enhancement, else the reconstruction,
/// which makes exposure and balance even.
pub fn default_mode(scene: &Scene) -> Mode {
    Mode::opening(scene)
}

/// A digest of the files of a scene folder that the photographs depend on.
///
/// # Errors
/// A file cannot be read.
pub fn scene_digest(scene: &Path) -> std::io::Result<String> {
    let mut digest = blake3::Hasher::new();
    for name in ["scene.json", "gaussians.ply", "medium.safetensors", "ubaf.safetensors", Originals::FILE] {
        // A scene without water or enhancement has fewer files.
        if let Ok(mut file) = std::fs::File::open(scene.join(name)) {
            digest.update(name.as_bytes());
            digest.update_reader(&mut file)?;
        }
    }
    Ok(digest.finalize().to_hex().to_string())
}
