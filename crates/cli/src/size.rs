//! Image sizes on the command line.

use crate::error::CliError;

/// Parses `WxH`.
pub(crate) fn parse_size(text: &str) -> Result<(usize, usize), CliError> {
    let sides = text.split_once(['x', 'X', '×']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    match sides {
        Some((w, h)) if (1..=65_535).contains(&w) && (1..=65_535).contains(&h) => Ok((w, h)),
        _ => Err(CliError::Input(format!(
            "size `{text}`: expected WIDTHxHEIGHT in pixels, 1 to 65535 each, e.g. 1400x933"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_checked() {
        assert_eq!(parse_size("1400x933").unwrap(), (1400, 933));
        for bad in ["1400", "x933", "0x3", "1400x933x3", "axb", "70000x2"] {
            let refused = parse_size(bad).unwrap_err();
            assert!(refused.text().contains("1 to 65535 each"), "{bad}: {}", refused.text());
        }
    }
}
