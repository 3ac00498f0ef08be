//! Tables in the paper's own layout, as Markdown, CSV, LaTeX and JSON.
//!
//! A cell is a number with the artifact it came from, or the reason why there is none. Best and second best
//! are marked per column among all rows that have a number, including published ones (they are labelled as
//! published).

mod batch;
mod format;
pub mod means;
pub mod methods;
pub mod paper;
pub mod published;
mod truth;

use std::io;
use std::path::Path;

pub use format::markdown_table;
use serde::Serialize;
use use3d_numerics::math;

use use3d_judge::names::{distinct, in_variant};

/// The better direction of a quantity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Better {
    /// Larger numbers are better.
    Higher,
    /// Smaller numbers are better.
    Lower,
    /// The number is information, not a score.
    Neither,
}

impl Better {
    /// The arrow of column heads.
    pub fn arrow(self) -> &'static str {
        match self {
            Self::Higher => "↑",
            Self::Lower => "↓",
            Self::Neither => "",
        }
    }
}

/// One column.
#[derive(Clone, Debug, Serialize)]
pub struct Column {
    /// The head over several columns (a data set, a scene); empty for none.
    pub group: String,
    /// The quantity.
    pub name: String,
    /// The better direction.
    pub better: Better,
    /// Decimals printed.
    pub decimals: usize,
}

impl Column {
    /// A column of a group.
    pub fn new(group: &str, name: &str, better: Better, decimals: usize) -> Self {
        Self { group: group.into(), name: name.into(), better, decimals }
    }

    /// Its name with the arrow of the better direction.
    pub fn head(&self) -> String {
        format!("{}{}", self.name, self.better.arrow())
    }
}

/// One cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Cell {
    /// A measured or published number, with its source.
    Number {
        /// The value, unrounded.
        value: f64,
        /// The artifact's digest, or the publication.
        source: String,
    },
    /// A missing number, with its reason.
    NotAvailable {
        /// The reason, for example a missing file, with the remedy.
        reason: String,
    },
    /// The quantity does not apply to this row.
    Blank,
}

impl Cell {
    /// The number, if there is one.
    pub fn value(&self) -> Option<f64> {
        match self {
            Self::Number { value, .. } if value.is_finite() => Some(*value),
            _ => None,
        }
    }
}

/// One row.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// The scene that the row is of, in a table with scenes as rows; empty in other tables.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub scene: String,
    /// The method or variant.
    pub label: String,
    /// Copied from the paper rather than measured here.
    pub published: bool,
    /// The configuration behind its numbers ([`use3d_judge::configuration`]); empty if it is not known.
    pub made_by: String,
    /// One cell per column.
    pub cells: Vec<Cell>,
}

impl Row {
    /// A row that was measured here.
    pub fn own(label: String, cells: Vec<Cell>) -> Self {
        Self { scene: String::new(), label, published: false, made_by: String::new(), cells }
    }

    /// A row from the paper.
    pub(crate) fn published(label: &str, cells: Vec<Cell>) -> Self {
        Self { published: true, ..Self::own(label.into(), cells) }
    }

    /// The name of the row: its scene, if it has one, and its method.
    pub fn name(&self) -> String {
        if self.scene.is_empty() { self.label.clone() } else { in_variant(&self.scene, &self.label) }
    }
}

/// A table.
#[derive(Clone, Debug, Serialize)]
pub struct Table {
    /// File stem, e.g. `reconstruction`.
    pub name: String,
    /// A description in one line.
    pub caption: String,
    /// The columns.
    pub columns: Vec<Column>,
    /// The rows.
    pub rows: Vec<Row>,
}

/// Writes the tables in all their formats into a folder, which is made.
///
/// # Errors
/// The error of the first file that cannot be written.
pub fn write(dir: &Path, tables: &[Table]) -> io::Result<()> {
    std::fs::create_dir_all(dir)?;
    for table in tables {
        let file = |extension: &str| dir.join(format!("{}.{extension}", table.name));
        std::fs::write(file("md"), table.markdown())?;
        std::fs::write(file("csv"), table.csv())?;
        std::fs::write(file("tex"), table.latex())?;
        let text = table.json()?;
        std::fs::write(file("json"), text + "\n")?;
    }
    Ok(())
}

/// The mark of the item at index `place`: a to z, then a1.
pub(crate) fn marked(place: usize) -> String {
    let letter = char::from(b'a' + (place % 26) as u8);
    if place < 26 { letter.to_string() } else { format!("{letter}{}", place / 26) }
}

/// The rank of a number in its column.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rank {
    /// The best of its column (ties share it).
    Best,
    /// The second best.
    Second,
    /// Anything else.
    Other,
}

impl Table {
    /// The rank of every cell, rows × columns. A row with a scene is compared with the rows of its scene. A
    /// column with fewer than two numbers has no best.
    pub fn ranks(&self) -> Vec<Vec<Rank>> {
        let mut ranks = vec![vec![Rank::Other; self.columns.len()]; self.rows.len()];
        let mut first = 0;
        for rows in self.rows.chunk_by(|a, b| a.scene == b.scene) {
            self.rank(rows, &mut ranks[first..first + rows.len()]);
            first += rows.len();
        }
        ranks
    }

    fn rank(&self, rows: &[Row], ranks: &mut [Vec<Rank>]) {
        for (c, column) in self.columns.iter().enumerate() {
            let sign = match column.better {
                Better::Higher => -1.0,
                Better::Lower => 1.0,
                Better::Neither => continue,
            };
            // Values are compared as printed: values that look equal rank equal.
            let scale = math::powi(10f64, column.decimals as i32);
            let printed =
                |row: &Row| row.cells.get(c).and_then(Cell::value).map(|v| (sign * v * scale).round() as i64);
            let mut values: Vec<i64> = rows.iter().filter_map(printed).collect();
            if values.len() < 2 {
                continue;
            }
            values.sort_unstable();
            values.dedup();
            for (row, ranks) in rows.iter().zip(ranks.iter_mut()) {
                match printed(row).and_then(|value| values.binary_search(&value).ok()) {
                    Some(0) => ranks[c] = Rank::Best,
                    Some(1) => ranks[c] = Rank::Second,
                    _ => {}
                }
            }
        }
    }

    /// The configurations behind the rows, each text once, in order of appearance.
    pub fn made_by(&self) -> Vec<&str> {
        distinct(self.rows.iter().map(|row| row.made_by.as_str()).filter(|made| !made.is_empty()))
    }

    /// The mark after each row's name that refers to its configuration: a, b, …; empty if the configuration
    /// is not known.
    pub fn marks(&self) -> Vec<String> {
        let made_by = self.made_by();
        let mark = |row: &Row| {
            let place = made_by.iter().position(|made| *made == row.made_by);
            place.map_or_else(String::new, marked)
        };
        self.rows.iter().map(mark).collect()
    }

    /// The distinct reasons for missing cells, in order of appearance.
    pub fn missing(&self) -> Vec<&str> {
        let cells = self.rows.iter().flat_map(|row| &row.cells);
        distinct(cells.filter_map(|cell| match cell {
            Cell::NotAvailable { reason } => Some(reason.as_str()),
            _ => None,
        }))
    }

    /// The heads over several columns, each with the number of its columns; empty if no column has one.
    pub(crate) fn spans(&self) -> Vec<(&str, usize)> {
        let alike = self.columns.chunk_by(|a, b| a.group == b.group);
        let spans: Vec<(&str, usize)> = alike.map(|span| (&*span[0].group, span.len())).collect();
        if spans.iter().all(|(group, _)| group.is_empty()) { Vec::new() } else { spans }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn sample() -> Table {
        let n = |value| Cell::Number { value, source: "abc".into() };
        Table {
            name: "t".into(),
            caption: "A caption with 50 % & more".into(),
            columns: vec![
                Column::new("A", "PSNR", Better::Higher, 2),
                Column::new("A", "LPIPS", Better::Lower, 3),
                Column::new("", "FPS", Better::Neither, 1),
            ],
            rows: vec![
                Row::published("one", vec![n(30.001), n(0.2), n(1.0)]),
                Row {
                    made_by: "preset paper; seed: 42".into(),
                    ..Row::own("two".into(), vec![n(30.004), n(0.1), Cell::Blank])
                },
                Row {
                    made_by: "preset paper, changed: targets.proposer = fusion; seed: 42".into(),
                    ..Row::own(
                        "three".into(),
                        vec![
                            n(29.0),
                            Cell::NotAvailable { reason: "put lpips.pth into models/".into() },
                            n(2.0),
                        ],
                    )
                },
            ],
        }
    }

    #[test]
    fn ranks_follow_the_printed_digits_and_the_direction() {
        let ranks = sample().ranks();
        let column = |c: usize| ranks.iter().map(|r| r[c]).collect::<Vec<_>>();
        assert_eq!(column(0), [Rank::Best, Rank::Best, Rank::Second]);
        assert_eq!(column(1), [Rank::Second, Rank::Best, Rank::Other]);
        assert_eq!(column(2), [Rank::Other; 3]);
        assert_eq!(sample().missing(), ["put lpips.pth into models/"]);
    }

    #[test]
    fn a_row_of_a_scene_is_ranked_among_the_rows_of_its_scene() {
        let mut table = sample();
        let mut others = table.rows.clone();
        table.rows.iter_mut().for_each(|row| row.scene = "reef".into());
        others.iter_mut().for_each(|row| row.scene = "wreck".into());
        table.rows.extend(others);
        let column: Vec<Rank> = table.ranks().iter().map(|r| r[0]).collect();
        assert_eq!(column, [[Rank::Best, Rank::Best, Rank::Second]; 2].concat());
        assert!(table.markdown().contains("| wreck · two [a] | **30.00** |"), "{}", table.markdown());
        assert!(
            table.csv().starts_with("scene,method,published,made by,")
                && table.csv().contains("\nwreck,two,")
        );
        assert!(table.latex().contains("wreck $\\cdot$ two & "), "{}", table.latex());
        assert!(
            table.json().unwrap().contains("\"scene\": \"wreck\"")
                && !sample().json().unwrap().contains("scene")
        );
    }
}
