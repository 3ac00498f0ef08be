//! Bars: dark rows and columns at the sides.

/// Pixels of a row or column that must be overlay.
const FULL: f64 = 0.97;

/// The widths of the bars at the sides, pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bars {
    /// Columns at the left.
    pub left: usize,
    /// Rows at the top.
    pub top: usize,
    /// Columns at the right.
    pub right: usize,
    /// Rows at the bottom.
    pub bottom: usize,
}

impl Bars {
    /// True if there is none.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

/// The bars among pixels that are hidden and dark.
pub(crate) fn bars((width, height): (usize, usize), is_dark: impl Fn(usize) -> bool) -> Bars {
    let full = |pixels: &mut dyn Iterator<Item = usize>| {
        let (mut count, mut dark) = (0, 0);
        for pixel in pixels {
            count += 1;
            dark += usize::from(is_dark(pixel));
        }
        count > 0 && dark as f64 >= FULL * count as f64
    };
    let row = |y: usize| full(&mut (y * width..(y + 1) * width));
    let (top, bottom) = at_both_ends(height, row);
    // Columns count between the bars above and below.
    let column = |x: usize| full(&mut (top..height - bottom).map(|y| y * width + x));
    let (left, right) = at_both_ends(width, column);
    Bars { left, top, right, bottom }
}

/// The number of indices from the first one, and from the last one, that are full; none if all are.
fn at_both_ends(count: usize, full: impl Fn(usize) -> bool) -> (usize, usize) {
    let first = (0..count).take_while(|i| full(*i)).count();
    if first == count {
        return (0, 0);
    }
    (first, (0..count).rev().take_while(|i| full(*i)).count())
}
