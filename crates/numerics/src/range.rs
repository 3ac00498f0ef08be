//! Errors for parameters outside their range: the name, the value found, and the expected values. The path is
//! separate from the text, so that a reader of parameter files can point to the line.

use std::error::Error;
use std::fmt;

/// A parameter outside its range.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutOfRange {
    /// Its name among its siblings, or its path below them: `learning_rates.means[1]`.
    pub path: String,
    /// The value found.
    pub found: String,
    /// The expected values.
    pub expected: String,
}

impl OutOfRange {
    /// Creates the error for the parameter at `path`.
    pub fn new(path: impl Into<String>, found: impl fmt::Display, expected: impl Into<String>) -> Self {
        Self { path: path.into(), found: found.to_string(), expected: expected.into() }
    }

    /// The same error for a parameter inside the table `table`.
    #[must_use]
    pub fn within(self, table: &str) -> Self {
        Self { path: format!("{table}.{}", self.path), ..self }
    }

    /// The text without the path: `is 7; expected 0 to 1`.
    pub fn words(&self) -> String {
        format!("is {}; expected {}", self.found, self.expected)
    }
}

impl fmt::Display for OutOfRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}` {}", self.path, self.words())
    }
}

impl Error for OutOfRange {}

/// Returns the error for the parameter at `path` unless `good`.
pub fn check(
    good: bool,
    path: impl Into<String>,
    found: impl fmt::Display,
    expected: impl Into<String>,
) -> Result<(), OutOfRange> {
    if good { Ok(()) } else { Err(OutOfRange::new(path, found, expected)) }
}

/// Checks that `value` lies in `[least, most]`.
pub fn within<T: Copy + PartialOrd + fmt::Display>(
    path: impl Into<String>,
    value: T,
    least: T,
    most: T,
) -> Result<(), OutOfRange> {
    check(value >= least && value <= most, path, value, format!("{least} to {most}"))
}

/// Checks that `value` is at least `least`.
pub fn at_least(path: impl Into<String>, value: u64, least: u64) -> Result<(), OutOfRange> {
    check(value >= least, path, value, format!("at least {least}"))
}

/// Checks that `value` is finite and above 0.
pub fn positive(path: impl Into<String>, value: f64) -> Result<(), OutOfRange> {
    check(value.is_finite() && value > 0.0, path, value, "a positive number")
}

/// Checks that `value` is finite and not below 0.
pub fn not_negative(path: impl Into<String>, value: f64) -> Result<(), OutOfRange> {
    check(value.is_finite() && value >= 0.0, path, value, "a finite number, 0 or more")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_number_is_in_no_range() {
        assert!(within("a", f64::NAN, 0.0, 1.0).is_err() && positive("a", f64::NAN).is_err());
        assert!(not_negative("a", f64::INFINITY).is_err() && within("a", 1.0, 0.0, 1.0).is_ok());
        let error = positive("rate", 0.0).unwrap_err().within("field");
        assert_eq!(error.to_string(), "`field.rate` is 0; expected a positive number");
    }
}
