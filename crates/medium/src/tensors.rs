//! Media as named tensors, the form in which a scene folder stores them.
//!
//! `rbf`: `centers [K,3]`, `log_widths [K]`, `coefficients [K,3,16,3]`. `global` and
//! `image`: `coefficients [3,16,3]`. `mlp`: `layer0.weight [128,16]`, `layer0.bias [128]`, `layer1…`,
//! `layer2…`. `per-view`: `centers [N,3]`, `axes [N,3]`, `numbers [N,3,3]`. `seasplat`: `far [3]`,
//! `backscatter [3]`, `attenuation [3]`. `uir`: `constants [4,3]`, `code.weight [16,12]`, `code.bias [16]`,
//! `depth.weight [32]`, `hidden.weight [32,16]`, `hidden.bias [32]`, `output.weight [3,32]`,
//! `output.bias [3]`. `none` has no tensors.

use std::collections::BTreeMap;

use crate::{Coefficients, MediumError};

/// An f32 tensor: shape and row-major values.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Sides.
    pub shape: Vec<usize>,
    /// Values.
    pub values: Vec<f32>,
}

/// Named tensors, in name order.
pub type Tensors = BTreeMap<String, Tensor>;

/// The largest number of anchors that a file or a parameter may request; no scene needs more.
pub const MOST_ANCHORS: usize = 4096;

/// A function that receives a model's tensors: name, shape, values.
pub(crate) type Put<'a> = &'a mut dyn FnMut(&str, &[usize], &[f32]);

/// Returns the values of a tensor, after checking its shape and that all values are finite.
pub(crate) fn get<'a>(tensors: &'a Tensors, name: &str, shape: &[usize]) -> Result<&'a [f32], MediumError> {
    let tensor = tensors.get(name).ok_or_else(|| MediumError::Missing { name: name.into() })?;
    if tensor.shape != shape || tensor.values.len() != shape.iter().product::<usize>() {
        return Err(MediumError::Shape {
            name: name.into(),
            found: tensor.shape.clone(),
            expected: shape.to_vec(),
        });
    }
    match tensor.values.iter().position(|v| !v.is_finite()) {
        Some(index) => Err(MediumError::NotFinite { name: name.into(), index }),
        None => Ok(&tensor.values),
    }
}

/// Splits values into sets of coefficients.
pub(crate) fn coefficients(values: &[f32]) -> Vec<Coefficients> {
    values.chunks_exact(144).map(|chunk| bytemuck::pod_read_unaligned(bytemuck::cast_slice(chunk))).collect()
}
