//! Media as named tensors, the form in which a scene folder keeps them.
//!
//! `rbf`: `centers [K,3]`, `log_widths [K]`, `coefficients [K,3,16,3]`. `global`: `coefficients [3,16,3]`.
//! `mlp`: `layer0.weight [128,16]`, `layer0.bias [128]`, `layer1…`, `layer2…`. `none` has no tensors.

use std::collections::BTreeMap;

use crate::mlp::SHAPES;
use crate::{MediumError, MediumGlobal, MediumKind, MediumMlp, MediumModel, MediumRbf};

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

/// More anchors than any scene needs: a bound on what a file or a parameter may ask for.
pub const MOST_ANCHORS: usize = 4096;

impl MediumModel {
    /// The model's tensors.
    pub fn to_tensors(&self) -> Tensors {
        let mut tensors = Tensors::new();
        let mut put = |name: &str, shape: &[usize], values: &[f32]| {
            tensors.insert(name.into(), Tensor { shape: shape.to_vec(), values: values.to_vec() });
        };
        match self {
            Self::None => {}
            Self::Global(m) => put("coefficients", &[3, 16, 3], bytemuck::cast_slice(&m.coefficients)),
            Self::Rbf(m) => {
                put("centers", &[m.len(), 3], bytemuck::cast_slice(&m.centers));
                put("log_widths", &[m.len()], &m.log_widths);
                put("coefficients", &[m.len(), 3, 16, 3], bytemuck::cast_slice(&m.coefficients));
            }
            Self::Mlp(m) => {
                for (layer, &(inputs, outputs)) in SHAPES.iter().enumerate() {
                    put(&format!("layer{layer}.weight"), &[outputs, inputs], &m.weights[layer]);
                    put(&format!("layer{layer}.bias"), &[outputs], &m.biases[layer]);
                }
            }
        }
        tensors
    }

    /// The model of `kind` from its tensors; `top_k` matters to `rbf` only. Shapes and finiteness are checked.
    pub fn from_tensors(kind: MediumKind, top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        let get = |name: &str, shape: &[usize]| -> Result<&[f32], MediumError> {
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
        };
        let coefficients = |values: &[f32]| -> Vec<crate::Coefficients> {
            values
                .chunks_exact(144)
                .map(|chunk| bytemuck::pod_read_unaligned(bytemuck::cast_slice(chunk)))
                .collect()
        };
        Ok(match kind {
            MediumKind::None => Self::None,
            MediumKind::Global => {
                let values = coefficients(get("coefficients", &[3, 16, 3])?);
                Self::Global(MediumGlobal { coefficients: values[0] })
            }
            MediumKind::Rbf => {
                let anchors = tensors.get("log_widths").map_or(0, |t| t.values.len());
                if anchors == 0 || anchors > MOST_ANCHORS {
                    return Err(MediumError::Anchors { found: anchors, most: MOST_ANCHORS });
                }
                if top_k == 0 || top_k > anchors {
                    return Err(MediumError::TopK { top_k, anchors });
                }
                let centers = get("centers", &[anchors, 3])?;
                Self::Rbf(MediumRbf {
                    centers: centers.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
                    log_widths: get("log_widths", &[anchors])?.to_vec(),
                    coefficients: coefficients(get("coefficients", &[anchors, 3, 16, 3])?),
                    top_k,
                })
            }
            MediumKind::Mlp => {
                let mut network = MediumMlp::new(0);
                for (layer, &(inputs, outputs)) in SHAPES.iter().enumerate() {
                    network.weights[layer] =
                        get(&format!("layer{layer}.weight"), &[outputs, inputs])?.to_vec();
                    network.biases[layer] = get(&format!("layer{layer}.bias"), &[outputs])?.to_vec();
                }
                Self::Mlp(network)
            }
        })
    }
}
