//! LPIPS 0.1 with AlexNet: the distance of two pictures in the features of a network trained on photographs.
//!
//! The pictures are mapped from [0, 1] to [−1, 1] and standardised per channel. After each of AlexNet's five
//! convolutions (with ReLU) the features of a pixel are divided by their length, f/(‖f‖ + 1e-10). The
//! distance is `Σ_l mean_pixels Σ_c head_l[c] · (f_l[c] − g_l[c])²`. Zhang, Isola, Efros, Shechtman, Wang,
//! "The unreasonable effectiveness of deep features as a perceptual metric", CVPR 2018. Files: torchvision's
//! AlexNet and the linear heads `alex.pth`.

use rayon::prelude::*;
use use3d_capture::{Image, Map};

use crate::engine::activation::Activation;
use crate::engine::convolution::{Convolution, Padding};
use crate::engine::planes::Planes;
use crate::engine::pool;
use crate::engine::resample::{Rule, resize};
use crate::error::NetError;
use crate::images;
use crate::weights::{Layers, Weights};

const NAME: &str = "LPIPS";
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Name in torchvision's checkpoint, shape, stride, padding; there is a maximum pool before the second and
/// the third.
const LAYERS: [(&str, [usize; 4], usize, usize); 5] = [
    ("features.0", [64, 3, 11, 11], 4, 2),
    ("features.3", [192, 64, 5, 5], 1, 2),
    ("features.6", [384, 192, 3, 3], 1, 1),
    ("features.8", [256, 384, 3, 3], 1, 1),
    ("features.10", [256, 256, 3, 3], 1, 1),
];

/// AlexNet's convolutions with the linear heads.
#[derive(Clone, Debug)]
pub struct Lpips {
    layers: Vec<Convolution>,
    heads: Vec<Vec<f32>>,
}

/// The features of one picture, so that one picture can be compared with many.
#[derive(Clone, Debug)]
pub struct Features {
    width: usize,
    height: usize,
    taps: Vec<Planes>,
}

impl Lpips {
    /// Reads AlexNet from `trunk` and the heads from `heads`.
    pub fn from_weights(trunk: &mut dyn Weights, heads: &mut dyn Weights) -> Result<Self, NetError> {
        let mut net = Self { layers: Vec::new(), heads: Vec::new() };
        for (i, (name, shape, stride, pad)) in LAYERS.into_iter().enumerate() {
            net.layers.push(trunk.convolution(name, shape, stride, Padding::same(pad))?);
            net.heads.push(heads.tensor(&format!("lin{i}.model.1.weight"), &[1, shape[0], 1, 1])?);
        }
        Ok(net)
    }

    /// The distance of two pictures of one size, display RGB in [0, 1], at least 31 pixels a side; 0 for
    /// equal pictures.
    pub fn distance(&self, a: &Image, b: &Image) -> Result<f64, NetError> {
        images::check_pair(NAME, a, b, 31)?;
        self.compare(&self.features(a)?, &self.features(b)?)
    }

    /// The features of a picture, for [`Lpips::compare`].
    pub fn features(&self, image: &Image) -> Result<Features, NetError> {
        images::check(NAME, image, 31)?;
        Ok(self.extract(image, &standardise))
    }

    /// The distance of two pictures by their features.
    pub fn compare(&self, a: &Features, b: &Features) -> Result<f64, NetError> {
        images::same_size(NAME, [a, b].map(|features| (features.width, features.height)))?;
        Ok(self.layer_distances(a, b).iter().sum())
    }

    /// The distance per pixel: each layer's map is resized to the pictures' size (bilinear), and the maps are
    /// summed. Its mean is near, but not equal to, [`Lpips::distance`].
    pub fn distance_map(&self, a: &Image, b: &Image) -> Result<Map, NetError> {
        images::check_pair(NAME, a, b, 31)?;
        let (a, b) = (self.features(a)?, self.features(b)?);
        let mut total = Planes::new(1, a.height, a.width);
        for (layer, head) in self.heads.iter().enumerate() {
            let map = difference(&a.taps[layer], &b.taps[layer], head);
            total.add(&resize(&map, a.height, a.width, Rule::Bilinear));
        }
        images::map(total)
    }

    fn extract(&self, image: &Image, standardise: &dyn Fn(usize, f32) -> f32) -> Features {
        let mut taps: Vec<Planes> = Vec::with_capacity(5);
        for (i, layer) in self.layers.iter().enumerate() {
            let tap = match (i, taps.last()) {
                (_, None) => layer.forward(&images::scaled_planes(image, standardise), Activation::Relu),
                (1 | 2, Some(previous)) => layer.forward(&pool::maximum(previous, 3, 2), Activation::Relu),
                (_, Some(previous)) => layer.forward(previous, Activation::Relu),
            };
            taps.push(tap);
        }
        Features { width: image.width(), height: image.height(), taps }
    }

    fn layer_distances(&self, a: &Features, b: &Features) -> Vec<f64> {
        let mean = |map: &Planes| {
            use3d_numerics::sums::sum(map.data.len(), |i| f64::from(map.data[i])) / map.data.len() as f64
        };
        let layers = self.heads.iter().zip(a.taps.iter().zip(&b.taps));
        layers.map(|(head, (a, b))| mean(&difference(a, b, head))).collect()
    }
}

/// Maps [0, 1] to [−1, 1] and standardises.
fn standardise(channel: usize, v: f32) -> f32 {
    ((2.0 * v - 1.0) - SHIFT[channel]) / SCALE[channel]
}

/// `Σ_c head[c] · (f/(‖f‖ + 1e-10) − g/(‖g‖ + 1e-10))²` per pixel.
fn difference(f: &Planes, g: &Planes, head: &[f32]) -> Planes {
    const BLOCK: usize = 256;
    let area = f.area();
    let mut out = Planes::new(1, f.height, f.width);
    out.data.par_chunks_mut(BLOCK).enumerate().for_each(|(block, out)| {
        let (first, n) = (block * BLOCK, out.len());
        let row = |planes: &Planes, c: usize| -> std::ops::Range<usize> {
            let start = c * planes.area() + first;
            start..start + n
        };
        let reciprocal = |planes: &Planes| {
            let mut squares = [0.0f32; BLOCK];
            for c in 0..planes.channels {
                for (s, v) in squares.iter_mut().zip(&planes.data[row(planes, c)]) {
                    *s += v * v;
                }
            }
            squares.map(|s| 1.0 / (s.sqrt() + 1e-10))
        };
        let (rf, rg) = (reciprocal(f), reciprocal(g));
        for (c, weight) in head.iter().enumerate() {
            debug_assert_eq!(area, g.area());
            let (f, g) = (&f.data[row(f, c)], &g.data[row(g, c)]);
            for i in 0..n {
                let d = f[i] * rf[i] - g[i] * rg[i];
                out[i] += weight * d * d;
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::{Golden, every_channel, picture};
    use crate::weights::StandIn;
    use use3d_numerics::math;

    #[test]
    fn golden_distance_layers_and_intermediates() {
        let golden = Golden::network("lpips_alex");
        let net = Lpips::from_weights(&mut StandIn, &mut StandIn).unwrap();
        let (a, b) = (golden.image("in0"), golden.image("in1"));
        golden.check("mid.scaled", &images::scaled_planes(&a, standardise).data);
        let (fa, fb) = (net.features(&a).unwrap(), net.features(&b).unwrap());
        for (layer, step) in [(1, 8), (2, 8), (5, 4)] {
            golden.check(&format!("mid.relu{layer}"), &every_channel(&fa.taps[layer - 1], step));
        }
        let layers: Vec<f32> = net.layer_distances(&fa, &fb).iter().map(|&d| d as f32).collect();
        golden.check("out_layers", &layers);
        golden.check("out", &[net.distance(&a, &b).unwrap() as f32]);
        golden.check("out_spatial", net.distance_map(&a, &b).unwrap().data());
        let raw = |c: usize, v: f32| (v - SHIFT[c]) / SCALE[c];
        let unnormalised = net.compare(&net.extract(&a, &raw), &net.extract(&b, &raw)).unwrap();
        golden.check("out_unnormalized", &[unnormalised as f32]);
    }

    /// The golden files of the part `metrics` use stand-in weights of their own: sines and cosines of the
    /// flat index, evaluated in f64.
    struct Waves;

    impl Weights for Waves {
        fn tensor(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, NetError> {
            let n: usize = shape.iter().product();
            let head = name.strip_prefix("lin").and_then(|s| s[..1].parse::<f64>().ok());
            let layer = LAYERS.iter().position(|(l, ..)| name.starts_with(&format!("{l}.")));
            let spread = (3.0 / shape[1..].iter().product::<usize>() as f64).sqrt();
            let value = |i: usize| match (head, layer) {
                (Some(l), _) => math::cos(0.11 * i as f64 + l).abs() / n as f64,
                (_, Some(l)) if name.ends_with("weight") => math::sin(0.37 * i as f64 + l as f64) * spread,
                _ => 0.01 * math::cos(i as f64),
            };
            Ok((0..n).map(|i| value(i) as f32).collect())
        }
    }

    #[test]
    fn golden_metrics_lpips() {
        let part = use3d_golden::Part::math("metrics");
        let net = Lpips::from_weights(&mut Waves, &mut Waves).unwrap();
        let mut checked = 0;
        for case in part.cases() {
            if !case.has("out.lpips_masked") {
                continue;
            }
            let masked = |name: &str| {
                let (width, height, mut values) = case.planes(name);
                let mask = case.f32("out.mask");
                values.iter_mut().enumerate().for_each(|(i, v)| *v *= mask[i % (width * height)]);
                Image::from_planes(width, height, values).unwrap()
            };
            let (a, b) = (masked("in.img1"), masked("out.warped"));
            let (a, b) = (net.features(&a).unwrap(), net.features(&b).unwrap());
            case.check_f64("out.lpips_taps", &net.layer_distances(&a, &b));
            case.check_f64("out.lpips_masked", &[net.compare(&a, &b).unwrap()]);
            checked += 1;
        }
        assert!(checked > 0);
    }

    #[test]
    fn equal_pictures_have_no_distance_and_a_change_is_symmetric() {
        let net = Lpips::from_weights(&mut StandIn, &mut StandIn).unwrap();
        let (a, b) = (picture(1, 64, 48), picture(2, 64, 48));
        assert_eq!(net.distance(&a, &a).unwrap(), 0.0);
        assert!(net.distance(&a, &b).unwrap() > 1e-4);
        assert_eq!(net.distance(&a, &b).unwrap(), net.distance(&b, &a).unwrap());
        assert!(net.distance(&a, &picture(1, 64, 47)).unwrap_err().to_string().contains("differ in size"));
        assert!(net.distance(&picture(1, 30, 64), &picture(1, 30, 64)).is_err());
        net.distance(&picture(1, 31, 31), &picture(2, 31, 31)).unwrap();
    }
}
