//! All figures of a capture folder: of its model, its tracks, its photographs and its masks.

use std::convert::Infallible;

use use3d_capture::{Image8, Pixels};
use use3d_import::{ImportError, Imported, load_mask, load_pixels};

use crate::agreement::{PixelsRead, agreement};
use crate::measure::{Figures, measure, measure_and, measure_masks};
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
    let mut look = |view: usize, small: &Image8| {
        passers.add(view, small, load_mask(&views[view])?.as_ref());
        Ok(())
    };
    let mut figures = measure_and(&prepared.capture, &tracks, Some(&mut load), &mut look)?;
    figures.largest_sample = largest;
    for (view, passed) in figures.views.iter_mut().zip(passers.passed()) {
        view.passed_points = passed;
    }
    measure_masks(&mut figures, &tracks, &mut |view| load_mask(&views[view]))?;
    figures.agreement = Some(agreement(original, PixelsRead::All)?);
    Ok(figures)
}

/// Measures a capture with as many photographs and masks as can be read in seconds. A file that cannot be
/// read is left out: the run itself reports it.
pub fn few_figures(original: &Imported) -> Figures {
    let tracks = original.tracks();
    let Ok(mut figures) = measure::<Infallible>(&original.capture, &tracks, None);
    figures.agreement = agreement(original, PixelsRead::Few).ok();
    let (views, step) = (&original.capture.views, original.capture.views.len().div_ceil(FEW_MASKS).max(1));
    let mut load = |view: usize| match view % step {
        0 => Ok::<_, Infallible>(load_mask(&views[view]).ok().flatten()),
        _ => Ok(None),
    };
    let Ok(()) = measure_masks(&mut figures, &tracks, &mut load);
    figures
}
