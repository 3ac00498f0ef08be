//! A score: a finite number, or the reason why there is none.
//!
//! A score can be neither infinite nor NaN: a [`Finite`] can only be made from a finite number, also when
//! it is read from a file. So no number becomes `null` in JSON, and no mean becomes NaN because of one
//! image.

use serde::{Deserialize, Serialize};

use crate::error::MetricError;

/// A number that is neither infinite nor NaN.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Finite(f64);

impl Finite {
    /// The number, if it is finite.
    pub fn new(value: f64) -> Option<Self> {
        value.is_finite().then_some(Self(value))
    }

    /// The number.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl From<Finite> for f64 {
    fn from(value: Finite) -> Self {
        value.0
    }
}

/// A number that is no score.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("a score of {0}; scores are finite")]
pub struct NonFiniteScore(pub f64);

impl TryFrom<f64> for Finite {
    type Error = NonFiniteScore;

    fn try_from(value: f64) -> Result<Self, NonFiniteScore> {
        Self::new(value).ok_or(NonFiniteScore(value))
    }
}

/// A number, or the reason why there is none. It is never zero for "unknown", and never silently absent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Score {
    /// The measured number.
    Value(Finite),
    /// The number could be measured, but not here. The text is the next step, e.g.
    /// `put lpips_alex.pth into models/`. A mean over such a score is not available either.
    NotAvailable(String),
    /// This image or pair has no such number (equal images have no finite PSNR, two views may see nothing
    /// in common). The text is the reason. A mean leaves it out and counts it.
    Undefined(String),
}

impl Score {
    /// The score of a number; one that is not finite is [`Score::Undefined`].
    pub fn of(value: f64) -> Self {
        Finite::new(value).map_or_else(
            || Self::Undefined(format!("the measure gives {value}, which is no score")),
            Self::Value,
        )
    }

    /// The score of a formula's result.
    pub fn measured(result: Result<f64, MetricError>) -> Self {
        match result {
            Ok(value) => Self::of(value),
            Err(
                e @ (MetricError::Equal
                | MetricError::NothingCounts
                | MetricError::NoWindow { .. }
                | MetricError::FewEdges { .. }
                | MetricError::NothingInCommon),
            ) => Self::Undefined(e.to_string()),
            Err(e) => Self::NotAvailable(e.to_string()),
        }
    }

    /// The number, if there is one.
    pub fn value(&self) -> Option<f64> {
        match self {
            Self::Value(value) => Some(value.get()),
            Self::NotAvailable(_) | Self::Undefined(_) => None,
        }
    }

    /// The reason why there is no number.
    pub fn reason(&self) -> Option<&str> {
        match self {
            Self::Value(_) => None,
            Self::NotAvailable(reason) | Self::Undefined(reason) => Some(reason),
        }
    }

    /// Adds words before the reason of a missing score, e.g. the view to which it belongs.
    #[must_use]
    pub fn named(self, place: &str) -> Self {
        match self {
            Self::Value(value) => Self::Value(value),
            Self::NotAvailable(reason) => Self::NotAvailable(reason),
            Self::Undefined(reason) => Self::Undefined(format!("{place}: {reason}")),
        }
    }

    /// The mean of the scores without those that are undefined. If a score is not available, or none is
    /// left, the result is the first reason.
    pub fn mean<'a>(scores: impl IntoIterator<Item = &'a Score>) -> Self {
        let (mut sum, mut count) = (0.0, 0usize);
        let mut undefined = None;
        for score in scores {
            match score {
                Self::Value(value) => {
                    sum += value.get();
                    count += 1;
                }
                Self::NotAvailable(_) => return score.clone(),
                Self::Undefined(_) => undefined = undefined.or(Some(score)),
            }
        }
        match (count, undefined) {
            (0, Some(score)) => score.clone(),
            (0, None) => Self::NotAvailable("nothing to measure: no views".into()),
            _ => Self::of(sum / count as f64),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_score_is_infinite_wherever_it_comes_from() {
        for value in [f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
            assert_eq!(Finite::new(value), None);
            assert!(matches!(Score::of(value), Score::Undefined(_)));
            assert!(matches!(Score::measured(Ok(value)), Score::Undefined(_)));
            let text = serde_json::to_string(&Score::of(value)).unwrap();
            let read: Score = serde_json::from_str(&text).unwrap();
            assert!(read.value().is_none() && read.reason().is_some(), "{text}");
        }
        assert!(serde_json::from_str::<Score>("{\"value\":null}").is_err());
        assert!(Finite::try_from(f64::INFINITY).is_err());
        assert_eq!(serde_json::to_string(&Score::of(2.5)).unwrap(), "{\"value\":2.5}");
        assert!(matches!(Score::measured(Err(MetricError::Equal)), Score::Undefined(_)));
    }

    #[test]
    fn a_mean_leaves_out_what_is_undefined_and_not_what_is_missing() {
        let missing = Score::NotAvailable("put x into y".into());
        let undefined = Score::Undefined("the images are equal".into());
        assert_eq!(Score::mean([&Score::of(1.0), &Score::of(3.0)]), Score::of(2.0));
        assert_eq!(Score::mean([&Score::of(1.0), &undefined, &Score::of(3.0)]), Score::of(2.0));
        assert_eq!(Score::mean([&Score::of(1.0), &undefined, &missing]), missing);
        assert_eq!(Score::mean([&undefined]), undefined);
        assert_eq!((undefined.reason(), Score::of(1.0).reason()), (Some("the images are equal"), None));
        assert!(Score::mean([]).value().is_none());
    }
}
