//! The report. The stage itself only notes what belongs to no single scene; [`section`] makes the section on
//! one scene in one variant from its artifacts, when its results are delivered. So a change of one scene
//! costs one section, and no artifact holds the sections of all scenes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use use3d_atc::calibrator::{Calibrator, METHOD_PAIRS, Provenance};
use use3d_atc::consensus::TargetsReport;
use use3d_capture::{Appearance, Camera, Image, flat_stem};
use use3d_enhance::EnhanceParams;
use use3d_io_image::read_image;
use use3d_reconstruct::ReconstructParams;
use use3d_render::{Mode, WaterSample, medium_along, medium_profile};
use use3d_scene::Scene;
use use3d_workflow::{StageContext, StageError};

use crate::parts::calibrator::read_calibrator;
use crate::parts::curves::stage_1;
use crate::parts::files::{
    BATCH, CALIBRATED, CONTACT, ENHANCED_IN_2D, SCORES, STRIP, TRUE_VIEWS, read, read_json, stems, write_json,
};
use crate::parts::proposer::NO_PROPOSER;
use crate::parts::water_words::{attenuation, water_sentences};
pub use crate::side_by_side::{MethodSide, side_by_side};
use use3d_chart::{Plot, RGB, Series};
use use3d_judge::names::in_variant;
use use3d_judge::scores::{Method, MethodScores, SceneScores};
use use3d_judge::strip::Strip;
use use3d_report::BatchReport;
use use3d_report::index::THUMBNAIL_SIDE;
use use3d_report::page::{CalibratorSection, Picture, PlotFigure, SceneSection, ViewSection};
use use3d_report::story::story;
use use3d_report::verdict::{SceneFacts, verdict};

/// Parameters of the report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Params {
    /// The page's title.
    pub(crate) title: String,
    /// Held-out views shown per scene.
    pub(crate) views: usize,
}

impl Default for Params {
    fn default() -> Self {
        Self { title: "3D-USE report".into(), views: 6 }
    }
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{Scope, Stage};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("report", Scope::Batch, run)
            .about("write the report")
            .promises(&[BATCH])
            .input("calibrator", "calibrate")
            .or_external("calibrator")
            .input("import", "import")
            .input("scene", "reconstruct")
            .optional_input("targets", "targets")
            .optional_input("enhanced", "enhance")
            .optional_input("photographs", "photographs")
            .optional_input("renders", "render")
            .optional_input("scores", "evaluate")
    }
}

/// The artifacts of one scene in one variant: the folders by stage.
pub struct ResultFolders<'a> {
    /// The scene.
    pub scene: &'a str,
    /// Its data set, or empty.
    pub group: &'a str,
    /// The variant; empty if there are no variants.
    pub variant: &'a str,
    /// The folders by stage.
    pub folders: BTreeMap<&'a str, &'a Path>,
}

impl ResultFolders<'_> {
    pub(crate) fn path(&self, stage: &str) -> Option<&Path> {
        self.folders.get(stage).copied()
    }
}

/// The report's part on one scene in one variant.
#[derive(Clone, Debug, Default)]
pub struct ResultSection {
    /// The section of the page.
    pub section: SceneSection,
    /// All of its scores.
    pub scores: Option<SceneScores>,
    /// A small picture of the scene.
    pub thumbnail: Option<Picture>,
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let mut all: Vec<(&str, &str)> = Vec::new();
    for input in context.inputs().iter().filter(|i| !i.scene.is_empty()) {
        let cell = (input.scene.as_str(), input.variant.as_str());
        // The inputs of a cell stand together in each role; two cells are enough to know.
        if all.len() < 2 && !all.contains(&cell) {
            all.push(cell);
        }
    }
    let calibrator = context.optional_input("calibrator").map(read_calibrator).transpose()?;
    let report = BatchReport {
        title: match &all[..] {
            // The title names the only scene, unless the user set a title.
            [(scene, variant)] if params.title == Params::default().title => {
                in_variant(&in_variant(scene, variant), &params.title)
            }
            _ => params.title.clone(),
        },
        calibrator: calibrator.as_ref().map(calibrator_section),
        missing: context.missing().to_vec(),
        // The report of equal results has equal bytes, so the date is not in it.
        made_with: format!(
            "Made by use3d {}. Links work in the results folder. Its folder “runs” has the date and the command of each \
             run.",
            env!("CARGO_PKG_VERSION")
        ),
    };
    write_json(&context.output().join(BATCH), &report)
}

/// The scores in a folder.
pub(crate) fn read_scores(folder: &Path) -> Result<SceneScores, StageError> {
    let path = folder.join(SCORES);
    let scores = SceneScores::parse(&read(&path)?);
    scores.map_err(|e| StageError::message(format!("{}: {e}", path.display())))
}

fn calibrator_section(calibrator: &Calibrator) -> CalibratorSection {
    let provenance = &calibrator.provenance;
    let plain = |summary| CalibratorSection { summary, rows: Vec::new() };
    if calibrator.corrects() == [false; 2] {
        return plain(format!(
            "The proposals are not corrected. The scales of the errors come from {} pairs; {}.",
            provenance.pairs, provenance.data
        ));
    }
    if provenance.pairs == 0 {
        // A calibrator that records no fit is the authors' file.
        return plain(format!("A finished calibrator: {}.", provenance.data));
    }
    let rows = provenance.held_out.iter().flat_map(|held_out| {
        let e = &held_out.errors;
        [("global", e.global), ("local", e.local), ("local, centred", e.centered)].map(|(name, change)| {
            let ratio = format!("{:.2}×", change.ratio());
            (name.to_string(), format!("{:.3}", change.before), format!("{:.3}", change.after), ratio)
        })
    });
    let kept = provenance.held_out.as_ref().map_or(String::new(), |held_out| {
        let [global, local] = held_out.kept.map(|share| 100.0 * share);
        format!(" The global head keeps {global:.0} % of its correction, the local head {local:.0} %.")
    });
    CalibratorSection {
        summary: format!(
            "Fitted to {} pairs ({} cells) in {} steps; {}.{} The errors were measured on held-out pairs, \
             after a fit to the others.",
            provenance.pairs, provenance.cells, provenance.steps, provenance.data, kept
        ),
        rows: rows.collect(),
    }
}

/// The section on a scene in a variant, with at most `most` held-out views.
///
/// # Errors
/// A file of an artifact cannot be read, or a picture cannot be encoded.
pub fn section(parts: &ResultFolders<'_>, most: usize) -> Result<ResultSection, StageError> {
    let all_scores = parts.path("evaluate").map(read_scores).transpose()?;
    let scores = all_scores.as_ref();
    let name = in_variant(parts.scene, parts.variant);
    let mut section = SceneSection { name, group: parts.group.into(), ..SceneSection::default() };
    if let Some(scores) = scores {
        let (w, h) = scores.size;
        let kept_back = match scores.held_out_views {
            0 => String::new(),
            n => format!("; {n} kept back as a test"),
        };
        let photographs = scores.training_views + scores.held_out_views;
        section.summary = format!("{photographs} photographs made into a 3D scene{kept_back}.");
        section.notes = vec![format!("Pictures of {w}×{h} pixels, {} Gaussians.", scores.gaussians)];
        section.notes.extend(left_out(scores));
    }
    let best = best_look(parts.path("enhance"))?;
    let log = training_log(parts, "reconstruct");
    let targets: Option<TargetsReport> =
        parts.path("targets").map(|dir| read_json(&dir.join("report.json"))).transpose()?;
    if let Some(scores) = scores {
        let facts = facts(parts, log.as_deref(), targets.as_ref());
        section.story = story(scores, scored_as(best), &facts);
        section.verdict = verdict(scores, scored_as(best), &facts);
    }
    let renders = parts.path("render");
    let folders = [renders, parts.path("evaluate"), parts.path("photographs")];
    section.views = views(folders, scores, best, most)?;
    section.plots.extend(
        log.iter()
            .flat_map(|log| stage_1(log))
            .map(|(plot, caption)| PlotFigure { svg: plot.svg(), caption: caption.into() }),
    );
    let plot = parts.path("enhance").map(|folder| folder.join("training.svg"));
    if let Some(svg) = plot.and_then(|path| std::fs::read_to_string(path).ok()) {
        let caption = "Stage 2: the distance of the scene from its targets, as a whole (global) and surface \
             by surface (local). Both should fall.";
        section.plots.push(PlotFigure { svg: inline(&svg), caption: caption.into() });
    }
    section.plots.extend(water(parts)?);
    section.sheets.extend(parts.path("reconstruct").map(contact).transpose()?.flatten());
    section.sheets.extend(parts.path("evaluate").map(strip).transpose()?.flatten());
    if let (Some(folder), Some(report)) = (parts.path("targets"), &targets) {
        section.plots.push(dispersion(report));
        section.sheets.extend(sheets(&folder.join("previews"), report)?);
    }
    let thumbnail = renders.map(|renders| thumbnail(renders, best)).transpose()?.flatten();
    Ok(ResultSection { section, scores: all_scores, thumbnail })
}

/// The first held-out view in the look that the report shows first, small.
fn thumbnail(renders: &Path, best: Mode) -> Result<Option<Picture>, StageError> {
    let Ok(entries) = std::fs::read_dir(renders.join(best.name())) else { return Ok(None) };
    let pictures = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let first = pictures.filter(|path| path.extension().is_some_and(|ending| ending == "png")).min();
    first.map(|path| Ok(Picture::embed_wide("", "", &read_image(&path)?, THUMBNAIL_SIDE)?)).transpose()
}

/// The training log of a stage, one JSON object for each line.
fn training_log(parts: &ResultFolders<'_>, stage: &str) -> Option<String> {
    std::fs::read_to_string(parts.path(stage)?.join("training.jsonl")).ok()
}

/// The last step of a training log; 0 for a log without steps.
fn last_step(log: &str) -> u64 {
    let entries = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    entries.filter_map(|entry| entry["step"].as_u64()).max().unwrap_or(0)
}

/// The facts of a scene that its verdict needs. `log` is the log of stage 1.
fn facts(parts: &ResultFolders<'_>, log: Option<&str>, targets: Option<&TargetsReport>) -> SceneFacts {
    let calibrated = targets.is_some_and(|targets| targets.calibrated);
    let provenance = parts.path("targets").map(|folder| read_json::<Provenance>(&folder.join(CALIBRATED)));
    let pairs = provenance.and_then(Result::ok).map_or(0, |provenance| provenance.pairs);
    SceneFacts {
        water: parts.path("reconstruct").map(water_sentences).unwrap_or_default(),
        attenuation: parts.path("reconstruct").and_then(attenuation),
        steps: [
            log.map(|log| (last_step(log), ReconstructParams::default().iterations)),
            training_log(parts, "enhance").map(|log| (last_step(&log), EnhanceParams::default().iterations)),
        ],
        unchanged: targets.is_some_and(|targets| targets.proposer.name == NO_PROPOSER),
        calibrated,
        pairs: (calibrated && pairs > 0).then_some((pairs, METHOD_PAIRS)),
    }
}

/// Notes on images and pairs that a mean leaves out because they have no such score.
fn left_out(scores: &SceneScores) -> Vec<String> {
    let of = |m: &MethodScores| {
        let count =
            |(metric, count): (&String, &usize)| format!("{metric} {count} of {}", count + m.counted(metric));
        let counts = m.left_out.iter().map(count).collect::<Vec<_>>().join(", ");
        let method = m.method.label();
        let note = || format!("{method}: these scores have no value, so the means leave them out: {counts}.");
        (!counts.is_empty()).then(note)
    };
    scores.methods.iter().filter_map(of).collect()
}

/// An SVG file as part of a page: without its XML declaration.
fn inline(svg: &str) -> String {
    svg.find("<svg").map_or_else(String::new, |start| svg[start..].to_string())
}

/// The look that the report of a scene shows first: the look that viewers open the scene with, or the scene
/// without its water if it has no enhancement.
pub(crate) fn best_look(enhanced: Option<&Path>) -> Result<Mode, StageError> {
    let Some(folder) = enhanced else { return Ok(Mode::Clear) };
    Ok(match Mode::opening(&Scene::load(folder)?) {
        Mode::Reconstruction => Mode::Clear,
        look => look,
    })
}

/// The scored method that corresponds to that look.
fn scored_as(best: Mode) -> Method {
    match best {
        Mode::Enhanced => Method::Enhanced,
        Mode::EnhancedClear => Method::EnhancedClear,
        _ => Method::Clear,
    }
}

/// The method whose scores head the scene's report.
///
/// # Errors
/// Fails if the enhanced scene cannot be read.
pub fn best_method(enhanced: Option<&Path>) -> Result<Method, StageError> {
    best_look(enhanced).map(scored_as)
}

/// The pictures of a scene that follow those that come first.
const OTHERS: [Mode; 3] = [Mode::Reconstruction, Mode::Depth, Mode::Medium];

/// The caption of a scene's picture.
pub fn caption(mode: Mode) -> &'static str {
    match mode {
        Mode::Enhanced => "the scene, enhanced",
        Mode::EnhancedClear => "the scene, enhanced, without water",
        Mode::Clear => "the scene without water (true for near things)",
        Mode::Reconstruction => "the scene as photographed",
        Mode::Medium => "the water alone",
        other => other.name(),
    }
}

/// The names of held-out views in the order of the page, at most `most`: the median one and the best one by
/// PSNR, then others evenly chosen. Without scores the middle one is first.
fn ordered(mut stems: Vec<String>, scores: Option<&SceneScores>, most: usize) -> Vec<String> {
    stems.sort();
    let mut by_score = stems.clone();
    let psnr = |stem: &str| view_score(stem, scores, Method::Reconstruction, "psnr").unwrap_or_default();
    by_score.sort_by(|a, b| psnr(a).total_cmp(&psnr(b)));
    let first = [by_score.get(by_score.len() / 2), by_score.last()];
    let mut order: Vec<String> = Vec::new();
    let rest = (0..stems.len().min(most)).map(|k| &stems[k * stems.len() / stems.len().min(most)]);
    for stem in first.into_iter().flatten().chain(rest) {
        if !order.contains(stem) && order.len() < most {
            order.push(stem.clone());
        }
    }
    order
}

/// The held-out views. The captured photograph comes first, then the same photograph enhanced by the scene,
/// the scene's best look and its clear view; the other pictures follow. Where the truth is known, the nearest
/// of these is second and the truth third. The three folders are those of `render`, `evaluate` and
/// `photographs`.
fn views(
    [renders, evaluated, photographs]: [Option<&Path>; 3],
    scores: Option<&SceneScores>,
    best: Mode,
    most: usize,
) -> Result<Vec<ViewSection>, StageError> {
    let Some(renders) = renders else { return Ok(Vec::new()) };
    let captured = renders.join("captured");
    let stems = stems(&captured)?;
    let nearness = |method: Method| {
        let mean = scores.and_then(|scores| scores.mean(method, "truth_psnr")?.value());
        mean.unwrap_or(f64::NEG_INFINITY)
    };
    let mut sections = Vec::new();
    for (k, stem) in ordered(stems, scores, most).into_iter().enumerate() {
        let picture = |label: &str, folder: &Path| -> Result<Option<Picture>, StageError> {
            let path = folder.join(format!("{stem}.png"));
            if !path.is_file() {
                return Ok(None);
            }
            Ok(Some(Picture::embed(label, "", &read_image(&path)?)?))
        };
        let rendered = |mode: Mode| picture(caption(mode), &renders.join(mode.name()));
        let of_scores = |label: &str, name: &str| match evaluated {
            Some(evaluated) => picture(label, &evaluated.join(name)),
            None => Ok(None),
        };
        // A synthetic capture knows the true appearance without water.
        let truth = of_scores("the truth (simulated)", TRUE_VIEWS)?;
        let enhanced =
            photographs.map(|folder| picture("the photograph, enhanced", folder)).transpose()?.flatten();
        let mut looks =
            vec![(nearness(Method::Photograph), enhanced), (nearness(scored_as(best)), rendered(best)?)];
        if best != Mode::Clear {
            looks.push((nearness(Method::Clear), rendered(Mode::Clear)?));
        }
        let mut lead = vec![picture("the photograph", &captured)?];
        if truth.is_some() {
            looks.sort_by(|a, b| b.0.total_cmp(&a.0));
        }
        lead.extend(looks.into_iter().map(|(_, picture)| picture));
        lead.insert(lead.len().min(2), truth);
        let images = [of_scores("the photograph, enhanced alone", ENHANCED_IN_2D)]
            .into_iter()
            .chain(OTHERS.map(rendered));
        let images = images.collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect();
        let lead = lead.into_iter().flatten().collect();
        let scores = view_scores(&stem, scores, scored_as(best));
        let place = match k {
            0 => "a typical photograph of those that were kept back (the middle one by likeness)",
            1 => "the one where scene and photograph are most alike",
            _ => "",
        };
        sections.push(ViewSection { name: stem, place, lead, images, scores });
    }
    Ok(sections)
}

/// A score of a held-out view.
pub(crate) fn view_score(
    stem: &str,
    scores: Option<&SceneScores>,
    method: Method,
    metric: &str,
) -> Option<f64> {
    let views = &scores?.methods.iter().find(|m| m.method == method)?.views;
    views.iter().find(|v| flat_stem(&v.view) == stem)?.scores.get(metric)?.value()
}

fn view_scores(stem: &str, scores: Option<&SceneScores>, best: Method) -> Vec<String> {
    let [colours, truth] =
        [format!("UCIQE {}", best.name()), format!("PSNR {} against the truth", best.name())];
    let wanted = [
        (Method::Reconstruction, "psnr", "PSNR", 2),
        (Method::Reconstruction, "ssim", "SSIM", 3),
        (Method::Captured, "uciqe", "UCIQE captured", 3),
        (best, "uciqe", &colours, 3),
        (best, "truth_psnr", &truth, 2),
    ];
    let text = |(method, metric, label, decimals): (Method, &str, &str, usize)| {
        view_score(stem, scores, method, metric).map(|value| format!("{label} {value:.decimals$}"))
    };
    wanted.into_iter().filter_map(text).collect()
}

/// The water by direction (along the horizontal axis of the first training view) and by position (along the
/// training cameras, in one direction).
fn water(parts: &ResultFolders<'_>) -> Result<Vec<PlotFigure>, StageError> {
    let paths = parts.path("reconstruct").zip(parts.path("import"));
    let Some((scene, import)) = paths else { return Ok(Vec::new()) };
    let scene = Scene::load(scene)?;
    if !scene.medium.kind().is_per_length() {
        return Ok(Vec::new());
    }
    let capture = use3d_import::load_prepared(import)?.capture;
    let cameras: Vec<Camera> = capture.training_views().map(|v| v.camera).collect();
    let Some(view) = capture.training_views().next() else { return Ok(Vec::new()) };
    let by_direction = medium_profile(&scene.medium, scene.medium_degree, &view.camera);
    let by_position = medium_along(&scene.medium, scene.medium_degree, &cameras);
    let (Some(by_direction), Some(by_position)) = (by_direction, by_position) else { return Ok(Vec::new()) };
    let figure =
        |samples: &[WaterSample], title: String, x_label: &str, meaning: &str, place: &str, pick: Pick| {
            let points = |c: usize| samples.iter().map(|s| (s.at, f64::from(pick(s)[c]))).collect();
            let series = (0..3).map(|c| Series::line(["red", "green", "blue"][c], RGB[c], points(c)));
            let plot = Plot { title, x_label: x_label.into(), log_y: false, series: series.collect() };
            PlotFigure { svg: plot.svg(), caption: format!("{meaning}, {place}.") }
        };
    let kinds: [(&str, &str, &str, Pick); 3] = [
        ("Attenuation", "1 / scene unit", "The rate at which distance dims the scene", |s| s.attenuation),
        ("Backscatter", "1 / scene unit", "The rate at which distance adds the water's own light", |s| {
            s.backscatter
        }),
        ("Colour of open water", "0 to 1", "The colour where there is nothing but water", |s| s.color),
    ];
    let along = format!("from the left to the right edge of {}", view.name);
    let from = format!("at the place of each training camera, looking as {} does", view.name);
    let figures = kinds.into_iter().flat_map(|(name, unit, meaning, pick)| {
        let title = |by: &str| format!("{name} by {by}, {unit}");
        let direction = "degrees from the optical axis";
        let both = [
            (&by_direction, title("direction"), direction, &along),
            (&by_position, title("place"), "training view", &from),
        ];
        let changing = both.into_iter().filter(move |(samples, ..)| !is_flat(samples, pick));
        changing
            .map(|(samples, title, axis, place)| figure(samples, title, axis, meaning, place, pick))
            .collect::<Vec<_>>()
    });
    Ok(figures.collect())
}

/// True if no channel changes by more than a twentieth of its largest value, so that a chart would be a
/// straight line.
fn is_flat(samples: &[WaterSample], pick: Pick) -> bool {
    (0..3).all(|c| {
        let values = samples.iter().map(|sample| pick(sample)[c]);
        let [least, most] = [values.clone().fold(f32::MAX, f32::min), values.fold(f32::MIN, f32::max)];
        most - least <= 0.05 * most.abs()
    })
}

/// Selects the one of the water's three quantities that is drawn.
type Pick = fn(&WaterSample) -> [f32; 3];

/// The contact sheet of stage 1.
fn contact(scene: &Path) -> Result<Option<Picture>, StageError> {
    let path = scene.join(CONTACT);
    if !path.is_file() {
        return Ok(None);
    }
    let caption = "Pairs of pictures: a photograph on the left, and the rendering of stage 1 from the same \
         place on the right. Held-out photographs are shown if there are any.";
    let sheet = read_image(&path)?;
    let picture = Picture::embed_wide("Stage 1: captured and rendered", caption, &sheet, 1640)?;
    Ok(Some(Picture { blank: blank_corner(&sheet), ..picture }))
}

/// The white corner at the end of the last row of a sheet: its left and top edge, in percent.
fn blank_corner(sheet: &Image) -> Option<(f64, f64)> {
    let (width, height) = (sheet.width(), sheet.height());
    let white = |x: usize, y: usize| sheet.pixel(x, y) == [1.0; 3];
    let left = (0..width).rev().find(|&x| !white(x, height - 1))? + 1;
    let top = (0..height).rev().find(|&y| (left..width).any(|x| !white(x, y))).map_or(0, |y| y + 1);
    // A smaller corner is only a gap, or the edge of a bright picture.
    let share = |at: usize, of: usize| 100.0 * at as f64 / of as f64;
    let corner = (share(left, width), share(top, height));
    (corner.0 < 90.0 && corner.1 < 90.0).then_some(corner)
}

/// The consistency strip of the scores, if there is one.
fn strip(scores: &Path) -> Result<Option<Picture>, StageError> {
    let (picture, description) = (scores.join(STRIP.0), scores.join(STRIP.1));
    if !picture.is_file() {
        return Ok(None);
    }
    let strip: Strip = read_json(&description)?;
    let row = |(label, mean): &(String, Option<f64>)| match mean {
        Some(mean) => format!("{label} (ΔE {mean:.1})"),
        None => label.clone(),
    };
    let caption = format!(
        "One spot of the scene in neighbouring views, enlarged twice. Rows from the top: {}. ΔE is the mean \
         change of colour over all pairs of neighbouring views, and the spot is one that stands for them. \
         Columns: {}.",
        strip.rows.iter().map(row).collect::<Vec<_>>().join(", "),
        strip.views.join(", ")
    );
    let sheet = read_image(&picture)?;
    Ok(Some(Picture::embed_wide("Consistency of neighbouring views", &caption, &sheet, 1600)?))
}

fn dispersion(report: &TargetsReport) -> PlotFigure {
    let points = report.views.iter().enumerate().map(|(i, v)| (i as f64, v.distance)).collect();
    let names = report.views.iter().map(|v| v.name.clone()).collect();
    let plot = Plot {
        title: "Distance of each view from the consensus".into(),
        x_label: "training view".into(),
        log_y: false,
        series: vec![Series { dots: true, names, ..Series::line("", "#0b7285", points) }],
    };
    let made = match (report.appearance, report.calibrated) {
        (Appearance::Clear, false) => {
            " The proposals are for the scene of stage 1 without its water. They are not calibrated."
        }
        (Appearance::Clear, true) => " The proposals are for the scene of stage 1 without its water.",
        (Appearance::Water, false) => " The proposals are not calibrated.",
        (Appearance::Water, true) => "",
    };
    let caption = format!(
        "Each view proposes how colours should change; the consensus is what the views agree on. A view far from the others was lit or exposed \
         differently. Median {:.4}; {} of {} Gaussians have a target.{made}",
        report.dispersion, report.supported, report.gaussians
    );
    PlotFigure { svg: plot.svg(), caption }
}

fn sheets(dir: &Path, report: &TargetsReport) -> Result<Vec<Picture>, StageError> {
    let first = match report.appearance {
        Appearance::Water if !report.kept_water.is_all() => "the scene with less water",
        Appearance::Water => "the photograph",
        Appearance::Clear => "the scene without its water",
    };
    let caption = format!(
        "From left to right: {first}, the same corrected by the filter, then adjusted by your pairs of pictures, if you \
         gave any, and the correction on which all views agree."
    );
    let Ok(entries) = std::fs::read_dir(dir) else { return Ok(Vec::new()) };
    let mut paths: Vec<_> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    paths.sort();
    let sheet = |path: &PathBuf| {
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        Ok(Picture::embed_wide(&format!("Corrections of {stem}"), &caption, &read_image(path)?, 1600)?)
    };
    paths.iter().map(sheet).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_sheet_whose_last_row_ends_early_has_a_blank_corner() {
        let mut sheet = Image::filled(20, 10, 0.4);
        assert_eq!(blank_corner(&sheet), None);
        // A white gap between pictures does not count as a corner.
        (0..20).for_each(|x| sheet.set_pixel(x, 4, [1.0; 3]));
        assert_eq!(blank_corner(&sheet), None);
        for y in 4..10 {
            (10..20).for_each(|x| sheet.set_pixel(x, y, [1.0; 3]));
        }
        assert_eq!(blank_corner(&sheet), Some((50.0, 40.0)));
        assert_eq!(blank_corner(&Image::filled(20, 10, 1.0)), None);
    }
}
