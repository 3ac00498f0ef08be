//! The paper's tables from a batch's scores: reconstruction, enhancement, scene by scene, consistency, both
//! ablations.

use use3d_metrics::UCIQE_VARIANT;

use super::batch::{ALL, Batch, Quantity, columns, published_cell};
use super::means::MeanScores;
use super::published;
use super::{Better, Cell, Column, Row, Table};
use use3d_judge::names::distinct;
use use3d_judge::scores::{Method, Warp};

const RECONSTRUCTION: [Quantity; 4] = [
    ("psnr", "PSNR", Better::Higher, 3),
    ("ssim", "SSIM", Better::Higher, 3),
    ("lpips", "LPIPS", Better::Lower, 3),
    ("edge_width", "edge width", Better::Lower, 2),
];
const ENHANCEMENT: [Quantity; 5] = [
    ("uciqe", "UCIQE", Better::Higher, 3),
    ("uranker", "URanker", Better::Higher, 3),
    ("musiq", "MUSIQ", Better::Higher, 3),
    ("wlpips", "wLPIPS", Better::Lower, 3),
    ("uiqm", "UIQM", Better::Higher, 3),
];
const CONSISTENCY: [Quantity; 8] = [
    ("wlpips", "wLPIPS", Better::Lower, 4),
    ("w_delta_e", "wΔE", Better::Lower, 3),
    ("w_ssim", "wSSIM", Better::Higher, 4),
    ("path_wlpips", "path wLPIPS", Better::Lower, 4),
    ("path_w_delta_e", "path wΔE", Better::Lower, 3),
    ("path_w_ssim", "path wSSIM", Better::Higher, 4),
    ("coverage", "share", Better::Neither, 2),
    ("path_coverage", "path share", Better::Neither, 2),
];
/// The tables of variants alone.
const OF_VARIANTS: [&str; 3] = ["ablation-stage1", "ablation-stage2", "prior-integration"];
/// The most failed scenes that a caption names.
const SHOWN: usize = 8;
/// The reason why a scene has no frames per second here.
const NOT_TIMED: &str = "times are no part of an artifact: they are kept beside it and filled in when `use3d run` writes its results";

/// A scene in a variant that has no scores, because a stage failed.
#[derive(Clone, Debug)]
pub struct FailedScene {
    /// The scene.
    pub scene: String,
    /// Its group, or empty.
    pub group: String,
    /// The variant; empty if there are no variants.
    pub variant: String,
    /// The stage, and why it failed.
    pub reason: String,
}

/// Every table that the scenes can fill, in the paper's order. Empty without scenes. A scene that failed has
/// a row with its reason in the tables of scenes, and is named where means lack it.
pub fn tables(scenes: &[MeanScores], failed: &[FailedScene]) -> Vec<Table> {
    if scenes.is_empty() {
        return Vec::new();
    }
    let batch = Batch::new(scenes);
    let mut tables = vec![
        batch.reconstruction(),
        batch.by_scene(
            ["reconstruction-scenes", "Reconstruction of held-out views, scene by scene"],
            &RECONSTRUCTION,
            (&[], &[Method::Reconstruction]),
            published::RECONSTRUCTION_SCENES,
        ),
        batch.enhancement(),
        batch.by_scene(
            [
                "enhancement-scenes",
                "Enhancement quality of held-out views, scene by scene. The scores of the other looks are in `scores.json` of each scene",
            ],
            &ENHANCEMENT,
            (
                &[Method::Captured, Method::Proposal],
                &[
                    Method::Enhanced,
                    Method::EnhancedClear,
                    Method::EnhanceThenReconstruct,
                    Method::PublishedClear,
                    Method::Clear,
                ],
            ),
            published::ENHANCEMENT_SCENES,
        ),
        batch.consistency(),
    ];
    if batch.by_name().len() == 1 && failed.is_empty() {
        // These tables would repeat the others.
        tables.retain(|t| !t.name.ends_with("-scenes"));
    }
    if let Some(methods) = batch.methods() {
        tables.insert(0, methods);
    }
    tables.extend(batch.truth());
    tables.extend(batch.recovered());
    if batch.variants.len() > 1 {
        tables.extend(batch.of_variants());
    }
    // Rows and tables without numbers are left out.
    for table in &mut tables {
        table.rows.retain(|row| row.published || row.cells.iter().any(|cell| *cell != Cell::Blank));
    }
    tables.retain(|table| !table.rows.is_empty());
    name_failed(&mut tables, &batch, failed);
    tables
}

/// Adds the rows and sentences about scenes that failed.
fn name_failed(tables: &mut [Table], batch: &Batch<'_>, failed: &[FailedScene]) {
    let is_whole = |scene: &FailedScene| batch.whole.contains(&scene.variant.as_str());
    for table in tables {
        if table.name.ends_with("-scenes") {
            table.rows.extend(failed.iter().filter(|scene| is_whole(scene)).map(|scene| {
                let reason = format!("{}: {}", scene.scene, scene.reason);
                let cells = vec![Cell::NotAvailable { reason }; table.columns.len()];
                Row { scene: scene.scene.clone(), ..Row::own(Batch::program(&scene.variant), cells) }
            }));
            continue;
        }
        // A stage that variants share failed once.
        let of_variants = OF_VARIANTS.contains(&table.name.as_str());
        let told = failed
            .iter()
            .filter(|scene| if of_variants { batch.is_compared(&scene.group) } else { is_whole(scene) });
        let told: Vec<String> = told.map(|scene| format!("{}: {}", scene.scene, scene.reason)).collect();
        let told = distinct(told.iter().map(String::as_str));
        if told.is_empty() {
            continue;
        }
        let more = told.len().saturating_sub(SHOWN);
        let more = if more > 0 { format!("; {more} more") } else { String::new() };
        let names = told.into_iter().take(SHOWN).collect::<Vec<_>>().join("; ");
        table.caption += &format!(". Without scenes that failed ({names}{more})");
    }
}

impl<'a> Batch<'a> {
    /// Both ablations, and the ways to bring 2D priors in.
    fn of_variants(&self) -> Vec<Table> {
        const STAGE_2: [Method; 3] =
            [Method::Enhanced, Method::EnhancedClear, Method::EnhanceThenReconstruct];
        let stage1 = self.ablation(
            [
                "ablation-stage1",
                "Variants, stage 1: reconstruction of held-out views. Variants that share a stage 1 have one row",
            ],
            (&self.variants, true),
            &RECONSTRUCTION,
            &[Method::Reconstruction],
            published::ABLATION_STAGE1,
        );
        let (others, own): (Vec<&'a str>, Vec<&'a str>) =
            self.variants.iter().copied().partition(|variant| self.is_other_way(variant));
        let mut stage2 = self.ablation(
            ["ablation-stage2", "Variants, stage 2: enhancement quality of held-out views"],
            (&own, false),
            &ENHANCEMENT,
            &STAGE_2,
            published::ABLATION_STAGE2,
        );
        // The start of stage 2, as in the paper: the same for all variants that share a stage 1.
        let first = stage2.rows.iter().position(|r| !r.published).unwrap_or(stage2.rows.len());
        stage2.rows.splice(first..first, self.before_stage2(&ENHANCEMENT));
        let mut tables = vec![stage1, stage2];
        if !others.is_empty() {
            let ours = own.iter().copied().find(|variant| {
                let scenes = self.compared(variant);
                let enhanced =
                    |s: &&MeanScores| s.has(s.result, ["uciqe"].into_iter()) && s.result != Method::Clear;
                scenes.iter().any(enhanced)
            });
            let ways: Vec<&str> = others.into_iter().chain(ours).collect();
            tables.push(self.ablation(
                [
                    "prior-integration",
                    "Ways to bring a 2D enhancer into a scene: enhancement quality of held-out views",
                ],
                (&ways, false),
                &ENHANCEMENT,
                &STAGE_2,
                &[],
            ));
        }
        tables
    }

    fn reconstruction(&self) -> Table {
        let mut columns = columns(&self.groups, &RECONSTRUCTION);
        let mut rows = self.published_rows(published::RECONSTRUCTION, &RECONSTRUCTION);
        let timed = !rows.is_empty() || self.scenes.iter().any(|s| s.speed.is_some());
        if timed {
            columns.push(Column::new("", "FPS", Better::Neither, 2));
        }
        for row in &mut rows {
            let fps = published::FPS.iter().find(|(method, _)| *method == row.label).map(|(_, fps)| *fps);
            row.cells.push(published_cell(fps));
        }
        for variant in &self.whole {
            let mut row = self.row(Method::Reconstruction, variant, &RECONSTRUCTION);
            row.label = self.trained(variant);
            let scenes = self.of_group(ALL, variant).iter();
            let speeds: Vec<f64> = scenes.filter_map(|s| Some(s.speed.as_ref()?.fps.get())).collect();
            if timed {
                row.cells.push(if speeds.is_empty() {
                    Cell::NotAvailable { reason: NOT_TIMED.into() }
                } else {
                    let value = speeds.iter().sum::<f64>() / speeds.len() as f64;
                    Cell::Number { value, source: self.hardware() }
                });
            }
            rows.push(row);
        }
        let mut caption = String::from("Reconstruction of held-out views");
        if timed {
            caption += ". FPS of ours: the enhanced scene";
            let hardware = self.hardware();
            if !hardware.is_empty() {
                caption += &format!(", {hardware}");
            }
            if rows.iter().any(|r| r.published) {
                caption += "; of published rows: the authors' graphics card, at 1400×933";
            }
        }
        caption += &self.of_few_pixels();
        Table { name: "reconstruction".into(), caption, columns, rows }
    }

    /// The processors or cards that our frames per second were measured on, with the image sizes.
    fn hardware(&self) -> String {
        let speeds = self.scenes.iter().filter_map(|s| s.speed.as_ref());
        distinct(speeds.map(ToString::to_string)).join(", ")
    }

    fn enhancement(&self) -> Table {
        let mut rows = self.published_rows(published::ENHANCEMENT, &ENHANCEMENT);
        rows.extend(self.rows(&Method::ALL, &ENHANCEMENT));
        Table {
            name: "enhancement".into(),
            caption: format!(
                "Enhancement quality of held-out views, and consistency of neighbouring captured views (scene-macro means). UCIQE: {}{}{}",
                UCIQE_VARIANT,
                self.pairs_compared(),
                self.of_few_pixels()
            ),
            columns: columns(&self.groups, &ENHANCEMENT),
            rows,
        }
    }

    /// A sentence on the number of pairs of captured views that wLPIPS is over: all pairs as in the paper, or
    /// fewer.
    fn pairs_compared(&self) -> String {
        let each = self
            .scenes
            .iter()
            .filter_map(|s| Some((s.compared?, (s.training_views + s.held_out_views).saturating_sub(1))));
        let each: Vec<(usize, usize)> = each.collect();
        match (each.iter().map(|(n, _)| n).min(), each.iter().all(|(n, all)| n == all)) {
            (None | Some(0), _) => String::new(),
            (_, true) => {
                ". wLPIPS over all pairs of captured views that follow one another, as in the paper".into()
            }
            (Some(least), false) => format!(
                ". wLPIPS over {least} pairs of captured views or more, evenly chosen from those that follow one another (the paper takes all: evaluate.neighbour_pairs)"
            ),
        }
    }

    fn consistency(&self) -> Table {
        let mut rows: Vec<Row> = Vec::new();
        if self.groups.iter().any(|g| self.is_published(g)) {
            rows.extend(published::CONSISTENCY.iter().map(|(method, _)| {
                let cells = self.groups.iter().flat_map(|group| {
                    let mut cells = vec![Cell::Blank; CONSISTENCY.len()];
                    cells[0] = published_cell(self.published_wlpips(method, group));
                    cells
                });
                Row::published(method, cells.collect())
            }));
        }
        rows.extend(self.rows(&Method::ALL, &CONSISTENCY));
        let mut caption = String::from(
            "Consistency of captured views that follow one another, and of adjacent frames of a path through the training cameras (where there are no photographs). wΔE and wSSIM warp by depth and need no weights (not the paper's). share: of the pixels, compared by depth",
        );
        caption += &self.pairs_compared();
        caption += if self.scenes.iter().all(|s| s.warp == Warp::Reference) {
            ". All methods and variants of a scene share one warp: the reference variant's stage 1"
        } else {
            ". Some scenes were compared by their own depth: not comparable with others"
        };
        Table { name: "consistency".into(), caption, columns: columns(&self.groups, &CONSISTENCY), rows }
    }
}

#[cfg(test)]
mod tests {
    use super::super::batch::ALL;
    use std::sync::Arc;

    use super::*;
    use use3d_judge::configuration::Configuration;
    use use3d_judge::scores::{
        FORMAT, Finite, MethodScores, SceneScores, SceneSpeed, Score, Scores, VERSION, ViewScores,
    };
    use use3d_judge::truth::WaterScores;

    /// All scores of a result, before their means are taken.
    #[derive(Clone)]
    struct AllScores {
        scene: String,
        group: String,
        variant: String,
        scores: SceneScores,
        configuration: Option<Configuration>,
        speed: Option<SceneSpeed>,
    }

    fn tables(scenes: &[AllScores]) -> Vec<Table> {
        let means = scenes.iter().map(|s| MeanScores {
            source: format!("digest-{}", s.scene),
            configuration: s.configuration.clone().map(Arc::new),
            speed: s.speed.clone(),
            ..MeanScores::new([&s.scene, &s.group, &s.variant], &s.scores)
        });
        super::tables(&means.collect::<Vec<_>>(), &[])
    }

    #[test]
    fn every_quantity_of_a_table_is_kept_for_it() {
        let quantities =
            [&RECONSTRUCTION[..], &ENHANCEMENT, &CONSISTENCY, &super::super::truth::TRUTH].concat();
        assert!(quantities.iter().all(|(metric, ..)| super::super::means::place(metric).is_some()));
    }

    fn changed(mut scene: AllScores, line: &str) -> AllScores {
        scene.configuration.as_mut().unwrap().changed.push(line.into());
        scene
    }

    fn scene(name: &str, group: &str, variant: &str, psnr: f64) -> AllScores {
        let view = |scores: Scores| vec![ViewScores { view: "v".into(), scores }];
        let reconstruction = Scores::from([
            ("psnr".to_string(), Score::of(psnr)),
            ("lpips".to_string(), Score::NotAvailable("put lpips_alex.pth into models/".into())),
        ]);
        let enhanced = Scores::from([("uciqe".to_string(), Score::of(0.6))]);
        AllScores {
            scene: name.into(),
            group: group.into(),
            variant: variant.into(),
            scores: SceneScores {
                format: FORMAT.into(),
                version: VERSION,
                training_views: 7,
                held_out_views: 1,
                pixels: 1.0,
                size: published::scene(name).map_or((4, 3), |(_, size)| size),
                gaussians: 10,
                warp: Warp::Reference,
                result: Method::Enhanced,
                water: None,
                methods: vec![
                    MethodScores::new(Method::Reconstruction, view(reconstruction), vec![], vec![]),
                    MethodScores::new(Method::Enhanced, view(enhanced), vec![], vec![]),
                ],
            },
            configuration: Some(Configuration {
                preset: "paper".into(),
                proposer: "nu2net".into(),
                data_of_the_paper: true,
                ..Configuration::default()
            }),
            speed: Some(SceneSpeed {
                fps: Finite::new(10.0).unwrap(),
                size: (4, 3),
                processor: "a processor".into(),
                threads: 2,
            }),
        }
    }

    #[test]
    fn groups_are_scene_macro_means_and_published_rows_need_the_whole_group() {
        let three = [
            scene("IUI3-RedSea", "SeaThru-4", "", 30.0),
            scene("Curasao", "SeaThru-4", "", 32.0),
            scene("D3", "D3", "", 28.0),
        ];
        let table = &tables(&three)[0];
        let ours = table.rows.iter().find(|r| !r.published).unwrap();
        assert_eq!(ours.cells[0].value(), Some(31.0));
        assert!(matches!(&ours.cells[2], Cell::NotAvailable { reason } if reason.contains("lpips_alex")));
        let plenodium = table.rows.iter().find(|r| r.label == "Plenodium").unwrap();
        assert_eq!(plenodium.cells[0], Cell::Blank, "two of four scenes are not SeaThru-4");
        assert_eq!(plenodium.cells[4].value(), Some(28.686));
        let scenes = &tables(&three)[1];
        let plenodium =
            scenes.rows.iter().find(|r| r.published && r.scene == "Curasao" && r.label == "Plenodium");
        assert_eq!(plenodium.and_then(|r| r.cells[0].value()), Some(33.861));
        let order: Vec<&str> =
            scenes.rows.iter().filter(|r| !r.published).map(|r| r.scene.as_str()).collect();
        assert_eq!(order, ["IUI3-RedSea", "Curasao", "D3"], "the scenes are rows");
    }

    #[test]
    fn scenes_learnt_from_proposals_have_rows_of_their_own_and_nothing_blank_takes_room() {
        let mut first = scene("reef", "", "first", 18.0);
        for (method, to) in
            first.scores.methods.iter_mut().zip([Method::Proposal, Method::EnhanceThenReconstruct])
        {
            method.method = to;
        }
        let tables = tables(&[scene("reef", "", "", 20.0), first]);
        let labels = |name: &str| -> Vec<&str> {
            tables
                .iter()
                .find(|t| t.name == name)
                .map_or(vec![], |t| t.rows.iter().map(|r| r.label.as_str()).collect())
        };
        assert_eq!(labels("enhancement"), ["3D-USE, this program", "Enhance, then reconstruct · first"]);
        assert_eq!(labels("ablation-stage2"), ["full model"]);
        assert_eq!(labels("prior-integration"), ["first", "full model"]);
        assert_eq!(labels("ablation-stage1"), ["full model"]);
        assert!(tables.iter().all(|t| !t.rows.is_empty()));
    }

    #[test]
    fn ablations_on_some_groups_are_compared_over_these_and_stay_out_of_the_other_tables() {
        let mut all = vec![scene("D3", "D3", "full", 28.0)];
        for (name, psnr) in [("Panama", 30.0), ("Curasao", 32.0)] {
            all.push(scene(name, "SeaThru-4", "full", psnr));
            all.push(changed(scene(name, "SeaThru-4", "mlp", psnr - 4.0), "reconstruct.medium = mlp"));
            all.push(scene(name, "SeaThru-4", "local-only", psnr));
            let labels = scene(name, "SeaThru-4", "labels", psnr);
            all.push(changed(labels, "enhance.objective = pseudo-labels"));
        }
        let tables = tables(&all);
        let rows = |name: &str| -> Vec<(&str, Option<f64>)> {
            let table = tables.iter().find(|t| t.name == name).unwrap();
            table
                .rows
                .iter()
                .filter(|r| !r.published)
                .map(|r| (r.label.as_str(), r.cells[0].value()))
                .collect()
        };
        assert_eq!(rows("ablation-stage1"), [("full", Some(31.0)), ("mlp", Some(27.0))]);
        let stage2: Vec<&str> = rows("ablation-stage2").iter().map(|row| row.0).collect();
        assert_eq!(stage2, ["full", "mlp", "local-only"]);
        assert_eq!(rows("prior-integration"), [("labels", Some(0.6)), ("full", Some(0.6))]);
        assert_eq!(rows("reconstruction").len(), 1);
        assert_eq!(rows("reconstruction-scenes").len(), 3);
    }

    #[test]
    fn a_scene_that_failed_has_a_row_with_its_reason_and_is_named_where_means_lack_it() {
        let scored = scene("D3", "D3", "", 28.0);
        let means = MeanScores::new([&scored.scene, &scored.group, ""], &scored.scores);
        let reason = "`prepare` failed: the film is cut off".to_string();
        let failed =
            [FailedScene { scene: "A7".into(), group: "DRUVA-20".into(), variant: String::new(), reason }];
        let tables = super::tables(&[means], &failed);
        let text = |name: &str| tables.iter().find(|t| t.name == name).unwrap().markdown();
        assert!(text("reconstruction-scenes").contains("| A7 · 3D-USE"), "{}", text("reconstruction-scenes"));
        assert!(text("reconstruction-scenes").contains("n/a: A7: `prepare` failed: the film is cut off"));
        assert!(text("reconstruction").contains("Without scenes that failed (A7: `prepare` failed"));
    }

    #[test]
    fn scenes_that_masks_hide_are_named_below_the_tables() {
        let mut scenes = [scene("reef", "a", "", 20.0), scene("wreck", "a", "", 30.0)];
        let captions = |scenes: &[AllScores]| -> Vec<String> {
            tables(scenes).into_iter().map(|t| t.caption).filter(|c| c.contains("Masks hide")).collect()
        };
        assert!(captions(&scenes).is_empty());
        scenes[1].scores.pixels = 0.31;
        let said = captions(&scenes);
        assert!(
            said.len() == 2
                && said.iter().all(|c| c.contains("wreck (31 % are scored)") && !c.contains("reef")),
            "{said:?}"
        );
    }

    #[test]
    fn published_rows_need_the_papers_size_and_split_and_not_only_its_name() {
        let published =
            |scenes: &[AllScores]| tables(scenes).iter().any(|t| t.rows.iter().any(|r| r.published));
        let d3 = scene("D3", "D3", "", 28.0);
        assert!(published(std::slice::from_ref(&d3)));
        let mut small = d3.clone();
        small.scores.size = (96, 64);
        let mut other_split = d3.clone();
        (other_split.scores.training_views, other_split.scores.held_out_views) = (7, 3);
        let mut foreign = d3.clone();
        foreign.scene = "mine".into();
        // A configuration that differs from the paper's in a single point, and an unknown one.
        let [mut changed, mut pairs, mut unknown] = [d3.clone(), d3.clone(), d3];
        let said = changed.configuration.get_or_insert_default();
        said.changed = vec!["targets.proposer = fusion".into()];
        pairs.configuration.get_or_insert_default().data_of_the_paper = false;
        unknown.configuration = None;
        for scene in [small, other_split, foreign, changed, pairs, unknown] {
            assert!(!published(&[scene]));
        }
    }

    #[test]
    fn all_scenes_together_have_a_mean_and_with_all_of_the_papers_its_wlpips() {
        let names: Vec<String> = ["IUI3-RedSea", "Curasao", "JapaneseGradens-RedSea", "Panama", "D3", "D5"]
            .map(String::from)
            .into_iter()
            .chain((1..=20).map(|i| format!("A{i}")))
            .collect();
        let mut scenes: Vec<AllScores> = (names.iter().enumerate())
            .map(|(i, name)| scene(name, published::scene(name).unwrap().0, "", 20.0 + i as f64))
            .collect();
        let find = |tables: &[Table], name: &str| tables.iter().find(|t| t.name == name).unwrap().clone();
        let all = tables(&scenes);
        let enhancement = find(&all, "enhancement");
        let place = enhancement.columns.iter().position(|c| c.group == ALL && c.name == "wLPIPS").unwrap();
        let plenodium = enhancement.rows.iter().find(|r| r.label == "Plenodium").unwrap();
        assert_eq!(plenodium.cells[place].value(), Some(0.158));
        let reconstruction = find(&all, "reconstruction");
        let ours = reconstruction.rows.iter().find(|r| !r.published).unwrap();
        let psnr = reconstruction.columns.iter().position(|c| c.group == ALL && c.name == "PSNR").unwrap();
        assert_eq!(ours.cells[psnr].value(), Some(32.5), "the mean of 20 to 45");
        scenes.pop();
        let fewer = find(&tables(&scenes), "enhancement");
        let plenodium = fewer.rows.iter().find(|r| r.label == "Plenodium").unwrap();
        assert_eq!(plenodium.cells[place], Cell::Blank, "25 scenes are not the paper's 26");
    }

    #[test]
    fn the_second_ablation_begins_with_stage_1_and_photographs_stand_once() {
        let mut variants = ["local-only", "full"].map(|v| scene("reef", "", v, 20.0));
        for scene in &mut variants {
            scene.scores.methods[0].mean.insert("uciqe".into(), Score::of(0.5));
            let view =
                ViewScores { view: "v".into(), scores: Scores::from([("uciqe".into(), Score::of(0.4))]) };
            scene.scores.methods.push(MethodScores::new(Method::Captured, vec![view], vec![], vec![]));
        }
        variants[1].scores.methods[1].mean.insert("uciqe".into(), Score::of(0.61));
        let tables = tables(&variants);
        let labels = |name: &str| -> Vec<&str> {
            tables.iter().find(|t| t.name == name).unwrap().rows.iter().map(|r| r.label.as_str()).collect()
        };
        assert_eq!(labels("ablation-stage2"), ["Stage 1", "local-only", "full"]);
        let rows = &tables.iter().find(|t| t.name == "enhancement").unwrap().rows;
        let shared = rows.iter().find(|r| r.label == Method::Captured.label());
        assert!(shared.is_some(), "what all variants share has no variant's name");
        let captured = |l: &&&str| l.starts_with(Method::Captured.label());
        assert_eq!(labels("enhancement").iter().filter(captured).count(), 1, "{:?}", labels("enhancement"));
    }

    /// Two variants with the same numbers are two results, and both are shown.
    #[test]
    fn variants_with_equal_numbers_stay_in_every_table() {
        let same = [("with-prior", "auto"), ("without-prior", "off")].map(|(v, prior)| {
            changed(scene("reef", "", v, 20.0), &format!("reconstruct.depth_prior = {prior}"))
        });
        let tables = tables(&same);
        for name in ["reconstruction", "enhancement", "ablation-stage1", "ablation-stage2"] {
            let table = tables.iter().find(|t| t.name == name).unwrap();
            for variant in ["with-prior", "without-prior"] {
                assert!(table.rows.iter().any(|r| r.label.ends_with(variant)), "{variant} in {name}");
            }
        }
    }

    /// If the enhancement was learnt in clear radiance, `enhanced-clear` is the result.
    #[test]
    fn the_row_of_the_method_is_the_look_that_it_was_learnt_in() {
        let mut clear = scene("reef", "", "v", 20.0);
        clear.scores.result = Method::EnhancedClear;
        let view = ViewScores { view: "v".into(), scores: Scores::from([("uciqe".into(), Score::of(0.7))]) };
        clear.scores.methods.push(MethodScores::new(Method::EnhancedClear, vec![view], vec![], vec![]));
        let tables = tables(&[clear, scene("reef", "", "w", 20.0)]);
        let table = |name: &str| tables.iter().find(|t| t.name == name).unwrap();
        let of = |name: &str, label: &str| {
            let row = table(name).rows.iter().find(|r| r.label == label);
            row.unwrap_or_else(|| panic!("{label}: {:?}", table(name).rows)).cells[0].value()
        };
        assert_eq!(of("enhancement", "3D-USE, this program (enhanced-clear) · v"), Some(0.7));
        assert_eq!(of("enhancement", "3D-USE, enhanced · v"), Some(0.6));
        assert_eq!(of("enhancement", "3D-USE, this program · w"), Some(0.6));
        assert_eq!((of("ablation-stage2", "v"), of("ablation-stage2", "w")), (Some(0.7), Some(0.6)));
    }

    #[test]
    fn another_method_does_not_have_the_name_of_this_program() {
        let mut other = scene("reef", "", "", 20.0);
        other.configuration.get_or_insert_default().preset = "seasplat + paper".into();
        for table in tables(&[other]).iter().filter(|table| table.name.starts_with("reconstruction")) {
            assert!(table.markdown().contains("SeaSplat, in this program"), "{}", table.markdown());
            assert!(!table.markdown().contains("3D-USE, this program"), "{}", table.markdown());
        }
    }

    #[test]
    fn every_row_says_what_made_it_in_every_form() {
        let mut other = scene("reef", "", "", 20.0);
        other.configuration.get_or_insert_default().changed = vec!["targets.proposer = fusion".into()];
        let tables = tables(&[other]);
        let table = tables.iter().find(|t| t.name == "enhancement").unwrap();
        let told = "preset paper, changed: targets.proposer = fusion; proposer: nu2net";
        assert!(table.rows.iter().all(|r| r.made_by == told), "{:?}", table.rows);
        let markdown = table.markdown();
        assert!(markdown.contains("3D-USE, this program [a] |") && markdown.contains(&format!("[a] {told}")));
        assert!(table.csv().starts_with("method,published,made by,"));
        assert!(table.csv().contains(&format!("\"{told}\"")), "{}", table.csv());
        assert!(table.json().unwrap().contains(told) && table.latex().contains("preset paper, changed"));
    }

    /// Twenty-six scenes without a group would be 78 columns.
    #[test]
    fn many_scenes_are_rows_with_the_photographs_once_and_their_variants_below() {
        let mut all = Vec::new();
        for name in ["reef", "wreck", "vent"] {
            for variant in ["full", "first"] {
                let mut scene = scene(name, "", variant, 20.0);
                let view =
                    ViewScores { view: "v".into(), scores: Scores::from([("uciqe".into(), Score::of(0.4))]) };
                scene.scores.methods.push(MethodScores::new(Method::Captured, vec![view], vec![], vec![]));
                all.push(scene);
            }
        }
        let tables = tables(&all);
        let table = |name: &str| tables.iter().find(|t| t.name == name).unwrap();
        assert!(table("reconstruction").columns.iter().all(|c| c.group == ALL || c.group.is_empty()));
        let rows = |name: &str| -> Vec<String> { table(name).rows.iter().map(|r| r.name()).collect() };
        let own = ["full", "first"].map(|variant| format!("vent · 3D-USE, this program · {variant}"));
        assert_eq!(rows("reconstruction-scenes")[4..], own);
        let captured = "vent · Captured (raw input)".to_string();
        assert_eq!(rows("enhancement-scenes")[6..], [&captured, &own[0], &own[1]].map(Clone::clone));
        let of_one = super::super::Table::marks(table("enhancement-scenes"));
        assert_eq!(of_one.len(), 9);
    }

    #[test]
    fn own_captures_have_no_published_rows_and_variants_make_ablations() {
        let mine = [scene("reef", "", "", 20.0), scene("reef", "", "vanilla", 18.0)];
        let tables = tables(&mine);
        assert!(tables.iter().all(|t| t.rows.iter().all(|r| !r.published)));
        let ablation = tables.iter().find(|t| t.name == "ablation-stage1").unwrap();
        assert_eq!(
            ablation.rows.iter().map(|r| r.cells[0].value()).collect::<Vec<_>>(),
            [Some(20.0), Some(18.0)]
        );
    }

    #[test]
    fn only_captures_with_their_truth_have_tables_of_it() {
        let real = scene("reef", "", "", 20.0);
        assert!(tables(std::slice::from_ref(&real)).iter().all(|t| !t.name.starts_with("truth")));
        let mut synthetic = scene("synthetic", "", "", 20.0);
        let methods = &mut synthetic.scores.methods;
        methods[0].mean.insert("depth_error".into(), Score::of(0.05));
        methods[1].mean.extend([
            ("truth_psnr".to_string(), Score::of(25.0)),
            ("truth_delta_e".to_string(), Score::of(4.0)),
        ]);
        synthetic.scores.water = Some(WaterScores {
            attenuation: [0.3, 0.2, 0.1],
            backscatter: [0.2, 0.1, 0.05],
            true_attenuation: [0.31, 0.21, 0.11],
            true_backscatter: [0.21, 0.11, 0.06],
        });
        let tables = tables(&[real, synthetic]);
        let table = |name: &str| tables.iter().find(|t| t.name == name).unwrap();
        let truth = table("truth");
        assert_eq!(truth.columns.len(), 2, "scenes without a group have no columns of their own");
        let enhanced = truth.rows.iter().find(|r| r.label == Method::Enhanced.label()).unwrap();
        assert_eq!(enhanced.cells.iter().map(Cell::value).collect::<Vec<_>>(), [Some(25.0), Some(4.0)]);
        let scene = table("truth-scene");
        assert!(scene.rows.iter().all(|r| r.scene == "synthetic"), "the real capture has no rows");
        let values = |row: usize| scene.rows[row].cells.iter().map(Cell::value).collect::<Vec<_>>();
        assert_eq!(
            (scene.rows[0].label.as_str(), &values(0)[..3]),
            ("Truth", &[None, Some(0.31), Some(0.21)][..])
        );
        assert_eq!(values(1)[..3], [Some(0.05), Some(0.3), Some(0.2)]);
        let latex = scene.latex();
        assert!(latex.contains("$\\beta$\\_attn R") && latex.is_ascii(), "{latex}");
    }
}
