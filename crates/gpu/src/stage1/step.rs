//! Records one step into one pass, and draws a view with the present state.

use use3d_capture::{Camera, Lattice};
use use3d_reconstruct::engine::{Degrees, StepPlan, StepReport};
use use3d_training::EngineError;

use super::stored::Floats;
use super::{Asked, RING, Stage1};
use crate::constants::{StepConstants, counts};
use crate::kernel::submit;
use crate::losses::{LossInput, LossOutput, LossPlan, VALUES};
use crate::raster::Outputs;
use crate::update::COLOR_PULL;

/// Makes the report of a step from the numbers that the device wrote.
pub(super) fn report(asked: &Asked, numbers: &[f32], has_prior: bool) -> StepReport {
    let Asked { view, plan, .. } = asked;
    let told = |name: &str| VALUES.iter().position(|v| *v == name).map(|at| f64::from(numbers[1 + at]));
    let weighs = |name: &str| {
        use3d_reconstruct::losses::names().zip(&plan.weights).any(|(n, w)| n == name && *w != 0.0)
    };
    // Both values of the photometric term are reported if one of them has a weight.
    let photometric = weighs("reg_l1") || weighs("reg_ms_ssim");
    let values = use3d_reconstruct::losses::names()
        .map(|name| match name {
            "reg_l1" | "reg_ms_ssim" => told(name).filter(|_| photometric),
            _ => told(name).filter(|_| has_prior && weighs(name)),
        })
        .collect();
    StepReport {
        step: plan.step,
        view: *view,
        loss: numbers[0].into(),
        values,
        psnr: photometric.then(|| use3d_metrics::decibels(numbers[4].into()).ok()).flatten(),
        non_finite: None,
    }
}

impl Stage1 {
    /// Prepares everything for a view with these outputs, and writes the constants.
    fn prepare(
        &mut self,
        constants: StepConstants,
        lattice: &Lattice,
        outputs: Outputs,
    ) -> Result<(), EngineError> {
        let gpu = &self.gpu;
        self.lists.prepare(gpu, &constants, lattice)?;
        self.compositor.grow(gpu, constants.pixels(), outputs)?;
        if outputs == Outputs::Training {
            self.image_slope.grow(gpu, 3 * constants.pixels())?;
            self.depth_slope.grow(gpu, constants.pixels())?;
            self.color_pull.grow(gpu, COLOR_PULL * constants.gaussians())?;
        }
        self.constants.write(gpu, 0, &[constants]);
        Ok(())
    }

    /// Submits a step.
    pub(super) fn ask(&mut self, view: usize, plan: StepPlan) -> Result<(), EngineError> {
        let weights = LossPlan::weights(&plan.weights)?;
        let (camera, divisor) = self.targets.views[view].camera_over(plan.divisor);
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let degree = plan.degrees.colors.min(self.scene.sh_degree);
        let lattice = Lattice::full(&camera.intrinsics);
        let mut constants =
            StepConstants::on(&camera, &lattice, self.scene.count, degree, self.lists.capacity());
        let slot = self.slot;
        self.slot = (self.slot + 1) % RING;
        constants.counts[3] = plan.step as u32;
        constants.flags = [
            u32::from(self.water.is_some()),
            u32::from(plan.depth_gradient),
            u32::from(plan.gather.is_some()),
            slot as u32,
        ];
        constants.set_rates(plan.step, &plan.rates);
        if let Some(scale) = plan.gather {
            // Scaled as on the processor.
            let pixels = (width * plan.divisor) as f64 * (height * plan.divisor) as f64;
            let scale = scale.at(pixels);
            constants.screen = [0.5 * scale * width as f32, 0.5 * scale * height as f32, 0.0, 0.0];
        }
        self.prepare(constants, &lattice, Outputs::Training)?;
        if let Some(water) = &mut self.water {
            let rates = [plan.rates.medium_constant, plan.rates.medium_directional];
            water.prepare(&self.gpu, &camera, plan.degrees.water, plan.step, rates)?;
        }
        self.losses.resize(&self.gpu, width, height)?;
        let place = self.targets.place(&self.gpu, view)?;
        let stored = self.targets.at(place);
        self.unpacked.prepare(&self.gpu, stored, divisor)?;
        let Floats { photograph, mask, prior } = self.unpacked.floats(stored);
        let (image, depth) = (&self.compositor.image, &self.compositor.depth);
        let seen = LossInput { image, depth, photograph, mask, prior };
        let exposed = plan.exposure.is_some();
        let loss = LossPlan {
            step: plan.step,
            report: slot as u32,
            weights,
            gains: plan.exposure.map(|exposure| (view, exposure)),
        };
        let gains = exposed.then_some(&mut self.gains);
        self.losses.prepare(&self.gpu, &loss, &seen, gains);

        let gains = exposed.then_some(&self.gains);
        let label = Some("step");
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label });
        {
            let timestamp_writes = self.gpu.clock.as_deref().and_then(|clock| clock.around("step"));
            let descriptor = wgpu::ComputePassDescriptor { label, timestamp_writes };
            let pass = &mut encoder.begin_compute_pass(&descriptor);
            self.unpacked.record(pass, stored);
            if let Some(water) = &self.water {
                water.record_maps(pass);
            }
            self.record_view(pass, &constants, true);
            let told = LossOutput {
                image: &self.image_slope,
                depth: &self.depth_slope,
                reports: &self.reports,
                counts: &self.counts,
            };
            self.losses.record(pass, &seen, gains, &told);
            self.compositor.record_backward(
                pass,
                &self.constants,
                constants.tiles(),
                &self.lists.drawn(),
                self.water_planes(),
                &self.image_slope,
                &self.depth_slope,
                &self.records,
            );
            let Self { update, constants, counts, lists, records, color_pull, scene, .. } = &*self;
            update.record(pass, constants, counts, lists, records, color_pull, scene);
            if let Some(water) = &self.water {
                water.record_backward(pass, &self.image_slope, &self.compositor.kept);
                water.record_update(pass, counts);
            }
            if let Some(gains) = gains {
                self.losses.learn_gains(pass, gains, counts);
            }
            update.record_finish(pass, constants, counts, &self.ends);
        }
        self.gpu.submit(encoder);
        self.asked.push_back(Asked { view, plan, slot });
        self.gpu.check()
    }

    /// Records the lists and the forward pass of the prepared view.
    fn record_view(&self, pass: &mut wgpu::ComputePass<'_>, constants: &StepConstants, train: bool) {
        let counts = if train { &self.counts } else { &self.render_counts };
        let (n, tiles) = (constants.gaussians(), constants.tiles());
        let records = train.then_some(&self.records);
        self.lists.record(pass, &self.constants, n, tiles, &self.scene.values, counts, records);
        let (water, drawn) = (self.water_planes(), self.lists.drawn());
        let outputs = if train { Outputs::Training } else { Outputs::Picture };
        self.compositor.record_forward(pass, &self.constants, tiles, &drawn, water, outputs);
    }

    /// Draws a camera into the planes, and makes more room for entries if needed.
    pub(super) fn draw(&mut self, camera: &Camera, degrees: Degrees) -> Result<(), EngineError> {
        let lattice = Lattice::full(&camera.intrinsics);
        loop {
            let degree = degrees.colors.min(self.scene.sh_degree);
            let mut constants =
                StepConstants::on(camera, &lattice, self.scene.count, degree, self.lists.capacity());
            constants.flags[0] = u32::from(self.water.is_some());
            self.prepare(constants, &lattice, Outputs::Picture)?;
            if let Some(water) = &mut self.water {
                water.prepare(&self.gpu, camera, degrees.water, 0, [0.0; 2])?;
            }
            self.render_counts.write(&self.gpu, 0, &[0; counts::WORDS]);
            submit(&self.gpu, "render", |pass| {
                if let Some(water) = &self.water {
                    water.record_maps(pass);
                }
                self.record_view(pass, &constants, false);
            })?;
            if self.lists.had_room(&self.gpu, &self.render_counts)? {
                return Ok(());
            }
            self.records.grow(&self.gpu, 3 * self.lists.capacity())?;
        }
    }
}
