//! The table "Internal/External camera parameters": a line for each photograph.

use std::path::Path;

use glam::{DMat3, DVec3};
use use3d_capture::{FileName, Pose, shown};
use use3d_numerics::math;
use use3d_survey::{ReadError, TextTable, first_bytes, read_at_most, tidy_name, unread};

use crate::registration::{RegisteredShot, Registration, ShareLens};

type Result<T> = std::result::Result<T, ReadError>;

/// The largest table that is read, bytes: more than a million photographs.
const LARGEST: u64 = 1 << 28;
/// Width of the film that `f` is stated for, millimetres.
const FILM: f64 = 36.0;
/// The names of each column, the older one first. The first [`NEEDED`] must be there.
const COLUMNS: [&[&str]; 16] = [
    &["name"],
    &["x"],
    &["y"],
    &["alt", "z"],
    &["heading", "yaw"],
    &["pitch"],
    &["roll"],
    &["f", "f_35mm"],
    &["px", "px_norm"],
    &["py", "py_norm"],
    &["k1"],
    &["k2"],
    &["k3"],
    &["k4"],
    &["t1"],
    &["t2"],
];
const NEEDED: usize = 8;

/// Lines before the names of the columns begin with this: some versions write the number of cameras there.
const COUNT: &str = "#cameras";

/// The first needed column that is not there.
fn missing(table: &TextTable) -> Option<&'static str> {
    COLUMNS[..NEEDED].iter().find(|names| table.column(names).is_none()).map(|names| names[0])
}

/// True if a file's first line names the columns of a table of cameras.
pub fn is_cameras_table(path: &Path) -> bool {
    let Some(head) = first_bytes(path, 4096) else { return false };
    // The last line may be cut off within a character or a quoted field.
    let whole = head.iter().rposition(|b| *b == b'\n').map_or(&head[..], |end| &head[..end]);
    TextTable::parse(whole, COUNT).is_ok_and(|table| missing(&table).is_none())
}

/// Reads a table.
///
/// # Errors
/// A file that cannot be read, is no such table, or holds something that cannot be used; the message names
/// the line.
pub fn read_table(path: &Path) -> Result<Registration> {
    parse_table(&read_at_most(path, LARGEST, "export fewer cameras")?, path)
}

/// Reads the bytes of a table; `path` is for messages.
///
/// # Errors
/// As [`read_table`].
pub fn parse_table(bytes: &[u8], path: &Path) -> Result<Registration> {
    let broken = |line: usize, reason: String| ReadError::broken(path, format!("line {line}"), reason);
    let table = TextTable::parse(bytes, COUNT).map_err(|(line, reason)| broken(line, reason))?;
    if table.columns.iter().all(String::is_empty) {
        return Err(ReadError::broken(path, "file", "it is empty; export the cameras again"));
    }
    let first = table.first_line;
    if let Some(missing) = missing(&table) {
        let reason = format!(
            "there is no column `{missing}`; expected name, x, y, alt, heading, pitch, roll and f: export the \
             registration as \"Internal/External camera parameters\""
        );
        return Err(broken(first, reason));
    }
    let places = COLUMNS.map(|names| table.column(names));
    let mut registration = Registration::default();
    let columns = table.columns.iter().map(String::as_str).filter(|name| !name.is_empty());
    registration.notes.extend(unread("the table of cameras", columns, &COLUMNS.concat().join(" ")));
    for row in &table.rows {
        let broken = |reason: String| broken(row.line, reason);
        // A column that is not in the table is 0, and one that is must be in every line.
        let value = |column: usize| -> Result<f64> {
            let Some(at) = places[column] else { return Ok(0.0) };
            row.number(at).ok_or_else(|| {
                let name = COLUMNS[column][0];
                broken(format!(
                    "`{name}` is {:?}; expected a number with a decimal point",
                    shown(row.get(at))
                ))
            })
        };
        let text = places[0].map_or("", |at| row.get(at));
        let name = FileName::new(&tidy_name(text))
            .map_err(|e| broken(format!("`name` is {:?}: {e}; export the cameras again", shown(text))))?;
        let centre = DVec3::new(value(1)?, value(2)?, value(3)?);
        let angles = [value(4)?, value(5)?, value(6)?];
        let f = value(7)?;
        if f <= 0.0 {
            return Err(broken(format!(
                "`f` is {f}; expected millimetres above 0: align the photographs again"
            )));
        }
        let lens = ShareLens {
            focal: f / FILM,
            principal: [value(8)?, value(9)?],
            radial: [value(10)?, value(11)?, value(12)?, value(13)?],
            tangential: [value(14)?, value(15)?],
        };
        let pose = Pose::from_center(turn(angles), centre);
        registration.shots.push(RegisteredShot { name, pose, lens });
    }
    if registration.shots.is_empty() {
        let reason = "it has no cameras; align the photographs, select a component, and export again";
        return Err(broken(first, reason.into()));
    }
    if in_degrees(&registration) {
        let reason = "the positions are longitudes and latitudes, which cannot be used: export again with the \
            coordinate system `Grid plane`";
        return Err(broken(first, reason.into()));
    }
    Ok(registration)
}

/// True if positions look like longitudes and latitudes: within hundredths of a degree, and hundreds of times
/// as far apart in height.
fn in_degrees(registration: &Registration) -> bool {
    let centres = registration.shots.iter().map(|shot| shot.pose.center());
    let (low, high) = centres.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, h), c| (l.min(c), h.max(c)));
    let [x, y, z] = (high - low).to_array();
    let on_earth = low.x >= -180.0 && high.x <= 180.0 && low.y >= -90.0 && high.y <= 90.0;
    registration.shots.len() > 2 && on_earth && x.max(y) < 0.02 && z > 300.0 * x.max(y)
}

/// World to camera by heading, pitch and roll in degrees.
fn turn([heading, pitch, roll]: [f64; 3]) -> DMat3 {
    let of = |degrees: f64| (math::sin(degrees.to_radians()), math::cos(degrees.to_radians()));
    let ((sh, ch), (sp, cp), (sr, cr)) = (of(-heading), of(pitch), of(roll));
    let about_z = DMat3::from_cols(DVec3::new(ch, sh, 0.0), DVec3::new(-sh, ch, 0.0), DVec3::Z);
    let about_x = DMat3::from_cols(DVec3::X, DVec3::new(0.0, cp, sp), DVec3::new(0.0, -sp, cp));
    let about_y = DMat3::from_cols(DVec3::new(cr, 0.0, -sr), DVec3::Y, DVec3::new(sr, 0.0, cr));
    // That camera looks along -z with y up.
    DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)) * (about_z * about_x * about_y).transpose()
}
