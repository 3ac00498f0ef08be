//! The four formats of a table.

use std::fmt::Write;

use super::{Cell, Rank, Table};
use use3d_judge::names::distinct;

/// The texts for a number that does not apply, and for one that is missing.
const BLANK: &str = "–";
const MISSING: &str = "n/a";

/// A Markdown table of labelled rows: the first column has no head, and the numbers stand to the right.
pub fn markdown_table<'h>(
    heads: impl Iterator<Item = &'h str>,
    rows: impl Iterator<Item = Vec<String>>,
) -> String {
    let line = |out: &mut String, cells: &mut dyn Iterator<Item = &str>| {
        out.push('|');
        for cell in cells {
            let _ = write!(out, " {} |", cell.replace('|', "\\|"));
        }
        out.push('\n');
    };
    let heads: Vec<&str> = heads.collect();
    let mut out = String::from("| ");
    line(&mut out, &mut heads.iter().copied());
    let _ = writeln!(out, "|---|{}", "---:|".repeat(heads.len()));
    rows.for_each(|row| line(&mut out, &mut row.iter().map(String::as_str)));
    out
}

impl Table {
    fn text(&self, cell: &Cell, column: usize) -> String {
        match cell {
            Cell::Number { value, .. } if value.is_finite() => {
                format!("{value:.*}", self.columns[column].decimals)
            }
            Cell::Number { .. } | Cell::NotAvailable { .. } => MISSING.into(),
            Cell::Blank => BLANK.into(),
        }
    }

    fn label(row: &super::Row) -> String {
        if row.published { format!("{} (published)", row.name()) } else { row.name() }
    }

    /// GitHub Markdown: best bold, second best underlined. The configuration of each row and the reasons for
    /// missing numbers are below the table.
    pub fn markdown(&self) -> String {
        let heads: Vec<String> = self
            .columns
            .iter()
            .map(|column| {
                let gap = if column.group.is_empty() { "" } else { " " };
                format!("{}{gap}{}{}", column.group, column.name, column.better.arrow())
            })
            .collect();
        let rows = self.rows.iter().zip(self.ranks()).zip(self.marks()).map(|((row, ranks), mark)| {
            let cells = row.cells.iter().enumerate().map(|(c, cell)| {
                let text = self.text(cell, c);
                match ranks[c] {
                    Rank::Best => format!("**{text}**"),
                    Rank::Second => format!("<u>{text}</u>"),
                    Rank::Other => text,
                }
            });
            let label = Self::label(row);
            let label = if mark.is_empty() { label } else { format!("{label} [{mark}]") };
            std::iter::once(label).chain(cells).collect()
        });
        let table = markdown_table(heads.iter().map(String::as_str), rows);
        let mut out = format!("**{}**\n\n{table}", self.caption.replace('|', "\\|"));
        for (place, made) in self.made_by().into_iter().enumerate() {
            let _ = writeln!(out, "\n[{}] {made}", super::marked(place));
        }
        for reason in self.missing() {
            let _ = writeln!(out, "\n{MISSING}: {reason}");
        }
        out
    }

    /// Comma-separated values with one head line. Numbers are printed as elsewhere but without marks; missing
    /// numbers are empty. `made by` is the configuration of a row; a table with scenes as rows begins with
    /// the scene.
    pub fn csv(&self) -> String {
        let quote = |text: &str| {
            if text.contains([',', '"', '\n']) {
                format!("\"{}\"", text.replace('"', "\"\""))
            } else {
                text.to_string()
            }
        };
        let by_scene = self.rows.iter().any(|row| !row.scene.is_empty());
        let mut out = String::from(if by_scene { "scene," } else { "" });
        out.push_str("method,published,made by");
        for column in &self.columns {
            let name = format!("{} {}", column.group, column.name);
            let _ = write!(out, ",{}", quote(if column.group.is_empty() { &column.name } else { &name }));
        }
        out.push('\n');
        for row in &self.rows {
            if by_scene {
                let _ = write!(out, "{},", quote(&row.scene));
            }
            let _ = write!(out, "{},{},{}", quote(&row.label), row.published, quote(&row.made_by));
            for (c, cell) in row.cells.iter().enumerate() {
                let text = cell.value().map(|_| self.text(cell, c));
                let _ = write!(out, ",{}", text.unwrap_or_default());
            }
            out.push('\n');
        }
        out
    }

    /// A `booktabs` table: best bold, second best underlined; comments below it describe the configurations
    /// of the rows.
    pub fn latex(&self) -> String {
        let escape = |text: &str| {
            let mut out = String::new();
            for c in text.chars() {
                match c {
                    '&' | '%' | '$' | '#' | '_' | '{' | '}' => out.extend(['\\', c]),
                    '–' => out.push_str("--"),
                    'Δ' => out.push_str("$\\Delta$"),
                    'β' => out.push_str("$\\beta$"),
                    '₀' => out.push_str("$_0$"),
                    '²' => out.push_str("$^2$"),
                    '·' => out.push_str("$\\cdot$"),
                    '×' => out.push_str("$\\times$"),
                    other => out.push(other),
                }
            }
            out
        };
        let n = self.columns.len();
        let mut out = format!(
            "\\begin{{table}}[t]\n\\centering\\small\n\\begin{{tabular}}{{@{{}}l*{{{n}}}{{c}}@{{}}}}\n\\toprule\n"
        );
        let spans = self.spans();
        if !spans.is_empty() {
            let mut rules = String::new();
            let mut start = 2;
            for (group, count) in spans {
                let _ = write!(out, " & \\multicolumn{{{count}}}{{c}}{{{}}}", escape(group));
                if !group.is_empty() {
                    let _ = write!(rules, "\\cmidrule(lr){{{start}-{}}}", start + count - 1);
                }
                start += count;
            }
            let _ = writeln!(out, " \\\\\n{rules}");
        }
        out.push_str("Method");
        for column in &self.columns {
            let arrow = match column.better {
                super::Better::Higher => "$\\uparrow$",
                super::Better::Lower => "$\\downarrow$",
                super::Better::Neither => "",
            };
            let _ = write!(out, " & {}{arrow}", escape(&column.name));
        }
        out.push_str(" \\\\\n\\midrule\n");
        for (row, ranks) in self.rows.iter().zip(self.ranks()) {
            out.push_str(&escape(&Self::label(row)));
            for (c, cell) in row.cells.iter().enumerate() {
                let text = escape(&self.text(cell, c));
                let _ = match ranks[c] {
                    Rank::Best => write!(out, " & \\textbf{{{text}}}"),
                    Rank::Second => write!(out, " & \\underline{{{text}}}"),
                    Rank::Other => write!(out, " & {text}"),
                };
            }
            out.push_str(" \\\\\n");
        }
        let _ = write!(
            out,
            "\\bottomrule\n\\end{{tabular}}\n\\caption{{{}}}\n\\label{{tab:{}}}\n\\end{{table}}\n",
            escape(&self.caption),
            self.name
        );
        let made = self.rows.iter().map(|row| (&row.label, &row.made_by));
        for (label, made) in distinct(made.filter(|(_, made)| !made.is_empty())) {
            let _ = writeln!(out, "% {}: {}", escape(label), escape(made));
        }
        out
    }

    /// JSON with unrounded values and the source of every cell.
    ///
    /// # Errors
    /// A number is not finite.
    pub fn json(&self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(self)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::sample;

    #[test]
    fn markdown_marks_best_and_second_and_says_what_is_missing() {
        let text = sample().markdown();
        assert!(text.contains("| two [a] | **30.00** | **0.100** | – |"), "{text}");
        assert!(text.contains("| one (published) | **30.00** | <u>0.200</u> | 1.0 |"), "{text}");
        assert!(text.contains("n/a: put lpips.pth into models/"), "{text}");
        assert!(
            text.contains("\n[b] preset paper, changed: targets.proposer = fusion; seed: 42\n"),
            "{text}"
        );
    }

    #[test]
    fn csv_leaves_missing_numbers_empty() {
        assert_eq!(
            sample().csv(),
            "method,published,made by,A PSNR,A LPIPS,FPS\none,true,,30.00,0.200,1.0\ntwo,false,preset paper; seed: 42,30.00,0.100,\n\
             three,false,\"preset paper, changed: targets.proposer = fusion; seed: 42\",29.00,,2.0\n"
        );
    }

    #[test]
    fn latex_escapes_and_spans() {
        let text = sample().latex();
        assert!(text.contains("\\multicolumn{2}{c}{A} & \\multicolumn{1}{c}{}"), "{text}");
        assert!(text.contains("50 \\% \\& more") && text.contains("\\textbf{0.100}"), "{text}");
    }
}
