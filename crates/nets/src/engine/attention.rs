//! Multi-head attention: `out = V · softmax(Kᵀ Q / √d)` for every head, tokens in columns.
//!
//! One block of [`LANES`] queries at a time is processed against all keys. The block of scores is exactly a
//! panel of the second product, so the whole matrix of scores is never stored, and memory is linear in the
//! number of tokens.

use fearless_simd::Level;
use rayon::prelude::*;

use super::activation;
use super::planes::Planes;
use super::product::{LANES, Packed, fill_from_rows, multiply_panels};

/// The score of masked pairs before the softmax, in place of their own.
const MASKED: f32 = -1000.0;

/// Attention with `heads` heads; `queries`, `keys`, `values` are `[heads · d, tokens]`, head-major. With a
/// mask, a pair of tokens gets the score −1000 if one of them is not valid.
pub(crate) fn attention(
    queries: &[f32],
    keys: &[f32],
    values: &[f32],
    heads: usize,
    tokens: usize,
    valid: Option<&[bool]>,
) -> Planes {
    let channels = queries.len() / tokens;
    let depth = channels / heads;
    let scale = 1.0 / (depth as f32).sqrt();
    let level = Level::new();
    let mut out = Planes::new(channels, 1, tokens);
    let head_size = depth * tokens;
    for (head, out) in out.data.chunks_exact_mut(head_size).enumerate() {
        let part = head * head_size..(head + 1) * head_size;
        let (queries, keys, values) = (&queries[part.clone()], &keys[part.clone()], &values[part]);
        let packed_keys = Packed::new(tokens, depth, |token, c| keys[c * tokens + token] * scale);
        let packed_values = Packed::from_row_major(depth, tokens, values);
        let mut pieces: Vec<Vec<&mut [f32]>> = Vec::new();
        pieces.resize_with(tokens.div_ceil(LANES), || Vec::with_capacity(depth));
        for row in out.chunks_exact_mut(tokens) {
            for (block, piece) in row.chunks_mut(LANES).enumerate() {
                pieces[block].push(piece);
            }
        }
        let scratch = || {
            let scores = vec![0.0; tokens.next_multiple_of(8) * LANES];
            (vec![0.0; depth * LANES], scores, vec![0.0; depth.next_multiple_of(8) * LANES])
        };
        pieces.into_par_iter().enumerate().for_each_init(
            scratch,
            |(panel, scores, sums), (block, mut rows)| {
                fill_from_rows(queries, tokens, block * LANES, panel);
                scores.fill(0.0);
                multiply_panels(level, &packed_keys, panel, scores, 1);
                let (scores, _) = scores[..tokens * LANES].as_chunks_mut::<LANES>();
                if let Some(valid) = valid {
                    mask(scores, valid, block * LANES);
                }
                let reciprocals = activation::softmax_columns(level, scores);
                sums.fill(0.0);
                multiply_panels(level, &packed_values, scores.as_flattened(), sums, 1);
                for (row, sums) in rows.iter_mut().zip(sums.chunks_exact(LANES)) {
                    for (i, o) in row.iter_mut().enumerate() {
                        *o = sums[i] * reciprocals[i];
                    }
                }
            },
        );
    }
    out
}

fn mask(scores: &mut [[f32; LANES]], valid: &[bool], first_query: usize) {
    for (key, row) in scores.iter_mut().enumerate() {
        for (i, score) in row.iter_mut().enumerate() {
            let query = valid.get(first_query + i).copied().unwrap_or(false);
            if !(query && valid[key]) {
                *score = MASKED;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::noise;
    use use3d_numerics::math;

    #[test]
    fn equals_the_definition_with_and_without_a_mask() {
        let (heads, depth) = (3, 5);
        for tokens in [1, 47, 101] {
            let n = heads * depth * tokens;
            let [q, k, v] = [1, 2, 3].map(|s| noise(s, n).iter().map(|x| 3.0 * x).collect::<Vec<f32>>());
            let valid: Vec<bool> = (0..tokens).map(|t| t % 4 != 1).collect();
            for valid in [None, Some(&valid[..])] {
                let out = attention(&q, &k, &v, heads, tokens, valid);
                for head in 0..heads {
                    for query in 0..tokens {
                        let at =
                            |m: &[f32], c: usize, t: usize| f64::from(m[(head * depth + c) * tokens + t]);
                        let scores: Vec<f64> = (0..tokens)
                            .map(|key| match valid {
                                Some(valid) if !(valid[key] && valid[query]) => -1000.0,
                                _ => {
                                    (0..depth).map(|c| at(&q, c, query) * at(&k, c, key)).sum::<f64>()
                                        / 5f64.sqrt()
                                }
                            })
                            .collect();
                        let top = scores.iter().copied().fold(f64::MIN, f64::max);
                        let total: f64 = scores.iter().map(|s| math::exp(s - top)).sum();
                        for c in 0..depth {
                            let expected: f64 =
                                (0..tokens).map(|t| math::exp(scores[t] - top) / total * at(&v, c, t)).sum();
                            let actual = f64::from(out.data[(head * depth + c) * tokens + query]);
                            assert!((actual - expected).abs() < 3e-6, "{actual} instead of {expected}");
                        }
                    }
                }
            }
        }
    }
}
