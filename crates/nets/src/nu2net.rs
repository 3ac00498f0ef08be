//! Nu2Net, the underwater image enhancer behind the proposer: a U-Net with instance normalisation.
//!
//! With Block(a→b) = 3×3 convolution, instance norm (ε 1e-5), ELU:
//!
//! ```text
//! e1 = Block(64→64)(conv 3→64 (x))      e2, e3, e4 = Block(→128, 256, 512) after a 2×2 maximum pool each
//! d4 = up Block(512→256)(e4)            d3 = up Block(256→128)(d4 + e3)
//! d2 = up Block(128→64)(d3 + e2)        y  = x + tanh(conv 16→3 (Block(64→16)(d2 + e1)))
//! ```
//!
//! `up` doubles the size, bilinear with the corners aligned. If any value of y is outside [0, 1], every
//! channel is stretched to [0, 1] by its own extremes. Instance norm uses the whole picture, so a picture
//! must not be tiled, and the result depends on the input's resolution. Source: UnderwaterRanker (AAAI 2023),
//! `NU2Net_ckpt.pth`, and the same network as released with 3D-USE, `uie_proposer.pth`; the two scale their
//! inputs differently ([`InputPolicy`]).

use use3d_capture::{Image, Image8};

use crate::engine::activation::Activation;
use crate::engine::convolution::Convolution;
use crate::engine::normalise;
use crate::engine::planes::Planes;
use crate::engine::pool;
use crate::engine::resample::{Rule, pillow_bilinear, resize};
use crate::error::NetError;
use crate::images;
use crate::weights::{Layers, Weights};

const EPSILON: f64 = 1e-5;
const NAME: &str = "Nu2Net";

/// The scaling of a picture of any size to the network's input, and of the result back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InputPolicy {
    /// As in 3D-USE: the picture is clamped to [0, 1]. If the long side exceeds this many pixels, it is
    /// scaled down to it bilinearly. Edges are repeated to multiples of 8. The result is cropped and resized
    /// back (half-pixel centres). 384 is for scenes, 256 for calibration pairs.
    LongSide(usize),
    /// As in the UnderwaterRanker demo: 8 bits, Pillow's bilinear to multiples of 16, the result resized back
    /// with the corners aligned. Memory grows with the picture: about 1.6 KB per pixel.
    MultiplesOf16,
}

/// The network with its weights.
#[derive(Clone, Debug)]
pub struct Nu2Net {
    first: Convolution,
    encoder: [Convolution; 4],
    decoder: [Convolution; 4],
    output: Convolution,
}

impl Nu2Net {
    /// Reads the ten convolutions.
    pub fn from_weights(weights: &mut dyn Weights) -> Result<Self, NetError> {
        let mut block = |name: &str, outputs, inputs| weights.same_convolution(name, [outputs, inputs], 3);
        let first = block("encoder.e_stage1.0", 64, 3)?;
        let encoder = [
            block("encoder.e_stage1.1.out.0", 64, 64)?,
            block("encoder.e_stage2.1.out.0", 128, 64)?,
            block("encoder.e_stage3.1.out.0", 256, 128)?,
            block("encoder.e_stage4.1.out.0", 512, 256)?,
        ];
        let decoder = [
            block("decoder.d_stage1.0.out.0", 16, 64)?,
            block("decoder.d_stage2.0.out.0", 64, 128)?,
            block("decoder.d_stage3.0.out.0", 128, 256)?,
            block("decoder.d_stage4.0.out.0", 256, 512)?,
        ];
        let output = weights.same_convolution("decoder.output.0", [3, 16], 1)?;
        Ok(Self { first, encoder, decoder, output })
    }

    /// Enhances a picture as 3D-USE does for scenes: [`InputPolicy::LongSide`] with 384 pixels.
    pub fn enhance(&self, image: &Image) -> Result<Image, NetError> {
        self.enhance_with(image, InputPolicy::LongSide(384))
    }

    /// Enhances a picture of at least 16 × 16 pixels, display RGB. The result has the same size and is within
    /// [0, 1] (up to the rounding of the resampling).
    pub fn enhance_with(&self, image: &Image, policy: InputPolicy) -> Result<Image, NetError> {
        images::check(NAME, image, 16)?;
        let (width, height) = (image.width(), image.height());
        match policy {
            InputPolicy::LongSide(side) => {
                let clamped = images::planes(&image.map(|v| v.clamp(0.0, 1.0)));
                let long = width.max(height);
                let small = if long > side {
                    let fit = |n: usize| {
                        let scaled = n as f64 * side as f64 / long as f64;
                        (scaled.round_ties_even() as usize).max(8)
                    };
                    resize(&clamped, fit(height), fit(width), Rule::Bilinear)
                } else {
                    clamped
                };
                let (h, w) = (small.height, small.width);
                let padded = images::pad_edges(&small, 0, 0, h.next_multiple_of(8), w.next_multiple_of(8));
                let enhanced = images::crop(&self.forward(&padded, &mut |_, _| ()), 0, 0, h, w);
                images::image(resize(&enhanced, height, width, Rule::Bilinear))
            }
            InputPolicy::MultiplesOf16 => {
                let fed = feed_multiples_of_16(&image.to_8bit());
                let enhanced = self.forward(&images::planes(&fed.to_float()), &mut |_, _| ());
                images::image(resize(&enhanced, height, width, Rule::BilinearCorners))
            }
        }
    }

    /// The network alone; height and width are multiples of 8.
    fn forward(&self, x: &Planes, probe: &mut dyn FnMut(&str, &Planes)) -> Planes {
        let e1 = block(&self.encoder[0], &self.first.forward(x, Activation::Identity));
        probe("e_stage1", &e1);
        let e2 = block(&self.encoder[1], &pool::maximum(&e1, 2, 2));
        let e3 = block(&self.encoder[2], &pool::maximum(&e2, 2, 2));
        let e4 = block(&self.encoder[3], &pool::maximum(&e3, 2, 2));
        probe("e_stage4", &e4);
        let mut d = double(&block(&self.decoder[3], &e4));
        drop(e4);
        probe("d_stage4", &d);
        for (stage, skip) in [(2, e3), (1, e2)] {
            d.add(&skip);
            drop(skip);
            d = double(&block(&self.decoder[stage], &d));
        }
        d.add(&e1);
        drop(e1);
        let mut y = self.output.forward(&block(&self.decoder[0], &d), Activation::Tanh);
        probe("tanh", &y);
        y.add(x);
        stretch_if_outside(&mut y);
        y
    }
}

fn block(convolution: &Convolution, input: &Planes) -> Planes {
    let mut out = convolution.forward(input, Activation::Identity);
    normalise::instance(&mut out, EPSILON, Activation::Elu);
    out
}

fn double(input: &Planes) -> Planes {
    resize(input, 2 * input.height, 2 * input.width, Rule::BilinearCorners)
}

/// The 8-bit picture at multiples of 16.
fn feed_multiples_of_16(image: &Image8) -> Image8 {
    pillow_bilinear(image, image.width() / 16 * 16, image.height() / 16 * 16)
}

/// If any value is outside [0, 1], every channel is stretched by its own minimum and maximum.
fn stretch_if_outside(y: &mut Planes) {
    if y.data.iter().all(|v| (0.0..=1.0).contains(v)) {
        return;
    }
    let area = y.area();
    for plane in y.data.chunks_exact_mut(area) {
        let low = plane.iter().copied().fold(f32::INFINITY, f32::min);
        let high = plane.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        plane.iter_mut().for_each(|v| *v = (*v - low) / (high - low + 1e-7));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::{Golden, every_channel, picture};
    use crate::weights::StandIn;

    #[test]
    fn golden_network_and_intermediates() {
        let golden = Golden::network("nu2net");
        let net = Nu2Net::from_weights(&mut StandIn).unwrap();
        let out = net.forward(&golden.planes("in"), &mut |name, planes| {
            let step = if name == "tanh" { 1 } else { 8 };
            golden.check(&format!("mid.{name}"), &every_channel(planes, step));
        });
        golden.check("out", &out.data);
        let flat = net.forward(&golden.planes("flat.in"), &mut |name, planes| {
            if name == "e_stage1" {
                let step = planes.channels / golden.shape("flat.e_stage1")[1];
                golden.check("flat.e_stage1", &every_channel(planes, step));
            }
        });
        golden.check("flat.out", &flat.data);
    }

    #[test]
    fn golden_full_pipeline_of_the_demo() {
        let golden = Golden::network("nu2net");
        let raw = golden.image8("raw_u8");
        assert_eq!(feed_multiples_of_16(&raw), golden.image8("net_in_u8"));
        let net = Nu2Net::from_weights(&mut StandIn).unwrap();
        let out = net.enhance_with(&raw.to_float(), InputPolicy::MultiplesOf16).unwrap();
        golden.check("out_full", out.data());
        let bytes = out.map(|v| (v * 255.0).round_ties_even().clamp(0.0, 255.0) as u8);
        let expected = golden.image8("out_u8");
        let differing = bytes.data().iter().zip(expected.data()).filter(|(a, b)| a != b).count();
        assert!(differing * 1000 <= bytes.data().len(), "{differing} bytes differ");
    }

    #[test]
    fn scene_policy_keeps_the_size_and_equals_the_network_on_small_multiples_of_8() {
        let net = Nu2Net::from_weights(&mut StandIn).unwrap();
        let small = picture(3, 40, 24);
        let direct = net.forward(&images::planes(&small), &mut |_, _| ());
        assert_eq!(net.enhance(&small).unwrap().data(), direct.data);
        let odd = net.enhance_with(&picture(4, 101, 67), InputPolicy::LongSide(48)).unwrap();
        assert_eq!((odd.width(), odd.height()), (101, 67));
        assert!(odd.data().iter().all(|v| (-1e-5..=1.0 + 1e-5).contains(v)));
    }

    #[test]
    fn unusable_pictures_are_refused() {
        let net = Nu2Net::from_weights(&mut StandIn).unwrap();
        assert!(net.enhance(&picture(1, 15, 40)).is_err());
        let mut broken = picture(1, 32, 32);
        broken.data_mut()[5] = f32::NAN;
        let message = net.enhance(&broken).unwrap_err().to_string();
        assert!(message.contains("not finite"), "{message}");
    }
}
