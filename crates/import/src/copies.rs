//! Photographs that are there more than once: a card that was copied twice, or a copy by a cloud folder.
//!
//! Two files are copies if their bytes are equal. Two views of nearly the same pose are copies, too, if their
//! pictures hardly differ, such as a photograph and the same one saved again.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

use use3d_capture::{Split, View};
use use3d_io_image::{PhotographInfo, read_image, shrunk};

/// Bytes at the beginning of files that are compared first.
const BEGINNING: u64 = 1 << 14;
/// Poses are nearly equal within this share of the swim, and this cosine of the half angle between them.
const NEAR: (f64, f64) = (1e-3, 1.0 - 1e-7);
/// The longer side of the pictures that are compared, pixels, and the mean difference of copies, of 255.
const PICTURE: (usize, f64) = (64, 1.5);
/// A camera that stands still gives more equal pictures than copies do.
const MOST: usize = 4;

/// Groups of views with copies, by index, each sorted; `infos` are their files' properties. A file that
/// cannot be read is no copy.
pub(crate) fn groups(views: &[View], infos: &[PhotographInfo]) -> Vec<Vec<usize>> {
    let mut group: Vec<usize> = (0..views.len()).collect();
    let mut join = |a: usize, b: usize| {
        let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
        group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
    };
    let mut lengths: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for (i, info) in infos.iter().enumerate() {
        lengths.entry(info.length).or_default().push(i);
    }
    for same in lengths.into_values().filter(|same| same.len() > 1) {
        let mut beginnings: BTreeMap<Vec<u8>, Vec<usize>> = BTreeMap::new();
        for i in same {
            if let Ok(bytes) = read(&views[i].image, BEGINNING) {
                beginnings.entry(bytes).or_default().push(i);
            }
        }
        for same in beginnings.into_values() {
            for pair in same.windows(2) {
                let whole = |i: usize| read(&views[pair[i]].image, u64::MAX);
                if matches!((whole(0), whole(1)), (Ok(a), Ok(b)) if a == b) {
                    join(pair[0], pair[1]);
                }
            }
        }
    }
    for near in standing(views) {
        let pictures: Vec<_> =
            near.iter().map(|i| read_image(&views[*i].image).ok().map(|p| shrunk(&p, PICTURE.0))).collect();
        for (k, picture) in pictures.iter().enumerate() {
            for (j, other) in pictures.iter().enumerate().skip(k + 1) {
                let (Some(a), Some(b)) = (picture, other) else { continue };
                let (a, b) = (a.data(), b.data());
                let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
                if a.len() == b.len() && sum <= PICTURE.1 * a.len() as f64 {
                    join(near[k], near[j]);
                }
            }
        }
    }
    let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    group.iter().enumerate().for_each(|(i, g)| groups.entry(*g).or_default().push(i));
    groups.into_values().filter(|group| group.len() > 1).collect()
}

fn read(path: &Path, most: u64) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    std::fs::File::open(path)?.take(most).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Groups of views with nearly equal poses, without those of a camera that stands still.
fn standing(views: &[View]) -> Vec<Vec<usize>> {
    let centres: Vec<_> = views.iter().map(|view| view.camera.pose.center()).collect();
    let reach = centres.iter().map(|c| c.distance(centres[0])).fold(0.0, f64::max);
    let turn = |i: usize| glam::DQuat::from_mat3(&views[i].camera.pose.rotation);
    let near = |a: usize, b: usize| {
        centres[a].distance(centres[b]) <= NEAR.0 * reach && turn(a).dot(turn(b)).abs() >= NEAR.1
    };
    let mut left: Vec<usize> = (0..views.len()).collect();
    let mut groups = Vec::new();
    while let Some(first) = left.first().copied() {
        let (same, others): (Vec<usize>, Vec<usize>) = left.into_iter().partition(|i| near(first, *i));
        left = others;
        if (2..=MOST).contains(&same.len()) {
            groups.push(same);
        }
    }
    groups
}

/// Most names of one group of copies that the sentence has.
const SHOWN: usize = 4;

/// The sentence on copies; `counted` if the split can keep them together.
pub(crate) fn fault(groups: &[Vec<usize>], views: &[View], counted: bool) -> Option<String> {
    let names: Vec<String> = groups
        .iter()
        .map(|group| {
            let shown: Vec<&str> = group.iter().take(SHOWN).map(|i| views[*i].name.as_str()).collect();
            let more = group.len() - shown.len();
            let more = if more > 0 { format!(" and {more} more") } else { String::new() };
            shown.join(" = ") + &more
        })
        .collect();
    let split = match counted {
        true => "The copies of photographs that are kept back are kept back, too",
        false => {
            "The lists of the split may hold out a photograph whose copy is learnt, so scores are too good"
        }
    };
    (!groups.is_empty()).then(|| {
        format!(
            "{} photographs have copies ({}). {split}; remove the copies and find the cameras again",
            groups.len(),
            crate::report::some(&names)
        )
    })
}

/// Moves the copies of held-out views to them, unless no view would be left for training.
pub(crate) fn keep_together(split: &mut Split, groups: &[Vec<usize>]) {
    let mut train = split.train.clone();
    let mut test = split.test.clone();
    for group in groups.iter().filter(|group| group.iter().any(|i| split.test.contains(i))) {
        train.retain(|i| !group.contains(i));
        test.extend(group.iter().filter(|i| split.train.contains(i)));
    }
    if !train.is_empty() {
        test.sort_unstable();
        (split.train, split.test) = (train, test);
    }
}
