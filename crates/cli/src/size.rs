//! Image sizes on the command line.

use use3d_io_image::MAX_PIXELS;

use crate::error::WorkError;

/// Parses `WxH`. The program draws no picture with more pixels than it would read from a file.
pub(crate) fn parse_size(text: &str) -> Result<(usize, usize), WorkError> {
    let sides: Option<(usize, usize)> =
        text.split_once(['x', 'X', '×']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    match sides.filter(|(w, h)| (1..=65_535).contains(w) && (1..=65_535).contains(h)) {
        None => Err(WorkError::Input(format!(
            "size `{text}`: expected WIDTHxHEIGHT in pixels, 1 to 65535 each, e.g. 1400x933"
        ))),
        Some((w, h)) if (w * h) as u64 > MAX_PIXELS => Err(WorkError::Input(format!(
            "size `{text}`: this is more than {MAX_PIXELS} pixels, the most that a picture may have; choose a smaller size"
        ))),
        Some(sides) => Ok(sides),
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
            assert!(refused.to_string().contains("1 to 65535 each"), "{bad}: {refused}");
        }
        assert_eq!(parse_size("16384x8192").unwrap(), (16_384, 8192), "2^27 pixels are allowed");
        for large in ["65535x65535", "16384x8193"] {
            let refused = parse_size(large).unwrap_err();
            assert!(refused.to_string().contains("choose a smaller size"), "{large}: {refused}");
        }
    }
}
