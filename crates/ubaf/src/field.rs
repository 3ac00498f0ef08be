//! The trainable parameters of U-BAF in one flat vector, so that one optimiser and one checkpoint record
//! hold them all.
//!
//! | group | shape | meaning | start |
//! |---|---|---|---|
//! | `factors` | `[4, G, R]` | one-dimensional factor grids over x, y, z and the guide | 1 + 0.01 N(0,1) |
//! | `hidden_weight`, `hidden_bias` | `[W, R]`, `[W]` | first decoder layer, then SiLU | uniform in ±1/√R |
//! | `output_weight`, `output_bias` | `[6, W]`, `[6]` | second layer: log-gain RGB, bias RGB | 0 |
//! | `guide` | `[4]` | `w_r, w_g, w_b, b` of `γ = tanh(w·h + b)` | ⅓, ⅓, ⅓, 0 |
//! | `affine` | `[3, 4]` | scene-global affine minus the identity, `(δA | b_g)` row by row | 0 |
//! | `transport` | `[2]` | `u_bs`, `u_attn`; a ratio is `exp(ln 4 · tanh u)` (R24) | 0 |
//!
//! Node `j` of a grid lies at `-1 + 2j/(G-1)`.
//!
//! With a zero second layer, affine and transport, the enhanced scene is exactly the reconstruction.
//!
//! The `output_bias` has no effect once the constant mode is removed. Its gradient is zero by construction
//! and is written as zero, because summing it would give rounding noise, which Adam's normalisation turns
//! into a random walk.

use std::ops::Range;

use use3d_numerics::random::{Purpose, Stream};

use crate::OUTPUTS;
use crate::field_box::FieldBox;

/// The sizes of a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Nodes per axis `G`, 2 to 256.
    pub resolution: usize,
    /// Rank `R` of the factorisation, 1 to 16.
    pub rank: usize,
    /// Hidden width `W` of the decoder, 1 to 1024.
    pub width: usize,
}

impl Default for Shape {
    /// The sizes of the method: 16 nodes, rank 8, width 64.
    fn default() -> Self {
        Self { resolution: 16, rank: 8, width: 64 }
    }
}

/// A reason why a field cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FieldError {
    /// A size is outside its range.
    #[error("U-BAF {what} is {value}; expected {low} to {high}")]
    Size {
        /// `resolution`, `rank` or `width`.
        what: &'static str,
        /// Value found.
        value: usize,
        /// Smallest allowed.
        low: usize,
        /// Largest allowed.
        high: usize,
    },
    /// The number of parameters does not match the shape.
    #[error("{found} U-BAF parameters; a field of this shape has {expected}")]
    Length {
        /// Number found.
        found: usize,
        /// Number expected.
        expected: usize,
    },
}

/// Largest rank for which the kernels are built.
pub(crate) const MAX_RANK: usize = 16;

impl Shape {
    /// Checks that every size is in its range.
    pub fn validate(&self) -> Result<(), FieldError> {
        for (what, value, low, high) in [
            ("resolution", self.resolution, 2, 256),
            ("rank", self.rank, 1, MAX_RANK),
            ("width", self.width, 1, 1024),
        ] {
            if !(low..=high).contains(&value) {
                return Err(FieldError::Size { what, value, low, high });
            }
        }
        Ok(())
    }

    /// Length of the flat parameter vector.
    pub fn parameters(&self) -> usize {
        self.transport().end
    }

    /// Range of `factors [4, G, R]` in the flat vector.
    pub fn factors(&self) -> Range<usize> {
        0..4 * self.resolution * self.rank
    }

    /// Range of `hidden_weight [W, R]`.
    pub fn hidden_weight(&self) -> Range<usize> {
        after(self.factors(), self.width * self.rank)
    }

    /// Range of `hidden_bias [W]`.
    pub fn hidden_bias(&self) -> Range<usize> {
        after(self.hidden_weight(), self.width)
    }

    /// Range of `output_weight [6, W]`.
    pub fn output_weight(&self) -> Range<usize> {
        after(self.hidden_bias(), OUTPUTS * self.width)
    }

    /// Range of `output_bias [6]`.
    pub fn output_bias(&self) -> Range<usize> {
        after(self.output_weight(), OUTPUTS)
    }

    /// Range of `guide [4]`.
    pub fn guide(&self) -> Range<usize> {
        after(self.output_bias(), 4)
    }

    /// Range of `affine [3, 4]`.
    pub fn affine(&self) -> Range<usize> {
        after(self.guide(), 12)
    }

    /// Range of `transport [2]`: the last group, so that all earlier parameters share one learning rate.
    pub fn transport(&self) -> Range<usize> {
        after(self.affine(), 2)
    }
}

fn after(previous: Range<usize>, length: usize) -> Range<usize> {
    previous.end..previous.end + length
}

/// The field: parameters and the box that maps positions to coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    shape: Shape,
    /// The box by which positions are normalised.
    pub bounds: FieldBox,
    /// All trainable numbers, in the layout of [`Shape`].
    pub parameters: Vec<f32>,
}

const FACTORS: Purpose = Purpose::new("U-BAF factors");
const HIDDEN: Purpose = Purpose::new("U-BAF hidden layer");

impl Field {
    /// The field at the start of Stage 2: an exact identity.
    pub fn identity(shape: Shape, bounds: FieldBox, seed: u64) -> Result<Self, FieldError> {
        shape.validate()?;
        let mut parameters = vec![0.0f32; shape.parameters()];
        let factors = Stream::new(seed, FACTORS, 0);
        for (i, p) in parameters[shape.factors()].iter_mut().enumerate() {
            *p = (1.0 + 0.01 * factors.normal(i as u64)) as f32;
        }
        let hidden = Stream::new(seed, HIDDEN, 0);
        let reach = 1.0 / (shape.rank as f64).sqrt();
        let layer = shape.hidden_weight().start..shape.hidden_bias().end;
        for (i, p) in parameters[layer].iter_mut().enumerate() {
            *p = (reach * (2.0 * hidden.uniform(i as u64) - 1.0)) as f32;
        }
        parameters[shape.guide()].copy_from_slice(&[1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0, 0.0]);
        Ok(Self { shape, bounds, parameters })
    }

    /// A field with given parameters.
    pub fn from_parameters(shape: Shape, bounds: FieldBox, parameters: Vec<f32>) -> Result<Self, FieldError> {
        shape.validate()?;
        if parameters.len() != shape.parameters() {
            return Err(FieldError::Length { found: parameters.len(), expected: shape.parameters() });
        }
        Ok(Self { shape, bounds, parameters })
    }

    /// The sizes.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// `w_r, w_g, w_b, b`.
    pub fn guide(&self) -> [f32; 4] {
        let start = self.shape.guide().start;
        std::array::from_fn(|i| self.parameters[start + i])
    }

    /// The scene-global affine minus the identity, rows `(δA | b_g)`.
    pub fn affine(&self) -> [[f32; 4]; 3] {
        let start = self.shape.affine().start;
        std::array::from_fn(|r| std::array::from_fn(|c| self.parameters[start + 4 * r + c]))
    }

    /// `u_bs`, `u_attn`.
    pub fn transport(&self) -> [f32; 2] {
        let start = self.shape.transport().start;
        [self.parameters[start], self.parameters[start + 1]]
    }

    /// True if every parameter is finite.
    pub fn is_finite(&self) -> bool {
        self.parameters.iter().all(|p| p.is_finite())
    }
}

/// `∂L/∂` every parameter, accumulated in f64 in a fixed order, in the layout of [`Shape`].
#[derive(Clone, Debug, PartialEq)]
pub struct Gradient {
    shape: Shape,
    /// The accumulated derivatives.
    pub values: Vec<f64>,
}

impl Gradient {
    /// Zeros for a shape.
    pub fn new(shape: Shape) -> Self {
        Self { shape, values: vec![0.0; shape.parameters()] }
    }

    /// Sets all values to zero.
    pub fn clear(&mut self) {
        self.values.fill(0.0);
    }

    /// The sizes.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Writes the values, rounded to f32, to `out`, which has the same length.
    pub fn round_into(&self, out: &mut [f32]) {
        for (o, &g) in out.iter_mut().zip(&self.values) {
            *o = g as f32;
        }
    }

    /// Adds derivatives to those in a range.
    pub(crate) fn add(&mut self, range: Range<usize>, derivatives: &[f64]) {
        for (g, d) in self.values[range].iter_mut().zip(derivatives) {
            *g += d;
        }
    }
}

/// `(I + δA) c + b_g` by rows, computed as `c + (δA c + b_g)`, so that zero parameters change no bit of a
/// non-negative colour.
#[inline(always)]
pub(crate) fn apply_affine(affine: &[[f32; 4]; 3], c: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|r| {
        let [x, y, z, b] = affine[r];
        c[r] + x.mul_add(c[0], y.mul_add(c[1], z.mul_add(c[2], b)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_tile_the_parameter_vector() {
        let s = Shape { resolution: 5, rank: 3, width: 7 };
        let groups = [
            s.factors(),
            s.hidden_weight(),
            s.hidden_bias(),
            s.output_weight(),
            s.output_bias(),
            s.guide(),
            s.affine(),
            s.transport(),
        ];
        assert_eq!(groups.iter().map(ExactSizeIterator::len).sum::<usize>(), s.parameters());
        assert!(groups.windows(2).all(|w| w[0].end == w[1].start));
        // The authors' number of parameters for the default sizes, plus the two transport scalars.
        assert_eq!(Shape::default().parameters(), 1494 + 2);
    }

    #[test]
    fn sizes_out_of_range_are_named() {
        for (shape, word) in [
            (Shape { resolution: 1, ..Shape::default() }, "resolution"),
            (Shape { rank: 17, ..Shape::default() }, "rank"),
            (Shape { width: 0, ..Shape::default() }, "width"),
        ] {
            let error = Field::identity(shape, FieldBox::UNIT, 0).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
        assert!(Field::from_parameters(Shape::default(), FieldBox::UNIT, vec![0.0; 3]).is_err());
    }

    #[test]
    fn another_seed_gives_another_start() {
        let make = |seed| Field::identity(Shape::default(), FieldBox::UNIT, seed).unwrap();
        assert_eq!(make(1), make(1));
        assert_ne!(make(1).parameters, make(2).parameters);
        assert!(make(1).parameters[Shape::default().output_weight()].iter().all(|&w| w == 0.0));
    }
}
