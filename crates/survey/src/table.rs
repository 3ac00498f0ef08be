//! Tables of text whose first line names the columns: CSV as spreadsheets and other programs save it.
//!
//! Fields are separated by commas, semicolons or tabs; the first line decides. A field may stand in quotes.
//! A number such as `1,5` has a decimal comma if no comma separates fields and no number has a point.
//! Empty lines, rows without any text and, after the first line, lines that begin with `#` do not count.

use csv::{ReaderBuilder, StringRecord, Trim};

use crate::text::text;

/// A table.
#[derive(Clone, Debug, Default)]
pub struct TextTable {
    /// The number of the line that names the columns, from 1.
    pub first_line: usize,
    /// The names of the columns in small letters, without a `#` in front.
    pub columns: Vec<String>,
    /// The rows.
    pub rows: Vec<TextRow>,
}

/// A row of a table.
#[derive(Clone, Debug)]
pub struct TextRow {
    /// The number of its line, from 1.
    pub line: usize,
    fields: StringRecord,
}

impl TextTable {
    /// Parses a text. Lines before the first one that counts are left out if they begin with `comment`.
    ///
    /// # Errors
    /// The number of a line that is not UTF-8 or not CSV, and the reason.
    pub fn parse(bytes: &[u8], comment: &str) -> Result<Self, (usize, String)> {
        let mut rest = text(bytes)?;
        let mut first_line = 1;
        let header = loop {
            let (line, after) = rest.split_once('\n').unwrap_or((rest, ""));
            if !(line.trim().is_empty() || line.trim_start().starts_with(comment)) || rest.is_empty() {
                break line;
            }
            (rest, first_line) = (after, first_line + 1);
        };
        let separator = [';', '\t'].into_iter().find(|s| header.contains(*s)).unwrap_or(',');
        let mut builder = ReaderBuilder::new();
        builder.has_headers(false).flexible(true).trim(Trim::All).delimiter(separator as u8);
        let names = builder.from_reader(header.as_bytes()).into_records().next();
        let names = names.transpose().map_err(|e| (first_line, e.to_string()))?.unwrap_or_default();
        let name = |name: &str| name.trim_start_matches('#').trim().to_lowercase();
        let columns = names.iter().map(name).collect();
        let body = rest.split_once('\n').map_or("", |(_, body)| body);
        let mut rows = Vec::new();
        let mut place = TextPlace { rest: body, byte: 0, line: first_line + 1 };
        for record in builder.comment(Some(b'#')).from_reader(body.as_bytes()).into_records() {
            let fields = record
                .map_err(|e| (place.advance(e.position().map_or(0, csv::Position::byte)), e.to_string()))?;
            let line = place.advance(fields.position().map_or(0, csv::Position::byte));
            if fields.iter().any(|field| !field.is_empty()) {
                rows.push(TextRow { line, fields });
            }
        }
        let number = |field: &str| field.parse::<f64>().is_ok();
        let points = |row: &TextRow| row.fields.iter().any(|field| field.contains('.') && number(field));
        if separator != ',' && !rows.iter().any(points) {
            for row in &mut rows {
                let pointed = |field: &str| Some(field.replacen(',', ".", 1)).filter(|text| number(text));
                row.fields = row.fields.iter().map(|f| pointed(f).unwrap_or_else(|| f.into())).collect();
            }
        }
        Ok(Self { first_line, columns, rows })
    }

    /// The place of a column with one of these names.
    pub fn column(&self, names: &[&str]) -> Option<usize> {
        self.columns.iter().position(|column| names.contains(&column.as_str()))
    }
}

/// A place in a text, with the number of its line.
struct TextPlace<'t> {
    rest: &'t str,
    byte: u64,
    line: usize,
}

impl TextPlace<'_> {
    /// Goes on to a byte and over the empty lines and comments there, which the reader counts to the record
    /// after them. Returns the number of the line.
    fn advance(&mut self, byte: u64) -> usize {
        let passed = byte.saturating_sub(self.byte) as usize;
        let (before, after) = self.rest.split_at_checked(passed).unwrap_or((self.rest, ""));
        self.line += before.matches('\n').count();
        (self.rest, self.byte) = (after, self.byte.max(byte));
        while let Some((line, after)) = self.rest.split_once('\n')
            && (line.trim().is_empty() || line.starts_with('#'))
        {
            self.byte += line.len() as u64 + 1;
            (self.rest, self.line) = (after, self.line + 1);
        }
        self.line
    }
}

impl TextRow {
    /// The text in a column; empty if the row ends before it.
    pub fn get(&self, column: usize) -> &str {
        self.fields.get(column).unwrap_or_default()
    }

    /// The finite number in a column.
    pub fn number(&self, column: usize) -> Option<f64> {
        self.get(column).parse().ok().filter(|v: &f64| v.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> TextTable {
        TextTable::parse(text.as_bytes(), "#").unwrap()
    }

    #[test]
    fn separators_quotes_comments_and_empty_rows_are_understood() {
        for separator in [",", ";", "\t"] {
            let text = "\u{feff}# a reef\r\n\r\nImage, Depth ,note\r\na.jpg,1.5,\"x|y\"\r\n\r\n,,\r\n# b\r\nc.jpg,2\r\n";
            let table = parsed(&text.replace([',', '|'], separator));
            assert_eq!(
                (table.first_line, &table.columns[..]),
                (3, &["image", "depth", "note"].map(String::from)[..])
            );
            let lines: Vec<usize> = table.rows.iter().map(|row| row.line).collect();
            assert_eq!(lines, [4, 8]);
            assert_eq!(table.rows[0].get(2), format!("x{separator}y"));
            assert_eq!((table.rows[0].number(1), table.rows[1].number(1)), (Some(1.5), Some(2.0)));
            assert_eq!((table.rows[1].get(2), table.rows[1].number(0)), ("", None));
        }
    }

    #[test]
    fn a_decimal_comma_is_read_where_it_can_mean_nothing_else() {
        let numbers = |text: &str| parsed(text).rows.iter().map(|row| row.number(1)).collect::<Vec<_>>();
        assert_eq!(numbers("image;x\na,1.jpg;1,00\nb;-0,5\n"), [Some(1.0), Some(-0.5)]);
        assert_eq!(parsed("image;x\na,1.jpg;1,00\n").rows[0].get(0), "a,1.jpg");
        assert_eq!(numbers("image\tx\na\t2,25\n"), [Some(2.25)]);
        // A point beside it: the comma may separate thousands.
        assert_eq!(numbers("image;x\na;1,500\nb;2.5\n"), [None, Some(2.5)]);
        assert_eq!(numbers("image;x\na;1,500,000\n"), [None]);
        assert_eq!(numbers("image,x\na,\"1,5\"\n"), [None]);
    }

    #[test]
    fn another_comment_leaves_a_header_with_a_number_sign() {
        let table = TextTable::parse(b"#cameras 2\n#name,x\na.jpg,1\n# end\n", "#cameras").unwrap();
        assert_eq!(
            (table.first_line, table.column(&["name"]), table.column(&["y", "x"])),
            (2, Some(0), Some(1))
        );
        assert_eq!(table.rows.len(), 1);
    }

    #[test]
    fn texts_without_a_table_have_no_columns_and_other_encodings_are_refused() {
        for text in ["", "\n\n", "# only a comment"] {
            assert!(parsed(text).rows.is_empty(), "{text}");
        }
        let (line, reason) = TextTable::parse(b"image,depth\nM\xfcritz.jpg,1\n", "#").unwrap_err();
        assert!(line == 2 && reason.contains("UTF-8"), "{reason}");
    }
}
