//! A batch of scored scenes as a table sees it: its groups, its variants, their means, and the rows and
//! columns made of them.
//!
//! A group's number is the unweighted mean over its scenes (scene-macro), as in the paper; with more than one
//! group, that over all scenes follows. Published rows appear for a scene only when its name, size and split
//! are the paper's, and for a group only when it holds the paper's scenes and no other.

use super::published::{self, Published};
use super::{Better, Cell, Column, Row, Table};
use crate::judge::scores::{Method, SceneScores, Score, ScoredScene};

/// A quantity: its key in the scores, its name in heads, its direction, its decimals.
pub(super) type Quantity = (&'static str, &'static str, Better, usize);

/// The group of all scenes together.
pub(super) const ALL: &str = "All scenes";

/// Whether a scene is the paper's: its name, size and split.
fn is_the_papers(scene: &ScoredScene) -> bool {
    let SceneScores { training_views, held_out_views, size, .. } = scene.scores;
    let every_eighth = held_out_views == (training_views + held_out_views).div_ceil(8);
    published::scene(&scene.scene).is_some_and(|(_, wanted)| wanted == size) && every_eighth
}

/// The scenes of a run, grouped.
pub(super) struct Batch<'a> {
    pub(super) scenes: &'a [ScoredScene],
    /// Distinct groups (a scene without one forms its own), in order of appearance.
    pub(super) groups: Vec<String>,
    /// Distinct variants, in order of appearance.
    pub(super) variants: Vec<&'a str>,
}

/// The group that a scene counts in; one without forms its own.
pub(super) fn group_of(scene: &ScoredScene) -> &str {
    if scene.group.is_empty() { &scene.scene } else { &scene.group }
}

impl<'a> Batch<'a> {
    pub(super) fn new(scenes: &'a [ScoredScene]) -> Self {
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
    pub(super) fn of_group(&self, group: &str, variant: &str) -> Vec<&'a ScoredScene> {
        let fits = |s: &&ScoredScene| (group == ALL || group_of(s) == group) && s.variant == variant;
        self.scenes.iter().filter(fits).collect()
    }

    /// Whether the paper's numbers for this group may stand beside ours.
    pub(super) fn is_published(&self, group: &str) -> bool {
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

    pub(super) fn every_group_is_one_scene(&self) -> bool {
        let variants = self.variants.len();
        let of = |g: &String| self.scenes.iter().filter(|s| group_of(s) == g).count();
        self.groups.iter().filter(|g| *g != ALL).all(|g| of(g) <= variants)
    }

    /// One row per variant and method. What a variant only repeats (photographs are the same in all of them)
    /// stands once.
    pub(super) fn rows(&self, methods: &[Method], quantities: &[Quantity]) -> Vec<Row> {
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
    pub(super) fn before_stage2(&self, quantities: &[Quantity]) -> Option<Row> {
        self.variants.iter().find_map(|variant| {
            let scenes: Vec<&ScoredScene> = self.scenes.iter().filter(|s| s.variant == **variant).collect();
            let cells: Vec<Cell> = (quantities.iter())
                .map(|(key, ..)| macro_mean(&scenes, Method::Reconstruction, key))
                .collect();
            let known = cells.iter().any(|c| *c != Cell::Blank);
            known.then(|| Row { label: Method::Reconstruction.label().into(), published: false, cells })
        })
    }

    pub(super) fn label(method: Method, variant: &str) -> String {
        if variant.is_empty() { method.label().into() } else { format!("{} · {variant}", method.label()) }
    }

    pub(super) fn row(&self, method: Method, variant: &str, quantities: &[Quantity]) -> Row {
        let cells = self.groups.iter().flat_map(|group| {
            let scenes = self.of_group(group, variant);
            quantities.iter().map(move |(key, ..)| macro_mean(&scenes, method, key))
        });
        Row { label: Self::label(method, variant), published: false, cells: cells.collect() }
    }

    pub(super) fn columns(&self, quantities: &[Quantity]) -> Vec<Column> {
        let column = |group: &str, q: &Quantity| Column::new(group, q.1, q.2, q.3);
        self.groups.iter().flat_map(|g| quantities.iter().map(move |q| column(g, q))).collect()
    }

    /// Published rows over our groups; groups that the paper does not have stay blank.
    pub(super) fn published_rows(&self, source: &[Published], quantities: &[Quantity]) -> Vec<Row> {
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
    pub(super) fn published_wlpips(&self, method: &str, group: &str) -> Option<f64> {
        if !self.is_published(group) {
            return None;
        }
        if group == ALL {
            return published::CONSISTENCY_ALL.iter().find(|(m, _)| *m == method).map(|(_, value)| *value);
        }
        let place = published::GROUPS.iter().position(|g| *g == group)?;
        published::CONSISTENCY.iter().find(|(m, _)| *m == method).map(|(_, values)| values[place])
    }

    pub(super) fn by_scene(
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

    /// One row per variant, averaged over all scenes of the run, of the first of some methods that the
    /// variant has.
    pub(super) fn ablation(
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

/// A published number, or a blank.
pub(super) fn published_cell(value: Option<f64>) -> Cell {
    value.map_or(Cell::Blank, |value| Cell::Number { value, source: published::SOURCE.into() })
}

/// The unweighted mean of the scenes' means; blank when no scene has the method or the metric.
pub(super) fn macro_mean(scenes: &[&ScoredScene], method: Method, metric: &str) -> Cell {
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
