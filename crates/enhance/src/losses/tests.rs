use proptest::prelude::*;
use use3d_numerics::random::{Purpose, Stream};

use use3d_atc::extractor::Affine;

use super::*;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20))]
    #[test]
    fn derivatives_are_differences(seed in 0u64..1 << 40, cells in 1usize..30) {
        let draw = Stream::new(seed, Purpose::new("objective"), 0);
        let n = |i: usize| draw.normal(i as u64);
        let t: Affine = std::array::from_fn(n);
        let target: Affine = std::array::from_fn(|i| n(100 + i));
        let scales: [f64; 12] = std::array::from_fn(|i| 0.2 + n(200 + i).abs());
        let mut gradient = [0.0; 12];
        global_loss(&t, &target, &scales, 1.7, &mut gradient);
        let h = 1e-6;
        for q in 0..12 {
            let at = |d: f64| {
                let mut moved = t;
                moved[q] += d;
                1.7 * global_loss(&moved, &target, &scales, 1.7, &mut [0.0; 12]).loss
            };
            prop_assert!(((at(h) - at(-h)) / (2.0 * h) - gradient[q]).abs() < 1e-5);
        }
        let rows = |at: usize| -> Vec<[f64; 6]> {
            (0..cells).map(|p| std::array::from_fn(|q| n(at + 6 * p + q))).collect()
        };
        let (delta, wanted) = (rows(1000), rows(2000));
        let support: Vec<f64> = (0..cells).map(|p| draw.uniform(5000 + p as u64)).collect();
        let scales: [f64; 6] = std::array::from_fn(|i| 0.2 + n(300 + i).abs());
        let mut gradient = Vec::new();
        local_loss(&mut delta.clone(), &wanted, &support, &scales, 0.6, &mut gradient);
        for p in 0..cells {
            for q in 0..6 {
                let at = |d: f64| {
                    let mut moved = delta.clone();
                    moved[p][q] += d;
                    0.6 * local_loss(&mut moved, &wanted, &support, &scales, 0.6, &mut Vec::new()).loss
                };
                prop_assert!(((at(h) - at(-h)) / (2.0 * h) - gradient[p][q]).abs() < 1e-5);
            }
        }
    }
}

#[test]
fn nothing_seen_is_no_loss_and_no_gradient() {
    let mut gradient = Vec::new();
    let mut cells = vec![[1.0; 6], [3.0; 6]];
    let r = local_loss(&mut cells, &[[9.0; 6]; 2], &[0.0; 2], &[1.0; 6], 1.0, &mut gradient);
    assert_eq!((r.loss, r.error), (0.0, 0.0));
    assert!(gradient.iter().flatten().all(|&b| b == 0.0));
}

/// The log line of a step and the report of a view have the same form as before the table existed: the same
/// names in the same order.
#[test]
fn lines_and_reports_follow_the_table() {
    use crate::report::{LogEntry, ViewErrors};
    let value = |k: f64| Realised { loss: k, error: k + 0.5 };
    let entry = LogEntry { step: 7, loss: 9.0, terms: [value(1.0), value(2.0), value(3.0), value(4.0)] };
    assert_eq!(
        entry.to_json(),
        r#"{"step":7,"loss":9.0,"global":1.0,"local":2.0,"pixels":3.0,"variation":4.0,"global_error":1.5,"local_error":2.5}"#
    );
    let json = |values: Values| serde_json::to_string(&ViewErrors(values)).unwrap();
    assert_eq!(
        json([Some(value(1.0)), None, None, Some(value(4.0))]),
        r#"{"global":{"loss":1.0,"error":1.5},"local":null,"pixels":0.0}"#
    );
    assert_eq!(json([None, None, Some(value(0.25)), None]), r#"{"global":null,"local":null,"pixels":0.25}"#);
}
