//! The order in which a loop uses its views: shuffled epochs without replacement.

use use3d_numerics::random::{Purpose, Stream};

/// A new permutation of the views for every epoch, as a function of (seed, purpose, epoch). The view of a
/// step does not depend on the steps before, so a resumed run uses the same views as an uninterrupted one.
#[derive(Clone, Debug)]
pub struct ViewOrder {
    seed: u64,
    purpose: Purpose,
    views: usize,
    epoch: Option<(u64, Vec<usize>)>,
}

impl ViewOrder {
    /// An order over `views > 0` views.
    pub fn new(seed: u64, purpose: Purpose, views: usize) -> Self {
        Self { seed, purpose, views: views.max(1), epoch: None }
    }

    /// The view of step `step` (from 0), in `0..views`.
    pub fn view(&mut self, step: u64) -> usize {
        let (epoch, within) = (step / self.views as u64, (step % self.views as u64) as usize);
        let current = self.epoch.as_ref().is_some_and(|(e, _)| *e == epoch);
        if !current {
            self.epoch = Some((epoch, Stream::new(self.seed, self.purpose, epoch).permutation(self.views)));
        }
        self.epoch.as_ref().map_or(0, |(_, order)| order[within])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_epoch_has_every_view_once_and_epochs_differ() {
        let mut order = ViewOrder::new(1, Purpose::new("views"), 7);
        let epochs: Vec<Vec<usize>> =
            (0..5).map(|e| (0..7).map(|i| order.view(e * 7 + i)).collect()).collect();
        for epoch in &epochs {
            let mut sorted = epoch.clone();
            sorted.sort_unstable();
            assert_eq!(sorted, [0, 1, 2, 3, 4, 5, 6]);
        }
        assert!(epochs.windows(2).any(|w| w[0] != w[1]));
        // Other orders of the calls give the same answers.
        let mut again = ViewOrder::new(1, Purpose::new("views"), 7);
        assert_eq!(again.view(20), epochs[2][6]);
        assert_eq!(again.view(3), epochs[0][3]);
    }
}
