//! Water that is the same along every ray of a view and differs between views, as in MarineSTD-GS.
//!
//! ```text
//! c_m = σ(p_v)          β_attn = softplus(q_v) / 10          β_bs = softplus(r_v) / 10
//! ```
//!
//! | symbol | meaning | shape |
//! |---|---|---|
//! | v | the training view nearest to the camera: by centre, then by axis | |
//! | p, q, r | free numbers | views × 3 each |
//!
//! Distances count in tenths of scene units. A training view is its own nearest one. All numbers start at 0.

use use3d_capture::{Camera, Lattice, MediumMaps, Pose};
use use3d_numerics::functions::scalar;
use use3d_numerics::sums;

use crate::medium::{Medium, MediumStart, fill};
use crate::tensors::{self, Put, Tensors};
use crate::{MediumError, Role};

/// Scene units in which distances count.
const UNIT: f32 = 10.0;

/// Water of single views.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumPerView {
    /// Centres of the training cameras, normalised scene units.
    pub centers: Vec<[f32; 3]>,
    /// Their viewing axes, unit vectors.
    pub axes: Vec<[f32; 3]>,
    /// p, q and r of every view.
    pub numbers: Vec<[[f32; 3]; 3]>,
}

fn place(pose: &Pose) -> [[f32; 3]; 2] {
    [pose.center(), pose.rotation.row(2)].map(|v| v.to_array().map(|v| v as f32))
}

impl MediumPerView {
    /// The nearest training view of a camera.
    fn view(&self, camera: &Camera) -> usize {
        let [center, axis] = place(&camera.pose);
        let dot = |a: &[f32; 3], b: &[f32; 3]| (0..3).map(|c| a[c] * b[c]).sum::<f32>();
        let far = |view: &usize| {
            let to = std::array::from_fn(|c| self.centers[*view][c] - center[c]);
            (dot(&to, &to), -dot(&self.axes[*view], &axis))
        };
        let nearer = |a: &usize, b: &usize| {
            let ((near_a, turned_a), (near_b, turned_b)) = (far(a), far(b));
            near_a.total_cmp(&near_b).then(turned_a.total_cmp(&turned_b))
        };
        (0..self.centers.len()).min_by(nearer).unwrap_or(0)
    }
}

impl Medium for MediumPerView {
    fn start(start: &MediumStart) -> Result<Self, MediumError> {
        let places: Vec<_> = start.views.iter().map(place).collect();
        if places.is_empty() {
            return Err(MediumError::Views);
        }
        let (centers, axes) = places.iter().map(|[center, axis]| (*center, *axis)).unzip();
        Ok(Self { centers, axes, numbers: vec![[[0.0; 3]; 3]; places.len()] })
    }

    fn maps(&self, camera: &Camera, lattice: &Lattice, _degree: usize, out: &mut MediumMaps) {
        out.resize(lattice.width(), lattice.height());
        let [p, q, r] = self.numbers[self.view(camera)];
        let coefficient = |x: f32| scalar::softplus(x) / UNIT;
        fill(&mut out.color, p.map(scalar::sigmoid));
        fill(&mut out.attenuation, q.map(coefficient));
        fill(&mut out.backscatter, r.map(coefficient));
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
        let [p, q, r] = &mut gradient.numbers[self.view(camera)];
        let sum = |plane: &[f32]| sums::sum(plane.len(), |i| f64::from(plane[i])) as f32;
        for c in 0..3 {
            let color = maps.color.plane(c)[0];
            p[c] += color * (1.0 - color) * sum(d_maps.color.plane(c));
            let of = |map: f32| scalar::softplus_slope(UNIT * map) / UNIT;
            q[c] += of(maps.attenuation.plane(c)[0]) * sum(d_maps.attenuation.plane(c));
            r[c] += of(maps.backscatter.plane(c)[0]) * sum(d_maps.backscatter.plane(c));
        }
    }

    fn groups(&self) -> Vec<(Role, &[f32])> {
        vec![(Role::Constant, self.numbers.as_flattened().as_flattened())]
    }

    fn groups_mut(&mut self) -> Vec<(Role, &mut [f32])> {
        vec![(Role::Constant, self.numbers.as_flattened_mut().as_flattened_mut())]
    }

    fn write(&self, put: Put<'_>) {
        let n = self.centers.len();
        put("centers", &[n, 3], self.centers.as_flattened());
        put("axes", &[n, 3], self.axes.as_flattened());
        put("numbers", &[n, 3, 3], self.numbers.as_flattened().as_flattened());
    }

    fn read(_top_k: usize, tensors: &Tensors) -> Result<Self, MediumError> {
        let n = tensors.get("centers").and_then(|tensor| tensor.shape.first()).copied().unwrap_or(0);
        if n == 0 {
            return Err(MediumError::Views);
        }
        let rows = |values: &[f32]| values.as_chunks::<3>().0.to_vec();
        let numbers = rows(tensors::get(tensors, "numbers", &[n, 3, 3])?);
        Ok(Self {
            centers: rows(tensors::get(tensors, "centers", &[n, 3])?),
            axes: rows(tensors::get(tensors, "axes", &[n, 3])?),
            numbers: numbers.as_chunks::<3>().0.to_vec(),
        })
    }
}
