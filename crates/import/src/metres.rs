//! Metres from tables that lie beside the photographs.
//!
//! ```text
//! lengths.csv      length, metres, image, x1, y1, x2, y2     a known length, in two or more photographs
//! positions.csv    image, x, y, z                            where photographs were taken, metres
//! depths.csv       image, depth                              how deep, metres below the surface
//! ```
//!
//! If none of these and not the model itself gives metres, the GPS positions in the photographs do, where
//! they are far enough apart.
//!
//! The first line of a table names its columns, in any order; other columns are ignored. If the model states
//! metres itself, these are kept, and a note says by how much a table differs. Otherwise the first table in
//! the order above gives them. A table that does not determine the metres says so in a note.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec3;
use use3d_capture::World;
use use3d_io_image::{GpsPosition, image_size, read_exif};
use use3d_numerics::math;
use use3d_survey::{
    EarthPlace, Mark, Marker, PosedImage, PositionsFit, ReadError, ScaleBar, Survey, TextRow, TextTable,
    fit_depths, fit_positions, read_at_most,
};

use crate::error::ImportError;
use crate::folder::{SourceFolder, last_part};

const LENGTHS: &str = "lengths.csv";
const POSITIONS: &str = "positions.csv";
const DEPTHS: &str = "depths.csv";
/// The largest table that is read, bytes.
const LARGEST: u64 = 1 << 26;
/// Metres of two sources that differ by more than this share are said.
const AGREE: f64 = 0.01;
/// Depths and GPS positions whose metres are less certain than this share are not used.
const CERTAIN: f64 = 0.1;
/// Metres by positions that are less certain than this share are doubtful, one standard error.
const DOUBTFUL: f64 = 0.02;
/// The error of GPS positions that all photographs of a swim may share, metres.
const GPS_ERROR: f64 = 3.0;

/// Marks farther from their marker than this share of the image's longer side are wrong.
const MISPLACED: f64 = 0.03;

/// The world by a source of metres, or a note on the reason why it gives none.
type FoundWorld = Result<World, String>;

/// Adds the sentence on a source that gives no world to the faults.
fn kept(found: FoundWorld, faults: &mut Vec<String>) -> Option<World> {
    found.map_err(|fault| faults.push(fault)).ok()
}

/// A table beside the photographs.
struct MetresTable {
    path: PathBuf,
    table: TextTable,
}

impl MetresTable {
    /// Reads a table of the capture; `None` if it is not there.
    fn read(dir: &Path, name: &str, needed: &[&str]) -> Result<Option<Self>, ImportError> {
        let path = dir.join(name);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = read_at_most(&path, LARGEST, "keep the rows of this capture alone")?;
        let fail = |line: usize, reason: String| ReadError::broken(&path, format!("line {line}"), reason);
        let table = TextTable::parse(&bytes, "#").map_err(|(line, reason)| fail(line, reason))?;
        if let Some(missing) = needed.iter().find(|name| table.column(&[name]).is_none()) {
            let expected = needed.join(",");
            let reason = format!("there is no column `{missing}`; expected this line to be {expected}");
            return Err(fail(table.first_line, reason).into());
        }
        Ok(Some(Self { path, table }))
    }

    fn fail(&self, row: &TextRow, reason: &str) -> ImportError {
        ReadError::broken(&self.path, format!("line {}", row.line), reason).into()
    }

    fn text<'a>(&self, row: &'a TextRow, name: &str) -> Result<&'a str, ImportError> {
        let field = self.table.column(&[name]).map_or("", |column| row.get(column));
        if field.is_empty() {
            return Err(self.fail(row, &format!("`{name}` is empty; fill it in")));
        }
        Ok(field)
    }

    fn number(&self, row: &TextRow, name: &str) -> Result<f64, ImportError> {
        let text = self.text(row, name)?;
        let number = text.parse::<f64>().ok().filter(|v| v.is_finite());
        number.ok_or_else(|| {
            self.fail(row, &format!("`{name}` is {text:?}; expected a number with a decimal point"))
        })
    }
}

/// The images of a survey by their names, also without folders and without extension where that is clear.
struct Names<'a>(BTreeMap<String, Vec<&'a PosedImage>>);

impl<'a> Names<'a> {
    fn of(survey: &'a Survey) -> Self {
        let mut names: BTreeMap<String, Vec<&PosedImage>> = BTreeMap::new();
        for image in &survey.images {
            let whole = image.name.as_str().to_lowercase();
            let file = last_part(&whole).to_string();
            let stem = use3d_capture::stem(&file).to_string();
            let mut forms = vec![whole, file, stem];
            forms.dedup();
            for form in forms {
                names.entry(form).or_default().push(image);
            }
        }
        Self(names)
    }

    fn find(&self, name: &str) -> Option<&'a PosedImage> {
        let name = name.replace('\\', "/").to_lowercase();
        let file = last_part(&name);
        let forms = [name.as_str(), file, use3d_capture::stem(file)];
        forms.iter().find_map(|form| match self.0.get(*form).map(Vec::as_slice) {
            Some(&[one]) => Some(one),
            _ => None,
        })
    }
}

/// Reads the tables of a capture, sets the survey's world where it has none, and names the files that were
/// read. The names of the survey's images are those of files in `images`. Returns the faults: sources of
/// metres that are not used or have mistakes.
pub(crate) fn read(
    dir: &Path,
    images: &SourceFolder,
    survey: &mut Survey,
    files: &mut Vec<PathBuf>,
) -> Result<Vec<String>, ImportError> {
    let (mut found, mut faults) = (Vec::new(), Vec::new());
    let (mut notes, mut markers, mut bars) = (Vec::new(), Vec::new(), Vec::new());
    if let Some(table) =
        MetresTable::read(dir, LENGTHS, &["length", "metres", "image", "x1", "y1", "x2", "y2"])?
    {
        files.push(LENGTHS.into());
        let world = lengths(&table, images, survey, (&mut markers, &mut bars), &mut notes)?;
        found.extend(kept(world, &mut faults));
    }
    if let Some(table) = MetresTable::read(dir, POSITIONS, &["image", "x", "y", "z"])? {
        files.push(POSITIONS.into());
        let world = positions(&table, survey, &mut notes, &mut faults)?;
        found.extend(kept(world, &mut faults));
    }
    if let Some(table) = MetresTable::read(dir, DEPTHS, &["image", "depth"])? {
        files.push(DEPTHS.into());
        let world = depths(&table, survey, &mut notes)?;
        found.extend(kept(world, &mut faults));
    }
    notes.extend(unread_tables(dir, images));
    survey.markers.append(&mut markers);
    survey.scale_bars.append(&mut bars);
    for world in found {
        match &survey.world {
            None => survey.world = Some(world),
            Some(kept) if (world.metres_per_unit / kept.metres_per_unit - 1.0).abs() > AGREE => {
                notes.push(format!(
                    "by {} one unit is {:.6} m, by {} {:.6} m; the latter is used",
                    world.source, world.metres_per_unit, kept.source, kept.metres_per_unit
                ));
            }
            Some(_) => {}
        }
    }
    if survey.world.is_none() {
        survey.world = gps(images, survey, &mut notes, &mut faults)?;
    }
    survey.notes.append(&mut notes);
    Ok(faults)
}

/// A remark on each file that is meant as a table and is not read: in another folder, or under another name.
fn unread_tables(dir: &Path, images: &SourceFolder) -> Vec<String> {
    let mut remarks = Vec::new();
    for folder in [dir, &images.path] {
        for entry in std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok) {
            let name = entry.file_name().to_string_lossy().into_owned();
            let table = [LENGTHS, POSITIONS, DEPTHS].into_iter().find(|table| {
                let (stem, ending) = name.rsplit_once('.').unwrap_or((&name, ""));
                let ending = ending.to_lowercase();
                stem.eq_ignore_ascii_case(use3d_capture::stem(table))
                    && ["csv", "txt", "tsv", "xlsx", "xls", "ods"].contains(&ending.as_str())
            });
            if let Some(table) = table.filter(|table| !dir.join(table).is_file()) {
                let name = use3d_capture::shown(&name).into_owned();
                remarks.push(format!(
                    "{name} is not read: a table must be a CSV file called {table}, in the capture's folder itself"
                ));
            }
        }
    }
    remarks.sort();
    remarks.dedup();
    remarks
}

/// Metres by known lengths. Their ends become markers with a scale bar between them.
fn lengths(
    table: &MetresTable,
    images: &SourceFolder,
    survey: &Survey,
    (markers, bars): (&mut Vec<Marker>, &mut Vec<ScaleBar>),
    notes: &mut Vec<String>,
) -> Result<FoundWorld, ImportError> {
    let names = Names::of(survey);
    let first = survey.markers.iter().map(|m| m.id).max().map_or(0, |id| id.saturating_add(1));
    let mut known: BTreeMap<&str, (usize, f64)> = BTreeMap::new();
    for row in &table.table.rows {
        let (label, metres) = (table.text(row, "length")?, table.number(row, "metres")?);
        if metres <= 0.0 {
            return Err(table.fail(row, &format!("`metres` is {metres}; expected a number above 0")));
        }
        let name = table.text(row, "image")?;
        let Some(image) = names.find(name) else {
            let example = survey.images.first().map_or("", |i| i.name.as_str());
            let reason = format!(
                "`image` is {name}, which has no camera or is there twice; expected a photograph of the model, such as \
                 {example}"
            );
            return Err(table.fail(row, &reason));
        };
        let next = markers.len() / 2;
        let (at, stated) = *known.entry(label).or_insert((next, metres));
        if stated != metres {
            let reason = format!("`metres` is {metres}, and {stated} in an earlier line of `{label}`");
            return Err(table.fail(row, &reason));
        }
        if at == next {
            let ids = [0, 1].map(|end| first.saturating_add((2 * next + end) as u32));
            for (id, end) in ids.into_iter().zip(["1", "2"]) {
                let label = format!("{label} {end}");
                markers.push(Marker { id, label, reference: None, marks: Vec::new() });
            }
            bars.push(ScaleBar { label: label.into(), ends: ids, metres });
        }
        // Marks count in the pixels of the file, which may be larger or smaller than in the model.
        let file = images.image(&image.name)?.map(|path| image_size(&path)).transpose()?;
        let camera = survey.camera(image.camera);
        let factors = camera.zip(file).map_or((1.0, 1.0), |(camera, (w, h))| {
            (camera.width as f64 / w as f64, camera.height as f64 / h as f64)
        });
        for (end, (x, y)) in [("x1", "y1"), ("x2", "y2")].into_iter().enumerate() {
            let (x, y) = (table.number(row, x)? * factors.0, table.number(row, y)? * factors.1);
            markers[2 * at + end].marks.push(Mark { image: image.id, x, y });
        }
    }
    let measured = Survey {
        cameras: survey.cameras.clone(),
        images: survey.images.iter().map(|i| PosedImage { keypoints: Vec::new(), ..i.clone() }).collect(),
        markers: markers.clone(),
        scale_bars: bars.clone(),
        ..Survey::default()
    };
    let Some((metres, worst, label)) = measured.metres_by_scale_bars() else {
        return Ok(Err(format!(
            "{LENGTHS} gives no metres: mark both ends of a length in two photographs at least, from different places"
        )));
    };
    if let Some((label, image, pixels)) = misplaced_mark(&measured) {
        return Ok(Err(format!(
            "{LENGTHS} does not give the metres: the end `{label}` in {image} is {} where the other photographs put it; \
             look for swapped ends and wrong pixels there",
            if pixels.is_finite() { format!("{pixels:.0} pixels away from") } else { "not".into() }
        )));
    }
    if worst > CERTAIN {
        return Ok(Err(format!(
            "{LENGTHS} does not give the metres: its lengths disagree, and `{label}` is off by {:.0} % of their mean; \
             look for a wrong length, or for ends that are swapped in one photograph",
            100.0 * worst
        )));
    }
    if worst > AGREE {
        notes.push(format!("the lengths in {LENGTHS} disagree by up to {:.1} % (`{label}`)", 100.0 * worst));
    }
    Ok(Ok(World::scaled(metres, format!("the measured lengths in {LENGTHS}"))))
}

/// The mark that is farthest from its marker, if it is absurdly far: the marker's label, the image, and
/// pixels of the model.
fn misplaced_mark(survey: &Survey) -> Option<(String, String, f64)> {
    let mut worst: Option<(String, String, f64)> = None;
    for marker in &survey.markers {
        let Some(position) = survey.marker_position(marker) else { continue };
        for mark in &marker.marks {
            let Some(image) = survey.images.iter().find(|image| image.id == mark.image) else { continue };
            let Some(camera) = survey.camera(image.camera) else { continue };
            let at = survey.project(image, position);
            let pixels = at.map_or(f64::INFINITY, |(x, y)| math::hypot(x - mark.x, y - mark.y));
            let absurd = pixels > MISPLACED * camera.width.max(camera.height) as f64;
            if absurd && worst.as_ref().is_none_or(|(_, _, most)| pixels > *most) {
                worst = Some((marker.label.clone(), image.name.to_string(), pixels));
            }
        }
    }
    worst
}

/// Measured places of cameras.
struct Centres<T> {
    /// The centre of each camera, with its measurement.
    pairs: Vec<(DVec3, T)>,
    /// The names of their images.
    names: Vec<String>,
    /// The number of rows whose images have no camera.
    unknown: usize,
}

impl<T> Centres<T> {
    /// The rows whose images have no camera, for the end of a sentence on the others.
    fn lacking(&self) -> String {
        if self.unknown > 0 { format!(", {} others have no camera", self.unknown) } else { String::new() }
    }
}

/// The centres of the named images with the values of their rows.
fn centres<T>(
    table: &MetresTable,
    survey: &Survey,
    of: impl Fn(&TextRow) -> Result<T, ImportError>,
) -> Result<Centres<T>, ImportError> {
    let known = Names::of(survey);
    let (mut pairs, mut names, mut unknown) = (Vec::new(), Vec::new(), 0);
    for row in &table.table.rows {
        let value = of(row)?;
        match known.find(table.text(row, "image")?) {
            Some(image) => {
                pairs.push((image.pose().center(), value));
                names.push(image.name.to_string());
            }
            None => unknown += 1,
        }
    }
    Ok(Centres { pairs, names, unknown })
}

fn positions(
    table: &MetresTable,
    survey: &Survey,
    notes: &mut Vec<String>,
    faults: &mut Vec<String>,
) -> Result<FoundWorld, ImportError> {
    let centres = centres(table, survey, |row| {
        Ok(DVec3::new(table.number(row, "x")?, table.number(row, "y")?, table.number(row, "z")?))
    })?;
    let lacking = centres.lacking();
    let Centres { mut pairs, names, .. } = centres;
    let mut source = format!("the positions in {POSITIONS}");
    if are_degrees(&pairs) {
        source += &in_metres(&mut pairs);
        notes.push(format!("the positions in {POSITIONS} are degrees, and were converted to metres"));
    }
    let Some(fit) = fit_positions(&pairs, 0.0, source) else {
        let reason = match pairs.len() {
            few @ 0..3 => format!("{few} of its images have a camera{lacking}; expected three or more"),
            many => format!("its {many} positions lie on one line; add one beside it"),
        };
        return Ok(Err(format!("{POSITIONS} gives no metres: {reason}")));
    };
    let PositionsFit { world, left, error, false_ones, mirrored } = fit;
    let off = |i: usize| DVec3::from_array(world.apply(pairs[i].0.to_array())).distance(pairs[i].1);
    if mirrored {
        return Ok(Err(format!(
            "{POSITIONS} does not give the metres: its positions fit the cameras only as their mirror image. Two columns \
             are exchanged, or z is depth; expected x to the east, y to the north and z upwards"
        )));
    }
    if error > CERTAIN {
        let worst = (0..pairs.len()).max_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap_or(0);
        return Ok(Err(format!(
            "{POSITIONS} does not give the metres: its positions fit the cameras to {left:.3} m only, so the metres \
             would be off by {:.0} %; {} is farthest off, by {:.3} m",
            100.0 * error,
            names[worst],
            off(worst)
        )));
    }
    let count = pairs.len() - false_ones.len();
    let least = fit_says(error);
    notes.push(format!("{count} positions in {POSITIONS} fit the cameras to {left:.3} m{least}{lacking}"));
    for i in false_ones {
        faults.push(format!(
            "the position of {} in {POSITIONS} is {:.1} m away from its camera and is not used; look for a wrong number or \
             name in its line",
            names[i],
            off(i)
        ));
    }
    if error > DOUBTFUL {
        faults.push(format!(
            "the metres by {POSITIONS} may be off by {:.0} %: its positions fit the cameras to {left:.3} m only; measure \
             a length to know them better",
            200.0 * error
        ));
    }
    Ok(Ok(world))
}

/// The error of a fit for the end of a sentence, if it is worth a word.
fn fit_says(error: f64) -> String {
    if error > AGREE / 2.0 {
        format!(" and give the metres to {:.1} %, two standard errors", 200.0 * error)
    } else {
        String::new()
    }
}

/// True if positions are longitudes and latitudes: they lie within hundredths of a degree, far from zero.
fn are_degrees(pairs: &[(DVec3, DVec3)]) -> bool {
    let Some(&(_, first)) = pairs.first() else { return false };
    let near = |p: &DVec3| (p.x - first.x).abs().max((p.y - first.y).abs()) < 0.05;
    let valid = |p: &DVec3| p.x.abs().min(p.y.abs()) <= 90.0 && p.x.abs().max(p.y.abs()) <= 180.0;
    let model = pairs.iter().map(|(at, _)| at.distance(pairs[0].0)).fold(0.0, f64::max);
    model > 0.0 && math::hypot(first.x, first.y) > 1.0 && pairs.iter().all(|(_, p)| near(p) && valid(p))
}

/// Turns longitude, latitude and height into metres east, north and up of the first. A table that has the
/// latitude first fits better that way, or has a longitude beyond 90 degrees there. Returns the place.
fn in_metres(pairs: &mut [(DVec3, DVec3)]) -> String {
    let converted = |turned: bool| -> (EarthPlace, Vec<(DVec3, DVec3)>) {
        let place = |p: &DVec3| EarthPlace {
            latitude: if turned { p.x } else { p.y },
            longitude: if turned { p.y } else { p.x },
            altitude: p.z,
        };
        let first = place(&pairs[0].1);
        (first, pairs.iter().map(|(at, p)| (*at, first.metres_to(&place(p)))).collect())
    };
    let left = |turned: bool| {
        let broken = pairs.iter().any(|(_, p)| (if turned { p.x } else { p.y }).abs() > 90.0);
        let fit = (!broken).then(|| fit_positions(&converted(turned).1, 0.0, String::new())).flatten();
        fit.map_or(f64::INFINITY, |fit| fit.left)
    };
    let (first, metres) = converted(left(true) < 0.5 * left(false));
    pairs.copy_from_slice(&metres);
    format!(", around latitude {:.7}, longitude {:.7}", first.latitude, first.longitude)
}

fn depths(table: &MetresTable, survey: &Survey, notes: &mut Vec<String>) -> Result<FoundWorld, ImportError> {
    let centres = centres(table, survey, |row| table.number(row, "depth"))?;
    let lacking = centres.lacking();
    let Centres { mut pairs, .. } = centres;
    if pairs.iter().all(|(_, depth)| *depth <= 0.0) && pairs.iter().any(|(_, depth)| *depth < 0.0) {
        pairs.iter_mut().for_each(|(_, depth)| *depth = -*depth);
        notes.push(format!("the depths in {DEPTHS} are negative; they count as metres below the surface"));
    }
    let remedy = "swim at different depths, or measure a length";
    Ok(match fit_depths(&pairs, format!("the depths in {DEPTHS}")) {
        Some((world, error)) if error <= CERTAIN => {
            let (count, percent) = (pairs.len(), 100.0 * error);
            notes.push(format!(
                "{count} depths in {DEPTHS} give the metres to {percent:.1} %, one standard error{lacking}"
            ));
            Ok(world)
        }
        Some((_, error)) => Err(format!(
            "{DEPTHS} does not give the metres: they would be off by {:.0} %; {remedy}",
            100.0 * error
        )),
        None => Err(format!(
            "{DEPTHS} gives no metres: {} of its images have a camera{lacking}; expected five or more that are not in one \
             plane; {remedy}",
            pairs.len()
        )),
    })
}

/// Metres by the GPS positions in the photographs themselves. If the first and the last photograph have none,
/// the others are not opened. Positions without an altitude do not count: they lie in a plane, and cameras do
/// not.
fn gps(
    images: &SourceFolder,
    survey: &Survey,
    notes: &mut Vec<String>,
    faults: &mut Vec<String>,
) -> Result<Option<World>, ImportError> {
    let mut photographs: Vec<&PosedImage> = survey.images.iter().collect();
    photographs.sort_by(|a, b| a.name.cmp(&b.name));
    let place = |image: &PosedImage| -> Result<Option<GpsPosition>, ImportError> {
        let Some(path) = images.image(&image.name)? else { return Ok(None) };
        Ok(read_exif(&path).map_err(ImportError::file(&path))?.gps)
    };
    let last = photographs.len().saturating_sub(1);
    let mut any = false;
    for i in [0, last] {
        any = any || photographs.get(i).map(|image| place(image)).transpose()?.flatten().is_some();
    }
    let mut found = Vec::new();
    for image in photographs.into_iter().filter(|_| any) {
        found.extend(place(image)?.map(|gps| (image.pose().center(), gps)));
    }
    if found.is_empty() {
        return Ok(None);
    }
    Ok(by_gps(&found, notes, faults))
}

fn by_gps(
    found: &[(DVec3, GpsPosition)],
    notes: &mut Vec<String>,
    faults: &mut Vec<String>,
) -> Option<World> {
    let places = found.iter().filter_map(|(at, gps)| {
        Some((*at, EarthPlace { latitude: gps.latitude, longitude: gps.longitude, altitude: gps.altitude? }))
    });
    let places: Vec<(DVec3, EarthPlace)> = places.collect();
    let Some(&(_, first)) = places.first() else {
        notes.push("the GPS positions of the photographs have no altitude, so they give no metres".into());
        return None;
    };
    let pairs: Vec<(DVec3, DVec3)> = places.iter().map(|(at, place)| (*at, first.metres_to(place))).collect();
    let source = format!(
        "the photographs' GPS positions: metres east, north and up of latitude {:.7}, longitude {:.7}, altitude {:.2} m",
        first.latitude, first.longitude, first.altitude
    );
    let count = pairs.len();
    let Some(PositionsFit { world, left, error, .. }) = fit_positions(&pairs, GPS_ERROR, source) else {
        notes.push(format!(
            "the GPS positions of {count} photographs give no metres: expected three or more that are not on one line; \
             measure a length"
        ));
        return None;
    };
    let percent = 200.0 * error;
    if error > CERTAIN {
        faults.push(format!(
            "the GPS positions of {count} photographs do not give the metres: GPS wanders by {GPS_ERROR} m and more, so \
             they would be off by up to {percent:.0} % on a swim as short as this; measure a length"
        ));
        return None;
    }
    notes.push(format!(
        "the GPS positions of {count} photographs fit the cameras to {left:.2} m and give the metres to {percent:.1} %, \
         two standard errors"
    ));
    Some(world)
}
