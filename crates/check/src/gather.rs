//! All figures of a capture folder: of its model, its tracks, its photographs and its masks.

use std::convert::Infallible;

use use3d_capture::{Image8, Pixels};
use use3d_import::{ImportError, Imported, load_mask, load_pixels};

use crate::agreement::{PixelsRead, agreement};
use crate::measure::{Figures, measure, measure_and, measure_mask, seen_places};
use crate::passers::Passers;

/// The masks that are read before a run, at most.
const FEW_MASKS: usize = 24;

/// Measures a capture: its views in the pixels of a run, and its model and photographs as they were given.
///
/// # Errors
/// A photograph, mask or depth map that cannot be read.
pub fn figures(prepared: &Imported, original: &Imported) -> Result<Figures, ImportError> {
    let (mut largest, views) = (Some(0), &prepared.capture.views);
    let mut load = |view: usize| {
        let pixels = load_pixels(&views[view])?;
        largest = match &pixels {
            Pixels::Sixteen(own) => largest.map(|most: u16| own.data().iter().fold(most, |m, v| m.max(*v))),
            Pixels::Eight(_) => None,
        };
        Ok::<_, ImportError>(pixels.to_image())
    };
    let tracks = prepared.tracks();
    let mut passers = Passers::new(&prepared.capture, &tracks);
    let (seen, mut masks) = (seen_places(&tracks, views.len()), vec![None; views.len()]);
    let mut look = |view: usize, small: &Image8| {
        let mask = load_mask(&views[view])?;
        passers.add(view, small, mask.as_ref());
        masks[view] = mask.map(|mask| measure_mask(&mask, &seen[view]));
        Ok(())
    };
    let mut figures = measure_and(&prepared.capture, &tracks, Some(&mut load), &mut look)?;
    figures.largest_sample = largest;
    for ((view, passed), mask) in figures.views.iter_mut().zip(passers.passed()).zip(masks) {
        view.passed_points = passed;
        (view.unmasked, view.hidden_points) =
            mask.map_or((None, None), |(free, hidden)| (Some(free), hidden));
    }
    figures.agreement = Some(agreement(original, PixelsRead::All)?);
    Ok(figures)
}

/// Measures a capture with as many photographs and masks as can be read in seconds. A file that cannot be
/// read is left out: the run itself reports it.
pub fn few_figures(original: &Imported) -> Figures {
    let tracks = original.tracks();
    let Ok(mut figures) = measure::<Infallible>(&original.capture, &tracks, None);
    figures.agreement = agreement(original, PixelsRead::Few).ok();
    let views = &original.capture.views;
    let seen = seen_places(&tracks, views.len());
    for view in (0..views.len()).step_by(views.len().div_ceil(FEW_MASKS).max(1)) {
        if let Some(mask) = load_mask(&views[view]).ok().flatten() {
            let (free, hidden) = measure_mask(&mask, &seen[view]);
            (figures.views[view].unmasked, figures.views[view].hidden_points) = (Some(free), hidden);
        }
    }
    figures
}
