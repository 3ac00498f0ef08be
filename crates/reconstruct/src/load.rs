//! Loads a capture's views once, and reports data that cannot be used.

use use3d_capture::{Capture, View};
use use3d_training::Observer;

use crate::views::{TrainingView, ViewLoader};
use crate::{DepthPrior, ReconstructError, ReconstructParams};

/// A capture's views in memory.
pub(crate) struct Views {
    pub(crate) train: Vec<TrainingView>,
    pub(crate) test: Vec<TrainingView>,
}

/// Loads every view once; reports priors without information.
pub(crate) fn load(
    capture: &Capture,
    loader: &ViewLoader<'_>,
    params: &ReconstructParams,
    observer: &mut dyn Observer,
) -> Result<Views, ReconstructError> {
    let mut one = |view: &View, training: bool| -> Result<TrainingView, ReconstructError> {
        let mut loaded =
            loader(view).map_err(|source| ReconstructError::Load { view: view.name.to_string(), source })?;
        if params.depth_prior == DepthPrior::Off || !training {
            loaded.depth_prior = None;
        }
        let (packed, dropped) = TrainingView::new(view, loaded)?;
        if let Some(why) = dropped {
            observer.notice(&format!(
                "view `{}`: its depth prior {why}; it is left out of the depth term",
                view.name
            ));
        }
        Ok(packed)
    };
    let train = capture.training_views().map(|v| one(v, true)).collect::<Result<Vec<_>, _>>()?;
    let test = capture.test_views().map(|v| one(v, false)).collect::<Result<Vec<_>, _>>()?;
    check_masks(&train, &test, observer)?;
    let with_prior = train.iter().filter(|v| v.prior.is_some()).count();
    // Without any prior the stage says why the depth term is off.
    if params.depth_prior != DepthPrior::Off
        && params.uses_priors()
        && 0 < with_prior
        && with_prior < train.len()
    {
        observer.notice(&format!(
            "only {with_prior} of {} training views have a depth prior; the depth term is off for the others",
            train.len()
        ));
    }
    Ok(Views { train, test })
}

/// Reports views in which no pixel counts, because nothing is learnt or measured from them. It is an error
/// if no training view is left.
fn check_masks(
    train: &[TrainingView],
    test: &[TrainingView],
    observer: &mut dyn Observer,
) -> Result<(), ReconstructError> {
    for (views, what) in [(train, "training"), (test, "held-out")] {
        let blank: Vec<&str> = views.iter().filter(|v| v.counts_nothing()).map(|v| v.name.as_str()).collect();
        let Some(first) = blank.first() else { continue };
        if blank.len() == views.len() && what == "training" {
            return Err(ReconstructError::NothingCounts { views: views.len() });
        }
        observer.notice(&format!(
            "the mask of {} of {} {what} views (first: `{first}`) leaves no pixel: these views have no \
             effect; masks are white where pixels count",
            blank.len(),
            views.len()
        ));
    }
    Ok(())
}
