//! The search for pixels that never change behind edges that last.

use std::path::Path;

use rayon::prelude::*;
use use3d_capture::{Image8, Map};
use use3d_io_image::{ImageError, read_image, shrunk};

use crate::bars::{Bars, bars};

/// The longer side of the pictures in which an overlay is looked for, pixels.
const SIDE: usize = 640;
/// The most pictures of a camera that are worth reading.
pub const ENOUGH: usize = 40;
/// The fewest pictures in which an overlay is looked for.
pub const FEWEST: usize = 8;
/// The largest range of a still pixel: in levels, and as a share of the median range of all pixels.
const STILL: (f64, f64) = (6.0, 0.35);
/// The least median range of all pixels: below it the camera stands still.
const MOVES: u8 = 4;
/// Neighbours of one patch differ by less, in levels, and all of its pixels by less from the first.
const PATCH: (u8, u8) = (12, 24);
/// The step of a lasting edge, in levels, and the share of the pictures that must have it.
const EDGE: (u8, f64) = (10, 0.6);
/// The share of a patch's border that must last.
const LASTING: f64 = 0.6;
/// The distances of the pixels outside, as shares of the width: at once, and behind the colour that JPEG
/// spreads over an edge.
const OUTSIDE: [f64; 2] = [0.006, 0.014];
/// The width of the noise that JPEG spreads from an edge, as a share of the picture's, and its largest
/// range, as a share of the median range.
const RINGING: (f64, f64) = (0.014, 0.5);
/// Gaps inside of the overlay that are closed, as a share of the width: across and down.
const GAPS: (f64, f64) = (0.03, 0.012);
/// The largest hole in the overlay that is filled, as a share of the picture: a clock's digits in a box.
const HOLE: f64 = 0.02;
/// The share of the pictures in which a thin stroke must stand out on both sides.
const STROKE: f64 = 0.9;
/// The distance from a patch of the overlay in which strokes are looked for, as a share of the width.
const NEAR: f64 = 0.05;
/// The smallest part of the overlay, as a share of the picture.
const SMALLEST: f64 = 4e-4;
/// The largest brightness of a bar.
const DARK: u8 = 48;
/// An overlay that hides more of what is between the bars is none.
const MOST: f64 = 0.5;

/// A picture: its brightness alone, or with two channels of colour.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Still {
    /// Its width, pixels.
    pub width: usize,
    /// Its height, pixels.
    pub height: usize,
    /// One channel after the other, each row by row: the brightness, then blue and red less the brightness.
    pub values: Vec<u8>,
}

impl Still {
    /// A picture in colour.
    pub fn of(picture: &Image8) -> Self {
        let (width, height) = (picture.width(), picture.height());
        let mut values = vec![0; 3 * width * height];
        let (lumas, colours) = values.split_at_mut(width * height);
        let (blues, reds) = colours.split_at_mut(width * height);
        for (i, ((luma, blue), red)) in lumas.iter_mut().zip(blues).zip(reds).enumerate() {
            let [r, g, b] = picture.pixel(i % width, i / width).map(f32::from);
            let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
            *luma = y.round() as u8;
            // Halved, they stay within 8 bits.
            (*blue, *red) = ((127.5 + 0.5 * (b - y)).round() as u8, (127.5 + 0.5 * (r - y)).round() as u8);
        }
        Self { width, height, values }
    }

    /// Reads an image, shrunk to about 640 pixels.
    ///
    /// # Errors
    /// The file cannot be read as an image.
    pub fn read(path: &Path) -> Result<Self, ImageError> {
        Ok(Self::of(&shrunk(&read_image(path)?, SIDE)))
    }

    fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// The values of a pixel.
    fn pixel(&self, pixel: usize) -> impl Iterator<Item = u8> {
        self.values[pixel..].iter().step_by(self.pixels()).copied()
    }

    /// The largest difference between two pixels in a channel.
    fn apart(&self, pixel: usize, other: usize) -> u8 {
        self.pixel(pixel).zip(self.pixel(other)).map(|(a, b)| a.abs_diff(b)).max().unwrap_or(0)
    }
}

/// The overlay of a camera's pictures.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Overlay {
    /// The width of the pictures in which it was found.
    pub width: usize,
    /// Their height.
    pub height: usize,
    /// For each pixel, row by row, true if the overlay hides the scene.
    pub hidden: Vec<bool>,
    /// The bars, which are part of it.
    pub bars: Bars,
}

impl Overlay {
    /// The share of the picture that it hides.
    pub fn share(&self) -> f64 {
        self.hidden.iter().filter(|hidden| **hidden).count() as f64 / self.hidden.len().max(1) as f64
    }

    /// The share of the picture that the bars take.
    pub fn bar_share(&self) -> f64 {
        let Bars { left, top, right, bottom } = self.bars;
        let rest = (self.width - left - right) * (self.height - top - bottom);
        1.0 - rest as f64 / (self.width * self.height).max(1) as f64
    }

    /// The part between the bars.
    pub fn without_bars(&self) -> Self {
        let Bars { left, top, right, bottom } = self.bars;
        let (width, height) = (self.width - left - right, self.height - top - bottom);
        let row = |y: usize| self.hidden[(top + y) * self.width + left..][..width].iter().copied();
        Self { width, height, hidden: (0..height).flat_map(row).collect(), bars: Bars::default() }
    }

    /// A mask of a picture of another size: 0 where the overlay hides the scene or is next to it, and 1
    /// elsewhere.
    pub fn mask(&self, width: usize, height: usize) -> Map {
        let part = |i: usize, side: usize, own: usize| {
            let (from, to) = (i * own / side.max(1), ((i + 1) * own).div_ceil(side.max(1)));
            from.saturating_sub(1)..(to + 1).min(own)
        };
        let mut mask = Map::new(width, height);
        let columns: Vec<_> = (0..width).map(|x| part(x, width, self.width)).collect();
        // No other threads help: a caller's own threads may be waiting for this one.
        let mut before = vec![0usize; self.width + 1];
        for (y, line) in mask.data_mut().chunks_exact_mut(width.max(1)).enumerate() {
            let rows = part(y, height, self.height);
            for x in 0..self.width {
                let hides = rows.clone().any(|row| self.hidden[row * self.width + x]);
                before[x + 1] = before[x] + usize::from(hides);
            }
            for (value, columns) in line.iter_mut().zip(&columns) {
                *value = if before[columns.end] > before[columns.start] { 0.0 } else { 1.0 };
            }
        }
        mask
    }
}

/// Finds the overlay of pictures of one camera; `None` if there is none, if the pictures are fewer than
/// [`FEWEST`] or of several sizes, or if the camera does not move between them.
pub fn find(pictures: &[Still]) -> Option<Overlay> {
    let first = pictures.first()?;
    let (width, height) = (first.width, first.height);
    let whole = |p: &Still| !p.values.is_empty() && p.values.len().is_multiple_of(p.pixels());
    let same = |p: &Still| (p.width, p.height, p.values.len()) == (width, height, first.values.len());
    if width < 3 || height < 3 || pictures.len() < FEWEST || !whole(first) || !pictures.iter().all(same) {
        return None;
    }
    let stack = Stack::of(pictures);
    // The range of the scene itself: bars may be most of the picture.
    let mut ranges: Vec<u8> = stack.range.iter().copied().filter(|range| *range >= MOVES).collect();
    if ranges.len() * 10 < stack.range.len() {
        return None;
    }
    ranges.sort_unstable();
    let usual = f64::from(ranges[ranges.len() / 2]);
    let most = STILL.0.min(STILL.1 * usual);
    let still: Vec<bool> = stack.range.iter().map(|range| f64::from(*range) <= most).collect();
    let mut patches = patches(&still, &stack.median);
    let soft: Vec<bool> = stack.range.iter().map(|range| f64::from(*range) <= RINGING.1 * usual).collect();
    grow(&mut patches, &soft, &stack.median);
    let lasting = lasting(pictures, &patches);
    let mut hidden: Vec<bool> =
        patches.iter().map(|patch| patch.is_some_and(|patch| lasting[patch])).collect();
    let least = ((SMALLEST * hidden.len() as f64) as usize).max(4);
    // Strokes and gaps add to patches, and do not make an overlay of a few pixels.
    if hidden.iter().filter(|hidden| **hidden).count() < least {
        return None;
    }
    strokes(pictures, &mut hidden);
    close((width, height), &mut hidden);
    for part in parts((width, height), &hidden, true).into_iter().filter(|part| part.len() < least) {
        part.into_iter().for_each(|pixel| hidden[pixel] = false);
    }
    let largest = (HOLE * hidden.len() as f64) as usize;
    let at_edge = |pixel: &usize| {
        let (x, y) = (pixel % width, pixel / width);
        x == 0 || y == 0 || x + 1 == width || y + 1 == height
    };
    for hole in parts((width, height), &hidden, false) {
        if hole.len() <= largest && !hole.iter().any(at_edge) {
            hole.into_iter().for_each(|pixel| hidden[pixel] = true);
        }
    }
    let dark = |pixel: usize| hidden[pixel] && stack.median.values[pixel] <= DARK;
    let bars = bars((width, height), dark);
    let overlay = Overlay { width, height, hidden, bars };
    let share = overlay.without_bars().share();
    (overlay.hidden.contains(&true) && share <= MOST).then_some(overlay)
}

/// The median of all pictures, and for each pixel the largest range of a channel.
struct Stack {
    median: Still,
    range: Vec<u8>,
}

impl Stack {
    fn of(pictures: &[Still]) -> Self {
        let (count, first) = (pictures.len(), &pictures[0]);
        let of = |value: usize| {
            let mut all: Vec<u8> = pictures.iter().map(|p| p.values[value]).collect();
            all.sort_unstable();
            (all[count / 2], all[count - 1 - count / 10] - all[count / 10])
        };
        let (values, ranges): (Vec<u8>, Vec<u8>) = (0..first.values.len()).into_par_iter().map(of).unzip();
        let ranges = Still { values: ranges, ..*first };
        let range = (0..first.pixels()).map(|pixel| ranges.pixel(pixel).max().unwrap_or(0)).collect();
        Self { median: Still { values, ..*first }, range }
    }
}

/// The four directions: columns and rows.
const DIRECTIONS: [(isize, isize); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];

/// The pixel so far away in a direction, if it is in the picture.
fn beside(
    (width, height): (usize, usize),
    pixel: usize,
    far: usize,
    (dx, dy): (isize, isize),
) -> Option<usize> {
    let x = (pixel % width).checked_add_signed(dx * far as isize).filter(|x| *x < width)?;
    let y = (pixel / width).checked_add_signed(dy * far as isize).filter(|y| *y < height)?;
    Some(y * width + x)
}

/// The four neighbours of a pixel.
fn around(size: (usize, usize), pixel: usize) -> impl Iterator<Item = usize> {
    DIRECTIONS.into_iter().filter_map(move |direction| beside(size, pixel, 1, direction))
}

/// The patch of each still pixel, by its number.
fn patches(still: &[bool], median: &Still) -> Vec<Option<usize>> {
    let size = (median.width, median.height);
    let mut patches = vec![None; still.len()];
    let mut next = 0;
    for start in 0..still.len() {
        if !still[start] || patches[start].is_some() {
            continue;
        }
        patches[start] = Some(next);
        let mut open = vec![start];
        while let Some(pixel) = open.pop() {
            for other in around(size, pixel) {
                let apart = |from: usize| median.apart(from, other);
                let alike = still[other] && apart(pixel) < PATCH.0 && apart(start) < PATCH.1;
                if alike && patches[other].is_none() {
                    patches[other] = Some(next);
                    open.push(other);
                }
            }
        }
        next += 1;
    }
    patches
}

/// Takes the noise that JPEG spreads from an edge into the patches: pixels nearby of the same colour, whose
/// range is small. So their borders come to the edge itself.
fn grow(patches: &mut [Option<usize>], soft: &[bool], median: &Still) {
    let size = (median.width, median.height);
    let steps = ((RINGING.0 * size.0 as f64).round() as usize).max(1);
    // Each pixel with the one that it grew from: it has that colour.
    let mut edge: Vec<(usize, usize)> =
        (0..patches.len()).filter(|pixel| patches[*pixel].is_some()).map(|pixel| (pixel, pixel)).collect();
    for _ in 0..steps {
        let mut next = Vec::new();
        for (pixel, from) in edge {
            for other in around(size, pixel) {
                if patches[other].is_none() && soft[other] && median.apart(from, other) < PATCH.0 {
                    patches[other] = patches[pixel];
                    next.push((other, from));
                }
            }
        }
        edge = next;
    }
}

/// For each patch, true if most of its border has a lasting edge.
fn lasting(pictures: &[Still], patches: &[Option<usize>]) -> Vec<bool> {
    let size = (pictures[0].width, pictures[0].height);
    let far = OUTSIDE.map(|share| ((share * size.0 as f64).round() as usize).max(1));
    let needed = (EDGE.1 * pictures.len() as f64).ceil() as usize;
    let lasts = |pixel: usize, other: usize| {
        let step = |p: &&Still| p.apart(pixel, other) >= EDGE.0;
        pictures.iter().filter(step).count() >= needed
    };
    let mut border = vec![(0usize, 0usize); patches.iter().flatten().max().map_or(0, |most| most + 1)];
    for (pixel, patch) in patches.iter().enumerate() {
        let Some(patch) = patch else { continue };
        for direction in DIRECTIONS {
            let Some(near) = beside(size, pixel, 1, direction) else { continue };
            if patches[near] != Some(*patch) {
                let mut others = far.iter().filter_map(|far| beside(size, pixel, *far, direction));
                border[*patch].0 += usize::from(lasts(pixel, near) || others.any(|q| lasts(pixel, q)));
                border[*patch].1 += 1;
            }
        }
    }
    border.iter().map(|(lasting, all)| *all > 0 && *lasting as f64 >= LASTING * *all as f64).collect()
}

/// Closes gaps: a line of pixels between two hidden ones that is shorter than a gap becomes hidden.
fn close((width, height): (usize, usize), hidden: &mut [bool]) {
    let gap = |share: f64| ((share * width as f64).round() as usize).max(1);
    let mut line = |from: usize, step: usize, count: usize, gap: usize| {
        let mut last: Option<usize> = None;
        for i in 0..count {
            if hidden[from + i * step] {
                if let Some(last) = last.filter(|last| i - last - 1 <= gap) {
                    (last..i).for_each(|k| hidden[from + k * step] = true);
                }
                last = Some(i);
            }
        }
    };
    (0..height).for_each(|y| line(y * width, 1, width, gap(GAPS.0)));
    (0..width).for_each(|x| line(x, width, height, gap(GAPS.1)));
}

/// Adds thin strokes near the overlay: pixels that are brighter than what lies on both sides of them, or
/// darker, in nearly all pictures. Their edges are soft, so their brightness changes with the scene behind.
fn strokes(pictures: &[Still], hidden: &mut [bool]) {
    let size = (pictures[0].width, pictures[0].height);
    let far = ((OUTSIDE[0] * size.0 as f64).round() as usize).max(2);
    let needed = (STROKE * pictures.len() as f64).ceil() as usize;
    let stands_out = |pixel: usize, sides: [Option<usize>; 2]| {
        let [Some(a), Some(b)] = sides else { return false };
        let (mut bright, mut dark) = (0, 0);
        for values in pictures.iter().map(|p| &p.values) {
            let (own, low, high) = (values[pixel], values[a].min(values[b]), values[a].max(values[b]));
            bright += usize::from(own >= high.saturating_add(EDGE.0));
            dark += usize::from(own.saturating_add(EDGE.0) <= low);
        }
        bright >= needed || dark >= needed
    };
    let near = near(size, hidden, (NEAR * size.0 as f64).ceil() as usize);
    let new = |(pixel, hidden): &(usize, &mut bool)| near[*pixel] && !**hidden;
    hidden.par_iter_mut().enumerate().filter(new).for_each(|(pixel, hidden)| {
        let [left, right, above, below] = DIRECTIONS.map(|direction| beside(size, pixel, far, direction));
        *hidden = stands_out(pixel, [left, right]) || stands_out(pixel, [above, below]);
    });
}

/// For each pixel, true if a hidden one is at most so far away, across and down.
fn near((width, height): (usize, usize), hidden: &[bool], far: usize) -> Vec<bool> {
    let spread = |from: &[bool], start: usize, step: usize, count: usize, to: &mut [bool]| {
        for i in (0..count).filter(|i| from[start + i * step]) {
            (i.saturating_sub(far)..(i + far + 1).min(count)).for_each(|k| to[start + k * step] = true);
        }
    };
    let (mut across, mut both) = (vec![false; hidden.len()], vec![false; hidden.len()]);
    (0..height).for_each(|y| spread(hidden, y * width, 1, width, &mut across));
    (0..width).for_each(|x| spread(&across, x, width, height, &mut both));
    both
}

/// The connected parts of the pixels that are hidden, or that are not.
fn parts(size: (usize, usize), hidden: &[bool], which: bool) -> Vec<Vec<usize>> {
    let (mut seen, mut all) = (vec![false; hidden.len()], Vec::new());
    for start in 0..hidden.len() {
        if hidden[start] != which || seen[start] {
            continue;
        }
        let (mut part, mut at) = (vec![start], 0);
        seen[start] = true;
        while at < part.len() {
            for other in around(size, part[at]) {
                if hidden[other] == which && !seen[other] {
                    seen[other] = true;
                    part.push(other);
                }
            }
            at += 1;
        }
        all.push(part);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 96;
    const H: usize = 64;

    /// Brightness of a scene of blocks below open water, seen by a camera that has moved.
    fn scene(x: usize, y: usize, moved: usize) -> u8 {
        let block = |side: usize| {
            let (u, v) = ((x + 5 * moved) / side, (y + 2 * moved) / side);
            (u.wrapping_mul(7919) ^ v.wrapping_mul(104_729)).wrapping_mul(2_654_435_761) >> 16 & 0xFF
        };
        // The reef begins lower or higher.
        if y < 24 + 3 * (moved % 4) { 120 + (y / 4) as u8 } else { ((block(3) + block(7)) / 3 + 40) as u8 }
    }

    fn pictures(count: usize, over: impl Fn(usize, usize, usize) -> Option<u8>) -> Vec<Still> {
        let of = |t: usize| {
            let values = (0..W * H).map(|i| (i % W, i / W));
            let values = values.map(|(x, y)| over(x, y, t).unwrap_or_else(|| scene(x, y, t)));
            Still { width: W, height: H, values: values.collect() }
        };
        (0..count).map(of).collect()
    }

    /// The share of what lies over the pictures that is found, and the share of the rest.
    fn found(count: usize, over: impl Fn(usize, usize, usize) -> Option<u8>) -> (f64, f64, Bars) {
        let overlay = find(&pictures(count, &over)).expect("an overlay");
        let (mut right, mut wrong, mut all) = (0, 0, 0);
        for (i, hidden) in overlay.hidden.iter().enumerate() {
            let over = over(i % W, i / W, 0).is_some();
            all += usize::from(over);
            right += usize::from(*hidden && over);
            wrong += usize::from(*hidden && !over);
        }
        (right as f64 / all as f64, wrong as f64 / (W * H - all) as f64, overlay.bars)
    }

    #[test]
    fn a_scene_with_open_water_has_no_overlay() {
        assert_eq!(find(&pictures(12, |_, _, _| None)), None);
        assert_eq!(find(&pictures(40, |_, _, _| None)), None);
    }

    #[test]
    fn bars_are_found_and_counted() {
        let (right, wrong, bars) = found(12, |_, y, _| (!(5..H - 3).contains(&y)).then_some(0));
        assert!(right == 1.0 && wrong == 0.0, "{right} {wrong}");
        assert_eq!(bars, Bars { left: 0, top: 5, right: 0, bottom: 3 });
        let upright = |x: usize, y: usize, _: usize| (!(32..64).contains(&x) || y == 63).then_some(2);
        assert_eq!(found(12, upright).2, Bars { left: 32, top: 0, right: 32, bottom: 1 });
    }

    #[test]
    fn a_rim_and_text_with_a_clock_over_water_are_found() {
        let rim = |x: usize, y: usize, _: usize| {
            let away = (x as f64 - 47.5) * (x as f64 - 47.5) + (y as f64 - 31.5) * (y as f64 - 31.5);
            (away > 48.0 * 48.0).then_some(3)
        };
        let (right, wrong, _) = found(12, rim);
        assert!(right > 0.95 && wrong < 0.01, "{right} {wrong}");
        // Letters of two columns, in a box; the last one changes.
        let text = |x: usize, y: usize, t: usize| {
            let inside = (4..40).contains(&x) && (3..11).contains(&y);
            let letter = (6..38).contains(&x) && (5..9).contains(&y);
            let clock = if x > 32 { t } else { 0 };
            inside.then_some(if letter && (x / 2 + y + clock).is_multiple_of(3) { 255 } else { 0 })
        };
        let (right, wrong, bars) = found(12, text);
        assert!(right > 0.98 && wrong < 0.01 && bars.is_none(), "{right} {wrong} {bars:?}");
    }

    #[test]
    fn few_pictures_and_a_camera_that_stands_say_nothing() {
        let bars = |_: usize, y: usize, _: usize| (y < 6).then_some(0);
        assert!(find(&pictures(FEWEST, bars)).is_some());
        assert_eq!(find(&pictures(FEWEST - 1, bars)), None);
        let standing = vec![pictures(1, bars).remove(0); 12];
        assert_eq!(find(&standing), None);
        let mut sizes = pictures(12, bars);
        sizes[3].width = 48;
        assert_eq!(find(&sizes), None);
        assert_eq!(find(&[]), None);
    }

    #[test]
    fn a_colour_of_the_same_brightness_is_found() {
        let with_colour = |t: usize| {
            let mut picture = Image8::new(W, H);
            for (x, y) in (0..W * H).map(|i| (i % W, i / W)) {
                let over = (40..56).contains(&x) && y > 40;
                let grey = scene(x, y, t);
                picture.set_pixel(x, y, if over { [190, 110, 20] } else { [grey, grey.max(20), grey] });
            }
            Still::of(&picture)
        };
        let overlay = find(&(0..12).map(with_colour).collect::<Vec<_>>()).unwrap();
        let share = (16 * 23) as f64 / (W * H) as f64;
        assert!((overlay.share() - share).abs() < 0.002, "{} of {share}", overlay.share());
    }

    #[test]
    fn masks_have_any_size_and_bars_are_cut_off() {
        let over = |x: usize, y: usize, _: usize| (y < 8 || (x < 24 && y > 47)).then_some(9);
        let overlay = find(&pictures(12, over)).unwrap();
        assert_eq!(overlay.bars.top, 8);
        let rest = overlay.without_bars();
        assert_eq!((rest.width, rest.height, rest.hidden[rest.hidden.len() - W]), (96, 56, true));
        let mask = overlay.mask(384, 256);
        assert_eq!((mask.pixel(0, 0), mask.pixel(200, 100), mask.pixel(10, 250)), ([0.0], [1.0], [0.0]));
        // What is next to it is hidden, too, and no more.
        let white = mask.data().iter().filter(|v| **v == 1.0).count() as f64 / mask.data().len() as f64;
        assert!((1.0 - white - overlay.share()).abs() < 0.04, "{white}");
        assert_eq!(overlay.mask(48, 32).pixel(0, 31), [0.0]);
    }
}
