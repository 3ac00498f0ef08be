//! Small helpers of the unit tests: reproducible noise and the golden files of the networks.

use safetensors::{Dtype, SafeTensors};
use use3d_capture::{Image, Image8};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use crate::engine::planes::Planes;

/// `n` reproducible numbers in [−1, 1).
pub(crate) fn noise(seed: u64, n: usize) -> Vec<f32> {
    let stream = Stream::new(seed, Purpose::new("network test"), 0);
    (0..n as u64).map(|i| (2.0 * stream.uniform(i) - 1.0) as f32).collect()
}

/// A smooth reproducible picture with some noise.
pub(crate) fn picture(seed: u64, width: usize, height: usize) -> Image {
    let grain = noise(seed, 3 * width * height);
    let mut image = Image::new(width, height);
    for (i, v) in image.data_mut().iter_mut().enumerate() {
        let (x, y) = ((i % width) as f32, (i / width % height) as f32);
        let c = (i / (width * height)) as f32;
        let wave = (math::sin(x * 0.11 + c + seed as f32) + math::cos(y * 0.07 - 0.5 * c)) * 0.2;
        *v = (0.5 + wave + 0.05 * grain[i]).clamp(0.0, 1.0);
    }
    image
}

/// One golden file with its stated tolerances.
pub(crate) struct Golden {
    name: String,
    bytes: Vec<u8>,
    metadata: std::collections::HashMap<String, String>,
}

impl Golden {
    pub(crate) fn network(name: &str) -> Self {
        let path = use3d_golden::root().join("networks").join(format!("{name}.safetensors"));
        let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("golden file {}: {e}", path.display()));
        let (_, header) = SafeTensors::read_metadata(&bytes).expect("golden file");
        let metadata = header.metadata().clone().expect("golden metadata");
        Self { name: name.to_string(), bytes, metadata }
    }

    fn file(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.bytes).expect("golden file")
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.file().names().into_iter().map(str::to_string).collect()
    }

    pub(crate) fn meta(&self, key: &str) -> &str {
        self.metadata.get(key).unwrap_or_else(|| panic!("{}: no metadata {key}", self.name))
    }

    pub(crate) fn shape(&self, tensor: &str) -> Vec<usize> {
        self.file().tensor(tensor).unwrap_or_else(|e| panic!("{} {tensor}: {e}", self.name)).shape().to_vec()
    }

    pub(crate) fn values(&self, tensor: &str) -> Vec<f32> {
        let file = self.file();
        let view = file.tensor(tensor).unwrap_or_else(|e| panic!("{} {tensor}: {e}", self.name));
        match view.dtype() {
            Dtype::F32 => view.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Dtype::U8 => view.data().iter().map(|&b| f32::from(b)).collect(),
            other => panic!("{tensor}: {other:?}"),
        }
    }

    /// `[1, C, H, W]` as planes.
    pub(crate) fn planes(&self, tensor: &str) -> Planes {
        let shape = self.shape(tensor);
        let [1, c, h, w] = shape[..] else { panic!("{tensor}: {shape:?}") };
        Planes::from_data(c, h, w, self.values(tensor))
    }

    /// `[1, 3, H, W]` as an image.
    pub(crate) fn image(&self, tensor: &str) -> Image {
        let planes = self.planes(tensor);
        Image::from_planes(planes.width, planes.height, planes.data).expect("three channels")
    }

    /// `[H, W, 3]` bytes.
    pub(crate) fn image8(&self, tensor: &str) -> Image8 {
        let shape = self.shape(tensor);
        let bytes: Vec<u8> = self.values(tensor).iter().map(|&v| v as u8).collect();
        Image8::from_interleaved(shape[1], shape[0], &bytes).expect("three channels")
    }

    /// `[H, W, C]` floats as planes.
    pub(crate) fn interleaved(&self, tensor: &str) -> Vec<f32> {
        let (shape, values) = (self.shape(tensor), self.values(tensor));
        let (n, c) = (shape[0] * shape[1], shape[2]);
        (0..n * c).map(|i| values[(i % n) * c + i / n]).collect()
    }

    /// Asserts agreement with a tensor at its stated tolerance.
    pub(crate) fn check(&self, tensor: &str, actual: &[f32]) {
        let tolerance = self.meta(&format!("tol:{tensor}")).parse().expect("a tolerance");
        self.close(tensor, actual, &self.values(tensor), tolerance);
    }

    pub(crate) fn close(&self, tensor: &str, actual: &[f32], expected: &[f32], tolerance: f64) {
        assert_eq!(actual.len(), expected.len(), "{} {tensor}: {:?}", self.name, self.shape(tensor));
        let mut worst = (0, 0.0f64);
        for (i, (a, e)) in actual.iter().zip(expected).enumerate() {
            let off = if a.is_nan() { f64::INFINITY } else { (f64::from(*a) - f64::from(*e)).abs() };
            if off > worst.1 {
                worst = (i, off);
            }
        }
        println!("{} {tensor}: {:.2e} of {tolerance:.2e}", self.name, worst.1);
        assert!(
            worst.1 <= tolerance,
            "{} {tensor}: element {} is {}, golden {}, off by {:.3e}, tolerance {tolerance:.3e}",
            self.name,
            worst.0,
            actual[worst.0],
            expected[worst.0],
            worst.1
        );
    }
}

/// Every `step`-th channel.
pub(crate) fn every_channel(planes: &Planes, step: usize) -> Vec<f32> {
    (0..planes.channels).step_by(step).flat_map(|c| planes.plane(c).iter().copied()).collect()
}

/// Tokens in columns as the rows of a `[tokens, channels]` matrix; every `step`-th token is kept.
pub(crate) fn token_rows(planes: &Planes, step: usize) -> Vec<f32> {
    let n = planes.area();
    (0..n).step_by(step).flat_map(|t| (0..planes.channels).map(move |c| planes.data[c * n + t])).collect()
}
