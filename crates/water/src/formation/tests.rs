use super::*;

/// Three points seen by four views.
fn channel() -> Channel {
    let value = vec![0.42, 0.36, 0.31, 0.55, 0.47, 0.12, 0.19, 0.24, 0.30];
    let distance = [0.5, 0.9, 1.6, 0.6, 1.3, 0.4, 0.8, 1.1, 1.9].to_vec();
    let direction = (0..9).map(|i| [0.05 * i as f64 - 0.2, 0.1, 0.3 - 0.07 * i as f64]).collect();
    Channel {
        start: vec![0, 3, 5, 9],
        view: vec![0, 1, 3, 1, 2, 0, 1, 2, 3],
        distance,
        direction,
        spread: vec![0.02; value.len()],
        value,
        views: 4,
    }
}

fn theta() -> Vec<f64> {
    vec![math::ln(0.6), math::ln(0.45), math::ln(0.4), 0.3, -0.2, 0.5, 0.05, -0.1, 0.02, 0.03]
}

fn weights() -> Vec<f64> {
    (0..9).map(|i| 1.0 + 0.3 * (i % 4) as f64).collect()
}

#[test]
fn golden_radiance_is_the_weighted_least_squares_solution() {
    // Two views of one point, calculated by hand: a = e^{-s}, I - b = 1 and 1/2 at s = 0 and ln 2, weights
    // 1 and 4.
    let (j, below) = radiance([(1.0, 1.0, 1.0), (4.0, 0.5, 0.5)].into_iter());
    assert_eq!((j, below), (1.0, 2.0));
    let (j, _) = radiance([(1.0, 1.0, 0.8), (4.0, 0.5, 0.5)].into_iter());
    assert!((j - (0.8 + 4.0 * 0.25) / 2.0).abs() < 1e-15);
    // A negative radiance becomes 0.
    assert_eq!(radiance([(1.0, 0.5, -0.2)].into_iter()).0, 0.0);
    assert_eq!(radiance(std::iter::empty()), (0.0, 0.0));
}

#[test]
fn golden_terms_are_those_of_the_equation() {
    let (channel, theta) = (channel(), theta());
    let t = terms(&channel, &Shared::new(&theta), 2);
    // Computed with 30 digits: γ = 0.03, β_a s = 0.96, β_b s = 0.72, B = 0.4 (1 + 0.3·(−0.1) − 0.2·0.1 +
    // 0.5·0.16).
    assert!((t.left - 0.394_553_710_371_601_14).abs() < 1e-14, "{}", t.left);
    assert!((t.added - 0.4 * 1.03 * math::exp(0.03) * (1.0 - math::exp(-0.72))).abs() < 1e-15);
}

/// The residuals as a function of the parameters, with radiances eliminated.
fn at(channel: &Channel, theta: &[f64], k: usize, step: f64) -> Vec<f64> {
    let mut moved = theta.to_vec();
    moved[k] += step;
    residuals(channel, &all_terms(channel, &moved), &weights())
}

fn compare_with_differences(channel: &Channel, theta: &[f64]) {
    let (w, n) = (weights(), channel.parameters());
    let system = normal(channel, &all_terms(channel, theta), &w, true, |_, _, _| ());
    let h = 1e-5;
    let columns: Vec<Vec<f64>> = (0..n)
        .map(|k| {
            let (up, down) = (at(channel, theta, k, h), at(channel, theta, k, -h));
            up.iter().zip(&down).map(|(u, d)| (u - d) / (2.0 * h)).collect()
        })
        .collect();
    let r = residuals(channel, &all_terms(channel, theta), &w);
    for k in 0..n {
        let gradient: f64 = (0..r.len()).map(|i| w[i] * r[i] * columns[k][i]).sum();
        assert!(
            (gradient - system.gradient[k]).abs() < 1e-8,
            "gradient {k}: {gradient} {}",
            system.gradient[k]
        );
        for l in 0..n {
            let product: f64 = (0..r.len()).map(|i| w[i] * columns[k][i] * columns[l][i]).sum();
            let found = system.matrix[k * n + l];
            assert!((product - found).abs() < 1e-8, "matrix {k} {l}: {product} {found}");
        }
    }
}

#[test]
fn the_projected_derivative_is_that_of_finite_differences() {
    compare_with_differences(&channel(), &theta());
}

#[test]
fn so_it_is_where_a_radiance_sits_at_its_bound() {
    let mut channel = channel();
    channel.value[3..5].fill(0.01);
    let r = residuals(&channel, &all_terms(&channel, &theta()), &weights());
    assert!(r[3] < 0.0 && r[4] < 0.0, "the second point is darker than the veil alone");
    compare_with_differences(&channel, &theta());
}

#[test]
fn parts_of_the_points_add_up_and_gains_can_be_left_out() {
    let (channel, w) = (channel(), weights());
    let terms = all_terms(&channel, &theta());
    let mut sum = vec![0.0; channel.parameters()];
    let whole = normal(&channel, &terms, &w, true, |_, index, part| {
        index.iter().zip(part).for_each(|(&k, v)| sum[k] += v);
    });
    assert!(sum.iter().zip(&whole.gradient).all(|(a, b)| (a - b).abs() < 1e-14));
    let shared = normal(&channel, &terms, &w, false, |_, _, _| ());
    let n = channel.parameters();
    for k in 0..n {
        let expected = if k < GAIN { whole.gradient[k] } else { 0.0 };
        assert!((shared.gradient[k] - expected).abs() < 1e-14);
        for l in 0..n {
            // The derivatives of a radiance by the gains do not enter the shared block.
            let expected = if k < GAIN && l < GAIN { whole.matrix[k * n + l] } else { 0.0 };
            assert!((shared.matrix[k * n + l] - expected).abs() < 1e-12, "{k} {l}");
        }
    }
}
