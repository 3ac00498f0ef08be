//! The clear view as the authors of a method show it, from the clear render `J = Σ w c`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Image;

/// The way in which the authors of a method show its clear view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum PublishedClear {
    /// They show none.
    #[default]
    None,
    /// `J`, limited to the display range: the clear render itself.
    Clamped,
    /// `J / (1 + J)`.
    ToneMapped,
}

impl PublishedClear {
    /// The picture that they show.
    pub(crate) fn shown(self, clear: &Image) -> Option<Image> {
        match self {
            Self::None => None,
            Self::Clamped => Some(clear.map(|j| j.clamp(0.0, 1.0))),
            Self::ToneMapped => Some(clear.map(|j| j / (1.0 + j))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clear_views_are_clamped_or_mapped() {
        let clear = Image::from_planes(1, 1, vec![0.25, 1.0, 3.0]).expect("a pixel");
        let shown = |by: PublishedClear| by.shown(&clear).map(|image| image.data().to_vec());
        assert_eq!(shown(PublishedClear::None), None);
        assert_eq!(shown(PublishedClear::Clamped), Some(vec![0.25, 1.0, 1.0]));
        assert_eq!(shown(PublishedClear::ToneMapped), Some(vec![0.2, 0.5, 0.75]));
    }
}
