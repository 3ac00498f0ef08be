//! The rank correlation of two lists (Spearman's ρ): 1 if they have the same order, −1 if the opposite one.

/// The rank correlation; `None` if one of the two does not vary.
pub fn rank_correlation(a: &[f64], b: &[f64]) -> Option<f64> {
    correlation(&ranks(a), &ranks(b))
}

/// The rank of each value; equal values share their mean rank.
fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_unstable_by(|a, b| values[*a].total_cmp(&values[*b]));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    while first < order.len() {
        let mut last = first;
        while last + 1 < order.len() && values[order[last + 1]] == values[order[first]] {
            last += 1;
        }
        for place in &order[first..=last] {
            ranks[*place] = (first + last) as f64 / 2.0;
        }
        first = last + 1;
    }
    ranks
}

/// Pearson's correlation; `None` if one of the two does not vary.
fn correlation(a: &[f64], b: &[f64]) -> Option<f64> {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        ab += (x - ma) * (y - mb);
        aa += (x - ma) * (x - ma);
        bb += (y - mb) * (y - mb);
    }
    (aa > 0.0 && bb > 0.0).then(|| ab / (aa * bb).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_order_counts() {
        let a = [1.0, 2.0, 3.0, 10.0];
        assert_eq!(rank_correlation(&a, &[0.0, 0.1, 5.0, 6.0]), Some(1.0));
        assert_eq!(rank_correlation(&a, &[9.0, 8.0, 1.0, -4.0]), Some(-1.0));
        assert_eq!(rank_correlation(&a, &[3.0; 4]), None);
        let shared = rank_correlation(&a, &[1.0, 1.0, 2.0, 2.0]).unwrap();
        assert!((shared - 0.8944).abs() < 1e-4, "{shared}");
    }
}
