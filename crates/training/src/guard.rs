//! The guard against numbers that are not finite.

use use3d_numerics::sums::BLOCK;

use rayon::prelude::*;

/// A loss, gradient or parameter that is infinite or NaN, with the place where it first occurred.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "step {step}, view `{view}`: {what} is not finite{}",
    match index { Some(i) => format!(" at element {i}"), None => String::new() }
)]
pub struct NonFinite {
    /// The step, from 0.
    pub step: u64,
    /// The view's name.
    pub view: String,
    /// The quantity: `loss`, `means`, …
    pub what: String,
    /// The index of the first bad element, if the quantity has several.
    pub index: Option<usize>,
}

/// The index of the first value that is not finite.
pub fn first_non_finite(values: &[f32]) -> Option<usize> {
    values.par_chunks(BLOCK).enumerate().find_map_first(|(block, chunk)| {
        // One pass without branches per block; the index is searched only in a block with a bad value.
        let bad = chunk.iter().fold(false, |bad, v| bad | !v.is_finite());
        bad.then(|| block * BLOCK + chunk.iter().position(|v| !v.is_finite()).unwrap_or(0))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_bad_value_is_found() {
        let mut values = vec![1.0f32; 3 * BLOCK + 5];
        assert_eq!(first_non_finite(&values), None);
        values[3 * BLOCK + 2] = f32::NAN;
        assert_eq!(first_non_finite(&values), Some(3 * BLOCK + 2));
        values[BLOCK + 9] = f32::NEG_INFINITY;
        assert_eq!(first_non_finite(&values), Some(BLOCK + 9));
    }

    #[test]
    fn the_message_says_where() {
        let error = NonFinite { step: 12, view: "a.png".into(), what: "means".into(), index: Some(7) };
        let text = error.to_string();
        for part in ["step 12", "a.png", "means", "element 7"] {
            assert!(text.contains(part), "{text}");
        }
    }
}
