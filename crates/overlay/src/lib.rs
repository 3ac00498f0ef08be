//! Finds the overlay of a camera's pictures: bars, burnt-in text, a gripper, the rim of a port. An overlay
//! never moves with the camera, so a scene that is learnt from it has a thing in front of every view.
//!
//! Let `I_t(p)` be pixel `p` of picture `t`, in grey or in colour, 0 to 255. Differences and ranges are
//! those of the channel with the largest. The camera moves between the pictures.
//!
//! * A pixel is *still* if the range of `I_t(p)` from its 10th to its 90th percentile is at most
//!   `min(6, 0.35 M)`, where `M` is the median range of all pixels. Open water is often still, too.
//! * Still neighbours whose medians differ by less than 12, and by less than 24 from the first of them, are
//!   one *patch*.
//! * A pixel `p` on the border of a patch has a *lasting edge* if `|I_t(p) − I_t(q)| ≥ 10` in at least 60 %
//!   of the pictures, where `q` lies a little outside. The edge of a bar lasts. The border of open water
//!   moves with the reef, so its edge does not.
//! * Pixels near a patch that have its colour and a small range belong to it: JPEG spreads noise from an
//!   edge.
//! * A patch belongs to the overlay if 60 % of its border has a lasting edge. So does a pixel of a thin
//!   stroke, which is brighter than what lies on both sides of it in 90 % of the pictures, or darker. Small
//!   gaps and holes, as in a line of text with a clock, are closed.
//! * Rows and columns at the sides that are overlay and dark throughout are *bars*.
//!
//! Limits: at least [`FEWEST`] pictures between which the camera moves; an overlay that lets the scene shine
//! through, or that fades out softly, is not found.

mod bars;
mod find;

pub use bars::Bars;
pub use find::{ENOUGH, FEWEST, Overlay, Still, find};
