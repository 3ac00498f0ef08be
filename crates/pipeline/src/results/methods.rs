//! The pages on which one scene by several methods stands side by side: one for each scene of a batch that
//! trained methods of other authors. They lie in the folder of tables.

use std::collections::BTreeMap;
use std::io;

use use3d_judge::configuration::Configuration;
use use3d_report::page::{Page, SceneSection};
use use3d_report::tables::means::MeanScores;
use use3d_report::tables::methods::{NAME, ahead, steps};
use use3d_report::tables::paper;
use use3d_stages::report::{MethodSide, ResultFolders, side_by_side};

use super::{DeliveredCell, PAGE, folder_of, lineage};

/// The name of the page of a scene.
pub(super) fn file(scene: &str) -> String {
    format!("{NAME}-{}.html", folder_of(scene, "").display())
}

/// The scenes that have a page.
pub(super) fn scenes(all: &[MeanScores]) -> Vec<&str> {
    let mut each: BTreeMap<&str, Vec<&MeanScores>> = BTreeMap::new();
    for scores in all {
        each.entry(&scores.scene).or_default().push(scores);
    }
    each.into_iter().filter(|(_, own)| ahead(own.iter().copied()).is_some()).map(|(scene, _)| scene).collect()
}

/// The steps, the size and the cost of a method's stage 1 in words.
fn cost(scores: &MeanScores) -> String {
    let steps = scores.configuration.as_deref().and_then(steps);
    let words = [
        steps.map(|steps| format!("{steps:.0} steps")),
        Some(format!("{} Gaussians", scores.gaussians)),
        scores.processor_seconds.map(|seconds| format!("{seconds:.0} processor seconds")),
    ];
    words.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

/// The page of a scene.
pub(super) fn page(scene: &str, all: &[MeanScores], cells: &[DeliveredCell<'_>]) -> io::Result<Page> {
    let scores: Vec<MeanScores> = all.iter().filter(|scores| scores.scene == scene).cloned().collect();
    let made: BTreeMap<&str, &Configuration> =
        scores.iter().filter_map(|s| Some((s.variant.as_str(), s.configuration.as_deref()?))).collect();
    let cells = cells.iter().filter(|own| own.scene == scene);
    let sides = cells.map(|own| {
        let folders =
            own.nodes.iter().filter_map(|node| Some((node.stage, node.artifact.as_deref()?.path.as_path())));
        let other = made.get(own.variant).and_then(|made| made.compared_method());
        MethodSide {
            name: own.variant,
            cost: scores.iter().find(|s| s.variant == own.variant).map(cost).unwrap_or_default(),
            own: other.is_none(),
            folders: ResultFolders { scene, group: "", variant: own.variant, folders: folders.collect() },
        }
    });
    let sides: Vec<MethodSide<'_>> = sides.collect();
    let views = side_by_side(&sides).map_err(|error| io::Error::other(error.to_string()))?;
    Ok(Page {
        title: format!("{scene}: the methods side by side"),
        subtitle: format!(
            "{} methods, each trained by this program on the same photographs. These views were kept back as a test.",
            sides.len()
        ),
        overview: format!("../{PAGE}"),
        verdict: ahead(&scores).into_iter().collect(),
        settings: lineage::settings(made.iter().map(|(variant, made)| (*variant, *made))),
        tables: paper::tables(&scores, &[]),
        scenes: vec![SceneSection { name: scene.into(), compared: true, views, ..SceneSection::default() }],
        ..Page::default()
    })
}
