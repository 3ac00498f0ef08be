//! A photograph at the size of the small grid: means over areas.

use rayon::prelude::*;
use use3d_capture::Image;

use crate::sample::Sample;

/// One pixel of a small line: the range of large pixels that it covers, with the shares of the first and
/// last.
struct Span {
    first: usize,
    shares: Vec<f32>,
}

fn spans(large: usize, small: usize) -> Vec<Span> {
    let scale = large as f64 / small as f64;
    let span = |i: usize| {
        let (low, high) = (i as f64 * scale, (i + 1) as f64 * scale);
        let first = low as usize;
        let last = (high.ceil() as usize).clamp(first + 1, large);
        let share = |k: usize| {
            let inside = (high.min((k + 1) as f64) - low.max(k as f64)).max(0.0);
            (inside / scale) as f32
        };
        Span { first, shares: (first..last).map(share).collect() }
    };
    (0..small).map(span).collect()
}

/// [`crate::shrink`] for one type of sample.
pub(crate) fn areas<T: Sample>(pixels: &[T], width: usize, size: (usize, usize)) -> Image {
    let height = if width == 0 { 0 } else { pixels.len() / (3 * width) };
    let mut out = Image::new(size.0, size.1);
    if height == 0 || size.0 == 0 || size.1 == 0 {
        return out;
    }
    let (columns, rows) = (spans(width, size.0), spans(height, size.1));
    let lines: Vec<Vec<[f32; 3]>> = rows
        .par_iter()
        .map(|row| {
            let mut sums = vec![[0.0f32; 3]; size.0];
            for (k, down) in row.shares.iter().enumerate() {
                let line = &pixels[3 * width * (row.first + k)..][..3 * width];
                for (sum, column) in sums.iter_mut().zip(&columns) {
                    let mut own = [0.0f32; 3];
                    for (pixel, share) in line[3 * column.first..].chunks_exact(3).zip(&column.shares) {
                        (0..3).for_each(|c| own[c] += share * pixel[c].value());
                    }
                    (0..3).for_each(|c| sum[c] += down * own[c]);
                }
            }
            sums
        })
        .collect();
    for (y, line) in lines.iter().enumerate() {
        line.iter().enumerate().for_each(|(x, pixel)| out.set_pixel(x, y, *pixel));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn areas_are_means_and_the_same_size_is_the_picture_itself() {
        let pixels: Vec<u8> = (0..3 * 6 * 4).map(|i| (i * 3) as u8).collect();
        let same = areas(&pixels, 6, (6, 4));
        assert_eq!(same.to_8bit().to_interleaved(), pixels);
        let half = areas(&pixels, 6, (3, 2));
        let mean =
            |c: usize| [0, 3, 18, 21].iter().map(|o| f32::from(pixels[o + c])).sum::<f32>() / 4.0 / 255.0;
        (0..3).for_each(|c| assert!((half.pixel(0, 0)[c] - mean(c)).abs() < 1e-6));
        // Parts of pixels count by their share: 6 columns to 4.
        let part = areas(&pixels, 6, (4, 4)).pixel(0, 0)[0];
        let expected = (f32::from(pixels[0]) + 0.5 * f32::from(pixels[3])) / 1.5 / 255.0;
        assert!((part - expected).abs() < 1e-6);
        assert_eq!(areas::<u8>(&[], 0, (2, 2)), Image::new(2, 2));
    }
}
