//! A pass over items in a row, some of which are compared with the one before: each is made once.

use std::collections::BTreeSet;

/// Makes the items of `alone`, and both items of each pair `(i, i + 1)` with `i` in `pairs`, each once and in
/// order. `make` also receives the item before if the two are a pair. At most two items are kept.
///
/// # Errors
/// The first error of `make`.
pub(crate) fn each_once<T, E>(
    alone: &BTreeSet<usize>,
    pairs: &BTreeSet<usize>,
    mut make: impl FnMut(usize, Option<&T>) -> Result<T, E>,
) -> Result<(), E> {
    let of_pairs = pairs.iter().flat_map(|i| [*i, i + 1]);
    let all: BTreeSet<usize> = alone.iter().copied().chain(of_pairs).collect();
    let mut before: Option<T> = None;
    for i in all {
        let paired = before.take().filter(|_| i.checked_sub(1).is_some_and(|left| pairs.contains(&left)));
        before = Some(make(i, paired.as_ref())?);
    }
    Ok(())
}

/// At most `most` of `0..n`, evenly spread.
pub(crate) fn evenly(n: usize, most: usize) -> Vec<usize> {
    let count = n.min(most);
    (0..count).map(|k| (2 * k + 1) * n / (2 * count)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_item_of_two_pairs_is_made_once() {
        let visits = |alone: &[usize], pairs: &[usize]| {
            let mut made = Vec::new();
            let (alone, pairs) = (alone.iter().copied().collect(), pairs.iter().copied().collect());
            let done: Result<(), ()> = each_once(&alone, &pairs, |i, before: Option<&usize>| {
                made.push((i, before.copied()));
                Ok(i)
            });
            done.map(|()| made)
        };
        // Views 0 to 4 with all of their pairs; 0 and 4 are held out, too.
        let all = visits(&[0, 4], &[0, 1, 2, 3]).unwrap();
        assert_eq!(all, [(0, None), (1, Some(0)), (2, Some(1)), (3, Some(2)), (4, Some(3))]);
        // Neighbours are compared only where that was asked for.
        assert_eq!(visits(&[1, 2], &[4, 5]).unwrap().len(), 5);
        assert_eq!(visits(&[1, 2], &[2]).unwrap(), [(1, None), (2, None), (3, Some(2))]);
        assert_eq!(visits(&[], &[]), Ok(Vec::new()));
    }

    #[test]
    fn pairs_are_spread_evenly() {
        assert_eq!(evenly(24, 4), [3, 9, 15, 21]);
        assert_eq!(evenly(3, 8), [0, 1, 2]);
        assert!(evenly(0, 8).is_empty() && evenly(8, 0).is_empty());
    }
}
