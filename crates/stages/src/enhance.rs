//! Stage 2: stores the enhancement in the scene.

use std::error::Error;
use std::path::Path;

use use3d_atc::consensus::Targets;
use use3d_capture::{Appearance, Image, View};
use use3d_enhance::losses::TERMS;
use use3d_enhance::{
    EnhanceError, EnhanceParams, EnhanceView, Guidance, LabelSource, LogEntry, Objective, PseudoLabels,
    Report, enhance,
};
use use3d_import::{Originals, load_pixels};
use use3d_scene::{Origin, Scene};
use use3d_workflow::{Figure, StageContext, StageError};

use crate::engines;
use crate::parts::captured::{capture, write_cameras};
use crate::parts::files::{TARGETS, read, write, write_json};
use crate::parts::proposer::by_name;
use crate::parts::scene::scene;
use crate::parts::watch::Watch;
use use3d_chart::{Plot, Series};

/// The report on a scene's training, next to its log.
const REPORT: &str = "report.json";

/// The largest difference between two trainings in two classes of arithmetic: in the means over views of the
/// normalised errors that remain.
const FIGURES: [Figure; 3] = [
    Figure { file: REPORT, at: "/views/*/after/global/error", within: 0.05 },
    Figure { file: REPORT, at: "/views/*/after/local/error", within: 0.05 },
    Figure { file: REPORT, at: "/views/*/after/pixels", within: 0.005 },
];

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{Scope, Stage};

    use crate::parts::files::out_of_range;
    use crate::parts::weights::proposer_files;
    use crate::planning::expected::{STAGE_2, of_training};
    use crate::planning::learns_from_proposals;
    use crate::planning::memory::{PROGRAM, extent, gaussians, largest, networks};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("enhance", Scope::Scene, run)
            .about("store the corrected colours in the scene")
            .promises(&["scene.json", "gaussians.ply", REPORT])
            .delivers("enhanced-scene")
            .check(|p: &EnhanceParams| p.validate().map_err(out_of_range))
            .computes_on(
                "engine",
                |p: &EnhanceParams| engines::asked(&p.engine),
                |p| engines::class(&p.engine),
            )
            .when(|all| !learns_from_proposals(all))
            .input("import", "import")
            .input("scene", "reconstruct")
            .input("targets", "targets")
            .optional_external("models", "models")
            .select(|_: &EnhanceParams, models| Ok(proposer_files(models)))
            .seeded()
            .resumable(&["iterations"])
            .without_effect(&["checkpoint_every", "cache_mib", "engine"])
            .agrees_across_classes(&FIGURES)
            .usually_costs(0.5, 0.003)
            .expects(|all, named, inputs| {
                let steps = all.of::<EnhanceParams>()?.iterations;
                of_training((steps, STAGE_2), (all, named), inputs)
            })
            .cost(0, 4 << 30)
            .memory(|p: &EnhanceParams, inputs| {
                let (gaussians, views) = (gaussians(inputs)?, extent(inputs)?.train.len() as u64);
                let kept = (views * (85 * gaussians + (1 << 20))).min((p.cache_mib as u64) << 20);
                let network = networks(inputs, proposer_files, 0);
                Some(PROGRAM + kept + 30 * largest(inputs)? + 400 * gaussians + network)
            })
    }
}

/// Reads targets from their file or from the folder that holds them.
fn read_targets(path: &Path) -> Result<Targets, StageError> {
    let file = if path.is_dir() { path.join(TARGETS) } else { path.to_path_buf() };
    Targets::from_bytes(&read(&file)?)
        .map_err(|e| StageError::bad_input_message(format!("{}: {e}", file.display())))
}

/// The 2D enhancer's images of the training views.
struct Proposals<'a> {
    views: Vec<&'a View>,
    proposer: Box<dyn use3d_atc::proposers::Proposer>,
}

impl LabelSource for Proposals<'_> {
    fn label(&self, index: usize) -> Result<Image, Box<dyn Error + Send + Sync>> {
        Ok(self.proposer.enhance(&load_pixels(self.views[index])?.to_image())?)
    }
}

/// Messages on the errors before and after stage 2, with the figures as the detail. An error that grew
/// although it was weighted is a warning.
fn reached(report: &Report, params: &EnhanceParams, detail: &mut dyn FnMut(String)) -> Vec<String> {
    let measuring = TERMS.iter().filter(|row| row.measures_errors());
    let errors: Option<Vec<_>> = measuring.map(|row| Some((row, report.errors(row.name)?))).collect();
    let Some(errors) = errors else {
        return vec![
            "colour errors not measured: the scene was fitted to images of the 2D enhancer, not to \
             transitions"
                .into(),
        ];
    };
    let each = errors.iter().map(|(row, (before, after))| format!("{} {before:.3} → {after:.3}", row.name));
    let each: Vec<String> = each.collect();
    detail(format!("remaining colour error, before → after: {}", each.join(", ")));
    let place = |name: &str| if name == "local" { "in small details" } else { "overall" };
    let stored = errors.iter().map(|(row, (before, after))| {
        let share = 1.0 - after / before.max(f64::MIN_POSITIVE);
        format!("{:.0} % of the correction {}", 100.0 * share.max(0.0), place(row.name))
    });
    let stored = stored.collect::<Vec<_>>().join(", ");
    let mut lines = vec![format!("the scene has the corrected colours now: {stored}")];
    for (row, (before, after)) in errors {
        let place = place(row.name);
        // The growth must be visible in the printed decimals: a thousandth of a scale is no growth.
        if (row.weight)(params) > 0.0 && after > before + GROWTH {
            lines.push(format!(
                "warning: the colour error {place} grew, from {before:.3} to {after:.3}; a longer run helps: --set enhance.iterations=N with a larger N than now"
            ));
        }
    }
    lines
}

/// Growth of an error, in its scale, above which there is a warning. It is visible in three decimals, and
/// more than the noise of a fit that has nothing to do.
const GROWTH: f64 = 2e-3;

/// Colours of the curves of a plot, in the order of terms.
const CURVES: [&str; 4] = ["#0b7285", "#e8590c", "#845ef7", "#2b8a3e"];

/// The curves of the terms that measure the distance of views from their targets.
fn curves(log: &[LogEntry]) -> Vec<Series> {
    let terms = TERMS.iter().enumerate().filter(|(_, row)| row.is_of_views());
    let curves = terms.zip(CURVES.iter().cycle()).map(|((at, row), &color)| {
        Series::line(row.title, color, log.iter().map(|e| (e.step as f64, e.terms[at].loss)).collect())
    });
    curves.collect()
}

fn run(context: &StageContext, params: &EnhanceParams) -> Result<(), StageError> {
    let capture = capture(context)?;
    let scene = scene(context, "scene")?;
    let targets = read_targets(context.input("targets")?)?;
    let params = EnhanceParams { seed: context.seed(), ..params.clone() };
    let views: Vec<EnhanceView> = capture.training_views().map(EnhanceView::from).collect();
    let labels;
    let guidance = if params.objective == Objective::PseudoLabels {
        if targets.appearance == Appearance::Clear {
            return Err(StageError::bad_input_message(
                "objective = \"pseudo-labels\" needs photographs enhanced by a 2D enhancer, but these \
                 targets are in clear radiance; make targets from another `targets.source`, or choose another \
                 objective",
            ));
        }
        let proposer = by_name(&targets.proposer.name, context.optional_input("models"))
            .map_err(StageError::bad_input)?;
        let source = Proposals { views: capture.training_views().collect(), proposer };
        labels = PseudoLabels::new(&source, &views, &params)?;
        Guidance::Labels(&labels)
    } else {
        Guidance::Targets(&targets)
    };
    let watch = &mut Watch(context);
    let outcome = {
        // The engine and the constants of the views are dropped at the end of this block.
        let (mut engine, chosen) = engines::stage2(&scene, &views, guidance, &params, watch)?;
        chosen.into_iter().for_each(|chosen| context.say(chosen));
        enhance(&scene, &views, guidance, &params, engine.as_mut(), context.checkpoints(), watch)
    };
    let outcome = match outcome {
        Err(EnhanceError::Interrupted { .. }) => return Err(StageError::Cancelled),
        other => other?,
    };
    context.profile(&outcome.profile.table());
    if targets.appearance == Appearance::Clear {
        context.say(
            "learnt in clear radiance: `enhanced` shows the enhanced objects behind the water of stage 1",
        );
    }
    for line in reached(&outcome.report, &params, &mut |line| context.detail(line)) {
        context.say(line);
    }
    let out = context.output();
    outcome.scene.save(out)?;
    if let Some(origin) = Origin::read(context.input("scene")?)? {
        origin.write(out)?;
    }
    if let Some(world) = Scene::world(context.input("scene")?)? {
        Scene::set_world(out, &world)?;
    }
    Originals::hand_on(context.input("import")?, out).map_err(StageError::bad_input)?;
    write(&out.join("training.jsonl"), outcome.log_lines())?;
    write_json(&out.join(REPORT), &outcome.report)?;
    write_cameras(out, &capture)?;
    let plot = Plot {
        title: "Stage 2: losses".into(),
        x_label: "step".into(),
        log_y: true,
        series: curves(&outcome.log),
    };
    write(&out.join("training.svg"), plot.svg())
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_enhance::{Realised, ViewErrors, ViewReport};

    fn report(errors: Option<[f64; 4]>) -> Report {
        let of = |k: usize| errors.map(|e| Realised { loss: 0.0, error: e[k] });
        let at = |k: usize| {
            ViewErrors(TERMS.map(|row| match row.name {
                "global" => of(k),
                "local" => of(k + 1),
                _ => None,
            }))
        };
        Report {
            views: vec![ViewReport { name: "a".into(), before: at(0), after: at(2) }],
            views_in_memory: 1,
            transport_ratios: [1.0; 2],
            scene_affine: [[0.0; 4]; 3],
            rendered_share: 1.0,
        }
    }

    #[test]
    fn what_was_not_measured_has_no_figure_and_what_grew_is_a_warning() {
        let asked = |objective| EnhanceParams { objective, ..EnhanceParams::default() };
        let labels = reached(&report(None), &asked(Objective::PseudoLabels), &mut |_| {});
        assert!(labels.len() == 1 && labels[0].contains("not measured") && !labels[0].contains("0.000"));
        let grew = report(Some([0.6, 0.185, 0.08, 0.253]));
        let mut details = Vec::new();
        let lines = reached(&grew, &asked(Objective::Full), &mut |line| details.push(line));
        assert!(
            lines[0].ends_with("now: 87 % of the correction overall, 0 % of the correction in small details")
        );
        assert_eq!(
            details,
            ["remaining colour error, before → after: global 0.600 → 0.080, local 0.185 → 0.253"]
        );
        assert!(
            lines[1].starts_with("warning: the colour error in small details grew")
                && lines[1].contains("0.253"),
            "{lines:?}"
        );
        assert_eq!(
            reached(&grew, &asked(Objective::GlobalOnly), &mut |_| {}).len(),
            1,
            "that objective does not ask for it"
        );
        assert_eq!(
            reached(&report(Some([0.6, 0.3, 0.08, 0.2])), &asked(Objective::Full), &mut |_| {}).len(),
            1
        );
        // A uniform grey capture has nothing to enhance, and its errors are those of arithmetic.
        let nothing =
            reached(&report(Some([0.0, 0.0, 0.0012, 0.0003])), &asked(Objective::Full), &mut |_| {});
        assert_eq!(nothing.len(), 1, "{nothing:?}");
    }
}
