//! The water of 3D-UIR, for comparison: attenuation is a network of the inverse depth and of a code of the
//! camera's pose, and backscatter has a residual term.
//!
//! ```text
//! e = P p + p₀                      p: the camera's centre and its rotation into the camera, 12 numbers
//! raw(q) = V σ(w q + U e + b) + o   one hidden layer of 32 units, three outputs
//! c_m = σ(·)        k = softplus(·)        R = σ(·)        r = softplus(·)        per channel
//! ```
//!
//! The compositor forms the image (see [`DepthNetwork`]). A view's pose is fixed, so `U e + b` are the
//! biases of its network. Maps show `c_m` and `k`. As attenuation coefficient they show `−ln a` at one scene
//! unit, which no formula uses.

use use3d_capture::{Camera, DEPTH_UNITS, DepthNetwork, Lattice, MediumMaps};
use use3d_numerics::functions::scalar;
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use crate::medium::{Medium, MediumStart, fill};
use crate::tensors::{self, Put, Tensors};
use crate::{MediumError, Role};

/// Numbers of a pose and of its code.
const POSE: usize = 12;
const CODE: usize = 16;

/// The water of 3D-UIR. Weights are row-major `[out][in]`.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumUir {
    /// `c_m`, `k`, `R` and `r` before their functions, `[4][RGB]`.
    pub constants: [[f32; 3]; 4],
    /// `P` and `p₀`: `[16][12]` and `[16]`.
    pub code: (Vec<f32>, Vec<f32>),
    /// `w`: `[32]`.
    pub slopes: Vec<f32>,
    /// `U` and `b`: `[32][16]` and `[32]`.
    pub hidden: (Vec<f32>, Vec<f32>),
    /// `V` and `o`: `[3][32]` and `[3]`.
    pub output: (Vec<f32>, Vec<f32>),
}

impl MediumUir {
    /// Uniform Xavier weights drawn from `seed` and zero biases. The water's colour starts grey, its
    /// coefficients at 0.22 as those of the other waters, and the residual term near zero.
    pub fn new(seed: u64) -> Self {
        let draw = |layer: u64, inputs: usize, outputs: usize, count: usize| {
            let stream = Stream::new(seed, Purpose::new("depth network weights"), layer);
            let bound = (6.0 / (inputs + outputs) as f64).sqrt();
            (0..count).map(|i| ((2.0 * stream.uniform(i as u64) - 1.0) * bound) as f32).collect()
        };
        let into = CODE + 1;
        Self {
            constants: [[0.0; 3], [-1.41; 3], [-4.0; 3], [-1.41; 3]],
            code: (draw(0, POSE, CODE, POSE * CODE), vec![0.0; CODE]),
            slopes: draw(1, into, DEPTH_UNITS, DEPTH_UNITS),
            hidden: (draw(2, into, DEPTH_UNITS, CODE * DEPTH_UNITS), vec![0.0; DEPTH_UNITS]),
            output: (draw(3, DEPTH_UNITS, 3, 3 * DEPTH_UNITS), vec![0.0; 3]),
        }
    }

    /// The code of a camera.
    fn code(&self, pose: &[f32; POSE]) -> Vec<f32> {
        apply(&self.code, pose)
    }

    /// The network of a view.
    fn network(&self, camera: &Camera) -> DepthNetwork {
        let biases = apply(&self.hidden, &self.code(&pose(camera)));
        let [_, veil, residual, rate] = self.constants;
        DepthNetwork {
            share: [1.0; 3],
            veil: veil.map(scalar::softplus),
            residual: residual.map(scalar::sigmoid),
            residual_rate: rate.map(scalar::softplus),
            slopes: std::array::from_fn(|j| self.slopes[j]),
            biases: std::array::from_fn(|j| biases[j]),
            outputs: std::array::from_fn(|j| std::array::from_fn(|c| self.output.0[c * DEPTH_UNITS + j])),
            offsets: std::array::from_fn(|c| self.output.1[c]),
        }
    }

    /// All parameters by their names and shapes.
    fn tensors(&mut self) -> [(&'static str, Vec<usize>, &mut [f32]); 8] {
        let Self { constants, code, slopes, hidden, output } = self;
        [
            ("constants", vec![4, 3], constants.as_flattened_mut()),
            ("code.weight", vec![CODE, POSE], &mut code.0),
            ("code.bias", vec![CODE], &mut code.1),
            ("depth.weight", vec![DEPTH_UNITS], slopes),
            ("hidden.weight", vec![DEPTH_UNITS, CODE], &mut hidden.0),
            ("hidden.bias", vec![DEPTH_UNITS], &mut hidden.1),
            ("output.weight", vec![3, DEPTH_UNITS], &mut output.0),
            ("output.bias", vec![3], &mut output.1),
        ]
    }
}

/// `W x + b`.
fn apply((weights, biases): &(Vec<f32>, Vec<f32>), x: &[f32]) -> Vec<f32> {
    let rows = weights.chunks_exact(x.len()).zip(biases);
    rows.map(|(row, b)| row.iter().zip(x).fold(*b, |sum, (w, x)| sum + w * x)).collect()
}

/// Adds the gradient of [`apply`] to `into`; returns that with respect to `x`.
fn apply_backward(
    (weights, _): &(Vec<f32>, Vec<f32>),
    x: &[f32],
    d_out: &[f32],
    into: &mut (Vec<f32>, Vec<f32>),
) -> Vec<f32> {
    let mut d_x = vec![0.0; x.len()];
    let rows = weights.chunks_exact(x.len()).zip(into.0.chunks_exact_mut(x.len()));
    for ((row, d_row), (d, d_bias)) in rows.zip(d_out.iter().zip(&mut into.1)) {
        *d_bias += d;
        for k in 0..x.len() {
            d_row[k] += d * x[k];
            d_x[k] += d * row[k];
        }
    }
    d_x
}

fn pose(camera: &Camera) -> [f32; POSE] {
    let center = camera.pose.center().to_array();
    let rotation = camera.pose.rotation.transpose().to_cols_array();
    std::array::from_fn(|k| if k < 3 { center[k] as f32 } else { rotation[k - 3] as f32 })
}

impl Medium for MediumUir {
    fn start(start: &MediumStart) -> Result<Self, MediumError> {
        Ok(Self::new(start.seed))
    }

    fn maps(&self, camera: &Camera, lattice: &Lattice, _degree: usize, out: &mut MediumMaps) {
        out.resize(lattice.width(), lattice.height());
        let network = self.network(camera);
        let raw = |c: usize| {
            let units = network.slopes.iter().zip(&network.biases).zip(&network.outputs);
            units.fold(network.offsets[c], |sum, ((w, b), v)| sum + v[c] * scalar::sigmoid(w + b))
        };
        fill(&mut out.color, self.constants[0].map(scalar::sigmoid));
        fill(&mut out.backscatter, network.veil);
        let arriving = |c| scalar::sigmoid(scalar::sigmoid(raw(c)));
        fill(&mut out.attenuation, std::array::from_fn(|c| -math::ln(arriving(c))));
        out.network = Some(Box::new(network));
    }

    fn backward(
        &self,
        camera: &Camera,
        _lattice: &Lattice,
        _degree: usize,
        maps: &MediumMaps,
        d_maps: &MediumMaps,
        gradient: &mut Self,
    ) {
        let (Some(network), Some(d)) = (&maps.network, &d_maps.network) else { return };
        let light = |y: f32| y * (1.0 - y);
        for c in 0..3 {
            let d_color: f64 = d_maps.color.plane(c).iter().map(|v| f64::from(*v)).sum();
            let color = scalar::sigmoid(self.constants[0][c]);
            gradient.constants[0][c] += d_color as f32 * light(color);
            gradient.constants[1][c] += d.veil[c] * scalar::softplus_slope(network.veil[c]);
            gradient.constants[2][c] += d.residual[c] * light(network.residual[c]);
            gradient.constants[3][c] += d.residual_rate[c] * scalar::softplus_slope(network.residual_rate[c]);
            gradient.output.1[c] += d.offsets[c];
            for j in 0..DEPTH_UNITS {
                gradient.output.0[c * DEPTH_UNITS + j] += d.outputs[j][c];
            }
        }
        gradient.slopes.iter_mut().zip(d.slopes).for_each(|(sum, d)| *sum += d);
        let pose = pose(camera);
        let d_code = apply_backward(&self.hidden, &self.code(&pose), &d.biases, &mut gradient.hidden);
        apply_backward(&self.code, &pose, &d_code, &mut gradient.code);
    }

    fn groups(&self) -> Vec<(Role, &[f32])> {
        let Self { constants, code, slopes, hidden, output } = self;
        let network = [&code.0, &code.1, slopes, &hidden.0, &hidden.1, &output.0, &output.1];
        let network = network.map(|values| (Role::Network, values.as_slice()));
        [(Role::Constant, constants.as_flattened())].into_iter().chain(network).collect()
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        let role = |name| if name == "constants" { Role::Constant } else { Role::Network };
        self.tensors().map(|(name, _, values)| (role(name), values)).into()
    }

    fn write(&self, put: Put<'_>) {
        self.clone().tensors().iter().for_each(|(name, shape, values)| put(name, shape, values));
    }

    fn read(_top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        let mut water = Self::new(0);
        for (name, shape, values) in water.tensors() {
            values.copy_from_slice(tensors::get(tensors, name, &shape)?);
        }
        Ok(water)
    }
}
