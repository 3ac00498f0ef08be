//! An [`Enhancement`] as safetensors.
//!
//! | tensor | shape | |
//! |---|---|---|
//! | `factors` | `[4, G, R]` | x, y, z, guide |
//! | `decoder.hidden.weight`, `decoder.hidden.bias` | `[W, R]`, `[W]` | first layer, SiLU after it |
//! | `decoder.output.weight`, `decoder.output.bias` | `[6, W]`, `[6]` | log-gain RGB, bias RGB |
//! | `guide` | `[4]` | `w_r, w_g, w_b, b` |
//! | `affine` | `[3, 4]` | scene affine minus the identity, bias in the last column |
//! | `transport` | `[2]` | `u_bs`, `u_attn` |
//! | `box` | `[2, 3]` | lower and upper corner of the field |
//! | `centre` | `[6]` | the removed constant mode |
//!
//! The file does not hold the appearance and the share of water in which the field was learnt
//! ([`Enhancement::appearance`], [`Enhancement::kept_water`]). A reader that has them sets them; otherwise
//! the share is all of the water. All tensors are f32, little-endian. An unknown tensor is an error,
//! because a file with more information than this version uses would be read wrongly.

use std::ops::Range;

use use3d_capture::{Appearance, KeptWater};
use use3d_tensors::{TensorFile, TensorWriter};

use crate::OUTPUTS;
use crate::enhancement::Enhancement;
use crate::field::{Field, FieldError, Shape};
use crate::field_box::FieldBox;

/// An error in a `ubaf.safetensors`.
#[derive(Debug, thiserror::Error)]
pub enum TensorError {
    /// The tensors are not those of a U-BAF.
    #[error(transparent)]
    Tensors(#[from] use3d_tensors::TensorError),
    /// The corners do not span a box.
    #[error("tensor `box` has corners {low:?} and {high:?}; expected low < high on every axis")]
    Box {
        /// Lower corner.
        low: [f32; 3],
        /// Upper corner.
        high: [f32; 3],
    },
    /// A size is outside the supported range.
    #[error(transparent)]
    Field(#[from] FieldError),
}

/// A group of parameters: name, range in the flat parameter vector, shape.
type Group = (&'static str, Range<usize>, Vec<usize>);

fn groups(shape: Shape) -> [Group; 8] {
    let Shape { resolution, rank, width } = shape;
    [
        ("factors", shape.factors(), vec![4, resolution, rank]),
        ("decoder.hidden.weight", shape.hidden_weight(), vec![width, rank]),
        ("decoder.hidden.bias", shape.hidden_bias(), vec![width]),
        ("decoder.output.weight", shape.output_weight(), vec![OUTPUTS, width]),
        ("decoder.output.bias", shape.output_bias(), vec![OUTPUTS]),
        ("guide", shape.guide(), vec![4]),
        ("affine", shape.affine(), vec![3, 4]),
        ("transport", shape.transport(), vec![2]),
    ]
}

impl Enhancement {
    /// The bytes of the file.
    pub fn to_safetensors(&self) -> Result<Vec<u8>, TensorError> {
        let corners = [self.field.bounds.low, self.field.bounds.high];
        let mut writer = TensorWriter::new();
        for (name, range, shape) in groups(self.field.shape()) {
            writer.f32(name, &shape, &self.field.parameters[range]);
        }
        writer.f32("box", &[2, 3], corners.as_flattened());
        writer.f32("centre", &[OUTPUTS], &self.centre);
        Ok(writer.finish()?)
    }

    /// Reads an enhancement from the bytes of a file.
    pub fn from_safetensors(data: &[u8]) -> Result<Self, TensorError> {
        let file = TensorFile::read(data)?;
        let grids = "[4, nodes, rank]";
        let [four, resolution, rank] = file.sides("factors", grids)?;
        if four != 4 {
            let (name, found) = ("factors".into(), vec![four, resolution, rank]);
            return Err(use3d_tensors::TensorError::Shape { name, found, expected: grids.into() }.into());
        }
        let [width] = file.sides("decoder.hidden.bias", "[width]")?;
        let shape = Shape { resolution, rank, width };
        shape.validate()?;
        let mut parameters = Vec::with_capacity(shape.parameters());
        let known = groups(shape);
        for (name, _, dimensions) in &known {
            parameters.extend(file.f32(name, dimensions)?);
        }
        let corners = file.f32("box", &[2, 3])?;
        let bounds = FieldBox {
            low: std::array::from_fn(|a| corners[a]),
            high: std::array::from_fn(|a| corners[3 + a]),
        };
        if !bounds.is_valid() {
            return Err(TensorError::Box { low: bounds.low, high: bounds.high });
        }
        let centre = file.f32("centre", &[OUTPUTS])?;
        let is_known = |name: &str| name == "box" || name == "centre" || known.iter().any(|g| g.0 == name);
        file.only(is_known)?;
        Ok(Self {
            field: Field::from_parameters(shape, bounds, parameters)?,
            centre: std::array::from_fn(|o| centre[o]),
            appearance: Appearance::default(),
            kept_water: KeptWater::ALL,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example() -> Enhancement {
        let shape = Shape { resolution: 5, rank: 3, width: 7 };
        let bounds = FieldBox { low: [-1.0, 0.0, 1.0], high: [1.0, 2.0, 3.5] };
        let mut field = Field::identity(shape, bounds, 9).unwrap();
        for (i, p) in field.parameters.iter_mut().enumerate() {
            *p += i as f32 * 1e-3;
        }
        let centre = [0.1, 0.2, 0.3, -0.1, -0.2, -0.3];
        Enhancement { field, centre, appearance: Appearance::Water, kept_water: KeptWater::ALL }
    }

    #[test]
    fn a_file_gives_back_what_was_written() {
        let e = example();
        let data = e.to_safetensors().unwrap();
        assert_eq!(Enhancement::from_safetensors(&data).unwrap(), e);
    }

    #[test]
    fn every_prefix_of_a_file_is_an_error_and_none_a_panic() {
        let data = example().to_safetensors().unwrap();
        for end in 0..data.len() {
            assert!(Enhancement::from_safetensors(&data[..end]).is_err(), "prefix of {end} bytes");
        }
    }

    #[test]
    fn wrong_contents_are_named() {
        let write = |tensors: Vec<(&str, Vec<usize>, Vec<f32>)>| {
            let mut writer = TensorWriter::new();
            tensors.iter().for_each(|(name, shape, values)| writer.f32(name, shape, values));
            writer.finish().unwrap()
        };
        let e = example();
        let all = || -> Vec<(&str, Vec<usize>, Vec<f32>)> {
            let mut t: Vec<_> = groups(e.field.shape())
                .into_iter()
                .map(|(n, r, s)| (n, s, e.field.parameters[r].to_vec()))
                .collect();
            t.push(("box", vec![2, 3], vec![0.0, 0.0, 0.0, 1.0, 1.0, 1.0]));
            t.push(("centre", vec![6], vec![0.0; 6]));
            t
        };
        let message = |t| Enhancement::from_safetensors(&write(t)).unwrap_err().to_string();
        let mut t = all();
        t.retain(|t| t.0 != "guide");
        assert!(message(t).contains("`guide` is missing"));
        let mut t = all();
        t[6] = ("affine", vec![4, 3], vec![0.0; 12]);
        assert!(message(t).contains("`affine` has shape [4, 3]"));
        let mut t = all();
        t[5].2[1] = f32::NAN;
        assert!(message(t).contains("`guide` is NaN at flat index 1"));
        let mut t = all();
        t[8].2[0] = 2.0;
        assert!(message(t).contains("box"));
        let mut t = all();
        t.push(("extra", vec![1], vec![0.0]));
        assert!(message(t).contains("`extra`"));
    }
}
