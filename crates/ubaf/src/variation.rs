//! Total variation of the factors: `L_TV = mean |f[j+1] - f[j]|` over all neighbours, ranks and the four
//! grids.

use crate::field::{Field, Gradient};

/// Computes `L_TV`.
pub fn forward(field: &Field) -> f64 {
    let mut total = 0.0;
    each(field, |_, _, difference| total += f64::from(difference).abs());
    total / count(field)
}

/// Adds `weight · ∂L_TV/∂factors` (0 where two neighbours are equal).
pub fn backward(field: &Field, weight: f64, gradient: &mut Gradient) {
    let step = weight / count(field);
    let start = field.shape().factors().start;
    each(field, |low, high, difference| {
        if difference != 0.0 {
            let g = step * f64::from(difference).signum();
            gradient.values[start + high] += g;
            gradient.values[start + low] -= g;
        }
    });
}

fn count(field: &Field) -> f64 {
    let shape = field.shape();
    (4 * (shape.resolution - 1) * shape.rank) as f64
}

/// Calls `visit(index of f[j], index of f[j+1], f[j+1] - f[j])` for every neighbouring pair.
fn each(field: &Field, mut visit: impl FnMut(usize, usize, f32)) {
    let shape = field.shape();
    let factors = &field.parameters[shape.factors()];
    for axis in 0..4 {
        for node in 0..shape.resolution - 1 {
            for r in 0..shape.rank {
                let low = (axis * shape.resolution + node) * shape.rank + r;
                let high = low + shape.rank;
                visit(low, high, factors[high] - factors[low]);
            }
        }
    }
}
