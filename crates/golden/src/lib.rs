//! Test support: golden cases from an independent float64 oracle, compared at the tolerances in the files
//! beside them.
//!
//! A part is `math/<part>.safetensors` with `math/<part>.json`. Tensors have the names `<case>/in.<name>`,
//! `<case>/out.<name>`, `<case>/cot.<out>` and `<case>/grad.<pull>.<input>`. A *pull* is a set of outputs;
//! its gradient is that of the sum of `<cotangent, output>` over the set. The JSON contains each case's
//! configuration and each tensor's absolute tolerance. Tests must loop over [`Part::cases`], so that other
//! cases of the same form can be added.
//!
//! The root is the folder in `USE3D_GOLDEN`, else the copy in the project. All functions here panic with a
//! message if a file or tensor is missing: golden tests never skip.

mod fixtures;
mod mutated;
pub mod torch;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

pub use fixtures::CaseGaussians;
pub use mutated::mutated;

/// The folder with `math/`, `networks/` and `scene-mini/`.
pub fn root() -> PathBuf {
    match std::env::var_os("USE3D_GOLDEN") {
        Some(dir) => PathBuf::from(dir),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden"),
    }
}

/// One safetensors file with its JSON, completely in memory.
pub struct Part {
    tensors: BTreeMap<String, Tensor>,
    info: Value,
    path: PathBuf,
}

struct Tensor {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

/// One case of a part.
pub struct Case<'a> {
    part: &'a Part,
    name: String,
}

impl Part {
    /// Loads `math/<name>`.
    pub fn math(name: &str) -> Self {
        Self::load(&root().join("math").join(format!("{name}.safetensors")))
    }

    /// Loads any safetensors file, with the JSON of the same stem if there is one.
    pub fn load(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("golden file {}: {e}", path.display()));
        let parsed = SafeTensors::deserialize(&bytes)
            .unwrap_or_else(|e| panic!("golden file {}: {e}", path.display()));
        let tensors = parsed
            .iter()
            .map(|(name, view)| {
                let tensor =
                    Tensor { dtype: view.dtype(), shape: view.shape().to_vec(), bytes: view.data().to_vec() };
                (name.to_string(), tensor)
            })
            .collect();
        let json = path.with_extension("json");
        let info = match std::fs::read(&json) {
            Ok(text) => serde_json::from_slice(&text)
                .unwrap_or_else(|e| panic!("golden file {}: {e}", json.display())),
            Err(_) => Value::Null,
        };
        Self { tensors, info, path: path.to_path_buf() }
    }

    /// Every case, by name. Panics if there is none.
    pub fn cases(&self) -> Vec<Case<'_>> {
        let cases =
            self.info["cases"].as_object().unwrap_or_else(|| panic!("{}: no cases", self.path.display()));
        assert!(!cases.is_empty(), "{}: no cases", self.path.display());
        cases.keys().map(|name| Case { part: self, name: name.clone() }).collect()
    }

    /// The whole file as one case with an empty name.
    pub fn whole(&self) -> Case<'_> {
        Case { part: self, name: String::new() }
    }

    /// The JSON beside the file.
    pub fn info(&self) -> &Value {
        &self.info
    }

    /// All tensor names.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }
}

impl Case<'_> {
    /// The case's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its `config` object.
    pub fn config(&self) -> &Value {
        &self.part.info["cases"][&self.name]["config"]
    }

    /// A number of its `config`.
    pub fn number(&self, key: &str) -> f64 {
        self.config()[key].as_f64().unwrap_or_else(|| panic!("{}: config has no number {key}", self.name))
    }

    /// A count of its `config`.
    pub fn count(&self, key: &str) -> usize {
        self.number(key) as usize
    }

    /// Its pulls: the name of each, with the outputs in its sum.
    pub fn pulls(&self) -> BTreeMap<String, Vec<String>> {
        match self.part.info["cases"][&self.name].get("pulls") {
            Some(pulls) => serde_json::from_value(pulls.clone()).expect("pulls map names to lists of names"),
            None => BTreeMap::new(),
        }
    }

    /// The inputs for which it has gradients.
    pub fn grads(&self) -> Vec<String> {
        match self.part.info["cases"][&self.name].get("grads") {
            Some(grads) => serde_json::from_value(grads.clone()).expect("grads is a list of names"),
            None => Vec::new(),
        }
    }

    fn key(&self, tensor: &str) -> String {
        if self.name.is_empty() { tensor.to_string() } else { format!("{}/{tensor}", self.name) }
    }

    /// Returns true if the case has this tensor, e.g. `in.means`.
    pub fn has(&self, tensor: &str) -> bool {
        self.part.tensors.contains_key(&self.key(tensor))
    }

    /// The case's tensor names, without its own name.
    pub fn names(&self) -> Vec<String> {
        let prefix = self.key("");
        self.part.tensors.keys().filter_map(|k| k.strip_prefix(&prefix)).map(str::to_string).collect()
    }

    fn tensor(&self, tensor: &str) -> &Tensor {
        let key = self.key(tensor);
        self.part.tensors.get(&key).unwrap_or_else(|| panic!("{}: no tensor {key}", self.part.path.display()))
    }

    /// The tensor's shape.
    pub fn shape(&self, tensor: &str) -> &[usize] {
        &self.tensor(tensor).shape
    }

    /// The tensor's values as f64, for any element type.
    pub fn f64(&self, tensor: &str) -> Vec<f64> {
        let t = self.tensor(tensor);
        let b = &t.bytes;
        macro_rules! read {
            ($ty:ty) => {
                b.chunks_exact(size_of::<$ty>())
                    .map(|c| <$ty>::from_le_bytes(c.try_into().expect("chunk size")) as f64)
                    .collect()
            };
        }
        match t.dtype {
            Dtype::F64 => read!(f64),
            Dtype::F32 => read!(f32),
            Dtype::I64 => read!(i64),
            Dtype::I32 => read!(i32),
            Dtype::U8 | Dtype::BOOL => read!(u8),
            other => panic!("{tensor}: golden tensors of type {other:?} are not expected"),
        }
    }

    /// The tensor's values as f32 (inputs are exactly representable).
    pub fn f32(&self, tensor: &str) -> Vec<f32> {
        self.f64(tensor).into_iter().map(|v| v as f32).collect()
    }

    /// The values as rows of `N`.
    pub fn rows<const N: usize>(&self, tensor: &str) -> Vec<[f32; N]> {
        let flat = self.f32(tensor);
        assert_eq!(flat.len() % N, 0, "{tensor}: {} values are not rows of {N}", flat.len());
        flat.chunks_exact(N).map(|c| c.try_into().expect("row length")).collect()
    }

    /// An `[H, W, C]` or `[H, W]` tensor as planes: `C` planes of `H × W`, with width and height.
    pub fn planes(&self, tensor: &str) -> (usize, usize, Vec<f32>) {
        let shape = self.shape(tensor).to_vec();
        let (h, w) = (shape[0], shape[1]);
        let c = shape.get(2).copied().unwrap_or(1);
        let flat = self.f32(tensor);
        let mut out = vec![0.0; flat.len()];
        for p in 0..h * w {
            for k in 0..c {
                out[k * h * w + p] = flat[p * c + k];
            }
        }
        (w, h, out)
    }

    /// The stated absolute tolerance of a tensor for a float32 implementation.
    pub fn tolerance(&self, tensor: &str) -> f64 {
        let info = &self.part.info["tensors"][self.key(tensor)];
        info["tol_abs"]
            .as_f64()
            .unwrap_or_else(|| panic!("{}: no tol_abs for {}", self.part.path.display(), self.key(tensor)))
    }

    /// Asserts that `actual` equals the tensor within its stated tolerance, element by element.
    pub fn check(&self, tensor: &str, actual: &[f32]) {
        let actual: Vec<f64> = actual.iter().map(|&v| f64::from(v)).collect();
        self.check_within(tensor, &actual, self.tolerance(tensor));
    }

    /// Like [`Case::check`], for an image as planes (the golden tensor is `[H, W, C]`).
    pub fn check_planes(&self, tensor: &str, planes: &[f32]) {
        let shape = self.shape(tensor);
        let n = shape[0] * shape[1];
        let c = shape.get(2).copied().unwrap_or(1);
        assert_eq!(planes.len(), n * c, "{}: wrong size", self.key(tensor));
        let interleaved: Vec<f32> = (0..n * c).map(|i| planes[(i % c) * n + i / c]).collect();
        self.check(tensor, &interleaved);
    }

    /// Like [`Case::check`], for values computed in f64, with the same float32 tolerance.
    pub fn check_f64(&self, tensor: &str, actual: &[f64]) {
        self.check_within(tensor, actual, self.tolerance(tensor));
    }

    /// Asserts element-wise agreement within `tolerance`; the message names the worst element.
    pub fn check_within(&self, tensor: &str, actual: &[f64], tolerance: f64) {
        let expected = self.f64(tensor);
        let key = self.key(tensor);
        assert_eq!(
            actual.len(),
            expected.len(),
            "{key}: {} values, golden has {}",
            actual.len(),
            expected.len()
        );
        let mut worst = (0usize, 0.0f64);
        for (i, (a, e)) in actual.iter().zip(&expected).enumerate() {
            let error = if a.is_nan() { f64::INFINITY } else { (a - e).abs() };
            if error > worst.1 {
                worst = (i, error);
            }
        }
        assert!(
            worst.1 <= tolerance,
            "{key}: element {} is {:e}, golden {:e}, off by {:.3e}, tolerance {:.3e} (shape {:?})",
            worst.0,
            actual[worst.0],
            expected[worst.0],
            worst.1,
            tolerance,
            self.shape(tensor)
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn golden_files_load_and_a_wrong_value_is_caught() {
        let part = Part::math("sh");
        let cases = part.cases();
        let case = &cases[0];
        let name = case.names().into_iter().find(|n| n.starts_with("out.")).unwrap();
        let mut values = case.f64(&name);
        case.check_f64(&name, &values);
        values[0] += 1.0;
        assert!(std::panic::catch_unwind(|| case.check_f64(&name, &values)).is_err());
    }
}
