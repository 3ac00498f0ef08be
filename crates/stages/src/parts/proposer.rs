//! The choice of a proposer, and the opening of a 2D enhancer.

use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::proposers::{Fusion, Proposer};
use use3d_nets::NetError;

use super::weights::NU2NET;

/// The proposer (R25).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ProposerChoice {
    /// `nu2net` if its weights are in the models folder, else `fusion`; the run reports the choice.
    #[default]
    Auto,
    /// Nu2Net; an error if its weights are missing.
    Nu2net,
    /// The classical fusion enhancer; needs no weights.
    Fusion,
}

/// A proposer that cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum ProposerError {
    /// There is no models folder.
    #[error("there is no models folder; name one with --models or USE3D_MODELS")]
    NoModels,
    /// The folder has no file of Nu2Net.
    #[error("its file is missing")]
    NoFile,
    /// The weights of Nu2Net cannot be used.
    #[error(transparent)]
    Network(#[from] NetError),
    /// Nu2Net was requested.
    #[error("proposer nu2net: {0}")]
    Requested(Box<Self>),
    /// A calibrator records Nu2Net.
    #[error("the calibrator was fitted for nu2net: {0}")]
    Recorded(Box<Self>),
    /// A calibrator records another proposer than the requested one.
    #[error(
        "the calibrator was fitted for the proposer `{0}`, but `{1}` is requested; choose \
         `{0}` or `auto`, or fit a calibrator for `{1}`"
    )]
    Other(String, String),
    /// The targets were made without a proposer.
    #[error(
        "the targets of this scene in air leave its photographs as they are; make them with a 2D enhancer \
         (`targets.proposer = \"fusion\"`)"
    )]
    None,
    /// A calibrator records a proposer that this program does not have.
    #[error("the calibrator was fitted for the proposer `{0}`, which this program does not have")]
    Unknown(String),
}

/// The name of the proposer in targets that leave photographs as they are.
pub(crate) const NO_PROPOSER: &str = "none";

impl ProposerChoice {
    /// The name of the choice in pipeline files.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Nu2net => "nu2net",
            Self::Fusion => "fusion",
        }
    }
}

mod network {
    use super::*;
    use use3d_atc::AtcError;
    use use3d_capture::Image;
    use use3d_nets::{InputPolicy, Nu2Net};

    pub(crate) struct Network {
        pub(crate) net: Nu2Net,
        pub(crate) digest: String,
    }

    /// Long side of proposals, pixels, as in 3D-USE.
    const PROPOSAL: usize = 384;
    /// Longest side at which pictures are enhanced at full detail, pixels: this needs about 5 GB of memory.
    /// Larger pictures are enhanced at this size and scaled back to their own.
    const LONGEST: usize = 2048;

    impl Network {
        fn with(&self, image: &Image, policy: InputPolicy) -> Result<Image, AtcError> {
            self.net
                .enhance_with(image, policy)
                .map_err(|e| AtcError::Proposer { proposer: "nu2net".into(), message: e.to_string() })
        }
    }

    impl Proposer for Network {
        fn name(&self) -> &str {
            "nu2net"
        }

        fn digest(&self) -> String {
            self.digest.clone()
        }

        fn propose(&self, image: &Image) -> Result<Image, AtcError> {
            self.with(image, InputPolicy::LongSide(PROPOSAL))
        }

        fn enhance(&self, image: &Image) -> Result<Image, AtcError> {
            let large = image.width().max(image.height()) > LONGEST;
            self.with(image, if large { InputPolicy::LongSide(LONGEST) } else { InputPolicy::MultiplesOf16 })
        }
    }
}

/// Opens a proposer. `models` is the models folder, if there is one. `say` reports the proposer that was
/// chosen if the choice was left open.
pub fn open(
    choice: ProposerChoice,
    models: Option<&Path>,
    say: &mut dyn FnMut(&str),
) -> Result<Box<dyn Proposer>, ProposerError> {
    if choice == ProposerChoice::Fusion {
        return Ok(Box::new(Fusion));
    }
    match nu2net(models) {
        Ok(network) => {
            say("proposer: nu2net");
            Ok(network)
        }
        Err(reason) if choice == ProposerChoice::Auto => {
            say(&format!("proposer: fusion (nu2net is not available: {reason})"));
            Ok(Box::new(Fusion))
        }
        Err(reason) => Err(ProposerError::Requested(Box::new(reason))),
    }
}

/// Opens the proposer that a calibrator was fitted for, by its recorded name. Requesting another one by name
/// is an error (R25).
pub(crate) fn of_calibrator(
    choice: ProposerChoice,
    recorded: &str,
    models: Option<&Path>,
) -> Result<Box<dyn Proposer>, ProposerError> {
    let asked = if choice == ProposerChoice::Auto { recorded } else { choice.name() };
    if asked != recorded {
        return Err(ProposerError::Other(recorded.into(), asked.into()));
    }
    by_name(recorded, models)
}

/// Opens a proposer by the name that a calibrator records.
pub(crate) fn by_name(name: &str, models: Option<&Path>) -> Result<Box<dyn Proposer>, ProposerError> {
    match name {
        "fusion" => Ok(Box::new(Fusion)),
        "nu2net" => nu2net(models).map_err(|reason| ProposerError::Recorded(Box::new(reason))),
        NO_PROPOSER => Err(ProposerError::None),
        other => Err(ProposerError::Unknown(other.into())),
    }
}

fn nu2net(models: Option<&Path>) -> Result<Box<dyn Proposer>, ProposerError> {
    let models = use3d_nets::Models::open(models.ok_or(ProposerError::NoModels)?);
    let net = models.nu2net()?;
    let path = NU2NET.into_iter().find_map(|n| models.find(n)).ok_or(ProposerError::NoFile)?;
    let bytes = std::fs::read(&path).map_err(|source| NetError::Read { path, source })?;
    Ok(Box::new(network::Network { net, digest: blake3::hash(&bytes).to_hex().to_string() }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::Image;
    use use3d_nets::{Nu2Net, weights::StandIn};

    #[test]
    fn the_network_looks_at_full_detail_where_its_images_are_compared() {
        let net = Nu2Net::from_weights(&mut StandIn).unwrap();
        let proposer = network::Network { net, digest: String::new() };
        // Stripes one pixel wide, finer than an image of 384 pixels can show.
        let mut image = Image::new(800, 32);
        for y in 0..32 {
            for x in 0..800 {
                image.set_pixel(x, y, [0.3 + 0.4 * (x % 2) as f32; 3]);
            }
        }
        let contrast = |image: &Image| {
            let steps = (100..700).map(|x| (image.pixel(x + 1, 16)[1] - image.pixel(x, 16)[1]).abs());
            steps.sum::<f32>() / 600.0
        };
        let (proposal, enhanced) = (proposer.propose(&image).unwrap(), proposer.enhance(&image).unwrap());
        assert_eq!((enhanced.width(), enhanced.height()), (800, 32));
        assert!(
            contrast(&enhanced) > 2.0 * contrast(&proposal),
            "{} {}",
            contrast(&enhanced),
            contrast(&proposal)
        );
    }
}
