//! SampleRows of pixels as bytes: RGB and alpha side by side, in either order of bytes.
//!
//! SampleRows are made one at a time, so no second copy of the picture is in memory.

use crate::decoded::{Decoded, Samples};

/// The pixels of one picture, `[height, width, 3]`, and its alpha, `[height, width]`, of the same type.
pub(crate) struct SampleRows<'a> {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) pixels: &'a Samples,
    pub(crate) alpha: Option<&'a Samples>,
}

impl Samples {
    /// The number of samples.
    pub(crate) fn count(&self) -> usize {
        match self {
            Self::Eight(s) => s.len(),
            Self::Sixteen(s) => s.len(),
            Self::Float(s) => s.len(),
        }
    }

    /// True if both have samples of one type.
    pub(crate) fn same_type(&self, other: &Self) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
    }
}

/// Appends the samples of a row as bytes; `turn` makes the bytes of one sample.
fn append<T: Copy, const N: usize>(
    row: &mut Vec<u8>,
    pixels: &[T],
    alpha: Option<&[T]>,
    turn: impl Fn(T) -> [u8; N],
) {
    match alpha {
        None => row.extend(pixels.iter().flat_map(|v| turn(*v))),
        Some(alpha) => {
            for (pixel, a) in pixels.chunks_exact(3).zip(alpha) {
                pixel.iter().chain([a]).for_each(|v| row.extend(turn(*v)));
            }
        }
    }
}

impl SampleRows<'_> {
    pub(crate) fn has_alpha(&self) -> bool {
        self.alpha.is_some()
    }

    pub(crate) fn samples_per_pixel(&self) -> usize {
        3 + usize::from(self.has_alpha())
    }

    pub(crate) fn bytes_per_sample(&self) -> usize {
        match self.pixels {
            Samples::Eight(_) => 1,
            Samples::Sixteen(_) => 2,
            Samples::Float(_) => 4,
        }
    }

    /// Replaces `row` by the bytes of row `y`; `big` puts the most significant byte of a sample first.
    pub(crate) fn bytes(&self, y: usize, big: bool, row: &mut Vec<u8>) {
        row.clear();
        let w = self.width as usize;
        let (p, a) = (3 * w * y..3 * w * (y + 1), w * y..w * (y + 1));
        match (self.pixels, self.alpha) {
            (Samples::Eight(s), None) => row.extend_from_slice(&s[p]),
            (Samples::Eight(s), Some(Samples::Eight(t))) => append(row, &s[p], Some(&t[a]), |v| [v]),
            (Samples::Sixteen(s), alpha) => {
                let alpha = if let Some(Samples::Sixteen(t)) = alpha { Some(&t[a]) } else { None };
                let turn = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() };
                append(row, &s[p], alpha, turn);
            }
            (Samples::Float(s), alpha) => {
                let alpha = if let Some(Samples::Float(t)) = alpha { Some(&t[a]) } else { None };
                let turn = |v: f32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
                append(row, &s[p], alpha, turn);
            }
            (Samples::Eight(s), Some(_)) => row.extend_from_slice(&s[p]),
        }
    }
}

fn split<T: Copy>(samples: Vec<T>, channels: usize) -> (Vec<T>, Option<Vec<T>>) {
    if channels == 3 {
        return (samples, None);
    }
    let pixels = samples.chunks_exact(channels);
    let alpha = matches!(channels, 2 | 4).then(|| pixels.clone().map(|p| p[channels - 1]).collect());
    let colors = if channels >= 3 { [0, 1, 2] } else { [0, 0, 0] };
    let mut rgb = Vec::with_capacity(samples.len() / channels * 3);
    pixels.for_each(|p| rgb.extend(colors.map(|c| p[c])));
    (rgb, alpha)
}

/// RGB and alpha of a decoded picture; grey is used for all three colours.
pub(crate) fn rgb_and_alpha(decoded: Decoded) -> (Samples, Option<Samples>) {
    let c = decoded.channels;
    match decoded.samples {
        Samples::Eight(s) => {
            let (rgb, alpha) = split(s, c);
            (Samples::Eight(rgb), alpha.map(Samples::Eight))
        }
        Samples::Sixteen(s) => {
            let (rgb, alpha) = split(s, c);
            (Samples::Sixteen(rgb), alpha.map(Samples::Sixteen))
        }
        Samples::Float(s) => {
            let (rgb, alpha) = split(s, c);
            (Samples::Float(rgb), alpha.map(Samples::Float))
        }
    }
}
