//! A stable order by depth.

use rayon::prelude::*;

/// Buffers of the depth sort.
#[derive(Clone, Debug, Default)]
pub(crate) struct Keys {
    keys: Vec<u64>,
    order: Vec<u32>,
}

impl Keys {
    /// Orders the finite, positive depths; equal depths keep their order. Infinite depths are left out.
    pub(crate) fn sort(&mut self, depths: impl Iterator<Item = f32>) {
        self.keys.clear();
        // The bits of positive floats ascend with their values; the index in the low half makes every key
        // unique.
        self.keys.extend(
            depths
                .enumerate()
                .filter(|(_, z)| z.is_finite())
                .map(|(i, z)| (u64::from(z.to_bits()) << 32) | i as u64),
        );
        self.keys.par_sort_unstable();
        self.order.clear();
        self.order.extend(self.keys.iter().map(|&k| k as u32));
    }

    /// Indices of the Gaussians, nearest first.
    pub(crate) fn order(&self) -> &[u32] {
        &self.order
    }

    /// Number of bytes held.
    pub(crate) fn memory(&self) -> usize {
        self.keys.capacity() * 8 + self.order.capacity() * 4
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ties_keep_their_order_and_infinity_is_left_out() {
        let mut keys = Keys::default();
        keys.sort([3.0, 1.0, f32::INFINITY, 1.0, 0.01, 3.0].into_iter());
        assert_eq!(keys.order(), [4, 1, 3, 0, 5]);
    }
}
