//! The table of all photographs, `photographs.csv`.

use std::io::Write;
use std::path::Path;

use super::record::{FinishedPhotograph, Record};

/// The table's name in the folder of the results.
pub const TABLE: &str = "photographs.csv";

/// The columns. Distances are in metres if they are known, else in units of the model.
const HEAD: &str = "photograph,colours,width,height,bits,distance_median,distance_90,distance_unit,\
    gain_red,gain_green,gain_blue,share_unknown,notes";

/// Writes the table, complete or not at all. `metres` is the number of metres of a unit of the model.
///
/// # Errors
/// The file cannot be written.
pub fn write_table(folder: &Path, record: &Record, metres: Option<f64>) -> std::io::Result<()> {
    use3d_files::write_atomically(&folder.join(TABLE), |w| {
        writeln!(w, "{HEAD}")?;
        record.entries().try_for_each(|entry| writeln!(w, "{}", row(entry, metres)))
    })
}

/// A field with its quotes, where it needs them.
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.into() }
}

fn row(entry: &FinishedPhotograph, metres: Option<f64>) -> String {
    let number = |v: Option<f64>, digits: usize| v.map_or_else(String::new, |v| format!("{v:.digits$}"));
    let scale = metres.unwrap_or(1.0);
    let [median, far] = [0, 1].map(|k| number(entry.distances.map(|d| scale * d[k]), 3));
    let unit = entry.distances.map_or("", |_| if metres.is_some() { "metre" } else { "model unit" });
    let gains = [0, 1, 2].map(|c| number(entry.gains().map(|g| f64::from(g[c])), 3));
    let colours = if entry.unknown.is_some() { "scene" } else { "mean of the scene (no camera)" };
    let fields = [
        quoted(&entry.name),
        colours.into(),
        entry.width.to_string(),
        entry.height.to_string(),
        entry.bits.to_string(),
        median,
        far,
        unit.into(),
        gains[0].clone(),
        gains[1].clone(),
        gains[2].clone(),
        number(entry.unknown, 4),
        quoted(&entry.notes.join("; ")),
    ];
    fields.join(",")
}
