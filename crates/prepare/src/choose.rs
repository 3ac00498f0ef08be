//! Chooses the frames of a film: neighbours overlap by a set share, and each is the sharpest of its moment.
//!
//! A frame comes as its sharpness and a small grey picture. What lies over all frames and never moves, such
//! as bars or text, would make them all alike: bars are cut off the small pictures, and the rest of it does
//! not count. The overlap of two thumbnails is searched over shifts `(dx, dy)` in pixels:
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
use std::sync::Arc;

use use3d_capture::Image8;
use use3d_overlay::{Bars, Overlay};

/// Width of small pictures, pixels.
const SMALL: usize = 96;
/// Width of thumbnails, pixels.
pub(crate) const THUMBNAIL: usize = 48;
/// The share of a thumbnail that must be free of an overlay, or all of it counts.
const FREE: f64 = 0.25;
/// Radius of the mean that is subtracted from a thumbnail, pixels.
const SLOW: usize = 5;
/// The largest shift that is searched, as a share of width and height.
const FARTHEST: f64 = 0.4;
/// The correlation at which an overlap begins to count, and at which it counts fully.
const TRUST: (f64, f64) = (0.2, 0.7);
/// The targets, from the smallest overlap to the largest; the usual one is [`USUAL`].
const TARGETS: [f64; 10] = [0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.94, 0.97, 0.985];
/// Frames that overlap by more show the same.
const STILL: f64 = 0.985;
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
    small: Small,
}

/// A small grey picture.
#[derive(Clone, Debug)]
struct Small {
    width: usize,
    height: usize,
    values: Vec<u8>,
}

/// A picture without slow changes of brightness.
#[derive(Clone, Debug)]
struct Thumbnail {
    width: usize,
    height: usize,
    /// Zero where an overlay lies.
    values: Vec<f32>,
    /// One where the scene is, and zero where an overlay lies; `None` without one.
    free: Option<Arc<[f32]>>,
    shifts: Arc<[Shift]>,
}

/// A shift of one picture against another: the share of the picture that both show, and pixels in x and y.
type Shift = (f64, isize, isize);

/// All shifts of thumbnails of a size, those that leave the largest part first.
fn shifts((width, height): (usize, usize)) -> Arc<[Shift]> {
    let farthest = |side: usize| (side as f64 * FARTHEST) as isize;
    let (fx, fy) = (farthest(width), farthest(height));
    let part = |shift: isize, side: usize| 1.0 - shift.unsigned_abs() as f64 / side as f64;
    let all = (-fy..=fy).flat_map(|dy| (-fx..=fx).map(move |dx| (dx, dy)));
    let mut all: Vec<Shift> = all.map(|(dx, dy)| (part(dx, width) * part(dy, height), dx, dy)).collect();
    all.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
    all.into()
}

impl Frame {
    /// A candidate from a grey picture, row by row.
    pub(crate) fn new(number: u64, width: usize, height: usize, grey: &[u8]) -> Self {
        let mean = grey.iter().map(|&v| f64::from(v)).sum::<f64>() / grey.len().max(1) as f64;
        Self {
            number,
            sharpness: sharpness(width, height, grey),
            usable: (USABLE.0..USABLE.1).contains(&(mean as f32)),
            small: Small::new(width, height, grey),
        }
    }

    /// A small grey picture of it.
    pub(crate) fn picture(&self) -> Image8 {
        let Small { width, height, values } = &self.small;
        let mut picture = Image8::new(*width, *height);
        for (i, value) in values.iter().enumerate() {
            picture.set_pixel(i % width, i / width, [*value; 3]);
        }
        picture
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

/// Means of a grey picture over the cells of a smaller one, each from the columns and rows of the larger one.
fn means(
    (width, grey): (usize, &[u8]),
    (x0, y0, w, h): (usize, usize, usize, usize),
    (small_width, small_height): (usize, usize),
) -> impl Iterator<Item = f32> {
    let part = |i: usize, side: usize, small: usize| {
        i * side / small..((i + 1) * side / small).max(i * side / small + 1)
    };
    (0..small_width * small_height).map(move |i| {
        let columns = part(i % small_width, w, small_width);
        let rows = part(i / small_width, h, small_height);
        let count = (columns.len() * rows.len()) as f32;
        let line =
            |row: usize| grey[(y0 + row) * width + x0..][columns.clone()].iter().map(|v| u32::from(*v));
        rows.flat_map(line).sum::<u32>() as f32 / count
    })
}

impl Small {
    fn new(width: usize, height: usize, grey: &[u8]) -> Self {
        let small = SMALL.min(width).max(1);
        let size = (small, (height * small / width.max(1)).max(1));
        let values = means((width, grey), (0, 0, width, height), size).map(|v| v.round() as u8).collect();
        Self { width: size.0, height: size.1, values }
    }
}

/// The part of small pictures that counts.
struct FreePart {
    /// Left, top, width and height in the small picture.
    part: (usize, usize, usize, usize),
    /// The size of thumbnails.
    size: (usize, usize),
    free: Option<Arc<[f32]>>,
    shifts: Arc<[Shift]>,
}

impl FreePart {
    fn new(small: &Small, overlay: Option<&Overlay>) -> Self {
        let bars = overlay.map_or(Bars::default(), |overlay| overlay.bars);
        let (across, down) = overlay.map_or((1, 1), |overlay| (overlay.width, overlay.height));
        // A pixel of the small picture that a bar touches is left out.
        let left = (bars.left * small.width).div_ceil(across);
        let top = (bars.top * small.height).div_ceil(down);
        let width = small.width.saturating_sub(left + (bars.right * small.width).div_ceil(across)).max(1);
        let height = small.height.saturating_sub(top + (bars.bottom * small.height).div_ceil(down)).max(1);
        let thumbnail = THUMBNAIL.min(width);
        let size = (thumbnail, (height * thumbnail / width).max(1));
        let free = overlay.map(Overlay::without_bars).filter(|rest| rest.hidden.contains(&true));
        let free = free.map(|rest| rest.mask(size.0, size.1).data().to_vec());
        let enough = |free: &Vec<f32>| free.iter().sum::<f32>() as f64 >= FREE * free.len() as f64;
        let part = (left.min(small.width - 1), top.min(small.height - 1), width, height);
        Self { part, size, free: free.filter(enough).map(Arc::from), shifts: shifts(size) }
    }

    fn thumbnail(&self, small: &Small) -> Thumbnail {
        let (w, h) = self.size;
        let small: Vec<f32> = means((small.width, &small.values), self.part, self.size).collect();
        let weight = |i: usize| self.free.as_ref().map_or(1.0, |free| free[i]);
        let slow = |x: usize, y: usize| {
            let columns = x.saturating_sub(SLOW)..(x + SLOW + 1).min(w);
            let (mut sum, mut count) = (0.0, 0.0);
            for row in y.saturating_sub(SLOW)..(y + SLOW + 1).min(h) {
                for i in columns.clone().map(|column| row * w + column) {
                    sum += weight(i) * small[i];
                    count += weight(i);
                }
            }
            if count > 0.0 { sum / count } else { 0.0 }
        };
        let values = (0..small.len()).map(|i| weight(i) * (small[i] - slow(i % w, i / w))).collect();
        let (free, shifts) = (self.free.clone(), self.shifts.clone());
        Thumbnail { width: w, height: h, values, free, shifts }
    }
}

impl Thumbnail {
    /// The share of the picture that both show.
    fn overlap(&self, other: &Self) -> f64 {
        if (self.width, self.height) != (other.width, other.height) {
            return 0.0;
        }
        let mut best = 0.0f64;
        for &(area, dx, dy) in self.shifts.iter() {
            // A smaller area cannot win, whatever its correlation.
            if area <= best {
                break;
            }
            let r = self.correlation(other, dx, dy);
            best = best.max(area * ((r - TRUST.0) / (TRUST.1 - TRUST.0)).clamp(0.0, 1.0));
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
        let mut count = 0.0f32;
        for row in 0..h {
            let (from_a, from_b) = ((ay + row) * self.width + ax, (by + row) * self.width + bx);
            let (a, b) = (&self.values[from_a..][..w], &other.values[from_b..][..w]);
            match &self.free {
                None => {
                    for (a, b) in a.iter().zip(b) {
                        ab += a * b;
                        aa += a * a;
                        bb += b * b;
                    }
                    count += w as f32;
                }
                // Only places that are free in both pictures count.
                Some(free) => {
                    let (free_a, free_b) = (&free[from_a..][..w], &free[from_b..][..w]);
                    for ((a, b), (in_a, in_b)) in a.iter().zip(b).zip(free_a.iter().zip(free_b)) {
                        ab += a * b;
                        aa += a * a * in_b;
                        bb += b * b * in_a;
                        count += in_a * in_b;
                    }
                }
            }
        }
        // A picture without any detail is like every other one.
        let scale = (f64::from(aa) * f64::from(bb)).sqrt();
        if scale < 1e-3 * f64::from(count.max(1.0)) { 1.0 } else { f64::from(ab) / scale }
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

/// True if all usable frames show the same as the first one.
fn stands(frames: &[Frame], overlap: &mut dyn FnMut(usize, usize) -> f64) -> bool {
    let usable: Vec<usize> = (0..frames.len()).filter(|i| frames[*i].usable).collect();
    let some: Vec<usize> = usable.iter().step_by((usable.len() / 8).max(1)).copied().collect();
    some.len() > 1 && some[1..].iter().all(|other| overlap(some[0], *other) >= STILL)
}

/// The overlap of neighbouring images.
pub(crate) struct SeenTogether {
    /// The overlap of each image with the next one.
    pub(crate) neighbours: Vec<f64>,
    /// True if all show the same.
    pub(crate) stands: bool,
}

/// Measures what neighbouring images of one camera have in common.
pub(crate) fn seen_together(frames: &[Frame], overlay: Option<&Overlay>) -> SeenTogether {
    let thumbnail = |frame: &Frame| FreePart::new(&frame.small, overlay).thumbnail(&frame.small);
    let all: Vec<Thumbnail> = frames.iter().map(thumbnail).collect();
    let neighbours = all.windows(2).map(|pair| pair[0].overlap(&pair[1])).collect();
    SeenTogether { neighbours, stands: stands(frames, &mut |a, b| all[a].overlap(&all[b])) }
}

/// The choice of a film's frames, and the figures on which it rests.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct FrameChoice {
    /// The indices of the chosen frames, in order.
    pub(crate) frames: Vec<usize>,
    /// The overlap that neighbours have at least; 0 if the limit of frames is too small for the film.
    pub(crate) overlap: f64,
    /// Frames that are neither black nor white.
    pub(crate) usable: usize,
    /// True if all frames show the same place.
    pub(crate) stands: bool,
}

/// Chooses at most `most` frames. `wanted` is the overlap of neighbours, if the user gives one.
pub(crate) fn choose(
    frames: &[Frame],
    most: usize,
    wanted: Option<f64>,
    overlay: Option<&Overlay>,
) -> FrameChoice {
    let Some(first) = frames.first() else { return FrameChoice::default() };
    let window = FreePart::new(&first.small, overlay);
    let thumbnails: Vec<Thumbnail> = frames.iter().map(|frame| window.thumbnail(&frame.small)).collect();
    // Several targets ask for the same overlaps.
    let mut known: HashMap<(usize, usize), f64> = HashMap::new();
    let mut overlap =
        |a: usize, b: usize| *known.entry((a, b)).or_insert_with(|| thumbnails[a].overlap(&thumbnails[b]));
    let stands = stands(frames, &mut overlap);
    let usable = frames.iter().filter(|frame| frame.usable).count();
    let (chosen, least) = match wanted {
        Some(target) => (with_overlap(frames, target, &mut overlap), target),
        None => by_targets(frames, most, &mut overlap),
    };
    // Even the smallest overlap may need more frames: evenly spread ones are left.
    let n = chosen.len();
    let (frames, overlap) = match n > most {
        true => ((0..most).map(|i| chosen[i * n / most]).collect(), 0.0),
        false => (chosen, least),
    };
    FrameChoice { frames, overlap, usable, stands }
}

/// The frames for the usual target, or for a lower or a higher one if these are too many or only a few; and
/// the target.
fn by_targets(
    frames: &[Frame],
    most: usize,
    overlap: &mut dyn FnMut(usize, usize) -> f64,
) -> (Vec<usize>, f64) {
    let usual = TARGETS.iter().position(|&t| t == USUAL).unwrap_or(0);
    let mut at = usual;
    let mut chosen = with_overlap(frames, TARGETS[at], overlap);
    while chosen.len() > most && at > 0 {
        at -= 1;
        chosen = with_overlap(frames, TARGETS[at], overlap);
    }
    while at >= usual && chosen.len() < ENOUGH.min(most) && at + 1 < TARGETS.len() {
        let more = with_overlap(frames, TARGETS[at + 1], overlap);
        if more.len() > most {
            break;
        }
        (at, chosen) = (at + 1, more);
    }
    (chosen, TARGETS[at])
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_overlay::{Still, find};

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
        let thumbnail = |shift: i64| {
            let small = frame(0, shift, false).small;
            FreePart::new(&small, None).thumbnail(&small)
        };
        for (shift, expected) in [(0, 1.0), (12, 0.95), (24, 0.9), (60, 0.75)] {
            let found = thumbnail(0).overlap(&thumbnail(shift));
            assert!((found - expected).abs() < 0.05, "{shift}: {found}");
        }
        assert!(thumbnail(0).overlap(&thumbnail(5000)) < 0.5);
    }

    #[test]
    fn a_steady_swim_gives_evenly_spread_sharp_frames() {
        // Two pixels a frame, every third frame sharp.
        let frames: Vec<Frame> = (0..200).map(|i| frame(i, 2 * i as i64, i % 3 != 0)).collect();
        let FrameChoice { frames: chosen, overlap, stands, .. } = choose(&frames, 1000, None, None);
        assert!(!stands);
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
        let chosen = choose(&frames, 1000, None, None).frames;
        let still = chosen.iter().filter(|&&i| (62..158).contains(&i)).count();
        assert!(still <= 1, "{still}");
        let FrameChoice { frames: few, overlap, .. } = choose(&frames, 6, None, None);
        assert!(few.len() <= 6 && few.len() >= 4 && overlap < USUAL, "{few:?} {overlap}");
        assert_eq!(choose(&frames, 3, None, None).frames.len(), 3);
    }

    #[test]
    fn a_camera_that_stands_is_seen_and_a_wanted_overlap_is_kept() {
        let standing: Vec<Frame> = (0..60).map(|i| frame(i, 0, false)).collect();
        assert!(choose(&standing, 100, None, None).stands);
        let slow: Vec<Frame> = (0..50).map(|i| frame(i, i as i64, false)).collect();
        let [usual, more] =
            [Some(0.8), Some(0.97)].map(|wanted| choose(&slow, 100, wanted, None).frames.len());
        assert!(usual <= 3 && more > 2 * usual, "{usual} {more}");
    }

    #[test]
    fn what_lies_over_all_frames_does_not_count() {
        // Bars above and below, and a box of text. Haze makes the scene weak beside them.
        let hazy = |x: i64, y: i64| 100 + texture(x, y) / 5;
        let over = |x: usize, y: usize| match (x, y) {
            _ if !(12..H - 12).contains(&y) => Some(0),
            (20..110, 20..36) => Some(if (x / 3 + y / 4).is_multiple_of(2) { 255 } else { 0 }),
            _ => None,
        };
        let grey = |shift: i64| -> Vec<u8> {
            let pixels = (0..W * H).map(|i| (i % W, i / W));
            pixels.map(|(x, y)| over(x, y).unwrap_or_else(|| hazy(x as i64 + shift, y as i64))).collect()
        };
        let greys: Vec<Vec<u8>> = (0..60).map(|i| grey(6 * i)).collect();
        let pictures =
            greys.iter().step_by(3).map(|values| Still { width: W, height: H, values: values.clone() });
        let overlay = find(&pictures.collect::<Vec<_>>()).unwrap();
        let frames: Vec<Frame> = (0..).zip(&greys).map(|(i, grey)| Frame::new(i, W, H, grey)).collect();
        let plain = |shift: i64| -> Vec<u8> {
            (0..(W * H) as i64).map(|i| hazy(i % W as i64 + shift, i / W as i64)).collect()
        };
        let plain: Vec<Frame> = (0..60).map(|i| Frame::new(i, W, H, &plain(6 * i as i64))).collect();
        let count = |frames: &[Frame], overlay| choose(frames, 100, Some(0.8), overlay).frames.len();
        let (with, without) = (count(&frames, Some(&overlay)), count(&plain, None));
        assert!(with.abs_diff(without) <= without / 10 + 1, "{with} {without}");
        let misled = count(&frames, None);
        assert!(misled.abs_diff(without) > without / 4, "{misled} {without}");
    }

    #[test]
    fn black_frames_are_never_taken() {
        let mut frames: Vec<Frame> = (0..60).map(|i| frame(i, 6 * i as i64, false)).collect();
        for i in (0..10).chain(30..35) {
            frames[i] = Frame::new(i as u64, W, H, &vec![2; W * H]);
        }
        let FrameChoice { frames: chosen, usable, .. } = choose(&frames, 100, None, None);
        assert_eq!(usable, 45);
        assert!(chosen.len() > 10 && chosen.iter().all(|&i| frames[i].usable), "{chosen:?}");
        assert!(choose(&[], 10, None, None).frames.is_empty());
        let black = vec![Frame::new(0, W, H, &vec![0; W * H])];
        assert!(choose(&black, 10, None, None).frames.is_empty());
    }
}
