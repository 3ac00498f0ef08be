//! The white balance: the references that should be grey.

use std::path::PathBuf;
use std::str::FromStr;

use clap::Args;

/// One way to balance the colours.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum WhiteChoice {
    /// No white balance.
    Off,
    /// The mean colour of reefs; only a part of the cast is corrected.
    Reef,
    /// All clear surfaces together.
    Grey,
    /// A pixel of a photograph that shows something grey.
    Place(Place),
    /// A file of gains.
    File(PathBuf),
}

/// A pixel of a photograph.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Place {
    /// The photograph's name, with or without the part after the last dot.
    pub(crate) view: String,
    /// Column from the left; the first one is 0.
    pub(crate) x: f64,
    /// Row from the top; the first one is 0.
    pub(crate) y: f64,
    /// The size of the picture whose pixels are meant, if it is not the camera's own.
    pub(crate) size: Option<(usize, usize)>,
}

impl Place {
    /// Parses the form in which it is typed.
    fn typed(text: &str) -> Option<Self> {
        let (view, rest) = text.rsplit_once(':').filter(|(view, _)| !view.is_empty())?;
        let (pixel, size) = match rest.split_once('@') {
            Some((pixel, size)) => (pixel, Some(size.split_once('x')?)),
            None => (rest, None),
        };
        let side = |text: &str| text.parse::<usize>().ok().filter(|n| *n > 0);
        let size = match size {
            Some((w, h)) => Some((side(w)?, side(h)?)),
            None => None,
        };
        let (x, y) = pixel.split_once(',')?;
        let number = |text: &str| text.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0);
        Some(Self { view: view.into(), x: number(x)?, y: number(y)?, size })
    }

    /// The form in which it is typed.
    pub(crate) fn text(&self) -> String {
        let size = self.size.map_or_else(String::new, |(w, h)| format!("@{w}x{h}"));
        format!("{}:{},{}{size}", self.view, self.x, self.y)
    }
}

/// The list of choices, for messages.
const EXPECTED: &str = "expected off, reef, grey, a pixel of a photograph that shows something grey or white \
                        (f_0001.jpg:812,430), or a file (white.json)";

impl FromStr for WhiteChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "off" => Ok(Self::Off),
            "reef" => Ok(Self::Reef),
            "grey" | "gray" => Ok(Self::Grey),
            "patch" => {
                Err("give a pixel of a photograph that is grey or white, e.g. f_0001.jpg:812,430".into())
            }
            file if file.to_lowercase().ends_with(".json") => Ok(Self::File(file.into())),
            place => Place::typed(place).map(Self::Place).ok_or_else(|| EXPECTED.to_string()),
        }
    }
}

/// `--white`, of verbs that show a scene.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct WhiteArgs {
    /// Balance the colours of clear, enhanced and enhanced-clear: `off`; by a pixel of a photograph that
    /// shows something grey or white (f_0001.jpg:812,430; may be repeated; the page and `use3d view` have a
    /// picker); by `reef` or `grey`; or by a file. Pixels, reef and grey need the capture, which a results
    /// folder and `run` know. Default: the balance that `use3d white` stored for the scene, or off.
    #[arg(long = "white", value_name = "off|VIEW:X,Y|reef|grey|FILE.json")]
    pub(crate) choices: Vec<WhiteChoice>,
}

/// The arguments of `white`.
#[derive(Clone, Debug, Args)]
pub(crate) struct KeepWhiteArgs {
    /// The scene, or the results folder of a run that made one.
    #[arg(value_name = "SCENE_DIR|RESULTS_DIR")]
    pub(crate) scene: PathBuf,
    /// The reference: one or more pixels of photographs that show something grey or white
    /// (f_0001.jpg:812,430), `reef`, `grey`, a file, or `off`. Without it, the stored balance is printed.
    #[arg(value_name = "VIEW:X,Y|reef|grey|FILE.json|off")]
    pub(crate) choices: Vec<WhiteChoice>,
    /// The capture that the scene was made from.
    #[arg(long, value_name = "CAPTURE")]
    pub(crate) cameras: Option<PathBuf>,
    /// Write the file here, and store nothing beside the scene.
    #[arg(short, long, value_name = "FILE.json")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) replace: super::shared::Replace,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_read_as_they_are_typed() {
        let read = |text: &str| WhiteChoice::from_str(text);
        assert_eq!(read("off"), Ok(WhiteChoice::Off));
        assert_eq!(read("gray"), Ok(WhiteChoice::Grey));
        assert_eq!(read("a/white.json"), Ok(WhiteChoice::File("a/white.json".into())));
        let place = |view: &str, size| Place { view: view.into(), x: 812.0, y: 430.5, size };
        assert_eq!(read("f_0001.jpg:812,430.5"), Ok(WhiteChoice::Place(place("f_0001.jpg", None))));
        let sized = place("a:b", Some((640, 360)));
        assert_eq!(read("a:b:812,430.5@640x360"), Ok(WhiteChoice::Place(sized.clone())));
        assert_eq!(read(&sized.text()), Ok(WhiteChoice::Place(sized)));
        for wrong in [
            "patch",
            "f_0001.jpg",
            "f.jpg:812",
            ":1,2",
            "f.jpg:-1,2",
            "f.jpg:nan,2",
            "f.jpg:1,2@0x9",
            "reefs",
        ] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
