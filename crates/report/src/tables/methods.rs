//! The methods of several authors side by side, each trained by this program: one row for a method, with its
//! scores in every scene, its steps, its size and its cost.

use use3d_judge::configuration::Configuration;
use use3d_judge::names::distinct;
use use3d_judge::scores::Method;

use super::batch::{ALL, Batch, Quantity, columns, means};
use super::means::MeanScores;
use super::truth::TRUTH;
use super::{Better, Cell, Column, Table};
use crate::verdict::{Sentence, Tone};

/// The name of the table.
pub const NAME: &str = "methods";
/// The scores of a scene.
const SCORES: [Quantity; 2] = [("psnr", "PSNR", Better::Higher, 2), ("ssim", "SSIM", Better::Higher, 3)];
/// With more scenes than this, the columns are those of their groups.
const MANY: usize = 8;
/// A difference in PSNR below this is none, dB.
const EQUAL: f64 = 0.005;

/// True if a result is of another method than this program's.
fn of_others(scene: &MeanScores) -> bool {
    scene.configuration.as_deref().is_some_and(|made| made.compared_method().is_some())
}

/// Mean PSNR of the held-out views, dB.
fn psnr(scene: &MeanScores) -> Option<f64> {
    scene.mean(Method::Reconstruction, "psnr")?.value()
}

/// The steps of stage 1, if they are known.
pub fn steps(made: &Configuration) -> Option<f64> {
    made.steps.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()
}

/// The scenes on which a method of others reproduces the held-out photographs better than this program's:
/// first the widest difference. `None` without such methods.
pub fn ahead<'s>(scenes: impl IntoIterator<Item = &'s MeanScores>) -> Option<Sentence> {
    let (theirs, ours): (Vec<&MeanScores>, Vec<&MeanScores>) = scenes.into_iter().partition(|s| of_others(s));
    let best = |of: &[&MeanScores], scene: &str| -> Option<(f64, String)> {
        let own = of.iter().filter(|s| s.scene == scene);
        let scored = own.filter_map(|s| Some((psnr(s)?, s.variant.clone())));
        scored.max_by(|a, b| a.0.total_cmp(&b.0))
    };
    let names = distinct(theirs.iter().map(|s| s.scene.as_str()));
    let compared = names.into_iter().filter_map(|scene| {
        let (their, method) = best(&theirs, scene)?;
        Some((their - best(&ours, scene)?.0, method, scene))
    });
    let mut compared: Vec<(f64, String, &str)> = compared.collect();
    if compared.is_empty() {
        return None;
    }
    compared.retain(|(by, ..)| *by >= EQUAL);
    compared.sort_by(|a, b| b.0.total_cmp(&a.0));
    let told = compared.iter().map(|(by, method, scene)| format!("{method} on {scene} by {by:.2} dB"));
    let told = told.collect::<Vec<_>>().join(", ");
    Some(if told.is_empty() {
        let text = "No other method reproduces the kept-back photographs of a scene better than this program's (PSNR).";
        Sentence { tone: Tone::Good, text: text.into() }
    } else {
        let text = format!("Other methods reproduce the kept-back photographs better: {told} (PSNR).");
        Sentence { tone: Tone::Bad, text }
    })
}

impl Batch<'_> {
    /// The table; `None` if no method of others was trained.
    pub(super) fn methods(&self) -> Option<Table> {
        let told = ahead(self.scenes)?;
        let scenes = self.by_name();
        let each: Vec<&str> = if scenes.len() > MANY {
            self.groups.clone()
        } else {
            scenes.iter().map(|(name, _)| *name).collect()
        };
        let mut heads = columns(&each, &SCORES);
        heads.extend([
            Column::new("", "PSNR to truth", Better::Higher, 2),
            Column::new("", "steps", Better::Neither, 0),
            Column::new("", "Gaussians", Better::Neither, 0),
            Column::new("", "processor seconds", Better::Lower, 0),
        ]);
        let mut rows = Vec::new();
        for variant in &self.variants {
            let own = self.of_group(ALL, variant);
            let of = |name: &&str| -> Vec<&MeanScores> {
                if scenes.len() > MANY {
                    return self.of_group(name, variant).to_vec();
                }
                own.iter().copied().filter(|s| s.scene == *name).collect()
            };
            let mut cells: Vec<Cell> =
                each.iter().flat_map(|name| means(&of(name), Method::Reconstruction, &SCORES)).collect();
            // The view without water as its authors show it, or else this program's.
            let shown = [Method::PublishedClear, Method::Clear].into_iter();
            let truth = shown.map(|look| means(own, look, &TRUTH[..1])).find(|cells| *cells != [Cell::Blank]);
            cells.extend(truth.unwrap_or_else(|| vec![Cell::Blank]));
            let known = |of: &dyn Fn(&MeanScores) -> Option<f64>| {
                let values: Vec<f64> = own.iter().filter_map(|scene| of(scene)).collect();
                let value = values.iter().sum::<f64>() / values.len() as f64;
                if values.is_empty() { Cell::Blank } else { Cell::Number { value, source: String::new() } }
            };
            cells.push(known(&|scene| steps(scene.configuration.as_deref()?)));
            cells.push(known(&|scene| (scene.gaussians > 0).then_some(scene.gaussians as f64)));
            cells.push(known(&|scene| scene.processor_seconds));
            let psnrs: Vec<f64> = own.iter().filter_map(|scene| psnr(scene)).collect();
            let mean = psnrs.iter().sum::<f64>() / psnrs.len().max(1) as f64;
            rows.push((mean, self.own_row(self.trained(variant), variant, cells)));
        }
        rows.sort_by(|a, b| b.0.total_cmp(&a.0));
        Some(Table {
            name: NAME.into(),
            caption: format!(
                "Methods side by side. {} Scores are of photographs that training did not see. PSNR to truth is \
                 that of the view without water, where a truth is known. Steps, Gaussians and processor seconds \
                 are of stage 1, as means over the scenes",
                told.text
            ),
            columns: heads,
            rows: rows.into_iter().map(|(_, row)| row).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::tables::paper;
    use crate::verdict::tests::scene;

    fn result(name: &str, method: &str, psnr: f64, processor_seconds: f64) -> MeanScores {
        let scores = scene(&[
            (Method::Reconstruction, &[("psnr", psnr), ("ssim", 0.5)]),
            (Method::Clear, &[("truth_psnr", 12.0)]),
            (
                if method == "3d-use" { Method::Enhanced } else { Method::PublishedClear },
                &[("truth_psnr", 14.0)],
            ),
        ]);
        let made =
            Configuration { preset: method.into(), steps: "3000 + 1000".into(), ..Configuration::default() };
        MeanScores {
            configuration: Some(Arc::new(made)),
            processor_seconds: Some(processor_seconds),
            ..MeanScores::new([name, "", method], &scores)
        }
    }

    #[test]
    fn methods_stand_by_their_score_with_steps_size_and_cost_and_who_is_ahead_is_said_first() {
        let all = [
            result("reef", "3d-use", 27.0, 100.0),
            result("reef", "seasplat", 27.4, 300.0),
            result("vent", "3d-use", 35.0, 200.0),
            result("vent", "seasplat", 34.0, 500.0),
        ];
        let tables = paper::tables(&all, &[]);
        let table = &tables[0];
        assert_eq!(table.name, NAME);
        assert!(table.caption.contains("better: seasplat on reef by 0.40 dB (PSNR)."), "{}", table.caption);
        let row = |at: usize| -> (&str, Vec<Option<f64>>) {
            (&table.rows[at].label, table.rows[at].cells.iter().map(Cell::value).collect())
        };
        let (first, ours) = row(0);
        assert_eq!(first, "3D-USE, this program · 3d-use");
        let of = |values: &[f64]| values.iter().map(|v| Some(*v)).collect::<Vec<_>>();
        assert_eq!(ours, of(&[27.0, 0.5, 35.0, 0.5, 12.0, 3000.0, 10.0, 150.0]));
        let (second, theirs) = row(1);
        assert_eq!(second, "SeaSplat, in this program · seasplat");
        assert_eq!(theirs, of(&[27.4, 0.5, 34.0, 0.5, 14.0, 3000.0, 10.0, 400.0]), "their own clear view");
    }

    #[test]
    fn a_batch_of_one_method_has_no_such_table() {
        let ours = [result("reef", "3d-use", 27.0, 1.0), result("vent", "3d-use", 27.0, 1.0)];
        assert_eq!(ahead(&ours), None);
        assert!(paper::tables(&ours, &[]).iter().all(|table| table.name != NAME));
        let good = ahead(&[result("reef", "3d-use", 27.0, 1.0), result("reef", "plenodium", 26.9, 1.0)]);
        assert!(good.is_some_and(|said| said.tone == Tone::Good && said.text.starts_with("No other method")));
    }
}
