//! The weights of a view whose geometry is frozen.
//!
//! The weight `w = T α` of a Gaussian at a pixel does not change during stage 2. So it is computed once per
//! view, by the operations of the forward pass, and stored twice: by pixel, with the Gaussian, and by entry,
//! with the pixel. Composing and its derivative with respect to colours are then sums over these lists,
//! without an exponential for `α` and without a barrier. Their order is that of the passes over tiles, and so
//! are their bits.
//!
//! A sparse lattice has some 160,000 pairs. A view with more than [`MOST`], such as a view at full size, is
//! composed tile by tile as in stage 1.

use use3d_training::EngineError;

use super::frozen::FrozenView;
use super::kernels::{count_weights, write_weights};
use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::{Kernel, bound, submit};

/// Most pairs of pixel and Gaussian that are stored for a view: 64 MiB.
pub(super) const MOST: usize = 4 << 20;

#[cfg(test)]
thread_local! {
    /// Another limit for the views that this thread makes.
    pub(super) static MOST_IN_TESTS: std::cell::Cell<usize> = const { std::cell::Cell::new(MOST) };
}

/// See [`MOST`].
fn most() -> usize {
    #[cfg(test)]
    return MOST_IN_TESTS.get();
    #[cfg(not(test))]
    MOST
}

/// Pairs in a list, with the first pair of every row of the list and one more.
#[derive(Debug)]
pub(super) struct PairLists {
    pub(super) firsts: Array<u32>,
    /// The Gaussian or the pixel, and the bits of the weight.
    pub(super) pairs: Array<[u32; 2]>,
}

impl PairLists {
    /// Lists for `count` pairs, which are written later.
    fn new(gpu: &Gpu, firsts: &[u32], count: usize) -> Result<Self, EngineError> {
        let firsts = Array::from(gpu, "first weights", firsts)?;
        Ok(Self { firsts, pairs: Array::new(gpu, "weights", count)? })
    }

    fn bytes(&self) -> usize {
        self.firsts.size() + self.pairs.size()
    }
}

/// The weights of a view.
#[derive(Debug)]
pub(super) struct FrozenWeights {
    /// Numbers of pixels and of entries; the rest is 0.
    pub(super) sizes: Array<[u32; 4]>,
    /// By pixel, the Gaussians from the nearest to the farthest.
    pub(super) of_pixels: PairLists,
    /// By entry, the pixels row by row.
    pub(super) of_entries: PairLists,
}

impl FrozenWeights {
    pub(super) fn bytes(&self) -> usize {
        self.of_pixels.bytes() + self.of_entries.bytes()
    }
}

/// The sums of `counts` before each of them, and the whole sum at the end.
fn firsts_of(counts: impl Iterator<Item = u32>) -> Vec<u32> {
    let mut firsts = vec![0];
    let mut sum = 0u32;
    for count in counts {
        sum = sum.saturating_add(count);
        firsts.push(sum);
    }
    firsts
}

/// The pairs by entry, from those by pixel: (entry, weight) of each pixel in turn. Within an entry the pixels
/// keep their order.
fn by_entry(firsts: &[u32], pairs: &[[u32; 2]], entries: usize) -> (Vec<u32>, Vec<[u32; 2]>) {
    let mut counts = vec![0u32; entries];
    pairs.iter().for_each(|[entry, _]| counts[*entry as usize] += 1);
    let of_entries = firsts_of(counts.into_iter());
    let mut next = of_entries.clone();
    let mut sorted = vec![[0; 2]; pairs.len()];
    for (pixel, ends) in (0..).zip(firsts.windows(2)) {
        for [entry, weight] in &pairs[ends[0] as usize..ends[1] as usize] {
            let place = &mut next[*entry as usize];
            sorted[*place as usize] = [pixel, *weight];
            *place += 1;
        }
    }
    (of_entries, sorted)
}

/// The kernels that compute weights.
#[derive(Debug)]
pub(super) struct WeightKernels {
    count: Kernel,
    write: Kernel,
}

impl WeightKernels {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self { count: Kernel::new(gpu, &count_weights())?, write: Kernel::new(gpu, &write_weights())? })
    }

    /// Computes the weights of a view, whose entries have these `owners`; `None` if there are too many.
    pub(super) fn weights(
        &self,
        gpu: &Gpu,
        view: &FrozenView,
        owners: &[u32],
    ) -> Result<Option<FrozenWeights>, EngineError> {
        let pixels = view.pixels();
        let counts = Array::<u32>::new(gpu, "numbers of weights", pixels)?;
        submit(gpu, "numbers of weights", |pass| {
            let mut buffers = view.drawn().buffers(&view.constants);
            buffers.extend(bound![counts]);
            self.count.record_groups(pass, view.tiles, buffers);
        })?;
        let firsts = firsts_of(counts.read(gpu, pixels)?.into_iter());
        let all = firsts.last().map_or(0, |all| *all as usize);
        if all > most() {
            return Ok(None);
        }
        let of_pixels = PairLists::new(gpu, &firsts, all)?;
        submit(gpu, "weights", |pass| {
            let mut buffers = view.drawn().buffers(&view.constants);
            buffers.extend(bound![of_pixels.firsts, of_pixels.pairs]);
            self.write.record_groups(pass, view.tiles, buffers);
        })?;
        let pairs = of_pixels.pairs.read(gpu, all)?;
        let (firsts_of_entries, sorted) = by_entry(&firsts, &pairs, owners.len());
        let gaussians: Vec<[u32; 2]> =
            pairs.iter().map(|[entry, weight]| [owners[*entry as usize], *weight]).collect();
        of_pixels.pairs.write(gpu, 0, &gaussians);
        let of_entries = PairLists::new(gpu, &firsts_of_entries, all)?;
        of_entries.pairs.write(gpu, 0, &sorted);
        let sizes = Array::uniform(gpu, "sizes of a view")?;
        sizes.write(gpu, 0, &[[pixels as u32, owners.len() as u32, 0, 0]]);
        Ok(Some(FrozenWeights { sizes, of_pixels, of_entries }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_are_sorted_by_entry_and_keep_the_order_of_pixels() {
        // Three pixels: the first sees entries 2 and 0, the second nothing, the third entry 2.
        let (firsts, sorted) = by_entry(&[0, 2, 2, 3], &[[2, 7], [0, 8], [2, 9]], 4);
        assert_eq!((firsts, sorted), (vec![0, 1, 1, 3, 3], vec![[0, 8], [0, 7], [2, 9]]));
        assert_eq!(by_entry(&[0, 0], &[], 0), (vec![0], vec![]));
        assert_eq!(firsts_of([u32::MAX, 1].into_iter()), [0, u32::MAX, u32::MAX]);
    }
}
