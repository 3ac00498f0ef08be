//! Values in ascending order, of which quantiles and medians are read.

/// Values (`f32` or `f64`) in the order of [`f64::total_cmp`]: −∞ to ∞, and every NaN before or after all
/// numbers, by its sign.
#[derive(Clone, Debug, PartialEq)]
pub struct Ascending<T>(Vec<T>);

impl<T: Copy + Into<f64>> Ascending<T> {
    /// Sorts values.
    pub fn of(values: impl IntoIterator<Item = T>) -> Self {
        let mut values: Vec<T> = values.into_iter().collect();
        values.sort_unstable_by(|a, b| (*a).into().total_cmp(&(*b).into()));
        Self(values)
    }

    /// The value below which `share` (0 to 1) of all `n` values lies: number `⌊share · n⌋`, counted from 0,
    /// at most the last; `None` of no values.
    pub fn at(&self, share: f64) -> Option<T> {
        let before = (share * self.0.len() as f64) as usize;
        self.0.get(before).or(self.0.last()).copied()
    }

    /// The value at or below the place of [`interpolated`](Self::interpolated), so that 0.5 gives the lower
    /// median; `None` of no values.
    pub fn below(&self, share: f64) -> Option<T> {
        self.0.get(self.place(share) as usize).copied()
    }

    /// The value at the place `share · (n − 1)` (`share` from 0 to 1), linear between neighbours; `None` of
    /// no values.
    pub fn interpolated(&self, share: f64) -> Option<f64> {
        let low = self.below(share)?.into();
        let (at, t) = (self.place(share) as usize, self.place(share).fract());
        let high = self.0.get(at + 1).map_or(low, |high| (*high).into());
        Some(low * (1.0 - t) + high * t)
    }

    fn place(&self, share: f64) -> f64 {
        share * self.0.len().saturating_sub(1) as f64
    }
}

/// The upper median of values: that at 0.5 of [`Ascending`]; `None` of no values.
pub fn median<T: Copy + Into<f64>>(values: impl IntoIterator<Item = T>) -> Option<T> {
    Ascending::of(values).at(0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_values_have_no_quantile() {
        let none = Ascending::<f32>::of([]);
        assert_eq!(
            (none.at(0.3), median::<f32>([]), none.below(1.0), none.interpolated(0.5)),
            (None, None, None, None)
        );
    }

    #[test]
    fn one_value_is_every_quantile() {
        let one = Ascending::of([7.0f32]);
        for share in [0.0, 0.2, 0.5, 1.0] {
            assert_eq!((one.at(share), one.below(share)), (Some(7.0), Some(7.0)));
            assert_eq!(one.interpolated(share), Some(7.0));
        }
    }

    #[test]
    fn odd_and_even_counts_have_their_medians() {
        let odd = Ascending::of([5.0, 1.0, 3.0]);
        assert_eq!((odd.at(0.5), odd.below(0.5), odd.interpolated(0.5)), (Some(3.0), Some(3.0), Some(3.0)));
        assert_eq!((median([5.0, 1.0, 3.0]), median([5.0, 1.0, 3.0, 7.0])), (Some(3.0), Some(5.0)));
        let even = Ascending::of([5.0, 1.0, 3.0, 7.0]);
        assert_eq!(
            (even.at(0.5), even.below(0.5), even.interpolated(0.5)),
            (Some(5.0), Some(3.0), Some(4.0))
        );
    }

    #[test]
    fn the_shares_0_and_1_are_the_least_and_the_greatest() {
        let values = Ascending::of([2.0, -4.0, 9.0, 3.0]);
        assert_eq!(
            (values.at(0.0), values.below(0.0), values.interpolated(0.0)),
            (Some(-4.0), Some(-4.0), Some(-4.0))
        );
        assert_eq!(
            (values.at(1.0), values.below(1.0), values.interpolated(1.0)),
            (Some(9.0), Some(9.0), Some(9.0))
        );
    }

    #[test]
    fn shares_count_the_values_before() {
        let values = Ascending::of((0..20).rev().map(f64::from));
        assert_eq!((values.at(0.05), values.at(0.5), values.at(0.95)), (Some(1.0), Some(10.0), Some(19.0)));
        assert_eq!((values.below(0.05), values.below(0.95)), (Some(0.0), Some(18.0)));
        assert!((values.interpolated(0.05).unwrap() - 0.95).abs() < 1e-12);
    }

    #[test]
    fn nan_lies_outside_of_all_numbers_by_its_sign() {
        let values = Ascending::of([f32::NAN, f32::INFINITY, -f32::NAN, 0.0, -0.0]);
        assert!(values.at(0.0).unwrap().is_nan() && values.at(1.0).unwrap().is_nan());
        assert_eq!(values.at(0.2).map(f32::to_bits), Some((-0.0f32).to_bits()));
        assert_eq!(values.at(0.4).map(f32::to_bits), Some(0.0f32.to_bits()));
        assert_eq!(values.at(0.6), Some(f32::INFINITY));
    }
}
