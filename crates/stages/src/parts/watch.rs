//! Forwards a training loop's progress to its stage.

use use3d_training::{Observer, Snapshot, TrainingProgress};

use use3d_workflow::StageContext;

/// A training loop's observer that reports to the stage's context.
pub(crate) struct Watch<'a>(pub(crate) &'a StageContext);

impl Observer for Watch<'_> {
    fn progress(&mut self, progress: &TrainingProgress) {
        let words = [
            progress.psnr.map(|psnr| format!("{psnr:.2} dB")),
            progress.steps_per_second.map(|pace| format!("{pace:.1} steps/s")),
        ];
        let words = words.into_iter().flatten().collect::<Vec<_>>().join(", ");
        let figures = [
            ("loss", progress.loss),
            ("psnr", progress.psnr),
            ("held-out psnr", progress.held_out_psnr),
            ("gaussians", progress.gaussians.map(|n| n as f64)),
            ("seconds left", progress.seconds_left),
        ];
        let known: Vec<(&str, f64)> = figures.iter().filter_map(|(name, v)| Some((*name, (*v)?))).collect();
        self.0.figures(progress.step, progress.steps, &known);
        self.0.progress_left(progress.step, progress.steps, "steps", &words, progress.seconds_left);
    }

    fn notice(&mut self, message: &str) {
        self.0.say(message);
    }

    fn should_stop(&self) -> bool {
        self.0.cancelled()
    }

    fn wants_view(&self) -> bool {
        self.0.wants_view()
    }

    fn view(&mut self, view: Snapshot) {
        self.0.view(&view);
    }
}
