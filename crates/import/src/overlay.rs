//! The overlay of each camera's photographs (`use3d_overlay`): bars, text, a gripper, a rim. A mask hides it.

use std::cell::OnceCell;
use std::collections::BTreeMap;

use use3d_capture::{FileName, View};
use use3d_overlay::{ENOUGH, FEWEST, Overlay, Still, find};
use use3d_survey::PointSight;

use crate::error::ImportError;
use crate::import::{Imported, Plan};
use crate::parallel::in_parallel;
use crate::report::OverlayReport;

/// An overlay has at most this share of the points that the rest of the picture has on the same area.
const POINTS: f64 = 0.5;

/// The overlays of a capture's photographs.
#[derive(Debug, Default)]
pub(crate) struct Overlays {
    found: Vec<Overlay>,
    /// For each view, its overlay.
    of_view: Vec<Option<usize>>,
}

impl Overlays {
    /// Looks for them, in photographs of the same folder, camera and size.
    pub(crate) fn of(imported: &Imported, workers: usize) -> Result<Self, ImportError> {
        let views = &imported.capture.views;
        let mut cameras: BTreeMap<(String, u32, (usize, usize)), Vec<usize>> = BTreeMap::new();
        for (i, Plan { geometry, camera, file, .. }) in imported.plans.iter().enumerate() {
            cameras.entry((folder(file), *camera, geometry.file)).or_default().push(i);
        }
        let sights = OnceCell::new();
        let mut all = Self { of_view: vec![None; views.len()], ..Self::default() };
        for own in cameras.into_values().filter(|own| own.len() >= FEWEST) {
            let chosen: Vec<&View> =
                own.iter().step_by(own.len().div_ceil(ENOUGH)).map(|i| &views[*i]).collect();
            let pictures = in_parallel(chosen.len(), workers, |i| Ok(Still::read(&chosen[i].image)?))?;
            let seen = |overlay: &Overlay| {
                let sights = sights.get_or_init(|| imported.model.tracked_sights());
                has_points(overlay, imported, &own, sights)
            };
            if let Some(overlay) = find(&pictures).filter(|overlay| !seen(overlay)) {
                own.iter().for_each(|i| all.of_view[*i] = Some(all.found.len()));
                all.found.push(overlay);
            }
        }
        Ok(all)
    }

    /// The overlay of a view.
    pub(crate) fn view(&self, index: usize) -> Option<&Overlay> {
        self.of_view.get(index).copied().flatten().map(|found| &self.found[found])
    }

    /// The part of the report; `None` if there is no overlay.
    pub(crate) fn report(&self) -> Option<OverlayReport> {
        let share = self.found.iter().map(Overlay::share).reduce(f64::max)?;
        Some(OverlayReport { views: self.of_view.iter().flatten().count(), share })
    }
}

fn folder(file: &FileName) -> String {
    file.as_str().rsplit_once('/').map_or(String::new(), |(folder, _)| folder.into())
}

/// True if the model has points on an overlay: then it is a part of the scene that hardly moves.
fn has_points(
    overlay: &Overlay,
    imported: &Imported,
    views: &[usize],
    sights: &BTreeMap<u32, Vec<PointSight>>,
) -> bool {
    let (mut on, mut all) = (0usize, 0usize);
    for i in views {
        let (width, height) = imported.plans[*i].geometry.file;
        for sight in sights.get(&imported.capture.views[*i].id).into_iter().flatten() {
            let pixel = |at: f64, side: usize, own: usize| (at / side as f64 * own as f64) as usize;
            let (x, y) =
                (pixel(sight.at[0], width, overlay.width), pixel(sight.at[1], height, overlay.height));
            if sight.at.iter().all(|v| *v >= 0.0) && x < overlay.width && y < overlay.height {
                on += usize::from(overlay.hidden[y * overlay.width + x]);
                all += 1;
            }
        }
    }
    on as f64 > POINTS * overlay.share() * all as f64
}
