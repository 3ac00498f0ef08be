//! The paper's tables from a batch's scores: reconstruction, enhancement, scene-wise, consistency, both ablations.
//!
//! A group's number is the unweighted mean over its scenes (scene-macro), as in the paper; with more than one group, that over all scenes
//! follows. Published rows appear for a scene only when its name, size and split are the paper's, and for a group only when it holds
//! the paper's scenes and no other.

use super::published::{self, Published};
use super::{Better, Cell, Column, Row, Table};
use crate::scores::{Method, SceneScores, Score, ScoredScene, Warp};

/// A quantity: its key in the scores, its name in heads, its direction, its decimals.
type Quantity = (&'static str, &'static str, Better, usize);

const RECONSTRUCTION: [Quantity; 3] = [
    ("psnr", "PSNR", Better::Higher, 3),
    ("ssim", "SSIM", Better::Higher, 3),
    ("lpips", "LPIPS", Better::Lower, 3),
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
/// Why a scene has no frames per second here.
const NOT_TIMED: &str = "times are no part of an artifact: they are kept beside it and filled in when `use3d run` writes its results";
/// The group of all scenes together.
const ALL: &str = "All scenes";

/// Against the truth of synthetic captures.
const TRUTH: [Quantity; 2] =
    [("truth_psnr", "PSNR", Better::Higher, 2), ("truth_delta_e", "ΔE₀₀", Better::Lower, 2)];
/// What is compared with the true clean images.
const CLEAN: [Method; 7] = [
    Method::Captured,
    Method::Proposal,
    Method::Clear,
    Method::ProposalOfRender,
    Method::EnhanceThenReconstruct,
    Method::Enhanced,
    Method::EnhancedClear,
];

/// Whether a scene is the paper's: its name, size and split.
fn is_the_papers(scene: &ScoredScene) -> bool {
    let SceneScores { training_views, held_out_views, size, .. } = scene.scores;
    let every_eighth = held_out_views == (training_views + held_out_views).div_ceil(8);
    published::scene(&scene.scene).is_some_and(|(_, wanted)| wanted == size) && every_eighth
}

/// Every table that the scenes can fill, in the paper's order. Empty for no scenes.
pub fn tables(scenes: &[ScoredScene]) -> Vec<Table> {
    if scenes.is_empty() {
        return Vec::new();
    }
    let batch = Batch::new(scenes);
    let mut tables = vec![
        batch.reconstruction(),
        batch.by_scene(
            "reconstruction-scenes",
            "Reconstruction of held-out views, scene by scene",
            &RECONSTRUCTION,
            &[Method::Reconstruction],
            published::RECONSTRUCTION_SCENES,
        ),
        batch.enhancement(),
        batch.by_scene(
            "enhancement-scenes",
            "Enhancement quality of held-out views, scene by scene",
            &ENHANCEMENT,
            &Method::ALL,
            published::ENHANCEMENT_SCENES,
        ),
        batch.consistency(),
    ];
    if batch.every_group_is_one_scene() {
        // They would repeat the group tables.
        tables.retain(|t| !t.name.ends_with("-scenes"));
    }
    tables.extend(batch.truth());
    tables.extend(batch.recovered());
    if batch.variants.len() > 1 {
        tables.push(batch.ablation(
            "ablation-stage1",
            "Variants, stage 1: reconstruction of held-out views",
            &RECONSTRUCTION,
            &[Method::Reconstruction],
            published::ABLATION_STAGE1,
        ));
        let mut stage2 = batch.ablation(
            "ablation-stage2",
            "Variants, stage 2: enhancement quality of held-out views",
            &ENHANCEMENT,
            &[Method::Enhanced, Method::EnhanceThenReconstruct],
            published::ABLATION_STAGE2,
        );
        // What stage 2 starts from, as in the paper: the same for all variants that share a stage 1.
        let first = stage2.rows.iter().position(|r| !r.published).unwrap_or(stage2.rows.len());
        stage2.rows.splice(first..first, batch.before_stage2(&ENHANCEMENT));
        tables.push(stage2);
    }
    // What a run does not have takes no room.
    for table in &mut tables {
        table.rows.retain(|row| row.published || row.cells.iter().any(|cell| *cell != Cell::Blank));
    }
    tables.retain(|table| !table.rows.is_empty());
    tables
}

struct Batch<'a> {
    scenes: &'a [ScoredScene],
    /// Distinct groups (a scene without one forms its own), in order of appearance.
    groups: Vec<String>,
    /// Distinct variants, in order of appearance.
    variants: Vec<&'a str>,
}

fn group_of(scene: &ScoredScene) -> &str {
    if scene.group.is_empty() { &scene.scene } else { &scene.group }
}

impl<'a> Batch<'a> {
    fn new(scenes: &'a [ScoredScene]) -> Self {
        let (mut groups, mut variants): (Vec<String>, Vec<&str>) = (Vec::new(), Vec::new());
        for scene in scenes {
            if !groups.iter().any(|g| g == group_of(scene)) {
                groups.push(group_of(scene).to_string());
            }
            if !variants.contains(&scene.variant.as_str()) {
                variants.push(&scene.variant);
            }
        }
        if groups.len() > 1 {
            groups.push(ALL.into());
        }
        Self { scenes, groups, variants }
    }

    /// The scenes of a group in a variant.
    fn of_group(&self, group: &str, variant: &str) -> Vec<&'a ScoredScene> {
        let fits = |s: &&ScoredScene| (group == ALL || group_of(s) == group) && s.variant == variant;
        self.scenes.iter().filter(fits).collect()
    }

    /// Whether the paper's numbers for this group may stand beside ours.
    fn is_published(&self, group: &str) -> bool {
        let wanted = match group {
            ALL => published::SCENES,
            _ if published::GROUPS.contains(&group) => published::scenes_of(group),
            _ => return false,
        };
        self.variants.iter().any(|variant| {
            let scenes = self.of_group(group, variant);
            let belongs = |s: &&ScoredScene| {
                group == ALL || published::scene(&s.scene).is_some_and(|(g, _)| g == group)
            };
            scenes.len() == wanted && scenes.iter().all(|s| is_the_papers(s) && belongs(s))
        })
    }

    fn every_group_is_one_scene(&self) -> bool {
        let variants = self.variants.len();
        let of = |g: &String| self.scenes.iter().filter(|s| group_of(s) == g).count();
        self.groups.iter().filter(|g| *g != ALL).all(|g| of(g) <= variants)
    }

    /// One row per variant and method. What a variant only repeats (photographs are the same in all of them) stands once.
    fn rows(&self, methods: &[Method], quantities: &[Quantity]) -> Vec<Row> {
        let mut rows: Vec<(Method, Row)> = Vec::new();
        for variant in &self.variants {
            for &method in methods {
                let row = self.row(method, variant, quantities);
                let values = |row: &Row| row.cells.iter().map(Cell::value).collect::<Vec<_>>();
                let new = values(&row);
                let repeats = |(m, r): &(Method, Row)| *m == method && values(r) == new;
                if new.iter().all(Option::is_none) || !rows.iter().any(repeats) {
                    rows.push((method, row));
                }
            }
        }
        rows.into_iter().map(|(_, row)| row).collect()
    }

    /// Stage 1's row of the second ablation, of the first variant that learnt from photographs.
    fn before_stage2(&self, quantities: &[Quantity]) -> Option<Row> {
        self.variants.iter().find_map(|variant| {
            let scenes: Vec<&ScoredScene> = self.scenes.iter().filter(|s| s.variant == **variant).collect();
            let cells: Vec<Cell> = (quantities.iter())
                .map(|(key, ..)| macro_mean(&scenes, Method::Reconstruction, key))
                .collect();
            let known = cells.iter().any(|c| *c != Cell::Blank);
            known.then(|| Row { label: Method::Reconstruction.label().into(), published: false, cells })
        })
    }

    fn label(method: Method, variant: &str) -> String {
        if variant.is_empty() { method.label().into() } else { format!("{} · {variant}", method.label()) }
    }

    fn row(&self, method: Method, variant: &str, quantities: &[Quantity]) -> Row {
        let cells = self.groups.iter().flat_map(|group| {
            let scenes = self.of_group(group, variant);
            quantities.iter().map(move |(key, ..)| macro_mean(&scenes, method, key))
        });
        Row { label: Self::label(method, variant), published: false, cells: cells.collect() }
    }

    fn columns(&self, quantities: &[Quantity]) -> Vec<Column> {
        let column = |group: &str, q: &Quantity| Column::new(group, q.1, q.2, q.3);
        self.groups.iter().flat_map(|g| quantities.iter().map(move |q| column(g, q))).collect()
    }

    /// Published rows over our groups; groups that the paper does not have stay blank.
    fn published_rows(&self, source: &[Published], quantities: &[Quantity]) -> Vec<Row> {
        let mut methods: Vec<&str> = Vec::new();
        for row in source.iter().filter(|r| self.groups.iter().any(|g| g == r.group && self.is_published(g)))
        {
            if !methods.contains(&row.method) {
                methods.push(row.method);
            }
        }
        let rows = methods.into_iter().map(|method| {
            let cells = self.groups.iter().flat_map(|group| {
                let found = source
                    .iter()
                    .find(|r| r.method == method && r.group == group && self.is_published(group));
                quantities.iter().enumerate().map(move |(q, (key, ..))| {
                    published_cell(match *key {
                        "wlpips" => self.published_wlpips(method, group),
                        _ => found.and_then(|r| r.values.get(q).copied()),
                    })
                })
            });
            Row { label: method.into(), published: true, cells: cells.collect() }
        });
        rows.collect()
    }

    /// The paper's wLPIPS of a method for one of our groups, if its numbers may stand beside ours.
    fn published_wlpips(&self, method: &str, group: &str) -> Option<f64> {
        if !self.is_published(group) {
            return None;
        }
        if group == ALL {
            return published::CONSISTENCY_ALL.iter().find(|(m, _)| *m == method).map(|(_, value)| *value);
        }
        let place = published::GROUPS.iter().position(|g| *g == group)?;
        published::CONSISTENCY.iter().find(|(m, _)| *m == method).map(|(_, values)| values[place])
    }

    fn reconstruction(&self) -> Table {
        let mut columns = self.columns(&RECONSTRUCTION);
        let mut rows = self.published_rows(published::RECONSTRUCTION, &RECONSTRUCTION);
        let timed = !rows.is_empty() || self.scenes.iter().any(|s| s.speed.is_some());
        if timed {
            columns.push(Column::new("", "FPS", Better::Neither, 2));
        }
        for row in &mut rows {
            let fps = published::FPS.iter().find(|(method, _)| *method == row.label).map(|(_, fps)| *fps);
            row.cells.push(published_cell(fps));
        }
        for variant in &self.variants {
            let mut row = self.row(Method::Reconstruction, variant, &RECONSTRUCTION);
            row.label = Self::label(Method::Enhanced, variant);
            let speeds: Vec<f64> = (self.scenes.iter().filter(|s| s.variant == **variant))
                .filter_map(|s| Some(s.speed.as_ref()?.fps.get()))
                .collect();
            if timed {
                row.cells.push(if speeds.is_empty() {
                    Cell::NotAvailable { reason: NOT_TIMED.into() }
                } else {
                    Cell::Number {
                        value: speeds.iter().sum::<f64>() / speeds.len() as f64,
                        source: self.hardware(),
                    }
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
        Table { name: "reconstruction".into(), caption, columns, rows }
    }

    /// What our frames per second were measured on, and at which sizes.
    fn hardware(&self) -> String {
        let mut seen: Vec<String> = Vec::new();
        for speed in self.scenes.iter().filter_map(|s| s.speed.as_ref()) {
            let (w, h) = speed.size;
            let text = format!("{w}×{h} on {} ({} threads)", speed.processor, speed.threads);
            if !seen.contains(&text) {
                seen.push(text);
            }
        }
        seen.join(", ")
    }

    fn enhancement(&self) -> Table {
        let mut rows = self.published_rows(published::ENHANCEMENT, &ENHANCEMENT);
        rows.extend(self.rows(&Method::ALL, &ENHANCEMENT));
        Table {
            name: "enhancement".into(),
            caption: "Enhancement quality of held-out views, and consistency of neighbouring captured views (scene-macro means)".into(),
            columns: self.columns(&ENHANCEMENT),
            rows,
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
                Row { label: (*method).into(), published: true, cells: cells.collect() }
            }));
        }
        rows.extend(self.rows(&Method::ALL, &CONSISTENCY));
        let mut caption = String::from(
            "Consistency of captured views that follow one another, and of adjacent frames of a path through the training cameras (where there are no photographs). wLPIPS as in the paper; wΔE and wSSIM warp by depth and need no weights (not the paper's). share: of the pixels, compared by depth",
        );
        caption += if self.scenes.iter().all(|s| s.scores.warp == Warp::Reference) {
            ". All methods and variants of a scene share one warp: the reference variant's stage 1"
        } else {
            ". Some scenes were compared by their own depth: not comparable with others"
        };
        Table { name: "consistency".into(), caption, columns: self.columns(&CONSISTENCY), rows }
    }

    /// Appearances against the true clean images, over the groups that have them.
    fn truth(&self) -> Option<Table> {
        let known = |s: &&ScoredScene| CLEAN.iter().any(|m| s.scores.mean(*m, TRUTH[0].0).is_some());
        let groups: Vec<&String> = self
            .groups
            .iter()
            .filter(|g| self.scenes.iter().filter(known).any(|s| group_of(s) == *g))
            .collect();
        if groups.is_empty() {
            return None;
        }
        let rows = self.variants.iter().flat_map(|variant| {
            CLEAN.map(|method| {
                let cells = groups.iter().flat_map(|group| {
                    let scenes: Vec<&ScoredScene> =
                        self.of_group(group, variant).into_iter().filter(known).collect();
                    TRUTH.map(|(key, ..)| macro_mean(&scenes, method, key))
                });
                Row { label: Self::label(method, variant), published: false, cells: cells.collect() }
            })
        });
        let columns = groups.iter().flat_map(|g| TRUTH.map(|q| Column::new(g, q.1, q.2, q.3)));
        Some(Table {
            name: "truth".into(),
            caption: "Against the truth (synthetic captures): held-out views against the true clean images, where they show a surface, after one least-squares gain per image".into(),
            columns: columns.collect(),
            rows: rows.collect(),
        })
    }

    /// Recovered water and depth beside the true ones, scene by scene.
    fn recovered(&self) -> Option<Table> {
        const DEPTH: &str = "depth_error";
        let mut names: Vec<&str> = Vec::new();
        for scene in self.scenes {
            let known = scene.scores.mean(Method::Reconstruction, DEPTH).is_some();
            if known && !names.contains(&scene.scene.as_str()) {
                names.push(&scene.scene);
            }
        }
        let first = |name: &str| self.scenes.iter().find(|s| s.scene == name && s.scores.water.is_some());
        let row = |label: String, cells: &dyn Fn(&str) -> Vec<Cell>| Row {
            label,
            published: false,
            cells: names.iter().flat_map(|name| cells(name)).collect(),
        };
        let numbers = |values: [[f64; 3]; 2], source: &str| -> Vec<Cell> {
            let cell = |value| Cell::Number { value, source: source.into() };
            values.into_iter().flatten().map(cell).collect()
        };
        let mut rows = vec![row("Truth".into(), &|name| {
            let mut cells = vec![Cell::Blank];
            cells.extend(match first(name).and_then(|s| s.scores.water) {
                Some(w) => {
                    numbers([w.true_attenuation, w.true_backscatter], "truth/water.json of the capture")
                }
                None => vec![Cell::Blank; 6],
            });
            cells
        })];
        for variant in &self.variants {
            let label =
                if variant.is_empty() { "Recovered".into() } else { format!("Recovered · {variant}") };
            rows.push(row(label, &|name| {
                let found: Vec<&ScoredScene> =
                    self.scenes.iter().filter(|s| s.scene == name && s.variant == **variant).collect();
                let mut cells = vec![macro_mean(&found, Method::Reconstruction, DEPTH)];
                cells.extend(match found.first().and_then(|s| Some((s, s.scores.water?))) {
                    Some((s, w)) => numbers([w.attenuation, w.backscatter], &s.source),
                    None => vec![Cell::Blank; 6],
                });
                cells
            }));
        }
        let quantities: [(&str, Better); 7] = [
            ("depth error", Better::Lower),
            ("β_attn R", Better::Neither),
            ("β_attn G", Better::Neither),
            ("β_attn B", Better::Neither),
            ("β_bs R", Better::Neither),
            ("β_bs G", Better::Neither),
            ("β_bs B", Better::Neither),
        ];
        let columns =
            names.iter().flat_map(|n| quantities.map(|(name, better)| Column::new(n, name, better, 4)));
        let columns: Vec<Column> = columns.collect();
        (!names.is_empty()).then(|| Table {
            name: "truth-scene".into(),
            caption: "Against the truth (synthetic captures): median relative error of stage 1's depth, and the water's coefficients in 1/m, means over the rays of held-out views".into(),
            columns,
            rows,
        })
    }

    fn by_scene(
        &self,
        name: &str,
        caption: &str,
        quantities: &[Quantity],
        methods: &[Method],
        source: &[Published],
    ) -> Table {
        let mut names: Vec<&str> = Vec::new();
        for scene in self.scenes {
            if !names.contains(&scene.scene.as_str()) {
                names.push(&scene.scene);
            }
        }
        let columns =
            names.iter().flat_map(|n| quantities.iter().map(move |q| Column::new(n, q.1, q.2, q.3)));
        let mut rows: Vec<Row> = Vec::new();
        let mut published_methods: Vec<&str> = Vec::new();
        let papers = |name: &str| self.scenes.iter().any(|s| s.scene == name && is_the_papers(s));
        for row in source.iter().filter(|r| names.contains(&r.group) && papers(r.group)) {
            if !published_methods.contains(&row.method) {
                published_methods.push(row.method);
            }
        }
        for method in published_methods {
            let cells = names.iter().flat_map(|name| {
                let found = source.iter().find(|r| r.method == method && r.group == *name && papers(name));
                (0..quantities.len())
                    .map(move |q| published_cell(found.and_then(|r| r.values.get(q).copied())))
            });
            rows.push(Row { label: method.into(), published: true, cells: cells.collect() });
        }
        for variant in &self.variants {
            for &method in methods {
                let cells = names.iter().flat_map(|name| {
                    let found: Vec<&ScoredScene> =
                        self.scenes.iter().filter(|s| s.scene == *name && s.variant == **variant).collect();
                    quantities.iter().map(move |(key, ..)| macro_mean(&found, method, key))
                });
                let label = if methods.len() == 1 { Method::Enhanced } else { method };
                rows.push(Row {
                    label: Self::label(label, variant),
                    published: false,
                    cells: cells.collect(),
                });
            }
        }
        Table { name: name.into(), caption: caption.into(), columns: columns.collect(), rows }
    }

    /// One row per variant, averaged over all scenes of the run, of the first of some methods that the variant has.
    fn ablation(
        &self,
        name: &str,
        caption: &str,
        quantities: &[Quantity],
        methods: &[Method],
        source: &[Published],
    ) -> Table {
        let columns = quantities.iter().map(|q| Column::new("", q.1, q.2, q.3)).collect();
        let mut rows = Vec::new();
        if self.groups.len() == 1 && self.groups[0] == "SeaThru-4" && self.is_published(&self.groups[0]) {
            rows.extend(source.iter().map(|r| Row {
                label: r.method.into(),
                published: true,
                cells: (0..quantities.len()).map(|q| published_cell(r.values.get(q).copied())).collect(),
            }));
        }
        for variant in &self.variants {
            let scenes: Vec<&ScoredScene> = self.scenes.iter().filter(|s| s.variant == **variant).collect();
            let has =
                |m: &&Method| quantities.iter().any(|(key, ..)| macro_mean(&scenes, **m, key) != Cell::Blank);
            let Some(method) = methods.iter().find(has).copied() else { continue };
            rows.push(Row {
                label: if variant.is_empty() { "full model".into() } else { (*variant).into() },
                published: false,
                cells: quantities.iter().map(|(key, ..)| macro_mean(&scenes, method, key)).collect(),
            });
        }
        Table { name: name.into(), caption: caption.into(), columns, rows }
    }
}

fn published_cell(value: Option<f64>) -> Cell {
    value.map_or(Cell::Blank, |value| Cell::Number { value, source: published::SOURCE.into() })
}

/// The unweighted mean of the scenes' means; blank when no scene has the method or the metric.
fn macro_mean(scenes: &[&ScoredScene], method: Method, metric: &str) -> Cell {
    let scores: Vec<&Score> = scenes.iter().filter_map(|s| s.scores.mean(method, metric)).collect();
    if scores.is_empty() {
        return Cell::Blank;
    }
    match Score::mean(scores) {
        Score::Value(value) => {
            let value = value.get();
            let sources: Vec<&str> = scenes.iter().map(|s| s.source.as_str()).collect();
            Cell::Number { value, source: sources.join(" ") }
        }
        Score::NotAvailable(reason) | Score::Undefined(reason) => Cell::NotAvailable { reason },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scores::{Finite, MethodScores, SceneSpeed, Scores, ViewScores};
    use crate::truth::WaterScores;

    fn scene(name: &str, group: &str, variant: &str, psnr: f64) -> ScoredScene {
        let view = |scores: Scores| vec![ViewScores { view: "v".into(), scores }];
        let reconstruction = Scores::from([
            ("psnr".to_string(), Score::of(psnr)),
            ("lpips".to_string(), Score::NotAvailable("put lpips_alex.pth into models/".into())),
        ]);
        let enhanced = Scores::from([("uciqe".to_string(), Score::of(0.6))]);
        ScoredScene {
            scene: name.into(),
            group: group.into(),
            variant: variant.into(),
            source: format!("digest-{name}"),
            scores: SceneScores {
                format: crate::scores::FORMAT.into(),
                version: crate::scores::VERSION,
                training_views: 7,
                held_out_views: 1,
                size: published::scene(name).map_or((4, 3), |(_, size)| size),
                gaussians: 10,
                warp: Warp::Reference,
                water: None,
                methods: vec![
                    MethodScores::new(Method::Reconstruction, view(reconstruction), vec![], vec![]),
                    MethodScores::new(Method::Enhanced, view(enhanced), vec![], vec![]),
                ],
            },
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
        assert_eq!(plenodium.cells[3].value(), Some(28.686));
        let scenes = &tables(&three)[1];
        assert!(scenes.rows.iter().any(|r| r.published && r.cells[3].value() == Some(33.861)));
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
        assert_eq!(labels("ablation-stage2"), ["full model", "first"]);
        assert_eq!(labels("ablation-stage1"), ["full model"]);
        assert!(tables.iter().all(|t| !t.rows.is_empty()));
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
        assert_eq!(truth.columns.len(), 2, "the real capture has no columns");
        let enhanced = truth.rows.iter().find(|r| r.label == Method::Enhanced.label()).unwrap();
        assert_eq!(enhanced.cells.iter().map(Cell::value).collect::<Vec<_>>(), [Some(25.0), Some(4.0)]);
        let scene = table("truth-scene");
        let values = |row: usize| scene.rows[row].cells.iter().map(Cell::value).collect::<Vec<_>>();
        assert_eq!(values(0)[..3], [None, Some(0.31), Some(0.21)]);
        assert_eq!(values(1)[..3], [Some(0.05), Some(0.3), Some(0.2)]);
        let latex = scene.latex();
        assert!(latex.contains("$\\beta$\\_attn R") && latex.is_ascii(), "{latex}");
    }

    #[test]
    fn published_rows_need_the_papers_size_and_split_and_not_only_its_name() {
        let published =
            |scenes: &[ScoredScene]| tables(scenes).iter().any(|t| t.rows.iter().any(|r| r.published));
        let d3 = scene("D3", "D3", "", 28.0);
        assert!(published(std::slice::from_ref(&d3)));
        let mut small = d3.clone();
        small.scores.size = (96, 64);
        let mut other_split = d3.clone();
        (other_split.scores.training_views, other_split.scores.held_out_views) = (7, 3);
        let mut foreign = d3;
        foreign.scene = "mine".into();
        for scene in [small, other_split, foreign] {
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
        let mut scenes: Vec<ScoredScene> = (names.iter().enumerate())
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
        let captured = |l: &&&str| l.starts_with(Method::Captured.label());
        assert_eq!(labels("enhancement").iter().filter(captured).count(), 1, "{:?}", labels("enhancement"));
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
}
