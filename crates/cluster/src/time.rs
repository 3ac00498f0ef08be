//! Times in the forms of people and schedulers.

use std::time::Duration;

use use3d_workflow::gc::parse_age;

/// A text that is not a time.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is not a time: write it as 90min, 3h or 3:50:00 (hours:minutes:seconds)")]
pub struct TimeError {
    /// The text.
    pub text: String,
}

/// Parses `90min`, `3h`, `1.5d`, or hours, minutes and seconds as `3:50:00`.
///
/// # Errors
/// Any other text.
pub fn parse(text: &str) -> Result<Duration, TimeError> {
    let wrong = || TimeError { text: text.to_string() };
    if !text.contains(':') {
        return parse_age(text).map_err(|_| wrong());
    }
    let parts: Vec<u64> = text.split(':').map(str::parse).collect::<Result<_, _>>().map_err(|_| wrong())?;
    let [hours, minutes, seconds] = parts[..] else { return Err(wrong()) };
    if minutes > 59 || seconds > 59 || hours > 100_000 {
        return Err(wrong());
    }
    Ok(Duration::from_secs(hours * 3600 + minutes * 60 + seconds))
}

/// A time as `3:50:00`, in whole minutes, rounded up.
pub fn clock(time: Duration) -> String {
    let minutes = time.as_secs().div_ceil(60);
    format!("{}:{:02}:00", minutes / 60, minutes % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_and_written() {
        for (text, seconds) in
            [("90min", 5400), ("3h", 10_800), ("1.5d", 129_600), ("3:50:00", 13_800), ("0:00:01", 1)]
        {
            assert_eq!(parse(text), Ok(Duration::from_secs(seconds)), "{text}");
        }
        for text in ["", "3", "3:50", "1:60:00", "a:b:c", "-1h", "1:2:3:4", "999999999999:00:00"] {
            assert!(parse(text).is_err(), "{text}");
        }
        assert_eq!(clock(Duration::from_secs(13_800)), "3:50:00");
        assert_eq!(clock(Duration::from_secs(61)), "0:02:00");
    }
}
