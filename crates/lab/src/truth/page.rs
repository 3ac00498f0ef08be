//! The table for readers, as Markdown: a summary over all captures, stage 1 and its water, then each capture
//! by itself.
//!
//! The best mean of a column is bold. Everything on the page follows from the figures; it contains no time,
//! place or machine.

use std::fmt::Write;

use use3d_judge::names::distinct;
use use3d_report::tables::{Better, markdown_table};

use super::figures::{CaptureFigures, Figure, Figures, TruthFigures};
use super::picture::Sheet;

/// A column: metric, head, decimals, factor, and the better direction.
struct Column {
    metric: &'static str,
    head: &'static str,
    decimals: usize,
    factor: f64,
    better: Better,
}

const fn column(metric: &'static str, head: &'static str, decimals: usize, better: Better) -> Column {
    Column { metric, head, decimals, factor: 1.0, better }
}

const fn percent(metric: &'static str, head: &'static str) -> Column {
    Column { metric, head, decimals: 1, factor: 100.0, better: Better::Lower }
}

const fn both(psnr: &'static str, delta_e: &'static str) -> [Column; 2] {
    [column(psnr, "", 1, Better::Higher), column(delta_e, "", 1, Better::Lower)]
}

/// The columns of a capture's table.
const ROWS: [Column; 11] = [
    column("truth_psnr_raw", "PSNR", 2, Better::Higher),
    column("truth_psnr_channel", "PSNR, gain per channel", 2, Better::Higher),
    column("truth_psnr_affine", "PSNR, affine", 2, Better::Higher),
    column("truth_delta_e_raw", "ΔE₀₀", 2, Better::Lower),
    column("truth_delta_e_channel", "ΔE₀₀, gain per channel", 2, Better::Lower),
    column("truth_delta_e_affine", "ΔE₀₀, affine", 2, Better::Lower),
    column("truth_delta_e_1976_channel", "ΔE of 1976, gain per channel", 2, Better::Lower),
    column("grey_near", "greys near, °", 1, Better::Lower),
    column("grey_far", "greys far, °", 1, Better::Lower),
    column("path_w_delta_e", "path wΔE", 3, Better::Lower),
    column("path_w_ssim", "path wSSIM", 4, Better::Higher),
];

/// The summaries over captures: two metrics share a cell.
const SUMMARIES: [(&str, [Column; 2]); 3] = [
    ("Against the true clean scene, as it is", both("truth_psnr_raw", "truth_delta_e_raw")),
    ("After one gain per channel and image", both("truth_psnr_channel", "truth_delta_e_channel")),
    ("After one affine map of colours (3×4) per image", both("truth_psnr_affine", "truth_delta_e_affine")),
];

/// The columns of the table of stage 1.
const SCENES: [Column; 8] = [
    column("held_out_psnr", "held-out PSNR", 2, Better::Higher),
    percent("depth_error", "depth, %"),
    percent("holes", "holes, %"),
    percent("attenuation_error_median", "β_attn, median, %"),
    percent("attenuation_error_worst", "β_attn, worst, %"),
    percent("backscatter_error_median", "β_bs, median, %"),
    percent("backscatter_error_worst", "β_bs, worst, %"),
    column("gaussians", "Gaussians", 0, Better::Neither),
];

impl Column {
    /// A text like `18.42 ± 0.31`, followed by the number of seeds if some have no figure; a dash if none has
    /// one.
    fn text(&self, figure: Option<&Figure>, seeds: usize) -> String {
        let Some((figure, mean)) = figure.and_then(|f| Some((f, f.value()?))) else { return "–".into() };
        let number = |v: f64| format!("{:.*}", self.decimals, v * self.factor);
        let mut text = number(mean);
        if let Some(spread) = figure.spread {
            let _ = write!(text, " ± {}", number(spread.get()));
        }
        let counted = figure.of.values().filter(|s| s.value().is_some()).count();
        if counted < seeds {
            let _ = write!(text, " ({counted} of {seeds})");
        }
        text
    }

    /// The best mean among some rows.
    fn best<'f>(&self, rows: impl Iterator<Item = Option<&'f Figures>>) -> Option<f64> {
        let means = rows.filter_map(|figures| figures?.get(self.metric)?.value());
        match self.better {
            Better::Higher => means.max_by(f64::total_cmp),
            Better::Lower => means.min_by(f64::total_cmp),
            Better::Neither => None,
        }
    }

    /// The cell, bold if it is the best.
    fn cell(&self, figures: Option<&Figures>, seeds: usize, best: Option<f64>) -> String {
        let figure = figures.and_then(|f| f.get(self.metric));
        let text = self.text(figure, seeds);
        let is_best = best.is_some() && figure.and_then(Figure::value) == best;
        if is_best { format!("**{text}**") } else { text }
    }
}

/// A table of labelled rows, with the best cell of each column in bold.
fn ranked(columns: &[Column], rows: &[(String, &Figures)], seeds: usize) -> String {
    let best: Vec<Option<f64>> = columns.iter().map(|c| c.best(rows.iter().map(|(_, f)| Some(*f)))).collect();
    let line = |(label, figures): &(String, &Figures)| {
        let cells = columns.iter().zip(&best).map(|(c, best)| c.cell(Some(figures), seeds, *best));
        std::iter::once(label.clone()).chain(cells).collect()
    };
    markdown_table(columns.iter().map(|c| c.head), rows.iter().map(line))
}

fn row<'f>(capture: &'f CaptureFigures, label: &str) -> Option<&'f Figures> {
    capture.rows.iter().find(|r| r.label == label).map(|r| &r.figures)
}

/// One summary: a row per compared method, a column per capture.
fn summary(columns: &[Column; 2], captures: &[CaptureFigures], seeds: usize) -> String {
    // The rows stand in the order of the first capture that has them.
    let labels = distinct(captures.iter().flat_map(|c| &c.rows).map(|row| row.label.as_str()));
    let cell = |capture: &CaptureFigures, label: &str| {
        let of = columns.each_ref().map(|column| {
            let best = column.best(labels.iter().map(|l| row(capture, l)));
            column.cell(row(capture, label), seeds, best)
        });
        of.join(" / ")
    };
    let rows = labels.iter().map(|label| {
        std::iter::once((*label).to_string()).chain(captures.iter().map(|c| cell(c, label))).collect()
    });
    markdown_table(captures.iter().map(|c| c.name.as_str()), rows)
}

/// The page: the file `truth.md`.
pub fn markdown(figures: &TruthFigures, pictures: &[Sheet]) -> String {
    let seeds = figures.seeds.len();
    let named: Vec<String> = figures.seeds.iter().map(u64::to_string).collect();
    let over = match seeds {
        1 => format!("One seed ({}): no spread is known.", named[0]),
        _ => format!(
            "Mean ± standard deviation over {seeds} seeds ({}), each used for captures and trainings.",
            named.join(", ")
        ),
    };
    let (width, height) = figures.recipe.size;
    let mut out = format!(
        "# Against the truth\n\n```\n{}\n```\n\n{over} {} views of {width}×{height} per capture, {} + {} steps. \
         Scores are means over the held-out views, where the truth shows a surface; the best of a column is bold.\n",
        figures.command,
        figures.recipe.views,
        figures.recipe.iterations,
        figures.recipe.enhance_iterations()
    );
    for failed in &figures.failed {
        let _ = write!(out, "\n**Failed, and left out of the figures:** {failed}\n");
    }
    let captures = &figures.captures;
    for (title, columns) in &SUMMARIES {
        let _ = write!(out, "\n## {title}: PSNR (dB) / ΔE₀₀\n\n{}", summary(columns, captures, seeds));
    }
    let scenes: Vec<(String, &Figures)> = captures
        .iter()
        .flat_map(|c| c.scenes.iter().map(move |s| (format!("{}: {}", c.name, s.label), &s.figures)))
        .collect();
    // No best cell is marked, because the captures differ.
    let plain = SCENES.map(|c| Column { better: Better::Neither, ..c });
    let _ = write!(out, "\n## Stage 1 and its water\n\n{}", ranked(&plain, &scenes, seeds));
    for capture in captures {
        let _ = write!(out, "\n## {}\n\n{}.\n\n", capture.name, capture.about);
        let rows: Vec<(String, &Figures)> =
            capture.rows.iter().map(|r| (r.label.clone(), &r.figures)).collect();
        out.push_str(&ranked(&ROWS, &rows, seeds));
        if let Some(sheet) = pictures.iter().find(|s| s.capture == capture.name) {
            let _ = write!(
                out,
                "\n![{0}: a held-out view](pictures/{0}.png)\n\n*A held-out view: {1}.*\n",
                capture.name,
                sheet.shows.join(" · ")
            );
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::truth::captures::CAPTURES;
    use crate::truth::figures::{FORMAT, of_capture, tests::scored};
    use crate::truth::runs::{DEFAULT, LearntFrom, Recipe};
    use use3d_capture::Image;
    use use3d_judge::scores::Method;

    fn figures(seeds: &[u64]) -> TruthFigures {
        let all: Vec<_> = seeds
            .iter()
            .map(|&seed| {
                let by = seed as f64;
                scored(
                    (seed, "air", DEFAULT),
                    None,
                    &[
                        (Method::Captured, &[("truth_psnr_raw", 10.0 + by), ("truth_delta_e_raw", 5.0)]),
                        (Method::Clear, &[("truth_psnr_raw", 20.0 + by), ("truth_delta_e_raw", 9.0)]),
                        (Method::Reconstruction, &[("psnr", 30.0), ("depth_error", 0.123)]),
                    ],
                )
            })
            .collect();
        let recipe = Recipe {
            views: 5,
            size: (48, 32),
            iterations: 10,
            baselines: false,
            methods: false,
            sets: vec![],
            learnt_from: LearntFrom::Nothing,
        };
        let air = CAPTURES.iter().find(|c| c.name == "air").unwrap();
        TruthFigures {
            format: FORMAT.into(),
            version: 1,
            program: "0".into(),
            command: recipe.command(&["air"], seeds),
            recipe,
            seeds: seeds.to_vec(),
            pipelines: [].into(),
            failed: vec![],
            captures: vec![of_capture(air, &all)],
        }
    }

    #[test]
    fn the_best_is_bold_spreads_are_given_and_what_is_missing_is_a_dash() {
        let image = Image::filled(4, 3, 0.5);
        let sheet = Sheet { capture: "air".into(), image, shows: vec!["photograph", "truth"] };
        let page = markdown(&figures(&[1, 3]), &[sheet]);
        assert!(page.contains("| photographs | 12.00 ± 1.41 | – | – | **5.00 ± 0.00** |"), "{page}");
        assert!(page.contains("| `clear` | **22.00 ± 1.41** | – | – | 9.00 ± 0.00 |"), "{page}");
        assert!(page.contains("| photographs | 12.0 ± 1.4 / **5.0 ± 0.0** |"), "{page}");
        assert!(
            page.contains("| air: stage 1 | 30.00 ± 0.00 | 12.3 ± 0.0 | – | – | – | – | – | 10 ± 0 |"),
            "{page}"
        );
        assert!(page.contains("over 2 seeds (1, 3)") && page.contains("pictures/air.png"), "{page}");
        assert!(page.contains("*A held-out view: photograph · truth.*"), "{page}");
        assert!(page.contains("--captures air --seeds 1,3 --size 48x32"), "{page}");
    }

    #[test]
    fn one_seed_has_no_spread_and_a_seed_without_a_figure_is_said() {
        let page = markdown(&figures(&[1]), &[]);
        assert!(page.contains("| `clear` | **21.00** |") && page.contains("no spread is known"), "{page}");
        assert!(!page.contains("pictures/"), "{page}");
        let mut some = figures(&[1, 3]);
        some.seeds = vec![1, 2, 3];
        some.failed = vec!["air with seed 2: no water".into()];
        let page = markdown(&some, &[]);
        assert!(page.contains("**22.00 ± 1.41 (2 of 3)**") && page.contains("air with seed 2"), "{page}");
    }
}
