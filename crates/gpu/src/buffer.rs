//! Typed buffers on the device, which can grow, and which report their size in errors.

use std::marker::PhantomData;

use bytemuck::Pod;
use use3d_training::EngineError;

use crate::device::{BufferBytes, Gpu, NAME};

/// An array of `T` that kernels read and write. Growing discards its contents.
#[derive(Debug)]
pub(crate) struct Array<T> {
    what: &'static str,
    buffer: wgpu::Buffer,
    held: BufferBytes,
    capacity: usize,
    item: PhantomData<T>,
}

fn create(
    gpu: &Gpu,
    what: &'static str,
    bytes: u64,
    uniform: bool,
) -> Result<(wgpu::Buffer, BufferBytes), EngineError> {
    gpu.fits(what, bytes)?;
    let kind = if uniform { wgpu::BufferUsages::UNIFORM } else { wgpu::BufferUsages::STORAGE };
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(what),
        size: bytes,
        usage: kind | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    gpu.check().map_err(|error| match error {
        EngineError::OutOfMemory { .. } => {
            let what = format!("{bytes} bytes for {what}, beside {} that it holds", gpu.held());
            EngineError::OutOfMemory { engine: NAME, what }
        }
        other => other,
    })?;
    Ok((buffer, gpu.hold(bytes)))
}

/// Copies the first bytes of buffers to main memory, in one submit with a single wait.
pub(crate) fn fetch(gpu: &Gpu, wanted: &mut [(&wgpu::Buffer, &mut [u8])]) -> Result<(), EngineError> {
    let padded = |bytes: &[u8]| bytes.len().next_multiple_of(16) as u64;
    let size = wanted.iter().map(|(_, bytes)| padded(bytes)).sum();
    if size == 0 {
        return Ok(());
    }
    let staging = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("read-back"),
        size,
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    let mut at = 0;
    for (buffer, bytes) in wanted.iter().filter(|(_, bytes)| !bytes.is_empty()) {
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, at, padded(bytes));
        at += padded(bytes);
    }
    gpu.submit(encoder);
    let slice = staging.slice(..);
    // The read below reports an error, so the result is not needed here.
    slice.map_async(wgpu::MapMode::Read, |_| ());
    gpu.wait()?;
    let view = slice.get_mapped_range().map_err(|e| EngineError::Failed(Box::new(e)))?;
    let mut at = 0;
    for (_, bytes) in wanted.iter_mut().filter(|(_, bytes)| !bytes.is_empty()) {
        bytes.copy_from_slice(&view[at..at + bytes.len()]);
        at += padded(bytes) as usize;
    }
    Ok(())
}

/// Reads the requested number of words from the start of each buffer, with a single wait.
pub(crate) fn read_together<const N: usize>(
    gpu: &Gpu,
    wanted: [(&wgpu::Buffer, usize); N],
) -> Result<[Vec<u32>; N], EngineError> {
    let words = |(buffer, words): (&wgpu::Buffer, usize)| vec![0; words.min(buffer.size() as usize / 4)];
    let mut out = wanted.map(words);
    let mut each: Vec<_> = wanted
        .iter()
        .zip(&mut out)
        .map(|((buffer, _), out)| (*buffer, bytemuck::cast_slice_mut(out)))
        .collect();
    fetch(gpu, &mut each)?;
    Ok(out)
}

impl<T: Pod> Array<T> {
    /// An array with room for `capacity` items, all zero.
    pub(crate) fn new(gpu: &Gpu, what: &'static str, capacity: usize) -> Result<Self, EngineError> {
        let capacity = capacity.max(1);
        let (buffer, held) = create(gpu, what, Self::bytes(capacity), false)?;
        Ok(Self { what, buffer, held, capacity, item: PhantomData })
    }

    /// An array of one item that kernels read as a uniform.
    pub(crate) fn uniform(gpu: &Gpu, what: &'static str) -> Result<Self, EngineError> {
        let (buffer, held) = create(gpu, what, Self::bytes(1), true)?;
        Ok(Self { what, buffer, held, capacity: 1, item: PhantomData })
    }

    /// An array with these items.
    pub(crate) fn from(gpu: &Gpu, what: &'static str, items: &[T]) -> Result<Self, EngineError> {
        let array = Self::new(gpu, what, items.len())?;
        array.write(gpu, 0, items);
        Ok(array)
    }

    /// Another array of the same kind.
    pub(crate) fn another(&self, gpu: &Gpu, capacity: usize) -> Result<Self, EngineError> {
        Self::new(gpu, self.what, capacity)
    }

    /// Number of bytes of `items` items, padded to the device's unit of copying.
    fn bytes(items: usize) -> u64 {
        (items * size_of::<T>()).next_multiple_of(16) as u64
    }

    /// Number of items for which there is room.
    pub(crate) fn capacity(&self) -> usize {
        self.capacity
    }

    /// Number of bytes on the device.
    pub(crate) fn size(&self) -> usize {
        self.buffer.size() as usize
    }

    /// The buffer that kernels bind.
    pub(crate) fn raw(&self) -> &wgpu::Buffer {
        &self.buffer
    }

    /// Makes room; returns true if the items were discarded. The old buffer is freed first, so that both
    /// need not fit.
    pub(crate) fn grow(&mut self, gpu: &Gpu, items: usize) -> Result<bool, EngineError> {
        if items <= self.capacity {
            return Ok(false);
        }
        gpu.fits(self.what, Self::bytes(items))?;
        self.let_go(gpu);
        (self.buffer, self.held) = create(gpu, self.what, Self::bytes(items), false)?;
        self.capacity = items;
        Ok(true)
    }

    /// Writes items starting at `first`; items beyond the capacity are left out.
    pub(crate) fn write(&self, gpu: &Gpu, first: usize, items: &[T]) {
        let items = &items[..items.len().min(self.capacity.saturating_sub(first))];
        if items.is_empty() {
            return;
        }
        let bytes: &[u8] = bytemuck::cast_slice(items);
        let offset = (first * size_of::<T>()) as u64;
        gpu.queue.write_buffer(&self.buffer, offset, bytes);
    }

    /// Frees its memory. Bindings may refer to it until they are made again; they use no memory.
    pub(crate) fn let_go(&mut self, gpu: &Gpu) {
        gpu.forget_bindings();
        self.buffer.destroy();
        self.held.let_go();
        self.capacity = 0;
    }

    /// Sets every item to zero.
    pub(crate) fn clear(&self, gpu: &Gpu) {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(&self.buffer, 0, None);
        gpu.submit(encoder);
    }

    /// Waits and reads the first items.
    pub(crate) fn read(&self, gpu: &Gpu, items: usize) -> Result<Vec<T>, EngineError> {
        let mut out = vec![T::zeroed(); items.min(self.capacity)];
        fetch(gpu, &mut [(&self.buffer, bytemuck::cast_slice_mut(&mut out))])?;
        Ok(out)
    }

    /// Fills the buffer with NaN, so that a read before the first write is detected.
    #[cfg(test)]
    pub(crate) fn poison(&self, gpu: &Gpu) {
        let words = vec![0x7fc0_dead_u32; self.size() / 4];
        gpu.queue.write_buffer(&self.buffer, 0, bytemuck::cast_slice(&words));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_written_is_read_and_growing_starts_anew() {
        let Some(gpu) = crate::test_support::software() else { return };
        let mut array = Array::from(&gpu, "numbers", &[1u32, 2, 3, 4, 5]).unwrap();
        assert_eq!(array.read(&gpu, 9).unwrap(), [1, 2, 3, 4, 5]);
        array.write(&gpu, 3, &[7, 8, 9]);
        assert_eq!(array.read(&gpu, 5).unwrap(), [1, 2, 3, 7, 8]);
        array.poison(&gpu);
        assert_eq!(array.read(&gpu, 2).unwrap(), [0x7fc0_dead; 2]);
        let other = Array::from(&gpu, "others", &[0.5f32, 0.25]).unwrap();
        array.write(&gpu, 0, &[6]);
        let together = read_together(&gpu, [(array.raw(), 1), (array.raw(), 0), (other.raw(), 900)]).unwrap();
        assert_eq!(together, [vec![6], vec![], vec![0.5f32.to_bits(), 0.25f32.to_bits(), 0, 0]]);
        array.clear(&gpu);
        assert_eq!(array.read(&gpu, 5).unwrap(), [0; 5]);
        assert!(!array.grow(&gpu, 5).unwrap() && array.grow(&gpu, 700).unwrap());
        assert_eq!((array.capacity(), array.read(&gpu, 700).unwrap()), (700, vec![0; 700]));
    }

    #[test]
    fn a_buffer_that_no_kernel_could_see_is_refused_with_its_size() {
        let Some(gpu) = crate::test_support::software() else { return };
        let most = gpu.adapter.binding;
        let error = Array::<u32>::new(&gpu, "records", (most / 4 + 4) as usize).unwrap_err().to_string();
        assert!(error.contains("records") && error.contains(&most.to_string()), "{error}");
        let held = gpu.held();
        let mut array = Array::<u32>::new(&gpu, "records", 1000).unwrap();
        array.grow(&gpu, 3000).unwrap();
        assert_eq!(gpu.held(), held + 12_000);
        array.let_go(&gpu);
        assert_eq!((gpu.held(), array.capacity()), (held, 0));
        assert!(array.grow(&gpu, 9).unwrap() && gpu.held() == held + 48);
        drop(array);
        assert_eq!(gpu.held(), held);
        gpu.run_out_of_memory();
        let error = Array::<u32>::new(&gpu, "records", 1000).unwrap_err().to_string();
        let expected = format!("out of memory: 4000 bytes for records, beside {held} that it holds");
        assert!(error.contains(&expected), "{error}");
    }
}
