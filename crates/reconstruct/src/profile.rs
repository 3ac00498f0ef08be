//! Where the time of a step goes.

use std::time::{Duration, Instant};

/// The parts of a step, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The target at the step's size.
    Target,
    /// The water's maps.
    Water,
    /// Projection, sorting, tile lists.
    Project,
    /// The compositor.
    Compose,
    /// Losses and their gradient with respect to the image.
    Loss,
    /// The compositor and the projection backward.
    ComposeBackward,
    /// The water backward.
    WaterBackward,
    /// Adam.
    Adam,
    /// Density statistics and refinements.
    Density,
}

impl Part {
    /// All parts.
    pub const ALL: [Self; 9] = [
        Self::Target,
        Self::Water,
        Self::Project,
        Self::Compose,
        Self::Loss,
        Self::ComposeBackward,
        Self::WaterBackward,
        Self::Adam,
        Self::Density,
    ];

    /// A name for tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Target => "target",
            Self::Water => "water",
            Self::Project => "project",
            Self::Compose => "compose",
            Self::Loss => "loss",
            Self::ComposeBackward => "compose backward",
            Self::WaterBackward => "water backward",
            Self::Adam => "adam",
            Self::Density => "density",
        }
    }
}

/// Time per part, summed over steps.
#[derive(Clone, Debug, Default)]
pub struct Profile {
    /// Steps measured.
    pub steps: u64,
    spent: [Duration; Part::ALL.len()],
    last: Option<Instant>,
}

impl Profile {
    /// Starts the clock.
    pub(crate) fn start(&mut self) {
        self.last = Some(Instant::now());
    }

    /// The time since the last call belongs to `part`.
    pub(crate) fn lap(&mut self, part: Part) {
        let now = Instant::now();
        if let Some(last) = self.last {
            self.spent[part as usize] += now - last;
        }
        self.last = Some(now);
    }

    /// Seconds per step of a part.
    pub fn seconds(&self, part: Part) -> f64 {
        self.spent[part as usize].as_secs_f64() / self.steps.max(1) as f64
    }

    /// Seconds per step of all parts.
    pub fn total(&self) -> f64 {
        Part::ALL.iter().map(|p| self.seconds(*p)).sum()
    }

    /// A table: milliseconds per step and share of each part.
    pub fn table(&self) -> String {
        let total = self.total();
        let mut text = format!("{} steps, {:.2} ms per step\n", self.steps, 1e3 * total);
        for part in Part::ALL {
            let seconds = self.seconds(part);
            let share = if total > 0.0 { 100.0 * seconds / total } else { 0.0 };
            text += &format!("{:>17} {:>9.2} ms {share:>5.1} %\n", part.name(), 1e3 * seconds);
        }
        text
    }
}
