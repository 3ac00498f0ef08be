//! A stable order by depth.

use rayon::prelude::*;

/// Largest number of parts by depth that are sorted apart.
const PARTS: u64 = 2048;

/// Buffers of the depth sort.
#[derive(Clone, Debug, Default)]
pub(crate) struct Keys {
    keys: Vec<u64>,
    parted: Vec<u64>,
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
        let (least, most) =
            self.keys.iter().fold((u64::MAX, 0), |(least, most), &key| (least.min(key), most.max(key)));
        let shift = (0..64).find(|shift| most.saturating_sub(least) >> shift < PARTS).unwrap_or(0);
        let part = |key: u64| ((key - least) >> shift) as usize;
        // Counts, then positions of the next key of each part.
        let mut next = [0u32; PARTS as usize];
        for &key in &self.keys {
            next[part(key)] += 1;
        }
        let lengths = next;
        let mut start = 0;
        for next in &mut next {
            start += std::mem::replace(next, start);
        }
        self.parted.resize(self.keys.len(), 0);
        for &key in &self.keys {
            let next = &mut next[part(key)];
            self.parted[*next as usize] = key;
            *next += 1;
        }
        let mut rest = &mut self.parted[..];
        let mut parts = Vec::with_capacity(lengths.len());
        for length in lengths {
            let (part, others) = rest.split_at_mut(length as usize);
            parts.push(part);
            rest = others;
        }
        parts.into_par_iter().with_min_len(64).for_each(<[u64]>::sort_unstable);
        self.order.clear();
        self.order.extend(self.parted.iter().map(|&k| k as u32));
    }

    /// Indices of the Gaussians, nearest first.
    pub(crate) fn order(&self) -> &[u32] {
        &self.order
    }

    /// Number of bytes held.
    pub(crate) fn memory(&self) -> usize {
        (self.keys.capacity() + self.parted.capacity()) * 8 + self.order.capacity() * 4
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
        keys.sort([f32::INFINITY].into_iter());
        assert!(keys.order().is_empty());
    }

    #[test]
    fn many_depths_are_sorted_as_by_the_standard_library() {
        let depths: Vec<f32> = (0..50_000u32).map(|i| (0.01 + (i * 7919 % 10_007) as f32) * 0.37).collect();
        let mut expected: Vec<u32> = (0..50_000).collect();
        expected.sort_by(|&a, &b| depths[a as usize].total_cmp(&depths[b as usize]));
        let mut keys = Keys::default();
        keys.sort(depths.into_iter());
        assert_eq!(keys.order(), expected);
    }
}
