//! Tables against the truth, for captures that bring one: appearances against the true clean images, and
//! depth and water next to the true ones.

use super::batch::{ALL, Batch, Quantity, columns, group_of, macro_mean, means};
use super::{Better, Cell, Row, Table};
use use3d_judge::names::{distinct, in_variant};
use use3d_judge::scores::{Method, ScoredScene};

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
        let there = |group: &str| self.scenes.iter().filter(known).any(|s| group_of(s) == group);
        let groups: Vec<&str> = self.groups.iter().copied().filter(|g| there(g)).collect();
        if groups.is_empty() {
            return None;
        }
        let rows = self.variants.iter().flat_map(|variant| {
            CLEAN.map(|method| {
                let of = |group: &&str| {
                    let mut scenes = self.of_group(group, variant);
                    scenes.retain(known);
                    means(&scenes, method, &TRUTH)
                };
                self.own_row(self.label(method, variant), variant, groups.iter().flat_map(of).collect())
            })
        });
        Some(Table {
            name: "truth".into(),
            caption: "Against the truth (synthetic captures): held-out views against the true clean images, where they show a surface, after one least-squares gain per image".into(),
            columns: columns(&groups, &TRUTH),
            rows: rows.collect(),
        })
    }

    /// Recovered and true water and the depth error, scene by scene.
    pub(super) fn recovered(&self) -> Option<Table> {
        const DEPTH: &str = "depth_error";
        let known = |s: &&ScoredScene| s.scores.mean(Method::Reconstruction, DEPTH).is_some();
        let names = distinct(self.scenes.iter().filter(known).map(|s| s.scene.as_str()));
        let first = |name: &str| self.scenes.iter().find(|s| s.scene == name && s.scores.water.is_some());
        let numbers = |values: [[f64; 3]; 2], source: &str| -> Vec<Cell> {
            let cell = |value| Cell::Number { value, source: source.into() };
            values.into_iter().flatten().map(cell).collect()
        };
        let truth = names.iter().flat_map(|name| {
            let mut cells = vec![Cell::Blank];
            cells.extend(match first(name).and_then(|s| s.scores.water) {
                Some(w) => {
                    numbers([w.true_attenuation, w.true_backscatter], "truth/water.json of the capture")
                }
                None => vec![Cell::Blank; 6],
            });
            cells
        });
        let mut rows = vec![Row {
            label: "Truth".into(),
            published: false,
            made_by: String::new(),
            cells: truth.collect(),
        }];
        for variant in &self.variants {
            let cells = names.iter().flat_map(|name| {
                let mut found = self.of_group(ALL, variant);
                found.retain(|s| s.scene == *name);
                let mut cells = vec![macro_mean(&found, Method::Reconstruction, DEPTH)];
                cells.extend(match found.first().and_then(|s| Some((s, s.scores.water?))) {
                    Some((s, w)) => numbers([w.attenuation, w.backscatter], &s.source),
                    None => vec![Cell::Blank; 6],
                });
                cells
            });
            rows.push(self.own_row(in_variant("Recovered", variant), variant, cells.collect()));
        }
        let quantities: [Quantity; 7] = [
            (DEPTH, "depth error", Better::Lower, 4),
            ("", "β_attn R", Better::Neither, 4),
            ("", "β_attn G", Better::Neither, 4),
            ("", "β_attn B", Better::Neither, 4),
            ("", "β_bs R", Better::Neither, 4),
            ("", "β_bs G", Better::Neither, 4),
            ("", "β_bs B", Better::Neither, 4),
        ];
        (!names.is_empty()).then(|| Table {
            name: "truth-scene".into(),
            caption: "Against the truth (synthetic captures): median relative error of stage 1's depth, and the water's coefficients in 1/m, means over the rays of held-out views".into(),
            columns: columns(&names, &quantities),
            rows,
        })
    }
}
