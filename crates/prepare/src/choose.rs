//! Chooses the frames of a film: neighbours overlap by a set share, and each is the sharpest of its moment.
//!
//! A frame comes as its sharpness and a thumbnail. The overlap of two thumbnails is searched over shifts
//! `(dx, dy)` in pixels:
//!
//! `overlap = (1 - |dx|/W) (1 - |dy|/H) · trust(r)`,
//!
//! where `r` is the correlation of the parts that meet, and `trust` rises from 0 at `r = 0.2` to 1 at
//! `r = 0.7`. A turn, a swim forward or a new place lowers `r`, so it lowers the overlap like a shift does.
//! Thumbnails have no slow changes of brightness: under water these are alike in all frames.
//!
//! From each chosen frame the search goes forward to the first frame whose overlap is below the target, and
//! takes the sharpest frame of the last part of that way. If a film gives more frames than allowed, the
//! target is lowered; if it gives only a few, it is raised.

use std::collections::HashMap;

/// Width of thumbnails, pixels.
pub(crate) const THUMBNAIL: usize = 48;
/// Radius of the mean that is subtracted from a thumbnail, pixels.
const SLOW: usize = 5;
/// The largest shift that is searched, as a share of width and height.
const FARTHEST: f64 = 0.4;
/// The correlation at which an overlap begins to count, and at which it counts fully.
const TRUST: (f64, f64) = (0.2, 0.7);
/// The targets, from the smallest overlap to the largest; the usual one is [`USUAL`].
const TARGETS: [f64; 9] = [0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.94, 0.97];
/// The usual target.
const USUAL: f64 = 0.8;
/// The number of frames below which the target is raised.
const ENOUGH: usize = 40;
/// The last part of the way to the next frame, in which the sharpest one is taken.
const LAST_PART: f64 = 0.4;
/// A frame is dark or bright beyond use if its mean is outside this range.
const USABLE: (f32, f32) = (6.0, 249.0);

/// A candidate.
#[derive(Clone, Debug)]
pub(crate) struct Frame {
    /// Its number in the film, from 0.
    pub(crate) number: u64,
    /// Mean squared Laplacian of grey values.
    pub(crate) sharpness: f32,
    /// True if it is neither black nor white.
    pub(crate) usable: bool,
    thumbnail: Thumbnail,
}

#[derive(Clone, Debug)]
struct Thumbnail {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Frame {
    /// A candidate from a grey picture, row by row.
    pub(crate) fn new(number: u64, width: usize, height: usize, grey: &[u8]) -> Self {
        let mean = grey.iter().map(|&v| f64::from(v)).sum::<f64>() / grey.len().max(1) as f64;
        Self {
            number,
            sharpness: sharpness(width, height, grey),
            usable: (USABLE.0..USABLE.1).contains(&(mean as f32)),
            thumbnail: Thumbnail::new(width, height, grey),
        }
    }
}

/// The mean squared Laplacian of the inner pixels.
pub(crate) fn sharpness(width: usize, height: usize, grey: &[u8]) -> f32 {
    if width < 3 || height < 3 {
        return 0.0;
    }
    let mut sum = 0.0f64;
    for y in 1..height - 1 {
        let row = |y: usize| &grey[y * width..(y + 1) * width];
        let (above, here, below) = (row(y - 1), row(y), row(y + 1));
        for x in 1..width - 1 {
            let v = |row: &[u8], x: usize| i32::from(row[x]);
            let l = 4 * v(here, x) - v(here, x - 1) - v(here, x + 1) - v(above, x) - v(below, x);
            sum += f64::from(l * l);
        }
    }
    (sum / ((width - 2) * (height - 2)) as f64) as f32
}

impl Thumbnail {
    fn new(width: usize, height: usize, grey: &[u8]) -> Self {
        let small_width = THUMBNAIL.min(width).max(1);
        let small_height = (height * small_width / width.max(1)).max(1);
        let mut small = vec![0.0f32; small_width * small_height];
        for (i, value) in small.iter_mut().enumerate() {
            let (x, y) = (i % small_width, i / small_width);
            let part = |i: usize, side: usize, small: usize| {
                i * side / small..((i + 1) * side / small).max(i * side / small + 1)
            };
            let (columns, rows) = (part(x, width, small_width), part(y, height, small_height));
            let count = (columns.len() * rows.len()) as f32;
            let sum: u32 =
                rows.flat_map(|r| columns.clone().map(move |c| u32::from(grey[r * width + c]))).sum();
            *value = sum as f32 / count;
        }
        let slow = |x: usize, y: usize| {
            let columns = x.saturating_sub(SLOW)..(x + SLOW + 1).min(small_width);
            let rows = y.saturating_sub(SLOW)..(y + SLOW + 1).min(small_height);
            let count = (columns.len() * rows.len()) as f32;
            rows.map(|r| small[r * small_width..][columns.clone()].iter().sum::<f32>()).sum::<f32>() / count
        };
        let values = (0..small.len()).map(|i| small[i] - slow(i % small_width, i / small_width)).collect();
        Self { width: small_width, height: small_height, values }
    }

    /// The share of the picture that both show.
    fn overlap(&self, other: &Self) -> f64 {
        if (self.width, self.height) != (other.width, other.height) {
            return 0.0;
        }
        let farthest = |side: usize| (side as f64 * FARTHEST) as isize;
        let (fx, fy) = (farthest(self.width), farthest(self.height));
        let mut best = 0.0f64;
        for dy in -fy..=fy {
            for dx in -fx..=fx {
                let part = |shift: isize, side: usize| 1.0 - shift.unsigned_abs() as f64 / side as f64;
                let area = part(dx, self.width) * part(dy, self.height);
                // A smaller area cannot win, whatever its correlation.
                if area > best {
                    let r = self.correlation(other, dx, dy);
                    best = best.max(area * ((r - TRUST.0) / (TRUST.1 - TRUST.0)).clamp(0.0, 1.0));
                }
            }
        }
        best
    }

    /// The correlation of this picture at `(x, y)` with the other one at `(x + dx, y + dy)`.
    fn correlation(&self, other: &Self, dx: isize, dy: isize) -> f64 {
        let part = |shift: isize, side: usize| {
            let size = side - shift.unsigned_abs();
            (shift.min(0).unsigned_abs(), shift.max(0) as usize, size)
        };
        let ((ax, bx, w), (ay, by, h)) = (part(dx, self.width), part(dy, self.height));
        let (mut ab, mut aa, mut bb) = (0.0f32, 0.0f32, 0.0f32);
        for row in 0..h {
            let a = &self.values[(ay + row) * self.width + ax..][..w];
            let b = &other.values[(by + row) * self.width + bx..][..w];
            for (a, b) in a.iter().zip(b) {
                ab += a * b;
                aa += a * a;
                bb += b * b;
            }
        }
        // A picture without any detail is like every other one.
        let scale = (f64::from(aa) * f64::from(bb)).sqrt();
        if scale < 1e-3 * (w * h) as f64 { 1.0 } else { f64::from(ab) / scale }
    }
}

/// The sharpest of some frames, the first of equals.
fn sharpest(frames: &[Frame], among: impl Iterator<Item = usize>) -> Option<usize> {
    let usable = among.filter(|&i| frames[i].usable);
    usable.reduce(|best, i| if frames[i].sharpness > frames[best].sharpness { i } else { best })
}

/// The frames for one target.
fn with_overlap(frames: &[Frame], target: f64, overlap: &mut dyn FnMut(usize, usize) -> f64) -> Vec<usize> {
    // The first frame is the sharpest of the first half second.
    let Some(first) = sharpest(frames, 0..frames.len().min(5)).or_else(|| sharpest(frames, 0..frames.len()))
    else {
        return Vec::new();
    };
    let mut chosen = vec![first];
    let mut last = first;
    while let Some(end) = (last + 1..frames.len()).find(|&i| overlap(last, i) < target) {
        let part = ((end - last) as f64 * LAST_PART) as usize;
        let next = sharpest(frames, (end - part).max(last + 1)..end + 1)
            .or_else(|| sharpest(frames, end..frames.len().min(end + 5)));
        let Some(next) = next.or_else(|| (end..frames.len()).find(|&i| frames[i].usable)) else { break };
        chosen.push(next);
        last = next;
    }
    chosen
}

/// The chosen frames, in order, with the overlap that neighbours have at least.
pub(crate) fn choose(frames: &[Frame], most: usize) -> (Vec<usize>, f64) {
    // Several targets ask for the same overlaps.
    let mut known: HashMap<(usize, usize), f64> = HashMap::new();
    let mut overlap = |a: usize, b: usize| {
        *known.entry((a, b)).or_insert_with(|| frames[a].thumbnail.overlap(&frames[b].thumbnail))
    };
    let usual = TARGETS.iter().position(|&t| t == USUAL).unwrap_or(0);
    let mut at = usual;
    let mut chosen = with_overlap(frames, TARGETS[at], &mut overlap);
    while chosen.len() > most && at > 0 {
        at -= 1;
        chosen = with_overlap(frames, TARGETS[at], &mut overlap);
    }
    while at >= usual && chosen.len() < ENOUGH.min(most) && at + 1 < TARGETS.len() {
        let more = with_overlap(frames, TARGETS[at + 1], &mut overlap);
        if more.len() > most {
            break;
        }
        (at, chosen) = (at + 1, more);
    }
    if chosen.len() > most {
        // Even the smallest overlap needs more frames: evenly spread ones are left.
        let n = chosen.len();
        chosen = (0..most).map(|i| chosen[i * n / most]).collect();
        return (chosen, 0.0);
    }
    (chosen, TARGETS[at])
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 240;
    const H: usize = 135;

    /// A texture of several sizes of detail, without a period.
    fn texture(x: i64, y: i64) -> u8 {
        let hash = |x: i64, y: i64| {
            let mut h = (x.wrapping_mul(0x9E37_79B9) ^ y.wrapping_mul(0x85EB_CA6B)) as u64;
            h = (h ^ h >> 15).wrapping_mul(0xD6E8_FEB8_6659_FD93);
            (h >> 40 & 0xFF) as i64
        };
        ((hash(x / 20, y / 20) * 2 + hash(x / 7, y / 7) + hash(x, y)) / 4) as u8
    }

    fn frame(number: u64, shift: i64, blur: bool) -> Frame {
        let at = |x: i64, y: i64| i32::from(texture(x + shift, y));
        let grey: Vec<u8> =
            (0..(W * H) as i64)
                .map(|i| (i % W as i64, i / W as i64))
                .map(|(x, y)| {
                    if blur { ((0..6).map(|d| at(x + d, y)).sum::<i32>() / 6) as u8 } else { at(x, y) as u8 }
                })
                .collect();
        Frame::new(number, W, H, &grey)
    }

    #[test]
    fn overlap_of_shifted_pictures_is_the_shared_part() {
        let first = frame(0, 0, false);
        for (shift, expected) in [(0, 1.0), (12, 0.95), (24, 0.9), (60, 0.75)] {
            let found = first.thumbnail.overlap(&frame(1, shift, false).thumbnail);
            assert!((found - expected).abs() < 0.05, "{shift}: {found}");
        }
        assert!(first.thumbnail.overlap(&frame(1, 5000, false).thumbnail) < 0.5);
    }

    #[test]
    fn a_steady_swim_gives_evenly_spread_sharp_frames() {
        // Two pixels a frame, every third frame sharp.
        let frames: Vec<Frame> = (0..200).map(|i| frame(i, 2 * i as i64, i % 3 != 0)).collect();
        let (chosen, overlap) = choose(&frames, 1000);
        assert!(chosen.len() >= ENOUGH.min(30), "{}", chosen.len());
        let sharp = chosen.iter().filter(|&&i| frames[i].number.is_multiple_of(3)).count();
        assert!(sharp * 10 >= chosen.len() * 8, "{sharp} of {}", chosen.len());
        for pair in chosen.windows(2) {
            assert!(pair[1] > pair[0]);
            let shared = 1.0 - 2.0 * (pair[1] - pair[0]) as f64 / W as f64;
            assert!(shared > overlap - 0.08, "{shared} {overlap}");
        }
    }

    #[test]
    fn fewer_frames_are_taken_where_a_film_stands_still_and_where_few_are_allowed() {
        // It moves, stands for 100 frames, and moves again.
        let shift = |i: i64| 3 * (i.min(60) + (i - 160).max(0));
        let frames: Vec<Frame> = (0..220).map(|i| frame(i, shift(i as i64), false)).collect();
        let (chosen, _) = choose(&frames, 1000);
        let still = chosen.iter().filter(|&&i| (62..158).contains(&i)).count();
        assert!(still <= 1, "{still}");
        let (few, overlap) = choose(&frames, 6);
        assert!(few.len() <= 6 && few.len() >= 4 && overlap < USUAL, "{few:?} {overlap}");
        assert_eq!(choose(&frames, 3).0.len(), 3);
    }

    #[test]
    fn black_frames_are_never_taken() {
        let mut frames: Vec<Frame> = (0..60).map(|i| frame(i, 6 * i as i64, false)).collect();
        for i in (0..10).chain(30..35) {
            frames[i] = Frame::new(i as u64, W, H, &vec![2; W * H]);
        }
        let (chosen, _) = choose(&frames, 100);
        assert!(chosen.len() > 10 && chosen.iter().all(|&i| frames[i].usable), "{chosen:?}");
        assert!(choose(&[], 10).0.is_empty());
        let black = vec![Frame::new(0, W, H, &vec![0; W * H])];
        assert!(choose(&black, 10).0.is_empty());
    }
}
