//! Arrays that are wider than one binding holds: so many Gaussians to a buffer, and a dispatch for each.
//!
//! A Gaussian has 192 bytes of colour, four times what it has of anything else. The compositor reads splats
//! (48 bytes) in any order, so one binding must hold all of them; colours are read and moved only by kernels
//! that take one Gaussian after another, which go over them chunk by chunk instead. So it is splats that
//! bound how many Gaussians a device takes, not colours. Where one binding holds everything there is one
//! chunk, and one dispatch. What a kernel computes of a Gaussian does not depend on the chunk it lies in.

use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::{Access, Binding};

/// How a kernel over a chunk sees it: its first Gaussian, and how many there is room for; the rest is 0.
pub(crate) const CHUNK: Binding = (Access::Uniform, "chunk", "vec4<u32>");

/// One buffer of a [`Chunked`].
#[derive(Debug)]
pub(crate) struct Chunk {
    /// See [`CHUNK`].
    pub(crate) place: Array<[u32; 4]>,
    pub(crate) floats: Array<f32>,
}

/// A buffer, the first of its Gaussians, and how many of them there are in it.
pub(crate) type Piece<'a> = (&'a wgpu::Buffer, usize, usize);

/// So many floats for each of N Gaussians. Growing loses what it held.
#[derive(Debug)]
pub(crate) struct Chunked {
    what: &'static str,
    /// Floats of a Gaussian.
    width: usize,
    /// Gaussians of a chunk; the same for every width, so that chunks of several arrays go together.
    most: usize,
    chunks: Vec<Chunk>,
}

impl Chunked {
    /// Room for so many Gaussians.
    pub(crate) fn new(gpu: &Gpu, what: &'static str, width: usize, n: usize) -> Result<Self, EngineError> {
        let mut all = Self { what, width, most: gpu.gaussians_of_chunk(), chunks: Vec::new() };
        all.grow(gpu, n.max(1))?;
        Ok(all)
    }

    /// Another of the same kind, for so many Gaussians.
    pub(crate) fn another(&self, gpu: &Gpu, n: usize) -> Result<Self, EngineError> {
        Self::new(gpu, self.what, self.width, n)
    }

    /// Gives its room back.
    pub(crate) fn let_go(&mut self, gpu: &Gpu) {
        self.chunks.iter_mut().for_each(|chunk| chunk.floats.let_go(gpu));
    }

    /// Makes room.
    pub(crate) fn grow(&mut self, gpu: &Gpu, n: usize) -> Result<(), EngineError> {
        let Self { what, width, most, chunks } = self;
        for (at, first) in (0..n).step_by(*most).enumerate() {
            let items = *width * (*most).min(n - first);
            if let Some(chunk) = chunks.get_mut(at) {
                chunk.floats.grow(gpu, items)?;
                continue;
            }
            let floats = Array::new(gpu, what, items)?;
            let place = Array::uniform(gpu, "place of a chunk")?;
            place.write(gpu, 0, &[[first as u32, *most as u32, 0, 0]]);
            chunks.push(Chunk { place, floats });
        }
        Ok(())
    }

    /// The chunks of the first `n` Gaussians, and how many of them lie in each.
    pub(crate) fn over(&self, n: usize) -> impl Iterator<Item = (&Chunk, usize)> {
        let firsts = (0..n).step_by(self.most);
        self.chunks.iter().zip(firsts).map(move |(chunk, first)| (chunk, self.most.min(n - first)))
    }

    /// The same as plain buffers.
    pub(crate) fn pieces(&self, n: usize) -> Vec<Piece<'_>> {
        let firsts = (0..n).step_by(self.most);
        self.over(n).zip(firsts).map(|((chunk, count), first)| (chunk.floats.raw(), first, count)).collect()
    }

    /// Puts the values of Gaussians from the first on, for which there is room.
    pub(crate) fn write(&self, gpu: &Gpu, values: &[f32]) {
        for (chunk, values) in self.chunks.iter().zip(values.chunks(self.width * self.most)) {
            chunk.floats.write(gpu, 0, values);
        }
    }

    /// The values of the first `n` Gaussians, waited for.
    pub(crate) fn read(&self, gpu: &Gpu, n: usize) -> Result<Vec<f32>, EngineError> {
        let mut all = Vec::with_capacity(self.width * n);
        for (chunk, count) in self.over(n) {
            all.extend(chunk.floats.read(gpu, self.width * count)?);
        }
        Ok(all)
    }

    /// Bytes on the device.
    pub(crate) fn size(&self) -> usize {
        self.chunks.iter().map(|chunk| chunk.floats.size()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_from_as_many_chunks_as_they_need() {
        let Some(gpu) = crate::testing::software() else { return };
        // Ten Gaussians to a chunk.
        let gpu = gpu.binding(1920 + 100);
        let mut chunked = Chunked::new(&gpu, "values", 48, 7).unwrap();
        for (n, counts) in
            [(7, vec![7]), (10, vec![10]), (11, vec![10, 1]), (25, vec![10, 10, 5]), (0, vec![])]
        {
            chunked.grow(&gpu, n).unwrap();
            let values: Vec<f32> = (0..48 * n).map(|i| i as f32).collect();
            chunked.write(&gpu, &values);
            assert_eq!(chunked.read(&gpu, n).unwrap(), values);
            assert_eq!(chunked.over(n).map(|(_, count)| count).collect::<Vec<_>>(), counts);
        }
        let places: Vec<_> =
            chunked.over(25).map(|(chunk, _)| chunk.place.read(&gpu, 1).unwrap()[0]).collect();
        assert_eq!(places, [[0, 10, 0, 0], [10, 10, 0, 0], [20, 10, 0, 0]]);
        assert_eq!(chunked.size(), 4 * 48 * 25);
    }
}
