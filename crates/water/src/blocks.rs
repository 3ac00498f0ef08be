//! Groups points into blocks of neighbours. The model's errors (shading, shadows, the veil's shape) are
//! alike for neighbouring points, so errors are counted per block and not per point. The sandwich
//! covariance and the test against no water treat blocks as independent.

use glam::DVec3;

/// Largest number of blocks.
const BLOCKS: usize = 48;
/// Fewest points in a block, if there are enough points.
const SMALLEST: usize = 8;

/// The order of two points by their coordinates.
pub(crate) fn order(a: &[f64; 3], b: &[f64; 3]) -> std::cmp::Ordering {
    a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])).then(a[2].total_cmp(&b[2]))
}

/// Returns the block of every point and the number of blocks. The points' box is halved repeatedly at the
/// median of its longest side.
pub(crate) fn blocks(positions: &[DVec3]) -> (Vec<usize>, usize) {
    let mut block = vec![0; positions.len()];
    let mut groups: Vec<Vec<usize>> = vec![(0..positions.len()).collect()];
    while groups.len() < BLOCKS {
        // The fullest group is halved next; among equally full groups, the first.
        let Some(fullest) = (0..groups.len()).rev().max_by_key(|&g| groups[g].len()) else { break };
        if groups[fullest].len() < 2 * SMALLEST {
            break;
        }
        let mut group = std::mem::take(&mut groups[fullest]);
        let (low, high) = group.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), &p| {
            (low.min(positions[p]), high.max(positions[p]))
        });
        let side = high - low;
        let axis = if side.x >= side.y && side.x >= side.z {
            0
        } else if side.y >= side.z {
            1
        } else {
            2
        };
        let key = |p: &usize| positions[*p].to_array()[axis];
        group.sort_by(|a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
        let rest = group.split_off(group.len() / 2);
        groups[fullest] = group;
        groups.push(rest);
    }
    for (g, group) in groups.iter().enumerate() {
        for &p in group {
            block[p] = g;
        }
    }
    (block, groups.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_neighbours_of_about_equal_number() {
        let points: Vec<DVec3> =
            (0..900).map(|i| DVec3::new((i % 30) as f64, (i / 30) as f64, 0.1 * (i % 7) as f64)).collect();
        let (block, count) = blocks(&points);
        assert_eq!(count, BLOCKS);
        for b in 0..count {
            let members: Vec<DVec3> = (0..900).filter(|&p| block[p] == b).map(|p| points[p]).collect();
            assert!((14..=29).contains(&members.len()), "{}", members.len());
            assert!(members.iter().all(|p| p.distance(members[0]) < 12.0));
        }
        assert_eq!(blocks(&[]).1, 1);
        assert_eq!(blocks(&points[..9]).1, 1);
    }
}
