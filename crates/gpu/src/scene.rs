//! Gaussians, moments and statistics on the device, and their conversion from and to rows in main memory.

use use3d_reconstruct::engine::{Moments, Statistics};
use use3d_splat::Gaussians;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::chunks::Chunked;
use crate::device::{Gpu, NAME};
use crate::rows::{COLORS, Float4, GEOMETRY, SPLAT};

/// The parameters of N Gaussians, or one of their moments.
#[derive(Debug)]
pub(crate) struct Parameters {
    /// Mean and opacity logit; log scales and 0; quaternion.
    pub(crate) geometry: Array<Float4>,
    /// 16 bands × rgb.
    pub(crate) colors: Chunked,
}

impl Parameters {
    fn new(gpu: &Gpu, geometry: &'static str, colors: &'static str, n: usize) -> Result<Self, EngineError> {
        Ok(Self {
            geometry: Array::new(gpu, geometry, GEOMETRY * n)?,
            colors: Chunked::new(gpu, colors, COLORS, n)?,
        })
    }

    /// The parameters of Gaussians that are drawn and not trained.
    pub(crate) fn of(gpu: &Gpu, gaussians: &Gaussians) -> Result<Self, EngineError> {
        let parameters = Self::new(gpu, "geometry", "colours", gaussians.len())?;
        parameters.write(gpu, gaussians);
        Ok(parameters)
    }

    fn grow(&mut self, gpu: &Gpu, n: usize) -> Result<(), EngineError> {
        self.geometry.grow(gpu, GEOMETRY * n)?;
        self.colors.grow(gpu, n)
    }

    /// The rows of one Gaussian's geometry.
    pub(crate) fn rows(
        [x, y, z]: [f32; 3],
        [a, b, c]: [f32; 3],
        quaternion: [f32; 4],
        logit: f32,
    ) -> [Float4; GEOMETRY] {
        [[x, y, z, logit], [a, b, c, 0.0], quaternion]
    }

    /// Writes these Gaussians; there must be room for them.
    pub(crate) fn write(&self, gpu: &Gpu, g: &Gaussians) {
        let rows: Vec<Float4> = (0..g.len())
            .flat_map(|i| Self::rows(g.means[i], g.log_scales[i], g.quaternions[i], g.opacity_logits[i]))
            .collect();
        self.geometry.write(gpu, 0, &rows);
        self.colors.write(gpu, g.sh.as_flattened().as_flattened());
    }

    /// Waits and reads the first `n` of them.
    pub(crate) fn read(&self, gpu: &Gpu, n: usize, sh_degree: usize) -> Result<Gaussians, EngineError> {
        let mut g = self.shapes(gpu, n, sh_degree)?;
        let colors = self.colors.read(gpu, n)?;
        g.sh = colors
            .chunks_exact(COLORS)
            .map(|c| std::array::from_fn(|k| std::array::from_fn(|channel| c[3 * k + channel])))
            .collect();
        Ok(g)
    }

    /// Waits and reads them without their colours, which is a fifth of the bytes.
    fn shapes(&self, gpu: &Gpu, n: usize, sh_degree: usize) -> Result<Gaussians, EngineError> {
        let rows = self.geometry.read(gpu, GEOMETRY * n)?;
        let mut g = Gaussians::empty(sh_degree);
        for row in rows.chunks_exact(GEOMETRY) {
            let [[x, y, z, logit], [a, b, c, _], q] = [row[0], row[1], row[2]];
            g.means.push([x, y, z]);
            g.log_scales.push([a, b, c]);
            g.quaternions.push(q);
            g.opacity_logits.push(logit);
        }
        Ok(g)
    }

    fn size(&self) -> usize {
        self.geometry.size() + self.colors.size()
    }
}

/// A scene in training on the device.
#[derive(Debug)]
pub(crate) struct DeviceScene {
    /// Number of Gaussians.
    pub(crate) count: usize,
    /// Highest stored degree of colours.
    pub(crate) sh_degree: usize,
    pub(crate) values: Parameters,
    pub(crate) first: Parameters,
    pub(crate) second: Parameters,
    /// Bits of the summed norm, and number of renders.
    pub(crate) statistics: Array<[u32; 2]>,
}

impl DeviceScene {
    /// An empty scene.
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self {
            count: 0,
            sh_degree: 0,
            values: Parameters::new(gpu, "geometry", "colours", 1)?,
            first: Parameters::new(gpu, "first moments of geometry", "first moments of colours", 1)?,
            second: Parameters::new(gpu, "second moments of geometry", "second moments of colours", 1)?,
            statistics: Array::new(gpu, "density statistics", 1)?,
        })
    }

    /// Returns an error if there are more Gaussians than the device can hold.
    pub(crate) fn refuse_more(gpu: &Gpu, n: usize) -> Result<(), EngineError> {
        let most = gpu.most_gaussians();
        if n <= most {
            return Ok(());
        }
        let (name, bytes) = (&gpu.adapter.name, SPLAT * size_of::<Float4>() * n);
        let what = format!(
            "the splats of {n} Gaussians would take {bytes} bytes in one piece, `{name}` binds at most {}: {most} Gaussians (`max_gaussians`)",
            gpu.longest()
        );
        Err(EngineError::OutOfMemory { engine: NAME, what })
    }

    /// Copies a scene from main memory. All arguments have the same length.
    pub(crate) fn write(
        &mut self,
        gpu: &Gpu,
        gaussians: &Gaussians,
        moments: &Moments,
        statistics: &Statistics,
    ) -> Result<(), EngineError> {
        let n = gaussians.len();
        Self::refuse_more(gpu, n)?;
        (self.count, self.sh_degree) = (n, gaussians.sh_degree);
        for (to, from) in [
            (&mut self.values, gaussians),
            (&mut self.first, &moments.first),
            (&mut self.second, &moments.second),
        ] {
            to.grow(gpu, n)?;
            to.write(gpu, from);
        }
        self.statistics.grow(gpu, n)?;
        self.write_statistics(gpu, statistics);
        Ok(())
    }

    /// Resets the statistics.
    pub(crate) fn forget_statistics(&self, gpu: &Gpu) {
        self.statistics.clear(gpu);
    }

    /// Writes other statistics of the same Gaussians.
    fn write_statistics(&self, gpu: &Gpu, statistics: &Statistics) {
        let rows: Vec<[u32; 2]> =
            statistics.norms.iter().zip(&statistics.renders).map(|(n, r)| [n.to_bits(), *r]).collect();
        self.statistics.write(gpu, 0, &rows);
    }

    /// Waits and reads the Gaussians.
    pub(crate) fn gaussians(&self, gpu: &Gpu) -> Result<Gaussians, EngineError> {
        self.values.read(gpu, self.count, self.sh_degree)
    }

    /// Waits and reads the Gaussians without their colours.
    pub(crate) fn shapes(&self, gpu: &Gpu) -> Result<Gaussians, EngineError> {
        self.values.shapes(gpu, self.count, self.sh_degree)
    }

    /// Waits and reads their moments.
    pub(crate) fn moments(&self, gpu: &Gpu) -> Result<Moments, EngineError> {
        Ok(Moments {
            first: self.first.read(gpu, self.count, self.sh_degree)?,
            second: self.second.read(gpu, self.count, self.sh_degree)?,
        })
    }

    /// Waits and reads their statistics.
    pub(crate) fn statistics(&self, gpu: &Gpu) -> Result<Statistics, EngineError> {
        let rows = self.statistics.read(gpu, self.count)?;
        Ok(Statistics {
            norms: rows.iter().map(|r| f32::from_bits(r[0])).collect(),
            renders: rows.iter().map(|r| r[1]).collect(),
            radii: Vec::new(),
        })
    }

    /// Number of bytes on the device.
    pub(crate) fn size(&self) -> usize {
        self.values.size() + self.first.size() + self.second.size() + self.statistics.size()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_comes_back_as_it_went() {
        let Some(gpu) = crate::test_support::software() else { return };
        let mut scene = DeviceScene::new(&gpu).unwrap();
        for n in [0usize, 1, 257] {
            let gaussians = crate::test_support::cloud(n, -2.0, 1.0);
            let mut moments = Moments::new(&gaussians);
            moments.first.clone_from(&gaussians);
            moments.second.opacity_logits.fill(0.25);
            let statistics = Statistics {
                norms: (0..n).map(|i| i as f32 * 0.1).collect(),
                renders: (0..n as u32).collect(),
                radii: Vec::new(),
            };
            scene.write(&gpu, &gaussians, &moments, &statistics).unwrap();
            assert!(scene.gaussians(&gpu).unwrap() == gaussians);
            let shapes = scene.shapes(&gpu).unwrap();
            assert!(shapes.sh.is_empty() && shapes == Gaussians { sh: Vec::new(), ..gaussians.clone() });
            assert!(scene.moments(&gpu).unwrap() == moments);
            assert!(scene.statistics(&gpu).unwrap() == statistics);
        }
    }
}
