//! Forwards a training loop's progress to its stage.

use use3d_training::{Observer, Snapshot, TrainingProgress};

use use3d_workflow::StageContext;

/// A training loop's observer that reports to the stage's context.
pub(super) struct Watch<'a> {
    context: &'a StageContext,
}

impl<'a> Watch<'a> {
    pub(super) fn new(context: &'a StageContext) -> Self {
        Self { context }
    }
}

impl Observer for Watch<'_> {
    fn progress(&mut self, progress: &TrainingProgress) {
        let mut words = Vec::new();
        if let Some(loss) = progress.loss {
            words.push(format!("loss {loss:.4}"));
        }
        if let Some(psnr) = progress.psnr {
            words.push(format!("{psnr:.2} dB"));
        }
        if let Some(gaussians) = progress.gaussians {
            words.push(format!("{gaussians} Gaussians"));
        }
        if let Some(pace) = progress.steps_per_second {
            words.push(format!("{pace:.1} steps/s"));
        }
        let figures = [
            ("loss", progress.loss),
            ("psnr", progress.psnr),
            ("held-out psnr", progress.held_out_psnr),
            ("gaussians", progress.gaussians.map(|n| n as f64)),
            ("seconds left", progress.seconds_left),
        ];
        let known: Vec<(&str, f64)> = figures.iter().filter_map(|(name, v)| Some((*name, (*v)?))).collect();
        self.context.figures(progress.step, progress.steps, &known);
        let words = words.join(", ");
        self.context.progress_left(progress.step, progress.steps, "steps", &words, progress.seconds_left);
    }

    fn notice(&mut self, message: &str) {
        self.context.say(message);
    }

    fn should_stop(&self) -> bool {
        self.context.cancelled()
    }

    fn wants_view(&self) -> bool {
        self.context.wants_view()
    }

    fn view(&mut self, view: Snapshot) {
        self.context.view(&view);
    }
}
