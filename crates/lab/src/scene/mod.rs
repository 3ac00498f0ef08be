//! The cost of a training step on a trained scene: how many pairs of pixel and Gaussian it has, and how long
//! each part takes, beside the limit of the machine.
//!
//! Trained scenes differ from those that a training starts with: their Gaussians are about a pixel wide, and
//! many of them lie on every pixel. A kernel that is fast on large Gaussians may be slow there.

mod limit;
mod made;

use std::error::Error;

use serde::Serialize;
use use3d_capture::{Capture, Lattice};
use use3d_import::{load_depth_prior, load_mask, load_pixels};
use use3d_reconstruct::engine::{CpuEngine, Engine, StepPlan, TrainingState};
use use3d_reconstruct::{LoadedView, ReconstructParams, StepPart, TrainingView};
use use3d_scene::Scene;
use use3d_splat::{Colors, Prepared};
use use3d_training::{Drain, Part};

pub use limit::Limit;

/// A failure, in words.
type Failure = Box<dyn Error + Send + Sync>;

/// A scene with photographs of it.
pub struct Subject {
    /// Its name in the output.
    pub name: String,
    scene: Scene,
    views: Vec<TrainingView>,
}

impl Subject {
    /// A trained scene, with some of the training views of its capture at equal distances.
    ///
    /// # Errors
    /// A photograph, mask or prior cannot be read.
    pub fn trained(name: &str, scene: Scene, capture: &Capture, views: usize) -> Result<Self, Failure> {
        let all: Vec<_> = capture.training_views().collect();
        let step = all.len().div_ceil(views.max(1)).max(1);
        let views = all.into_iter().skip(step / 2).step_by(step).map(|view| {
            let (mask, depth_prior) = (load_mask(view)?, load_depth_prior(view)?);
            let loaded = LoadedView { pixels: load_pixels(view)?, mask, depth_prior };
            Ok::<_, Failure>(TrainingView::new(view, loaded)?.0)
        });
        Ok(Self { name: name.into(), scene, views: views.collect::<Result<_, _>>()? })
    }

    /// A scene from a seed with the statistics of a trained one, and a picture of it.
    ///
    /// # Errors
    /// There is none for sizes of at least one pixel.
    pub fn made(gaussians: usize, size: (usize, usize)) -> Result<Self, Failure> {
        let (scene, view, loaded) = made::made(gaussians, size)?;
        let views = vec![TrainingView::new(&view, loaded)?.0];
        Ok(Self { name: format!("made, {} x {}", size.0, size.1), scene, views })
    }
}

/// The figures of a scene, means over its views.
#[derive(Clone, Debug, Serialize)]
pub struct SceneRecord {
    /// Its name.
    pub name: String,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of views.
    pub views: usize,
    /// Number of threads.
    pub threads: usize,
    /// Pairs of pixel and Gaussian a pixel that contribute to it.
    pub contributing: f64,
    /// Pairs a pixel that the kernels compute.
    pub tested: f64,
    /// Entries of the tiles' lists a pixel.
    pub entries: f64,
    /// Milliseconds of each part of a step, the best round of each view.
    pub parts: Vec<(&'static str, f64)>,
    /// Milliseconds of a step.
    pub step: f64,
    /// The compositor's speed in both directions, as a share of the limit of as many threads.
    pub share: f64,
}

/// Measures a scene in `rounds` steps a view of the default training, as at its end.
///
/// # Errors
/// The engine refuses the scene.
pub fn measure(subject: &Subject, rounds: usize, limit: &Limit) -> Result<SceneRecord, Failure> {
    let Subject { name, scene, views } = subject;
    let mut engine = CpuEngine::default();
    for view in views {
        engine.upload(view.clone())?;
    }
    let params = ReconstructParams::default();
    let plan = StepPlan::at_full_size(&params, params.iterations - 1);
    let (mut contributing, mut tested, mut entries, mut pixels) = (0, 0, 0, 0);
    let mut best = vec![0.0; StepPart::ALL.len()];
    for (index, view) in views.iter().enumerate() {
        let mut prepared = Prepared::new();
        let lattice = Lattice::full(&view.camera.intrinsics);
        prepared.prepare(&scene.gaussians, &view.camera, &lattice, Colors::Sh { degree: 3 });
        let pairs = prepared.pairs();
        contributing += pairs.contributing;
        tested += pairs.tested;
        entries += pairs.entries;
        pixels += lattice.width() * lattice.height();
        engine.load(TrainingState::new(scene.gaussians.clone(), scene.medium.clone(), &[]))?;
        let mut fastest = vec![f64::INFINITY; best.len()];
        // The first step allocates memory and is not counted.
        for round in 0..=rounds.max(1) {
            let before = engine.profile();
            engine.step(index, &plan)?;
            engine.drain(Drain::All)?;
            let after = engine.profile();
            for (fastest, (part, _)) in fastest.iter_mut().zip(StepPart::ALL) {
                let total = |p: &use3d_training::Profile<StepPart>| p.seconds(*part) * p.steps as f64;
                if round > 0 {
                    *fastest = fastest.min(1e3 * (total(&after) - total(&before)));
                }
            }
        }
        best.iter_mut().zip(fastest).for_each(|(best, ms)| *best += ms / views.len() as f64);
    }
    let parts: Vec<_> = StepPart::ALL.iter().zip(best).map(|((_, name), ms)| (*name, ms)).collect();
    let of = |wanted: StepPart| {
        StepPart::ALL.iter().zip(&parts).filter(|((part, _), _)| *part == wanted).map(|(_, (_, ms))| ms).sum()
    };
    let raster: f64 = [StepPart::Compose, StepPart::ComposeBackward].map(of).iter().sum::<f64>();
    let threads = rayon::current_num_threads();
    let dense = if scene.medium.is_none() { limit.dry } else { limit.water };
    let a_pixel = |n: u64| n as f64 / pixels.max(1) as f64;
    Ok(SceneRecord {
        name: name.clone(),
        gaussians: scene.gaussians.len(),
        views: views.len(),
        threads,
        contributing: a_pixel(contributing),
        tested: a_pixel(tested),
        entries: a_pixel(entries),
        step: parts.iter().map(|(_, ms)| ms).sum(),
        share: 1e-6 * dense * contributing as f64 / views.len() as f64 / threads as f64 / raster,
        parts,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_made_scene_has_the_counts_of_a_trained_one() {
        let limit = Limit { instructions: String::new(), water: 1.0, dry: 1.0 };
        let record = measure(&Subject::made(6_100, (160, 72)).unwrap(), 1, &limit).unwrap();
        // A trained scene of 122,000 Gaussians at 640×360 has 32 contributing pairs a pixel, 45 % of those
        // tested, and one entry a pixel.
        assert!((20.0..45.0).contains(&record.contributing), "{record:?}");
        assert!((0.35..0.65).contains(&(record.contributing / record.tested)), "{record:?}");
        assert!((0.6..1.6).contains(&record.entries), "{record:?}");
        assert!(record.step > 0.0 && record.parts.len() == StepPart::ALL.len());
    }
}
