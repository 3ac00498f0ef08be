//! Tables against the truth, for captures that bring one: appearances against the true clean images, and
//! depth and water next to the true ones.

use super::batch::{Batch, Quantity, columns, macro_mean, means};
use super::means::MeanScores;
use super::{Better, Cell, Row, Table};
use use3d_judge::names::in_variant;
use use3d_judge::scores::Method;

/// Quantities against the truth of synthetic captures.
pub(super) const TRUTH: [Quantity; 2] =
    [("truth_psnr", "PSNR", Better::Higher, 2), ("truth_delta_e", "ΔE₀₀", Better::Lower, 2)];

/// The methods that are compared with the true clean images.
const CLEAN: [Method; 8] = [
    Method::Captured,
    Method::Proposal,
    Method::Clear,
    Method::PublishedClear,
    Method::ProposalOfRender,
    Method::EnhanceThenReconstruct,
    Method::Enhanced,
    Method::EnhancedClear,
];

impl Batch<'_> {
    /// Appearances against the true clean images, over the groups that have them.
    pub(super) fn truth(&self) -> Option<Table> {
        let known = |s: &&MeanScores| CLEAN.iter().any(|m| s.mean(*m, TRUTH[0].0).is_some());
        let of = |group: &str, variant: &str| -> Vec<&MeanScores> {
            self.of_group(group, variant).iter().copied().filter(known).collect()
        };
        let there = |group: &&str| self.variants.iter().any(|variant| !of(group, variant).is_empty());
        let groups: Vec<&str> = self.groups.iter().copied().filter(there).collect();
        if groups.is_empty() {
            return None;
        }
        let rows = self.variants.iter().flat_map(|variant| {
            let scenes: Vec<Vec<&MeanScores>> = groups.iter().map(|group| of(group, variant)).collect();
            CLEAN.map(|method| {
                let cells = scenes.iter().flat_map(|scenes| means(scenes, method, &TRUTH)).collect();
                self.own_row(self.label(method, variant), variant, cells)
            })
        });
        Some(Table {
            name: "truth".into(),
            caption: "Against the truth (synthetic captures): held-out views against the true clean images, where they show a surface, after one least-squares gain per image".into(),
            columns: columns(&groups, &TRUTH),
            rows: rows.collect(),
        })
    }

    /// Recovered and true water and the depth error, with the scenes as rows.
    pub(super) fn recovered(&self) -> Option<Table> {
        const DEPTH: &str = "depth_error";
        let numbers = |values: [[f64; 3]; 2], source: &str| -> Vec<Cell> {
            let cell = |value| Cell::Number { value, source: source.into() };
            values.into_iter().flatten().map(cell).collect()
        };
        let mut rows = Vec::new();
        for (scene, mut own) in self.by_name() {
            own.retain(|s| s.mean(Method::Reconstruction, DEPTH).is_some());
            let truth = own.iter().find_map(|s| s.water).map(|w| {
                let source = "truth/water.json of the capture";
                let mut cells = vec![Cell::Blank];
                cells.extend(numbers([w.true_attenuation, w.true_backscatter], source));
                Row::own("Truth".into(), cells)
            });
            let recovered = own.into_iter().map(|s| {
                let mut cells = vec![macro_mean(&[s], Method::Reconstruction, DEPTH)];
                cells.extend(match s.water {
                    Some(w) => numbers([w.attenuation, w.backscatter], &s.source),
                    None => vec![Cell::Blank; 6],
                });
                self.own_row(in_variant("Recovered", &s.variant), &s.variant, cells)
            });
            let named = |row| Row { scene: scene.into(), ..row };
            rows.extend(truth.into_iter().chain(recovered).map(named));
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
        (!rows.is_empty()).then(|| Table {
            name: "truth-scene".into(),
            caption: "Against the truth (synthetic captures): median relative error of stage 1's depth, and the water's coefficients in 1/m, means over the rays of held-out views".into(),
            columns: columns(&[""], &quantities),
            rows,
        })
    }
}
