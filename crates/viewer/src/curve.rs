//! A curve of bounded length: for a long run, only every second, fourth, eighth … value is kept.

use serde_json::{Value, json};

/// Number of points above which every second one is dropped.
const MOST: usize = 600;

/// Values over steps.
#[derive(Clone, Debug, Default)]
pub(crate) struct Curve {
    points: Vec<(u64, f64)>,
    /// A point is kept if it is at least this many steps after the last one.
    apart: u64,
}

impl Curve {
    /// Adds a value. A step before the last one begins a new curve.
    pub(crate) fn add(&mut self, step: u64, value: f64) {
        if !value.is_finite() {
            return;
        }
        match self.points.last() {
            Some((last, _)) if step < *last => *self = Self::default(),
            Some((last, _)) if step < last + self.apart => return,
            _ => {}
        }
        self.points.push((step, value));
        if self.points.len() > MOST {
            self.points = self.points.iter().copied().step_by(2).collect();
            let span = self.points.last().map_or(0, |p| p.0) - self.points.first().map_or(0, |p| p.0);
            self.apart = span / self.points.len().max(1) as u64;
        }
    }

    /// The last value that was kept.
    pub(crate) fn last(&self) -> Option<f64> {
        self.points.last().map(|point| point.1)
    }

    pub(crate) fn json(&self) -> Value {
        self.points.iter().map(|(step, value)| json!([step, value])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_curve_keeps_its_ends_and_its_evenness() {
        let mut curve = Curve::default();
        (1..=100_000).for_each(|step| curve.add(step, step as f64));
        assert!((MOST / 2..=MOST).contains(&curve.points.len()), "{}", curve.points.len());
        assert!(curve.points[0].0 == 1 && curve.points.last().unwrap().0 > 99_000);
        let gaps: Vec<u64> = curve.points.windows(2).map(|w| w[1].0 - w[0].0).collect();
        let (least, most) = (gaps.iter().min().unwrap(), gaps.iter().max().unwrap());
        assert!(most <= &(3 * least), "{least} {most}");
        curve.add(1, 0.5);
        assert_eq!(curve.points, [(1, 0.5)]);
    }
}
