//! Fixed-order parallel sums: the same bits for any number of threads.
//!
//! A slice is cut into blocks of a fixed length, each block is summed by one thread, and the
//! block sums are added in order. `rayon`'s own `sum` and `reduce` split by load and would change
//! the last bits from run to run.

use rayon::prelude::*;

/// Block length of the fixed-order reductions.
pub const BLOCK: usize = 4096;

/// Sums `term(i)` for `i` in `0..n` in f64, with a fixed order of additions.
pub fn sum(n: usize, term: impl Fn(usize) -> f64 + Sync) -> f64 {
    let blocks: Vec<f64> = (0..n.div_ceil(BLOCK))
        .into_par_iter()
        .map(|b| (b * BLOCK..((b + 1) * BLOCK).min(n)).map(&term).sum())
        .collect();
    blocks.iter().sum()
}

/// Sums `N` quantities at once: `accumulate(i, &mut totals)` adds item `i`.
pub fn sums<const N: usize>(n: usize, accumulate: impl Fn(usize, &mut [f64; N]) + Sync) -> [f64; N] {
    let blocks: Vec<[f64; N]> = (0..n.div_ceil(BLOCK))
        .into_par_iter()
        .map(|b| {
            let mut totals = [0.0; N];
            for i in b * BLOCK..((b + 1) * BLOCK).min(n) {
                accumulate(i, &mut totals);
            }
            totals
        })
        .collect();
    let mut totals = [0.0; N];
    for block in blocks {
        for (t, v) in totals.iter_mut().zip(block) {
            *t += v;
        }
    }
    totals
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math;

    #[test]
    fn the_same_bits_on_any_number_of_threads() {
        let values: Vec<f64> = (0..100_000).map(|i| math::sin((i * 7919) as f64) * 1e3).collect();
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                (sum(values.len(), |i| values[i]), sums::<2>(values.len(), |i, t| t[i % 2] += values[i]))
            })
        };
        let one = run(1);
        for threads in [2, 3, 8] {
            assert_eq!(one, run(threads));
        }
        let exact: f64 = values.iter().sum();
        assert!((one.0 - exact).abs() < 1e-6);
    }
}
