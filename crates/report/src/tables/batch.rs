//! A batch of scored scenes as the tables need it: its groups, its variants, their means, and the rows and
//! columns made of them.
//!
//! A group's number is the unweighted mean over its scenes (scene-macro), as in the paper. The mean over all
//! scenes follows, unless one group has them all. A scene without a group counts only there; a single scene
//! is its own group. Published rows appear for a scene only if its name, its size and its configuration are
//! the paper's, and for a group only if it contains exactly the paper's scenes.

use std::collections::{BTreeMap, BTreeSet};

use super::means::{MeanScores, place};
use super::published::{self, Published};
use super::{Better, Cell, Column, Row, Table};
use use3d_judge::configuration::Configuration;
use use3d_judge::names::{distinct, in_variant};
use use3d_judge::scores::{Method, Score};

/// A quantity: its key in the scores, its name in heads, its better direction, its decimals.
pub(super) type Quantity = (&'static str, &'static str, Better, usize);

/// The group of all scenes together.
pub(super) const ALL: &str = "All scenes";

/// True if a scene is the paper's: its name, size, number of held-out views and whole configuration.
fn is_the_papers(scene: &MeanScores) -> bool {
    let MeanScores { training_views, held_out_views, size, .. } = *scene;
    let every_eighth = held_out_views == (training_views + held_out_views).div_ceil(8);
    let configured = scene.configuration.as_deref().is_some_and(Configuration::is_the_papers);
    published::scene(&scene.scene).is_some_and(|(_, wanted)| wanted == size) && every_eighth && configured
}

/// Methods that depend on the photographs alone and so are the same in every variant.
const OF_PHOTOGRAPHS: [Method; 2] = [Method::Captured, Method::Proposal];

/// The most results whose names a cell lists as its sources.
const SOURCES: usize = 8;

/// The scenes of a run, grouped.
pub(super) struct Batch<'a> {
    pub(super) scenes: &'a [MeanScores],
    /// The groups that have columns.
    pub(super) groups: Vec<&'a str>,
    /// Distinct variants, in order of appearance.
    pub(super) variants: Vec<&'a str>,
    /// The variants with scenes in every group; all variants if there is none. The others are ablations on
    /// some groups, and have rows in the tables of variants alone.
    pub(super) whole: Vec<&'a str>,
    /// The scenes by variant and group.
    parts: BTreeMap<&'a str, BTreeMap<&'a str, Vec<&'a MeanScores>>>,
    /// The configuration behind the numbers of each variant.
    made_by: BTreeMap<&'a str, String>,
}

/// The group that a scene counts in besides [`ALL`]; the scene itself if it is the only one.
fn group_of(scene: &MeanScores, alone: bool) -> &str {
    if scene.group.is_empty() && alone { &scene.scene } else { &scene.group }
}

impl<'a> Batch<'a> {
    pub(super) fn new(scenes: &'a [MeanScores]) -> Self {
        let alone = scenes.iter().all(|s| s.scene == scenes[0].scene);
        let mut groups = distinct(scenes.iter().map(|s| group_of(s, alone)));
        let whole = groups.len() == 1 && !groups[0].is_empty();
        groups.retain(|group| !group.is_empty());
        if !whole {
            groups.push(ALL);
        }
        let mut parts: BTreeMap<&str, BTreeMap<&str, Vec<&MeanScores>>> = BTreeMap::new();
        for scene in scenes {
            let groups = parts.entry(&scene.variant).or_default();
            for group in BTreeSet::from([group_of(scene, alone), ALL]) {
                groups.entry(group).or_default().push(scene);
            }
        }
        let variants = distinct(scenes.iter().map(|s| s.variant.as_str()));
        let made_by = |variant: &&'a str| {
            let scenes = parts[variant][ALL].iter();
            let all: Vec<&Configuration> = scenes.filter_map(|s| s.configuration.as_deref()).collect();
            (*variant, Configuration::told(&all))
        };
        let has = |variant: &&&str| groups.iter().all(|group| parts[**variant].contains_key(group));
        let mut whole: Vec<&str> = variants.iter().filter(has).copied().collect();
        if whole.is_empty() {
            whole.clone_from(&variants);
        }
        Self { scenes, groups, made_by: variants.iter().map(made_by).collect(), variants, whole, parts }
    }

    /// The scenes of a group, or of [`ALL`] groups, in a variant.
    pub(super) fn of_group(&self, group: &str, variant: &str) -> &[&'a MeanScores] {
        self.parts.get(variant).and_then(|groups| groups.get(group)).map_or(&[], Vec::as_slice)
    }

    /// The scenes in order of appearance, each with its results.
    pub(super) fn by_name(&self) -> Vec<(&'a str, Vec<&'a MeanScores>)> {
        let mut places: BTreeMap<&str, usize> = BTreeMap::new();
        let mut all: Vec<(&str, Vec<&MeanScores>)> = Vec::new();
        for scene in self.scenes {
            let at = *places.entry(&scene.scene).or_insert(all.len());
            if at == all.len() {
                all.push((&scene.scene, Vec::new()));
            }
            all[at].1.push(scene);
        }
        all
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
            let belongs =
                |s: &MeanScores| group == ALL || published::scene(&s.scene).is_some_and(|(g, _)| g == group);
            scenes.len() == wanted && scenes.iter().all(|s| is_the_papers(s) && belongs(s))
        })
    }

    /// A sentence with the scenes whose masks hide more than half of the held-out pixels; empty if there is
    /// none.
    pub(super) fn of_few_pixels(&self) -> String {
        let few: Vec<&MeanScores> = self.scenes.iter().filter(|s| s.pixels < 0.5).collect();
        let named = few
            .iter()
            .take(SOURCES)
            .map(|s| format!("{} ({:.0} % are scored)", in_variant(&s.scene, &s.variant), 100.0 * s.pixels));
        let more = few.len().saturating_sub(SOURCES);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        match named.collect::<Vec<_>>().join(", ") {
            none if none.is_empty() => none,
            named => format!(
                ". Masks hide more than half of the held-out pixels of {named}{more}: do not trust its scores"
            ),
        }
    }

    /// One row per variant and method. Rows with equal numbers stay, so that a variant with the same numbers
    /// as another is not left out. Methods that depend on the photographs alone appear once, without a
    /// variant's name.
    pub(super) fn rows(&self, methods: &[Method], quantities: &[Quantity]) -> Vec<Row> {
        let values = |row: &Row| row.cells.iter().map(Cell::value).collect::<Vec<_>>();
        let mut rows: Vec<Row> = Vec::new();
        let mut shared: Vec<Method> = Vec::new();
        for &method in methods.iter().filter(|m| OF_PHOTOGRAPHS.contains(m)) {
            let mut each = self.whole.iter().map(|variant| self.row(method, variant, quantities));
            let Some(first) = each.next() else { continue };
            if self.whole.len() > 1 && each.all(|row| values(&row) == values(&first)) {
                shared.push(method);
                rows.push(Row { label: method.label().into(), made_by: String::new(), ..first });
            }
        }
        for variant in &self.whole {
            let own = methods.iter().filter(|m| !shared.contains(m));
            rows.extend(own.map(|&method| self.row(method, variant, quantities)));
        }
        rows
    }

    /// The look in which the enhancement of a variant was learnt; it is the variant's result.
    fn result(&self, variant: &str) -> Method {
        self.of_group(ALL, variant).first().map_or(Method::Enhanced, |s| s.result)
    }

    /// Stage 1's row of the second ablation, from the first variant that learnt from photographs.
    pub(super) fn before_stage2(&self, quantities: &[Quantity]) -> Option<Row> {
        self.variants.iter().find_map(|variant| {
            let cells = means(&self.compared(variant), Method::Reconstruction, quantities);
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

    /// The name of the method that was trained in a variant: that of this program, unless it is another one.
    pub(super) fn trained(&self, variant: &str) -> String {
        let made = self.of_group(ALL, variant).iter().find_map(|scene| scene.configuration.as_deref());
        match made.and_then(Configuration::compared_method) {
            Some(method) => in_variant(&format!("{method}, in this program"), variant),
            None => Self::program(variant),
        }
    }

    /// A row of this program's own numbers.
    pub(super) fn own_row(&self, label: String, variant: &str, cells: Vec<Cell>) -> Row {
        let made_by = self.made_by.get(variant).cloned().unwrap_or_default();
        Row { made_by, ..Row::own(label, cells) }
    }

    pub(super) fn row(&self, method: Method, variant: &str, quantities: &[Quantity]) -> Row {
        let of = |group: &&str| means(self.of_group(group, variant), method, quantities);
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

    /// A table with the scenes as rows: for each scene the published rows, a row for each method of
    /// `of_photographs`, and a row for each variant with the first of the `results` that it has.
    pub(super) fn by_scene(
        &self,
        [name, caption]: [&str; 2],
        quantities: &[Quantity],
        (of_photographs, results): (&[Method], &[Method]),
        source: &[Published],
    ) -> Table {
        let mut rows = Vec::new();
        for (scene, own) in self.by_name() {
            let papers = own.iter().any(|s| is_the_papers(s));
            let known: Vec<&Published> = source.iter().filter(|_| papers).collect();
            rows.extend(published_over(&[scene], &known, quantities, |_, _| None));
            for &method in of_photographs {
                rows.push(Row::own(method.label().into(), means(&own[..1], method, quantities)));
            }
            for result in own.into_iter().filter(|result| self.whole.contains(&result.variant.as_str())) {
                let variant = result.variant.as_str();
                let mut own = [result.result].into_iter().filter(|m| results.contains(m));
                let metrics = || quantities.iter().map(|(metric, ..)| *metric);
                let has = |method: &Method| result.has(*method, metrics());
                let Some(method) = own.find(has).or_else(|| results.iter().copied().find(has)) else {
                    continue;
                };
                let label =
                    if results.len() == 1 { self.trained(variant) } else { self.label(method, variant) };
                rows.push(self.own_row(label, variant, means(&[result], method, quantities)));
            }
            let first = rows.iter().rposition(|row: &Row| !row.scene.is_empty()).map_or(0, |at| at + 1);
            rows[first..].iter_mut().for_each(|row| row.scene = scene.into());
        }
        Table { name: name.into(), caption: caption.into(), columns: columns(&[""], quantities), rows }
    }

    /// The groups that all variants have scenes in; `None` if that is all of them, or none.
    fn common(&self) -> Option<Vec<&'a str>> {
        let has = |group: &&str| self.variants.iter().all(|v| !self.of_group(group, v).is_empty());
        let groups = self.groups.iter().copied().filter(|group| *group != ALL);
        let (common, others): (Vec<&str>, Vec<&str>) = groups.partition(has);
        (!others.is_empty() && !common.is_empty()).then_some(common)
    }

    /// True if variants are compared over a group.
    pub(super) fn is_compared(&self, group: &str) -> bool {
        self.common().is_none_or(|groups| groups.contains(&group))
    }

    /// The scenes of a variant that the variants are compared over: those in groups that all of them have.
    pub(super) fn compared(&self, variant: &str) -> Vec<&'a MeanScores> {
        let all = self.of_group(ALL, variant).iter().copied();
        all.filter(|scene| self.is_compared(&scene.group)).collect()
    }

    /// True if a variant brings the 2D enhancer in by another way than transitions: from photographs that
    /// were enhanced one by one, or from labels of each view.
    pub(super) fn is_other_way(&self, variant: &str) -> bool {
        self.of_group(ALL, variant).iter().any(|scene| {
            let changed = scene.configuration.iter().flat_map(|made| &made.changed);
            let labels = |line: &String| line.starts_with("enhance.objective = pseudo-labels");
            scene.has(Method::EnhanceThenReconstruct, ["uciqe"].into_iter())
                || changed.into_iter().any(labels)
        })
    }

    /// The settings that a variant's stage 1 follows from, as far as its configuration is known.
    fn stage_1(&self, variant: &str) -> Option<Vec<&'a str>> {
        let made = self.compared(variant).into_iter().find_map(|scene| scene.configuration.as_deref())?;
        let changed = made.changed.iter().map(String::as_str);
        let own = changed.filter(|line| line.starts_with("import.") || line.starts_with("reconstruct."));
        let shared = [&made.preset, &made.depth_prior, &made.water, &made.split, &made.seed];
        Some(shared.into_iter().map(String::as_str).chain(own).collect())
    }

    /// One row for each of some variants, averaged over the scenes that all variants have, of the first of
    /// these methods that the variant has. With `once`, variants that share a stage 1 have one row.
    pub(super) fn ablation(
        &self,
        [name, caption]: [&str; 2],
        (variants, once): (&[&'a str], bool),
        quantities: &[Quantity],
        methods: &[Method],
        source: &[Published],
    ) -> Table {
        const SET: &str = "SeaThru-4";
        let of_one = self.common().map_or(self.groups == [SET], |common| common == [SET]);
        let known: Vec<&Published> = source.iter().filter(|_| of_one && self.is_published(SET)).collect();
        let mut rows = published_over(&[SET], &known, quantities, |_, _| None);
        let mut told = Vec::new();
        for variant in variants {
            let scenes = self.compared(variant);
            let has = |m: &Method| means(&scenes, *m, quantities).iter().any(|cell| *cell != Cell::Blank);
            // The result of a variant comes first; if it was learnt without water, that is `enhanced-clear`.
            let result = self.result(variant);
            let in_order = [result].into_iter().filter(|m| methods.contains(m));
            let Some(method) = in_order.chain(methods.iter().copied()).find(has) else { continue };
            let label = if variant.is_empty() { "full model" } else { variant };
            let cells = means(&scenes, method, quantities);
            if once && let Some(stage_1) = self.stage_1(variant) {
                let own = (stage_1, cells.iter().map(Cell::value).collect::<Vec<_>>());
                if told.contains(&own) {
                    continue;
                }
                told.push(own);
            }
            rows.push(self.own_row(label.into(), variant, cells));
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
pub(super) fn means(scenes: &[&MeanScores], method: Method, quantities: &[Quantity]) -> Vec<Cell> {
    quantities.iter().map(|(key, ..)| macro_mean(scenes, method, key)).collect()
}

/// A published number, or a blank.
pub(super) fn published_cell(value: Option<f64>) -> Cell {
    value.map_or(Cell::Blank, |value| Cell::Number { value, source: published::SOURCE.into() })
}

/// The unweighted mean of the scenes' means; blank if no scene has the method or the metric.
pub(super) fn macro_mean(scenes: &[&MeanScores], method: Method, metric: &str) -> Cell {
    let Some(place) = place(metric) else { return Cell::Blank };
    let scores: Vec<Score> = scenes.iter().filter_map(|s| s.means.at(method, place)).collect();
    if scores.is_empty() {
        return Cell::Blank;
    }
    match Score::mean(&scores) {
        Score::Value(value) => {
            let value = value.get();
            let mut sources: Vec<&str> = scenes.iter().take(SOURCES).map(|s| s.source.as_str()).collect();
            let more = scenes.len().saturating_sub(SOURCES);
            let more = format!("and {more} more");
            if scenes.len() > SOURCES {
                sources.push(&more);
            }
            Cell::Number { value, source: sources.join(" ") }
        }
        Score::NotAvailable(reason) | Score::Undefined(reason) => Cell::NotAvailable { reason },
    }
}
