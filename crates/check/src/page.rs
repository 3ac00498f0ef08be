//! The report as one HTML page, with small pictures of the views that findings are about. The page needs no
//! other file and no network.

use std::fmt::Write;

use use3d_capture::{Capture, Reach};

use crate::above::drawing;
use crate::report::{CheckReport, Severity};

/// A small picture of a view.
#[derive(Clone, Debug)]
pub struct Picture {
    /// The view's name.
    pub name: String,
    /// Its `data:` address.
    pub address: String,
}

/// Small pictures under a heading.
#[derive(Clone, Debug)]
pub struct Gallery {
    /// The heading.
    pub title: String,
    /// A sentence below it.
    pub text: String,
    /// The pictures.
    pub pictures: Vec<Picture>,
}

const STYLE: &str = "body{font:16px/1.5 system-ui,sans-serif;max-width:56rem;margin:2rem auto;padding:0 1rem;\
    color:#1b1f23;background:#fff}article{border-left:.4rem solid #999;padding:.1rem 1rem;margin:1.2rem 0}\
    article.serious{border-color:#b3261e}article.minor{border-color:#c98a00}article.note{border-color:#5b8db8}article.good{border-color:#2e7d32}\
    figure{display:inline-block;width:min(14rem,45%);margin:.4rem .6rem .4rem 0;font-size:.8rem}\
    figure.small{width:min(7rem,30%)}h2{margin-top:2.5rem}code{overflow-wrap:anywhere}figure.cells{display:block;width:auto}img,svg{display:block;max-width:100%}\
    @media(prefers-color-scheme:dark){body{color:#e6e6e6;background:#16191c}}";

/// The pictures that one finding shows.
const MOST: usize = 8;

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Text with commands between backquotes.
fn marked(text: &str) -> String {
    let mut out = String::new();
    for (i, part) in escaped(text).split('`').enumerate() {
        // Every second part stands between a pair.
        let whole = i % 2 == 0;
        let _ = if whole { write!(out, "{part}") } else { write!(out, "<code>{part}</code>") };
    }
    out
}

impl CheckReport {
    /// The names of the views whose pictures [`page`] shows, each once.
    pub fn pictured(&self) -> std::collections::BTreeSet<String> {
        self.faults().flat_map(|f| f.views.iter().take(MOST)).cloned().collect()
    }
}

/// A drawing of a picture's cells: blue where tracks reach, red where none does.
fn cells(reach: &Reach) -> String {
    const CELL: usize = 12;
    let (rows, columns) = (reach.cells.len(), reach.cells.first().map_or(0, Vec::len));
    let (width, height) = (columns * CELL, rows * CELL);
    let mut out = format!(
        "<figure class=\"cells\"><svg width=\"{width}\" height=\"{height}\" role=\"img\" aria-label=\"parts of the picture without \
         points\"><rect width=\"{width}\" height=\"{height}\" fill=\"#5b8db8\"/><path fill=\"#f2c1bb\" stroke=\"#b3261e\" \
         d=\""
    );
    for (row, column) in (0..rows).flat_map(|r| (0..columns).map(move |c| (r, c))) {
        if reach.is_bare(column, row) {
            // Writing to a string cannot fail.
            let _ = write!(out, "M{} {}h{CELL}v{CELL}h-{CELL}z", column * CELL, row * CELL);
        }
    }
    out.push_str("\"/></svg>blue: points were found again here; red: none in any view</figure>\n");
    out
}

/// A small picture with its name below it; the name alone without a picture.
fn figure(class: &str, name: &str, picture: Option<&Picture>) -> String {
    let name = escaped(name);
    let image =
        picture.map(|p| format!("<img alt=\"{name}\" loading=\"lazy\" src=\"{}\">", escaped(&p.address)));
    format!("<figure class=\"{class}\">{}{name}</figure>\n", image.unwrap_or_default())
}

/// Writes the page: the findings with `pictures` of their views, the path of the camera, and galleries.
pub fn page(report: &CheckReport, pictures: &[Picture], capture: &Capture, galleries: &[Gallery]) -> String {
    let title = escaped(&format!("Check of {}", report.capture));
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\n\
         <title>{title}</title><style>{STYLE}</style>\n<h1>{title}</h1>\n<p>{}.</p>\n",
        escaped(&report.summary())
    );
    // Writing to a string cannot fail.
    for finding in &report.findings {
        let word = finding.severity.word();
        let _ = writeln!(out, "<article class=\"{word}\"><p><b>{word}</b>: {}</p>", marked(&finding.text));
        if !finding.remedy.is_empty() {
            let _ = writeln!(out, "<p>Do this: {}.</p>", marked(&finding.remedy));
        }
        if finding.subject == "reach" && finding.severity <= Severity::Minor {
            out.push_str(&Reach::worst(&report.figures.reach).map(cells).unwrap_or_default());
        }
        if finding.severity <= Severity::Minor {
            for name in finding.views.iter().take(MOST) {
                let picture = pictures.iter().find(|p| p.name == *name);
                out.push_str(&figure("view", name, picture));
            }
            if finding.views.len() > MOST {
                let _ = writeln!(out, "<p>and {} more</p>", finding.views.len() - MOST);
            }
        }
        out.push_str("</article>\n");
    }
    let above = drawing(capture);
    if !above.is_empty() {
        let _ = writeln!(
            out,
            "<h2>The path of the camera</h2>\n<figure class=\"cells\">{above}The line goes through the places \
             where the photographs were taken, in the order of their names, and begins at the large dot. The small dots are points of the \
             scene.</figure>"
        );
    }
    for Gallery { title, text, pictures } in galleries {
        let _ = writeln!(out, "<h2>{}</h2>\n<p>{}</p>", escaped(title), escaped(text));
        pictures.iter().for_each(|p| out.push_str(&figure("small", &p.name, Some(p))));
    }
    out.push_str("</html>\n");
    out
}
