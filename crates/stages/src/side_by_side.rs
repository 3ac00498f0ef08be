//! One scene by several methods side by side: held-out views with the picture of each method.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_io_image::read_image;
use use3d_judge::scores::{Method, SceneScores};
use use3d_render::Mode;
use use3d_report::page::{Picture, ViewSection};
use use3d_workflow::StageError;

use crate::parts::files::{AUTHORS_CLEAR, TRUE_VIEWS, stems};
use crate::report::{ResultFolders, best_look, read_scores, view_score};

/// A scene by one method.
pub struct MethodSide<'a> {
    /// The name of the method.
    pub name: &'a str,
    /// The steps, Gaussians and processor seconds of its scene, in words.
    pub cost: String,
    /// True for the method of this program.
    pub own: bool,
    /// Its artifacts.
    pub folders: ResultFolders<'a>,
}

/// A method with its scores.
struct ByMethod<'s> {
    side: &'s MethodSide<'s>,
    scores: SceneScores,
}

impl ByMethod<'_> {
    fn psnr(&self, stem: &str) -> Option<f64> {
        view_score(stem, Some(&self.scores), Method::Reconstruction, "psnr")
    }

    fn picture(
        &self,
        (stage, folder): (&str, &str),
        stem: &str,
        label: &str,
    ) -> Result<Option<Picture>, StageError> {
        let Some(path) = self.side.folders.path(stage) else { return Ok(None) };
        let path = path.join(folder).join(format!("{stem}.png"));
        let label = format!("{}: {label}", self.side.name);
        path.is_file().then(|| Ok(Picture::embed(&label, "", &read_image(&path)?)?)).transpose()
    }

    /// The view without water, as the authors of the method show it or else as this program does.
    fn clear(&self, stem: &str) -> Result<Option<Picture>, StageError> {
        let label = "without water";
        let shown = match self.picture(("evaluate", AUTHORS_CLEAR), stem, label)? {
            None => self.picture(("render", Mode::Clear.name()), stem, label)?,
            shown => shown,
        };
        Ok(shown.map(|picture| Picture { caption: self.side.cost.clone(), ..picture }))
    }
}

/// The lead of the best other method over the best own one in a view, dB.
fn lead(scored: &[ByMethod<'_>], stem: &str) -> Option<f64> {
    let best = |own: bool| {
        let values = scored.iter().filter(|method| method.side.own == own).filter_map(|m| m.psnr(stem));
        values.max_by(f64::total_cmp)
    };
    Some(best(false)? - best(true)?)
}

/// The views that are shown, each with the reason: the middle one by the lead, and those where one side is
/// furthest ahead.
fn chosen(scored: &[ByMethod<'_>], stems: &[String]) -> Vec<(String, &'static str)> {
    let leads: BTreeMap<&String, f64> = stems.iter().filter_map(|s| Some((s, lead(scored, s)?))).collect();
    let mut order: Vec<(&String, f64)> = leads.into_iter().collect();
    order.sort_by(|a, b| a.1.total_cmp(&b.1));
    let wanted = [
        (order.get(order.len() / 2), "the middle one of the kept-back photographs, by who is ahead"),
        (order.last().filter(|(_, by)| *by > 0.0), "here another method is furthest ahead"),
        (order.first().filter(|(_, by)| *by < 0.0), "here the method of this program is furthest ahead"),
    ];
    let mut out: Vec<(String, &str)> = Vec::new();
    for (view, reason) in wanted {
        let Some((stem, _)) = view else { continue };
        if !out.iter().any(|(known, _)| known == *stem) {
            out.push(((*stem).clone(), reason));
        }
    }
    out
}

/// The views of a scene with a picture of every method. First come the photograph, the truth where it is
/// known, and the views without water.
///
/// # Errors
/// A file of an artifact cannot be read, or a picture cannot be encoded.
pub fn side_by_side(sides: &[MethodSide<'_>]) -> Result<Vec<ViewSection>, StageError> {
    let mut scored = Vec::new();
    for side in sides {
        if let (Some(evaluated), Some(_)) = (side.folders.path("evaluate"), side.folders.path("render")) {
            scored.push(ByMethod { side, scores: read_scores(evaluated)? });
        }
    }
    let Some(first) = scored.first() else { return Ok(Vec::new()) };
    let captured: &Path = &first.side.folders.path("render").unwrap_or(Path::new("")).join("captured");
    let mut sections = Vec::new();
    for (stem, place) in chosen(&scored, &stems(captured)?) {
        let common = |folder: &Path, label: &str| -> Result<Option<Picture>, StageError> {
            let path = folder.join(format!("{stem}.png"));
            path.is_file().then(|| Ok(Picture::embed(label, "", &read_image(&path)?)?)).transpose()
        };
        let mut lead = vec![common(captured, "the photograph")?];
        let evaluated = first.side.folders.path("evaluate");
        lead.push(
            evaluated
                .map(|folder| common(&folder.join(TRUE_VIEWS), "the truth (simulated)"))
                .transpose()?
                .flatten(),
        );
        let (mut images, mut scores) = (Vec::new(), Vec::new());
        for method in &scored {
            lead.push(method.clear(&stem)?);
            let best = best_look(method.side.folders.path("enhance"))?;
            if best != Mode::Clear {
                lead.push(method.picture(("render", best.name()), &stem, "enhanced")?);
            }
            let score = method.psnr(&stem).map_or_else(String::new, |psnr| format!("{psnr:.2} dB"));
            scores.push(format!("{} {score}", method.side.name));
            let label = format!("as photographed, {score}");
            images.push(method.picture(("render", Mode::Reconstruction.name()), &stem, &label)?);
        }
        let [lead, images] = [lead, images].map(|pictures| pictures.into_iter().flatten().collect());
        sections.push(ViewSection { name: stem, place, lead, images, scores });
    }
    Ok(sections)
}
