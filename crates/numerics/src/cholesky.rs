//! Small dense systems: a symmetric positive definite matrix, row-major, factored as `L Lᵀ` in place.
//!
//! Sums run in the order of their indices, so the same matrix gives the same bits everywhere. Nothing is
//! pivoted: the factor of a badly conditioned matrix loses digits.

/// A lower triangular factor `L`, `n × n`.
pub struct Factor {
    n: usize,
    lower: Vec<f64>,
}

impl Factor {
    /// Factors an `n × n` matrix, reading only its lower triangle; `None` if it is not positive definite or
    /// not finite.
    pub fn new(mut matrix: Vec<f64>, n: usize) -> Option<Self> {
        for j in 0..n {
            for i in j..n {
                let (head, tail) = matrix.split_at(i * n);
                let (row_i, row_j) = (&tail[..j], if i == j { &tail[..j] } else { &head[j * n..j * n + j] });
                let dot: f64 = row_i.iter().zip(row_j).map(|(a, b)| a * b).sum();
                let value = matrix[i * n + j] - dot;
                matrix[i * n + j] = if i == j {
                    if !(value > 0.0 && value.is_finite()) {
                        return None;
                    }
                    value.sqrt()
                } else {
                    value / matrix[j * n + j]
                };
            }
        }
        Some(Self { n, lower: matrix })
    }

    /// Solves `L Lᵀ x = b` for the `n` entries of `b`.
    pub fn solve(&self, b: &[f64]) -> Vec<f64> {
        let (n, l) = (self.n, &self.lower);
        let mut x = b.to_vec();
        for i in 0..n {
            let dot: f64 = (0..i).map(|k| l[i * n + k] * x[k]).sum();
            x[i] = (x[i] - dot) / l[i * n + i];
        }
        for i in (0..n).rev() {
            let dot: f64 = (i + 1..n).map(|k| l[k * n + i] * x[k]).sum();
            x[i] = (x[i] - dot) / l[i * n + i];
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_what_it_factored_and_refuses_the_rest() {
        let a = [4.0, 0.0, 0.0, 2.0, 5.0, 0.0, -1.0, 0.5, 3.0];
        let x = Factor::new(a.to_vec(), 3).unwrap().solve(&[5.0, 7.5, 2.5]);
        let full = [[4.0, 2.0, -1.0], [2.0, 5.0, 0.5], [-1.0, 0.5, 3.0]];
        for (row, b) in full.iter().zip([5.0, 7.5, 2.5]) {
            let value: f64 = row.iter().zip(&x).map(|(a, x)| a * x).sum();
            assert!((value - b).abs() < 1e-12);
        }
        assert!(Factor::new(vec![1.0, 0.0, 2.0, 1.0], 2).is_none());
        assert!(Factor::new(vec![f64::NAN], 1).is_none());
    }
}
