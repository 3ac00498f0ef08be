//! A batch of scored scenes as the tables need it: its groups, its variants, their means, and the rows and
//! columns made of them.
//!
//! A group's number is the unweighted mean over its scenes (scene-macro), as in the paper; with more than one
//! group, the mean over all scenes follows. Published rows appear for a scene only if its name, its size and
//! its configuration are the paper's, and for a group only if it contains exactly the paper's scenes.

use super::published::{self, Published};
use super::{Better, Cell, Column, Row, Table};
use use3d_judge::configuration::Configuration;
use use3d_judge::names::{distinct, in_variant};
use use3d_judge::scores::{Method, SceneScores, Score, ScoredScene};

/// A quantity: its key in the scores, its name in heads, its better direction, its decimals.
pub(super) type Quantity = (&'static str, &'static str, Better, usize);

/// The group of all scenes together.
pub(super) const ALL: &str = "All scenes";

/// True if a scene is the paper's: its name, size, number of held-out views and whole configuration.
fn is_the_papers(scene: &ScoredScene) -> bool {
    let SceneScores { training_views, held_out_views, size, .. } = scene.scores;
    let every_eighth = held_out_views == (training_views + held_out_views).div_ceil(8);
    let configured = scene.configuration.as_ref().is_some_and(Configuration::is_the_papers);
    published::scene(&scene.scene).is_some_and(|(_, wanted)| wanted == size) && every_eighth && configured
}

/// Methods that depend on the photographs alone and so are the same in every variant.
const OF_PHOTOGRAPHS: [Method; 2] = [Method::Captured, Method::Proposal];

/// The scenes of a run, grouped.
pub(super) struct Batch<'a> {
    pub(super) scenes: &'a [ScoredScene],
    /// Distinct groups (a scene without one forms its own), in order of appearance.
    pub(super) groups: Vec<&'a str>,
    /// Distinct variants, in order of appearance.
    pub(super) variants: Vec<&'a str>,
}

/// The group that a scene counts in; a scene without a group forms its own.
pub(super) fn group_of(scene: &ScoredScene) -> &str {
    if scene.group.is_empty() { &scene.scene } else { &scene.group }
}

impl<'a> Batch<'a> {
    pub(super) fn new(scenes: &'a [ScoredScene]) -> Self {
        let mut groups = distinct(scenes.iter().map(group_of));
        if groups.len() > 1 {
            groups.push(ALL);
        }
        Self { scenes, groups, variants: distinct(scenes.iter().map(|s| s.variant.as_str())) }
    }

    /// The scenes of a group, or of [`ALL`] groups, in a variant.
    pub(super) fn of_group(&self, group: &str, variant: &str) -> Vec<&'a ScoredScene> {
        let fits = |s: &&ScoredScene| (group == ALL || group_of(s) == group) && s.variant == variant;
        self.scenes.iter().filter(fits).collect()
    }

    /// True if the paper's numbers for this group may be shown next to ours.
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

    /// A sentence with the scenes whose masks hide more than half of the held-out pixels; empty if there is
    /// none.
    pub(super) fn of_few_pixels(&self) -> String {
        let few = self.scenes.iter().filter(|s| s.scores.is_of_few_pixels());
        let named = few.map(|s| {
            format!("{} ({:.0} % are scored)", in_variant(&s.scene, &s.variant), 100.0 * s.scores.pixels)
        });
        match named.collect::<Vec<_>>().join(", ") {
            none if none.is_empty() => none,
            named => format!(
                ". Masks hide more than half of the held-out pixels of {named}: do not trust its scores"
            ),
        }
    }

    pub(super) fn every_group_is_one_scene(&self) -> bool {
        let variants = self.variants.len();
        let of = |g: &str| self.scenes.iter().filter(|s| group_of(s) == g).count();
        self.groups.iter().filter(|g| **g != ALL).all(|g| of(g) <= variants)
    }

    /// One row per variant and method. Rows with equal numbers stay, so that a variant with the same numbers
    /// as another is not left out. Methods that depend on the photographs alone appear once, without a
    /// variant's name.
    pub(super) fn rows(&self, methods: &[Method], quantities: &[Quantity]) -> Vec<Row> {
        let values = |row: &Row| row.cells.iter().map(Cell::value).collect::<Vec<_>>();
        let mut rows: Vec<Row> = Vec::new();
        let mut shared: Vec<Method> = Vec::new();
        for &method in methods.iter().filter(|m| OF_PHOTOGRAPHS.contains(m)) {
            let mut each = self.variants.iter().map(|variant| self.row(method, variant, quantities));
            let Some(first) = each.next() else { continue };
            if self.variants.len() > 1 && each.all(|row| values(&row) == values(&first)) {
                shared.push(method);
                rows.push(Row { label: method.label().into(), made_by: String::new(), ..first });
            }
        }
        for variant in &self.variants {
            let own = methods.iter().filter(|m| !shared.contains(m));
            rows.extend(own.map(|&method| self.row(method, variant, quantities)));
        }
        rows
    }

    /// The configuration behind the numbers of a variant.
    fn made_by(&self, variant: &str) -> String {
        let scenes = self.of_group(ALL, variant).into_iter();
        let all: Vec<&Configuration> = scenes.filter_map(|s| s.configuration.as_ref()).collect();
        Configuration::told(&all)
    }

    /// The look in which the enhancement of a variant was learnt; it is the variant's result.
    fn result(&self, variant: &str) -> Method {
        self.of_group(ALL, variant).first().map_or(Method::Enhanced, |s| s.scores.result)
    }

    /// Stage 1's row of the second ablation, from the first variant that learnt from photographs.
    pub(super) fn before_stage2(&self, quantities: &[Quantity]) -> Option<Row> {
        self.variants.iter().find_map(|variant| {
            let cells = means(&self.of_group(ALL, variant), Method::Reconstruction, quantities);
            let known = cells.iter().any(|c| *c != Cell::Blank);
            known.then(|| self.own_row(Method::Reconstruction.label().into(), variant, cells))
        })
    }

    /// A method's name in a variant; the look that is the variant's result gets the program's name.
    pub(super) fn label(&self, method: Method, variant: &str) -> String {
        let name = match (method, self.result(variant)) {
            (Method::EnhancedClear, Method::EnhancedClear) => "3D-USE, this program (enhanced-clear)",
            (Method::Enhanced, Method::EnhancedClear) => "3D-USE, enhanced",
            _ => method.label(),
        };
        in_variant(name, variant)
    }

    /// The program's name in a variant, for a row about the whole program.
    pub(super) fn program(variant: &str) -> String {
        in_variant(Method::Enhanced.label(), variant)
    }

    /// A row of this program's own numbers.
    pub(super) fn own_row(&self, label: String, variant: &str, cells: Vec<Cell>) -> Row {
        Row { label, published: false, made_by: self.made_by(variant), cells }
    }

    pub(super) fn row(&self, method: Method, variant: &str, quantities: &[Quantity]) -> Row {
        let of = |group: &&str| means(&self.of_group(group, variant), method, quantities);
        self.own_row(self.label(method, variant), variant, self.groups.iter().flat_map(of).collect())
    }

    /// Published rows over our groups; groups that are not in the paper stay blank.
    pub(super) fn published_rows(&self, source: &[Published], quantities: &[Quantity]) -> Vec<Row> {
        let known: Vec<&Published> = source.iter().filter(|r| self.is_published(r.group)).collect();
        published_over(&self.groups, &known, quantities, |method, group| self.published_wlpips(method, group))
    }

    /// The paper's wLPIPS of a method for one of our groups, if its numbers may be shown next to ours.
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
        let names = distinct(self.scenes.iter().map(|s| s.scene.as_str()));
        let papers = |name: &str| self.scenes.iter().any(|s| s.scene == name && is_the_papers(s));
        let known: Vec<&Published> = source.iter().filter(|r| papers(r.group)).collect();
        let mut rows = published_over(&names, &known, quantities, |_, _| None);
        for variant in &self.variants {
            for &method in methods {
                let cells = names.iter().flat_map(|name| {
                    let mut found = self.of_group(ALL, variant);
                    found.retain(|s| s.scene == *name);
                    means(&found, method, quantities)
                });
                let alone = methods.len() == 1;
                let label = if alone { Self::program(variant) } else { self.label(method, variant) };
                rows.push(self.own_row(label, variant, cells.collect()));
            }
        }
        Table { name: name.into(), caption: caption.into(), columns: columns(&names, quantities), rows }
    }

    /// One row per variant, averaged over all scenes of the run, of the first of these methods that the
    /// variant has.
    pub(super) fn ablation(
        &self,
        name: &str,
        caption: &str,
        quantities: &[Quantity],
        methods: &[Method],
        source: &[Published],
    ) -> Table {
        let of_one = self.groups == ["SeaThru-4"] && self.is_published(self.groups[0]);
        let known: Vec<&Published> = source.iter().filter(|_| of_one).collect();
        let mut rows = published_over(&self.groups, &known, quantities, |_, _| None);
        for variant in &self.variants {
            let scenes = self.of_group(ALL, variant);
            let has = |m: &Method| means(&scenes, *m, quantities).iter().any(|cell| *cell != Cell::Blank);
            // The result of a variant comes first; if it was learnt without water, that is `enhanced-clear`.
            let result = self.result(variant);
            let in_order = [result].into_iter().filter(|m| methods.contains(m));
            let Some(method) = in_order.chain(methods.iter().copied()).find(has) else { continue };
            let label = if variant.is_empty() { "full model" } else { variant };
            rows.push(self.own_row(label.into(), variant, means(&scenes, method, quantities)));
        }
        Table { name: name.into(), caption: caption.into(), columns: columns(&[""], quantities), rows }
    }
}

/// Columns of some quantities for each of some groups or scenes.
pub(super) fn columns(groups: &[&str], quantities: &[Quantity]) -> Vec<Column> {
    let column = |group: &str, q: &Quantity| Column::new(group, q.1, q.2, q.3);
    groups.iter().flat_map(|g| quantities.iter().map(move |q| column(g, q))).collect()
}

/// Published rows over some groups or scenes, one per method that has a number there. `wlpips` gives the
/// wLPIPS of a method and a group, which is in no row of the paper's.
fn published_over(
    groups: &[&str],
    known: &[&Published],
    quantities: &[Quantity],
    wlpips: impl Fn(&str, &str) -> Option<f64>,
) -> Vec<Row> {
    let there = known.iter().filter(|r| groups.contains(&r.group));
    let rows = distinct(there.map(|r| r.method)).into_iter().map(|method| {
        let mut cells = Vec::new();
        for group in groups {
            let found = known.iter().find(|r| r.method == method && r.group == *group);
            cells.extend(quantities.iter().enumerate().map(|(q, (key, ..))| {
                published_cell(match *key {
                    "wlpips" => wlpips(method, group),
                    _ => found.and_then(|r| r.values.get(q).copied()),
                })
            }));
        }
        Row::published(method, cells)
    });
    rows.collect()
}

/// The means of a method's scores over some scenes, one per quantity.
pub(super) fn means(scenes: &[&ScoredScene], method: Method, quantities: &[Quantity]) -> Vec<Cell> {
    quantities.iter().map(|(key, ..)| macro_mean(scenes, method, key)).collect()
}

/// A published number, or a blank.
pub(super) fn published_cell(value: Option<f64>) -> Cell {
    value.map_or(Cell::Blank, |value| Cell::Number { value, source: published::SOURCE.into() })
}

/// The unweighted mean of the scenes' means; blank if no scene has the method or the metric.
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
