//! The term of the field itself: total variation of its factors.

use use3d_ubaf::variation;

use super::{LossTerm, Reads};

/// The term's row of the table.
pub(super) const TERM: LossTerm = LossTerm {
    name: "variation",
    title: "total variation",
    weight: |params| params.lambda_variation,
    reads: Reads::Field { value: variation::forward, backward: variation::backward },
};
