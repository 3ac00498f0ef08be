//! Tables against the truth, for captures that bring one: appearances against the true clean images, and
//! depth and water next to the true ones.

use super::batch::{Batch, Quantity, group_of, macro_mean};
use super::{Better, Cell, Column, Row, Table};
use crate::judge::scores::{Method, ScoredScene};

/// Quantities against the truth of synthetic captures.
const TRUTH: [Quantity; 2] =
    [("truth_psnr", "PSNR", Better::Higher, 2), ("truth_delta_e", "ΔE₀₀", Better::Lower, 2)];

/// The methods that are compared with the true clean images.
const CLEAN: [Method; 7] = [
    Method::Captured,
    Method::Proposal,
    Method::Clear,
    Method::ProposalOfRender,
    Method::EnhanceThenReconstruct,
    Method::Enhanced,
    Method::EnhancedClear,
];

impl Batch<'_> {
    /// Appearances against the true clean images, over the groups that have them.
    pub(super) fn truth(&self) -> Option<Table> {
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
                Row {
                    label: self.label(method, variant),
                    published: false,
                    made_by: self.made_by(variant),
                    cells: cells.collect(),
                }
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

    /// Recovered and true water and the depth error, scene by scene.
    pub(super) fn recovered(&self) -> Option<Table> {
        const DEPTH: &str = "depth_error";
        let mut names: Vec<&str> = Vec::new();
        for scene in self.scenes {
            let known = scene.scores.mean(Method::Reconstruction, DEPTH).is_some();
            if known && !names.contains(&scene.scene.as_str()) {
                names.push(&scene.scene);
            }
        }
        let first = |name: &str| self.scenes.iter().find(|s| s.scene == name && s.scores.water.is_some());
        let row = |label: String, made_by: String, cells: &dyn Fn(&str) -> Vec<Cell>| Row {
            label,
            published: false,
            made_by,
            cells: names.iter().flat_map(|name| cells(name)).collect(),
        };
        let numbers = |values: [[f64; 3]; 2], source: &str| -> Vec<Cell> {
            let cell = |value| Cell::Number { value, source: source.into() };
            values.into_iter().flatten().map(cell).collect()
        };
        let mut rows = vec![row("Truth".into(), String::new(), &|name| {
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
            rows.push(row(label, self.made_by(variant), &|name| {
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
}
