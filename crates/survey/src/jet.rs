//! Numbers that carry their derivatives with respect to two inputs, so that each lens formula is written once
//! and its Jacobian is exact.

use std::ops::{Add, Div, Mul};

use use3d_numerics::math;

/// The operations that a lens formula needs.
pub(crate) trait Real:
    Copy
    + Add<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Add<f64, Output = Self>
    + Mul<f64, Output = Self>
{
    fn value(self) -> f64;
    /// `f(self)`, given `f` and `f'` at this value.
    fn chain(self, f: f64, derivative: f64) -> Self;

    fn sqrt(self) -> Self {
        let root = self.value().sqrt();
        self.chain(root, 0.5 / root)
    }

    fn atan(self) -> Self {
        let x = self.value();
        self.chain(math::atan(x), 1.0 / (1.0 + x * x))
    }
}

impl Real for f64 {
    fn value(self) -> f64 {
        self
    }

    fn chain(self, f: f64, _: f64) -> f64 {
        f
    }
}

/// A value with its derivatives with respect to two inputs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Jet {
    pub(crate) value: f64,
    pub(crate) by: [f64; 2],
}

impl Jet {
    /// The two inputs themselves.
    pub(crate) fn inputs(x: f64, y: f64) -> (Self, Self) {
        (Self { value: x, by: [1.0, 0.0] }, Self { value: y, by: [0.0, 1.0] })
    }

    fn combine(self, other: Self, value: f64, a: f64, b: f64) -> Self {
        Self { value, by: [a * self.by[0] + b * other.by[0], a * self.by[1] + b * other.by[1]] }
    }
}

impl Real for Jet {
    fn value(self) -> f64 {
        self.value
    }

    fn chain(self, f: f64, derivative: f64) -> Self {
        Self { value: f, by: self.by.map(|d| d * derivative) }
    }
}

impl Add for Jet {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        self.combine(o, self.value + o.value, 1.0, 1.0)
    }
}

impl Mul for Jet {
    type Output = Self;
    fn mul(self, o: Self) -> Self {
        self.combine(o, self.value * o.value, o.value, self.value)
    }
}

impl Div for Jet {
    type Output = Self;
    fn div(self, o: Self) -> Self {
        let q = self.value / o.value;
        self.combine(o, q, 1.0 / o.value, -q / o.value)
    }
}

impl Add<f64> for Jet {
    type Output = Self;
    fn add(self, c: f64) -> Self {
        Self { value: self.value + c, ..self }
    }
}

impl Mul<f64> for Jet {
    type Output = Self;
    fn mul(self, c: f64) -> Self {
        self.chain(self.value * c, c)
    }
}
