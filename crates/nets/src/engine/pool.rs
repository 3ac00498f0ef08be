//! Maximum and average pooling.

use rayon::prelude::*;

use super::planes::Planes;

/// The maximum of every `kernel × kernel` window, at steps of `stride`; windows are inside the picture (the
/// rest is dropped).
pub(crate) fn maximum(input: &Planes, kernel: usize, stride: usize) -> Planes {
    let (height, width) = ((input.height - kernel) / stride + 1, (input.width - kernel) / stride + 1);
    let mut out = Planes::new(input.channels, height, width);
    out.data.par_chunks_mut(height * width).enumerate().for_each(|(c, plane)| {
        let source = input.plane(c);
        for (y, row) in plane.chunks_exact_mut(width).enumerate() {
            row.fill(f32::NEG_INFINITY);
            for ky in 0..kernel {
                let source = &source[(y * stride + ky) * input.width..][..input.width];
                for (x, o) in row.iter_mut().enumerate() {
                    for v in &source[x * stride..x * stride + kernel] {
                        *o = o.max(*v);
                    }
                }
            }
        }
    });
    out
}

/// The mean of every 2 × 2 block; an odd last row or column is dropped.
pub(crate) fn halve(input: &Planes) -> Planes {
    let (height, width) = (input.height / 2, input.width / 2);
    let mut out = Planes::new(input.channels, height, width);
    for c in 0..input.channels {
        let source = input.plane(c);
        for y in 0..height {
            for x in 0..width {
                let at = 2 * y * input.width + 2 * x;
                let sum =
                    source[at] + source[at + 1] + source[at + input.width] + source[at + input.width + 1];
                out.data[(c * height + y) * width + x] = 0.25 * sum;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pools_drop_what_does_not_fill_a_window() {
        let input = Planes::from_data(1, 3, 5, (0..15).map(|v| v as f32).collect());
        assert_eq!(maximum(&input, 2, 2).data, [6.0, 8.0]);
        assert_eq!(maximum(&input, 3, 2).data, [12.0, 14.0]);
        assert_eq!(halve(&input).data, [3.0, 5.0]);
    }
}
