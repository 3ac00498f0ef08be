//! The formats of models that an import takes: one row of a table for each.
//!
//! A row says what a model looks like in a folder, how it is read into a [`Survey`], where its photographs
//! may lie, and what to say about files of the format that are not usable. COLMAP's comes first, so that
//! a folder with several formats is read as before there were others.

use std::path::{Path, PathBuf};

use use3d_capture::FileName;
use use3d_io_colmap::{ModelForm, count_images, form_of, read_survey};
use use3d_io_image::image_size;
use use3d_io_metashape::is_cameras_file;
use use3d_io_realityscan::{is_cameras_table, is_sidecar, parse_sidecars, read_sidecar, read_table};
use use3d_survey::Survey;

use crate::error::ImportError;
use crate::folder::{
    IMAGE_DIRS, MANIFEST, SourceFolder, any_has, has_extension, is_film, may_hold_photographs, names_in,
    subfolders, visible_files,
};
use crate::labels;
use crate::layout::{FoundModel, find_colmap};

/// A format of models.
#[derive(Debug)]
pub(crate) struct Format {
    /// Its name, for people.
    pub(crate) name: &'static str,
    /// The models of this format in a capture, the best first.
    pub(crate) find: fn(&Path) -> Result<Vec<FoundModel>, ImportError>,
    /// A model that only a look at every photograph finds. It is called if no other model is there.
    pub(crate) search: fn(&Path) -> Option<FoundModel>,
    /// The model at a place that the user named; `None` if it is not of this format.
    pub(crate) at: fn(&Path, &str) -> Result<Option<FoundModel>, ImportError>,
    /// Reads a model that was found.
    pub(crate) read: fn(&FoundModel) -> Result<ReadModel, ImportError>,
    /// The advice for a capture without a model, by the names in its folder.
    pub(crate) instead: fn(&[String]) -> Option<&'static str>,
}

/// A model that was read.
pub(crate) struct ReadModel {
    pub(crate) survey: Survey,
    /// Files and folders, relative to the capture, whose content makes the model.
    pub(crate) files: Vec<PathBuf>,
    /// The folder, relative to the capture, that the survey's files lie in.
    pub(crate) base: String,
    /// The image folders to try, relative to the capture.
    pub(crate) image_dirs: Vec<String>,
    /// True if names are labels: without folders, extensions or both.
    pub(crate) labels: bool,
    /// The ids of images that the model's files hold out.
    pub(crate) held_out: Vec<u32>,
}

/// The formats, in the order in which they are tried.
pub(crate) static FORMATS: [Format; 5] = [
    Format {
        name: "COLMAP",
        find: find_colmap,
        search: |_| None,
        at: colmap_at,
        read: read_colmap,
        instead: no_colmap,
    },
    Format {
        name: "Metashape",
        find: |root| Ok(find_metashape(root)),
        search: |_| None,
        at: |root, place| Ok(metashape_at(root, place)),
        read: read_metashape,
        instead: no_metashape,
    },
    Format {
        name: "nerfstudio",
        find: |root| {
            Ok([TRANSFORMS, TRANSFORMS_TRAIN]
                .iter()
                .find_map(|place| nerfstudio_at(root, place))
                .into_iter()
                .collect())
        },
        search: |_| None,
        at: |root, place| {
            Ok(nerfstudio_at(root, place).or_else(|| nerfstudio_at(root, &format!("{place}/{TRANSFORMS}"))))
        },
        read: read_nerfstudio,
        instead: |_| None,
    },
    Format {
        name: "OpenSfM",
        find: |root| Ok(find_opensfm(root, ".").into_iter().collect()),
        search: |_| None,
        at: |root, place| Ok(opensfm_at(root, place).or_else(|| find_opensfm(root, place))),
        read: read_opensfm,
        instead: no_opensfm,
    },
    Format {
        name: "RealityScan",
        find: |root| Ok(realityscan_tables(root)),
        search: realityscan_sidecars,
        at: |root, place| Ok(realityscan_at(root, place)),
        read: read_realityscan,
        instead: no_realityscan,
    },
];

/// The largest file of points that is read, bytes.
const LARGEST_POINTS: u64 = 4 << 30;

/// The folder of a model's file, relative to the capture.
fn base_of(found: &FoundModel) -> String {
    let parent = Path::new(&found.relative).parent().map(|p| p.to_string_lossy().into_owned());
    parent.filter(|p| !p.is_empty()).unwrap_or_else(|| ".".into())
}

/// A name in a folder of the capture.
fn inside(base: &str, name: &str) -> String {
    match (base, name) {
        (".", _) => name.to_string(),
        (_, ".") => base.to_string(),
        _ => format!("{base}/{name}"),
    }
}

/// A model at a place of the capture, in the format of this index. Its images are not counted.
fn found_at(format: usize, place: &str, path: PathBuf, form: &str) -> FoundModel {
    FoundModel { format: &FORMATS[format], relative: place.into(), path, form: form.into(), images: 0 }
}

/// Names of the files in a folder, sorted.
fn files_in(dir: &Path) -> Vec<String> {
    let mut names = names_in(dir, std::fs::FileType::is_file);
    names.sort();
    names
}

fn read_points(path: &Path) -> Result<Vec<u8>, ImportError> {
    let file = ImportError::file(path);
    if std::fs::metadata(path).map_err(&file)?.len() > LARGEST_POINTS {
        let reason = "it is larger than 4 GiB; export the tie points (sparse cloud), not the dense cloud";
        return Err(file(std::io::Error::new(std::io::ErrorKind::InvalidData, reason)));
    }
    std::fs::read(path).map_err(file)
}

// COLMAP: three files, in `sparse/0` or thereabouts.

fn colmap_at(root: &Path, place: &str) -> Result<Option<FoundModel>, ImportError> {
    let path = root.join(place);
    let Some(form) = ModelForm::of(&path) else { return Ok(None) };
    let images = count_images(&path, form)?;
    Ok(Some(FoundModel { images, ..found_at(0, place, path, &form.to_string()) }))
}

fn read_colmap(found: &FoundModel) -> Result<ReadModel, ImportError> {
    Ok(ReadModel {
        survey: read_survey(&found.path, form_of(&found.path)?)?,
        files: vec![PathBuf::from(&found.relative)],
        base: ".".into(),
        image_dirs: IMAGE_DIRS.map(String::from).to_vec(),
        labels: false,
        held_out: Vec::new(),
    })
}

fn no_colmap(names: &[String]) -> Option<&'static str> {
    names.iter().any(|name| is_film(Path::new(name))).then_some(
        "it has a film and no model: `use3d prepare FILM --out CAPTURE_DIR` makes a capture of it, and `use3d run FILM` \
         does so first",
    )
}

// Metashape: an XML file in the capture's folder, and points as PLY beside it.

fn metashape_at(root: &Path, place: &str) -> Option<FoundModel> {
    let path = root.join(place);
    if path.is_dir() {
        let inside = find_metashape(&path).into_iter().next()?;
        let relative = format!("{place}/{}", inside.relative);
        return Some(FoundModel { relative, ..inside });
    }
    let cameras = path.is_file() && has_extension(place, &["xml"]) && is_cameras_file(&path);
    cameras.then(|| found_at(1, place, path, "Agisoft XML"))
}

fn find_metashape(root: &Path) -> Vec<FoundModel> {
    let mut found: Vec<FoundModel> =
        files_in(root).iter().filter_map(|name| metashape_at(root, name)).collect();
    // Markers are exported as a file of the same form; the one with the cameras is called so.
    found.sort_by_key(|f| !f.relative.to_lowercase().contains("camera"));
    found
}

/// The file of points beside a cameras file: the only one, or the one that is called after tie points.
fn points_beside(dir: &Path, notes: &mut Vec<String>) -> Option<String> {
    let mut clouds = files_in(dir);
    clouds.retain(|name| has_extension(name, &["ply"]));
    let named = |name: &String| {
        let name = name.to_lowercase();
        name == "points.ply" || name.contains("tie") || name.contains("sparse")
    };
    let chosen = clouds.iter().find(|name| clouds.len() == 1 || named(name));
    if clouds.is_empty() {
        let note =
            "no points: export the tie points as PLY into the same folder, and the scene starts from them";
        notes.push(note.into());
    } else if chosen.is_none() {
        let list = clouds.join(", ");
        notes.push(format!("several files of points, none used ({list}): call one points.ply"));
    }
    chosen.cloned()
}

fn read_metashape(found: &FoundModel) -> Result<ReadModel, ImportError> {
    let mut survey = use3d_io_metashape::read(&found.path)?;
    let mut files = vec![PathBuf::from(&found.relative)];
    let (dir, base) = (found.path.parent().unwrap_or(Path::new(".")), base_of(found));
    if let Some(name) = points_beside(dir, &mut survey.notes) {
        let path = dir.join(&name);
        use3d_io_metashape::add_points(&mut survey, &read_points(&path)?, &path)?;
        files.push(PathBuf::from(inside(&base, &name)));
    }
    let image_dirs = places_of_photographs(dir).iter().map(|place| inside(&base, place)).collect();
    Ok(ReadModel { survey, files, base, image_dirs, labels: true, held_out: Vec::new() })
}

/// The folders that may hold the photographs of a file in `dir`, relative to it. The usual ones come first;
/// the whole folder comes last, for photographs in several of its folders.
fn places_of_photographs(dir: &Path) -> Vec<String> {
    let others = subfolders(dir).into_iter().filter(|name| may_hold_photographs(dir, name));
    let mut places = IMAGE_DIRS.map(String::from).to_vec();
    places.extend(others.filter(|name| !IMAGE_DIRS.contains(&name.as_str())));
    places.push(".".into());
    places
}

fn no_metashape(names: &[String]) -> Option<&'static str> {
    if any_has(names, &["psx", "psz"]) {
        return Some(
            "a project of Metashape is not read itself: choose File > Export > Export Cameras, format Agisoft XML, \
             and put that file beside the photographs",
        );
    }
    any_has(names, &["xml"]).then_some(
        "the XML file here is no cameras file of Metashape: choose File > Export > Export Cameras, format Agisoft \
         XML, and put that file beside the photographs",
    )
}

// nerfstudio: transforms.json in the capture's folder.

const TRANSFORMS: &str = "transforms.json";
/// The file that stands beside `transforms_test.json`.
const TRANSFORMS_TRAIN: &str = "transforms_train.json";

fn nerfstudio_at(root: &Path, place: &str) -> Option<FoundModel> {
    let path = root.join(place);
    let other = place.ends_with(MANIFEST) || place.ends_with(RECONSTRUCTION);
    let ours = path.is_file() && has_extension(place, &["json"]) && !other;
    ours.then(|| found_at(2, place, path, TRANSFORMS))
}

fn read_nerfstudio(found: &FoundModel) -> Result<ReadModel, ImportError> {
    let (dir, base) = (found.path.parent().unwrap_or(Path::new(".")), base_of(found));
    let folder = SourceFolder::open_own(dir, ".");
    let size = |name: &FileName| image_size(&folder.as_ref()?.image(name).ok()??).ok();
    let mut read = use3d_io_nerfstudio::read(&found.path, &size)?;
    let names = read.files.iter().filter_map(|path| path.file_name()?.to_str());
    let mut files: Vec<PathBuf> = names.map(|name| PathBuf::from(inside(&base, name))).collect();
    match &read.points {
        Some(name) if name.below(dir).is_file() => {
            let path = name.below(dir);
            files.push(PathBuf::from(inside(&base, name)));
            read.add_points(&read_points(&path)?, &path)?;
        }
        Some(name) => read.survey.notes.push(format!("the file of points {name} is not there")),
        None => read
            .survey
            .notes
            .push(format!("{TRANSFORMS} names no points (ply_file_path): the scene starts from chance")),
    }
    let mut survey = read.survey;
    if survey.files.values().any(|f| f.depth.is_some()) {
        survey.notes.push(
            "the depth maps of the field depth_file_path are not used: they are distances, and \
             depth priors are larger where things are nearer"
                .into(),
        );
    }
    // The photographs' common folder is the image folder, as with other formats.
    let parents = survey.images.iter().map(|image| {
        let folder = image.name.rsplit_once('/').map(|(folder, _)| folder);
        folder.map_or_else(Vec::new, |folder| folder.split('/').collect())
    });
    let alike = |(a, b): &(&str, &str)| a == b;
    let common = parents.reduce(|a, b| a.into_iter().zip(b).take_while(alike).map(|(a, _)| a).collect());
    let common = common.unwrap_or_default();
    let folder = if common.is_empty() { ".".to_string() } else { common.join("/") };
    let skipped = if common.is_empty() { 0 } else { folder.len() + 1 };
    for image in &mut survey.images {
        let short = FileName::new(&image.name[skipped..]);
        image.name = short.map_err(ImportError::file_name(&image.name.below(dir)))?;
    }
    // The file names its masks, wherever they lie.
    let masks = survey.files.values().filter_map(|f| f.mask.as_ref());
    files.extend(masks.map(|name| PathBuf::from(inside(&base, name))));
    let image_dirs = vec![inside(&base, &folder)];
    Ok(ReadModel { survey, files, base, image_dirs, labels: false, held_out: read.held_out })
}

// OpenSfM: reconstruction.json with tracks.csv beside it, in the capture's folder or in `opensfm/`, as in a
// project of WebODM.

const RECONSTRUCTION: &str = "reconstruction.json";
const TRACKS: &str = "tracks.csv";

fn opensfm_at(root: &Path, place: &str) -> Option<FoundModel> {
    let path = root.join(place);
    (path.is_file() && place.ends_with(RECONSTRUCTION)).then(|| found_at(3, place, path, "OpenSfM"))
}

fn find_opensfm(root: &Path, place: &str) -> Option<FoundModel> {
    ["", "opensfm/"]
        .iter()
        .find_map(|folder| opensfm_at(root, &inside(place, &format!("{folder}{RECONSTRUCTION}"))))
}

fn read_opensfm(found: &FoundModel) -> Result<ReadModel, ImportError> {
    let mut survey = use3d_io_opensfm::read(&found.path)?;
    let mut files = vec![PathBuf::from(&found.relative)];
    let (dir, base) = (found.path.parent().unwrap_or(Path::new(".")), base_of(found));
    let tracks = dir.join(TRACKS);
    if tracks.is_file() {
        use3d_io_opensfm::read_tracks(&mut survey, &tracks)?;
        files.push(PathBuf::from(inside(&base, TRACKS)));
    } else {
        survey.notes.push(format!(
            "no {TRACKS} beside {RECONSTRUCTION}: put it there, and the water is measured before the training"
        ));
    }
    // WebODM keeps the photographs beside the folder `opensfm`.
    let above = Path::new(&base).parent().map(|p| p.to_string_lossy().into_owned());
    let above = above.filter(|_| base != ".").map(|p| if p.is_empty() { ".".into() } else { p });
    let folders = [Some(base.clone()), above];
    let mut image_dirs = Vec::new();
    for at in folders.iter().flatten() {
        image_dirs.extend(IMAGE_DIRS.iter().chain(&["."]).map(|place| inside(at, place)));
    }
    Ok(ReadModel { survey, files, base, image_dirs, labels: false, held_out: Vec::new() })
}

fn no_opensfm(names: &[String]) -> Option<&'static str> {
    let has = |name: &str| names.iter().any(|n| n == name);
    (has("odm_report") || has("cameras.json") && has("images.json")).then_some(
        "results of WebODM have no tracks: put `opensfm/reconstruction.json` and `opensfm/tracks.csv` of the project's \
         folder beside the photographs",
    )
}

// RealityScan: a table of cameras in the capture's folder with points as PLY beside it, or an XMP file beside
// each photograph.

/// Folders that are searched for XMP files go this deep.
const XMP_DEPTH: usize = 4;

/// RealityScan's XMP files below a folder, sorted, with their names relative to it.
fn sidecars_below(dir: &Path) -> impl Iterator<Item = (String, PathBuf)> {
    let files = visible_files(dir, XMP_DEPTH).map(|(name, path)| (name.replace('\\', "/"), path));
    files.filter(|(name, path)| has_extension(name, &["xmp"]) && is_sidecar(path))
}

fn realityscan_at(root: &Path, place: &str) -> Option<FoundModel> {
    let path = root.join(place);
    let table = path.is_file() && has_extension(place, &["csv"]) && is_cameras_table(&path);
    let form = match table {
        true => "RealityScan CSV",
        false if path.is_dir() && sidecars_below(&path).next().is_some() => "RealityScan XMP",
        false => return None,
    };
    Some(found_at(4, place, path, form))
}

fn realityscan_tables(root: &Path) -> Vec<FoundModel> {
    let files = files_in(root);
    files.iter().filter(|n| has_extension(n, &["csv"])).filter_map(|n| realityscan_at(root, n)).collect()
}

fn realityscan_sidecars(root: &Path) -> Option<FoundModel> {
    // The folder above all photographs is tried last: its XMP files include those of the others.
    places_of_photographs(root).iter().find_map(|place| realityscan_at(root, place))
}

fn read_realityscan(found: &FoundModel) -> Result<ReadModel, ImportError> {
    let mut files = Vec::new();
    let (registration, dir, base, places) = if found.path.is_dir() {
        let mut sidecars = Vec::new();
        for (name, path) in sidecars_below(&found.path) {
            let photograph =
                FileName::new(use3d_capture::stem(&name)).map_err(ImportError::file_name(&path))?;
            sidecars.push(read_sidecar(photograph, &path)?);
            files.push(PathBuf::from(inside(&found.relative, &name)));
        }
        let registration = parse_sidecars(&sidecars, &found.path)?;
        (registration, found.path.as_path(), found.relative.clone(), vec![".".to_string()])
    } else {
        let dir = found.path.parent().unwrap_or(Path::new("."));
        files.push(PathBuf::from(&found.relative));
        (read_table(&found.path)?, dir, base_of(found), places_of_photographs(dir))
    };
    let names: Vec<&FileName> = registration.shots.iter().map(|shot| &shot.name).collect();
    let folders = places.iter().filter_map(|place| SourceFolder::open_own(dir, place));
    // The first of those with the most photographs.
    let photographs = folders
        .map(|folder| labels::photographs(&names, &folder))
        .reduce(|best, more| if more.len() > best.len() { more } else { best });
    let size = |(name, path): (FileName, PathBuf)| Ok((name, image_size(&path)?));
    let sizes = photographs.into_iter().flatten().map(size).collect::<Result<_, ImportError>>()?;
    let mut survey = registration.into_survey(&sizes, &found.path)?;
    // Points lie beside the table, or in the capture's folder above the photographs.
    let above = (found.path.is_dir() && base != ".").then(|| dir.parent()).flatten();
    let (near, near_base) = above.map_or_else(|| (dir, base.clone()), |parent| (parent, base_of(found)));
    if let Some(name) = points_beside(near, &mut survey.notes) {
        let path = near.join(&name);
        use3d_io_realityscan::add_points(&mut survey, &read_points(&path)?, &path)?;
        files.push(PathBuf::from(inside(&near_base, &name)));
    }
    survey.notes.push(
        "RealityScan's files do not state the unit: if the project is in metres, a table beside the photographs says so"
            .into(),
    );
    let image_dirs = places.iter().map(|place| inside(&base, place)).collect();
    Ok(ReadModel { survey, files, base, image_dirs, labels: true, held_out: Vec::new() })
}

fn no_realityscan(names: &[String]) -> Option<&'static str> {
    if names.iter().any(|name| name.eq_ignore_ascii_case("cameras.csv")) {
        return Some(
            "cameras.csv is no table of RealityScan with the columns name, x, y, alt, heading, pitch, roll and f: export \
             the registration as \"Internal/External camera parameters\" in the coordinate system `Grid plane`",
        );
    }
    any_has(names, &["rcproj", "rsproj"]).then_some(
        "a project of RealityScan (RealityCapture) is not read itself: export the registration as \
         \"Internal/External camera parameters\" (CSV) and the points as PLY, and put both files beside the photographs",
    )
}
