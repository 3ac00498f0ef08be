//! Arrays that are larger than one binding: each buffer holds a limited number of Gaussians and has its own
//! dispatch.
//!
//! A Gaussian has 192 bytes of colour, four times as much as of any other array. The compositor reads
//! splats (48 bytes) in any order, so one binding must hold all of them. Colours are read and moved only by
//! kernels that process one Gaussian after another, which run over them chunk by chunk instead. So the
//! splats and not the colours limit the number of Gaussians on a device. If one binding holds everything,
//! there is one chunk and one dispatch. The result of a kernel for a Gaussian does not depend on its chunk.

use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::{Access, Binding};

/// The description of a chunk for a kernel: its first Gaussian, and the number for which there is room; the
/// rest is 0.
pub(crate) const CHUNK: Binding = (Access::Uniform, "chunk", "vec4<u32>");

/// One buffer of a [`Chunked`].
#[derive(Debug)]
pub(crate) struct Chunk {
    /// See [`CHUNK`].
    pub(crate) place: Array<[u32; 4]>,
    pub(crate) floats: Array<f32>,
}

/// A buffer, its first Gaussian, and the number of Gaussians in it.
pub(crate) type Piece<'a> = (&'a wgpu::Buffer, usize, usize);

/// An array with `width` floats for each of N Gaussians. Growing discards its contents.
#[derive(Debug)]
pub(crate) struct Chunked {
    what: &'static str,
    /// Number of floats per Gaussian.
    width: usize,
    /// Number of Gaussians in a chunk; equal for every width, so that the chunks of several arrays
    /// correspond.
    most: usize,
    chunks: Vec<Chunk>,
}

impl Chunked {
    /// An array with room for `n` Gaussians.
    pub(crate) fn new(gpu: &Gpu, what: &'static str, width: usize, n: usize) -> Result<Self, EngineError> {
        let mut all = Self { what, width, most: gpu.gaussians_of_chunk(), chunks: Vec::new() };
        all.grow(gpu, n.max(1))?;
        Ok(all)
    }

    /// Another array of the same kind, for `n` Gaussians.
    pub(crate) fn another(&self, gpu: &Gpu, n: usize) -> Result<Self, EngineError> {
        Self::new(gpu, self.what, self.width, n)
    }

    /// Frees its memory.
    pub(crate) fn let_go(&mut self, gpu: &Gpu) {
        self.chunks.iter_mut().for_each(|chunk| chunk.floats.let_go(gpu));
    }

    /// Makes room for `n` Gaussians.
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

    /// The chunks of the first `n` Gaussians, each with the number of Gaussians in it.
    pub(crate) fn over(&self, n: usize) -> impl Iterator<Item = (&Chunk, usize)> {
        let firsts = (0..n).step_by(self.most);
        self.chunks.iter().zip(firsts).map(move |(chunk, first)| (chunk, self.most.min(n - first)))
    }

    /// The chunks of the first `n` Gaussians as plain buffers.
    pub(crate) fn pieces(&self, n: usize) -> Vec<Piece<'_>> {
        let firsts = (0..n).step_by(self.most);
        self.over(n).zip(firsts).map(|((chunk, count), first)| (chunk.floats.raw(), first, count)).collect()
    }

    /// Writes the values of Gaussians, starting at the first; there must be room for them.
    pub(crate) fn write(&self, gpu: &Gpu, values: &[f32]) {
        for (chunk, values) in self.chunks.iter().zip(values.chunks(self.width * self.most)) {
            chunk.floats.write(gpu, 0, values);
        }
    }

    /// Waits and reads the values of the first `n` Gaussians.
    pub(crate) fn read(&self, gpu: &Gpu, n: usize) -> Result<Vec<f32>, EngineError> {
        let mut all = Vec::with_capacity(self.width * n);
        for (chunk, count) in self.over(n) {
            all.extend(chunk.floats.read(gpu, self.width * count)?);
        }
        Ok(all)
    }

    /// Number of bytes on the device.
    pub(crate) fn size(&self) -> usize {
        self.chunks.iter().map(|chunk| chunk.floats.size()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_from_as_many_chunks_as_they_need() {
        let Some(gpu) = crate::test_support::software() else { return };
        // A chunk holds ten Gaussians.
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
