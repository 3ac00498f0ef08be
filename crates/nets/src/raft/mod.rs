//! RAFT-Large: optical flow by recurrent refinement of an all-pairs correlation.
//!
//! Features of both pictures at ⅛ resolution are correlated. A recurrent unit reads the correlation around
//! the current estimate and corrects the estimate, 12 times (torchvision's default). The last estimate is
//! upsampled to full resolution by learned convex combinations of neighbouring values. Teed, Deng, "RAFT:
//! Recurrent all-pairs field transforms for optical flow", ECCV 2020; torchvision's `raft_large_*.pth` or
//! Princeton's `raft-*.pth`.

mod correlation;
mod encoder;
mod update;

use use3d_capture::{Image, Raster};

use crate::engine::activation::{self, Activation};
use crate::engine::planes::Planes;
use crate::error::NetError;
use crate::images;
use crate::weights::Weights;
use correlation::Correlation;
use encoder::{Norm, RaftEncoder};
use update::{Update, Upsampler};

const NAME: &str = "RAFT";
/// Smallest side: the coarsest of the four correlation levels must have more than one cell.
const SMALLEST: usize = 128;
const UPDATES: usize = 12;
const HIDDEN: usize = 128;

/// Displacement in pixels per pixel: plane 0 along x, plane 1 along y.
pub type Flow = Raster<f32, 2>;

/// The network with its weights.
#[derive(Clone, Debug)]
pub struct Raft {
    features: RaftEncoder,
    context: RaftEncoder,
    update: Update,
    upsampler: Upsampler,
}

impl Raft {
    /// Reads the network, with tensors by torchvision's names.
    pub fn from_weights(weights: &mut dyn Weights) -> Result<Self, NetError> {
        Ok(Self {
            features: RaftEncoder::read("feature_encoder", Norm::Instance, weights)?,
            context: RaftEncoder::read("context_encoder", Norm::Batch, weights)?,
            update: Update::read(weights)?,
            upsampler: Upsampler::read(weights)?,
        })
    }

    /// The flow from `a` to `b`: pixel p of `a` corresponds to p + flow(p) in `b`. The pictures must have one
    /// size, at least 128 pixels a side.
    pub fn flow(&self, a: &Image, b: &Image) -> Result<Flow, NetError> {
        self.flow_with(a, b, UPDATES)
    }

    /// Like [`flow`](Self::flow), with another number of updates than 12.
    pub fn flow_with(&self, a: &Image, b: &Image, updates: usize) -> Result<Flow, NetError> {
        images::check_pair(NAME, a, b, SMALLEST)?;
        if updates == 0 {
            return Err(NetError::Input { network: NAME, problem: "at least one update is needed".into() });
        }
        let (width, height) = (a.width(), a.height());
        let (full_width, full_height) = (width.next_multiple_of(8), height.next_multiple_of(8));
        let (left, top) = ((full_width - width) / 2, (full_height - height) / 2);
        // Edges are repeated to multiples of 8, half before and the rest after, and the flow is cropped back.
        let fit = |image: &Image| {
            let centred = images::scaled_planes(image, |_, v| (v - 0.5) / 0.5);
            images::pad_edges(&centred, top, left, full_height, full_width)
        };
        let flow = self.forward(&fit(a), &fit(b), updates, &mut |_, _| ());
        let flow = images::crop(&flow, top, left, height, width);
        Flow::from_planes(width, height, flow.data)
            .ok_or(NetError::Input { network: NAME, problem: "the flow has not two channels".into() })
    }

    /// The network alone: pictures in [−1, 1], sides multiples of 8.
    fn forward(
        &self,
        a: &Planes,
        b: &Planes,
        updates: usize,
        probe: &mut dyn FnMut(&str, &Planes),
    ) -> Planes {
        let (fa, fb) = (self.features.forward(a), self.features.forward(b));
        probe("fmap0", &fa);
        probe("fmap1", &fb);
        let (height, width) = (fa.height, fa.width);
        let correlation = Correlation::new(&fa, fb);
        drop(fa);
        let context = self.context.forward(a);
        probe("context", &context);
        let mut hidden = context.slice(0..HIDDEN);
        activation::apply(Activation::Tanh, &mut hidden.data);
        let mut inputs = context.slice(HIDDEN..2 * HIDDEN);
        activation::apply(Activation::Relu, &mut inputs.data);
        drop(context);
        let inputs = self.update.context_part(&inputs);
        let mut flow = Planes::new(2, height, width);
        for step in 0..updates {
            let found = correlation.lookup(&flow);
            let motion = self.update.motion(&found, &flow);
            drop(found);
            if step == 0 {
                probe("motion1", &motion);
            }
            self.update.refine(&mut hidden, &inputs, &motion);
            if step == 0 {
                probe("hidden1", &hidden);
            }
            flow.add(&self.update.step(&hidden));
        }
        let mask = self.upsampler.mask(&hidden);
        probe("mask", &mask);
        update::upsample(&flow, &mask)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::{Golden, every_channel, picture};
    use crate::weights::StandIn;

    fn centred(image: &Image) -> Planes {
        images::scaled_planes(image, |_, v| (v - 0.5) / 0.5)
    }

    #[test]
    fn golden_encoders_lookup_and_first_update() {
        let golden = Golden::network("raft_large");
        let net = Raft::from_weights(&mut StandIn).unwrap();
        let (a, b) = (golden.image("in0"), golden.image("in1"));
        let mut maps = Vec::new();
        let flow = net.forward(&centred(&a), &centred(&b), 1, &mut |name, planes| match name {
            "fmap0" | "fmap1" => maps.extend(every_channel(planes, 16)),
            "context" => golden.check("mid.context", &every_channel(planes, 16)),
            "motion1" | "hidden1" => golden.check(&format!("mid.{name}"), &every_channel(planes, 8)),
            _ => golden.check("mid.mask1", &every_channel(planes, 32)),
        });
        golden.check("mid.fmap", &maps);
        golden.check("flow1", &flow.data);

        let (fa, fb) = (net.features.forward(&centred(&a)), net.features.forward(&centred(&b)));
        let mut offset = Planes::new(2, fa.height, fa.width);
        let area = offset.area();
        offset.data[..area].fill(0.37);
        offset.data[area..].fill(-1.21);
        golden.check("corr_lookup", &every_channel(&Correlation::new(&fa, fb).lookup(&offset), 5));

        let flat = net.features.forward(&golden.planes("flat.in"));
        golden.check("flat.fmap", &every_channel(&flat, 16));
    }

    #[test]
    fn golden_flow_after_two_and_twelve_updates_and_padded() {
        let golden = Golden::network("raft_large");
        let net = Raft::from_weights(&mut StandIn).unwrap();
        let (a, b) = (golden.image("in0"), golden.image("in1"));
        golden.check("flow12", net.flow(&a, &b).unwrap().data());
        let two = net.flow_with(&a, &b, 2).unwrap();
        let mut sampled = Vec::new();
        for c in 0..2 {
            for y in (0..two.height()).step_by(2) {
                sampled.extend(two.row(c, y).iter().step_by(2));
            }
        }
        golden.check("flow2", &sampled);
        let (a, b) = (golden.image8("pad.in0_u8").to_float(), golden.image8("pad.in1_u8").to_float());
        golden.check("pad.flow3", net.flow_with(&a, &b, 3).unwrap().data());
    }

    #[test]
    fn small_or_differing_pictures_are_refused() {
        let net = Raft::from_weights(&mut StandIn).unwrap();
        let (a, b) = (picture(1, 128, 128), picture(2, 136, 128));
        assert!(net.flow(&a, &b).unwrap_err().to_string().contains("differ in size"));
        let small = picture(3, 127, 200);
        assert!(net.flow(&small, &small).unwrap_err().to_string().contains("128x128"));
        assert!(net.flow_with(&a, &a, 0).is_err());
    }
}
