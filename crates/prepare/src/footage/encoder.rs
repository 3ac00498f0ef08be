//! The encoders of films, in the order in which they are chosen.

use std::process::Stdio;

use super::info::Fraction;
use crate::error::PrepareError;
use crate::tools::{self, Program};

/// An encoder with its arguments for a quality near that of the source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FilmEncoder {
    pub(super) name: &'static str,
    arguments: &'static [&'static str],
}

/// H.264 plays everywhere; the others are for an ffmpeg without it.
const ENCODERS: [FilmEncoder; 3] = [
    FilmEncoder { name: "libx264", arguments: &["-crf", "17", "-preset", "medium"] },
    // Players of Apple want this tag.
    FilmEncoder { name: "libx265", arguments: &["-crf", "19", "-preset", "medium", "-tag:v", "hvc1"] },
    FilmEncoder { name: "mpeg4", arguments: &["-qscale:v", "2"] },
];

/// The largest unit that `mpeg4` can have, as parts of a second.
const MPEG4_PARTS: u32 = 65_535;

/// The first encoder in the list of an ffmpeg.
fn first(list: &str) -> Option<FilmEncoder> {
    let has = |name: &str| list.lines().any(|l| l.split_whitespace().nth(1) == Some(name));
    ENCODERS.into_iter().find(|encoder| has(encoder.name))
}

impl FilmEncoder {
    /// The best encoder that an ffmpeg has.
    ///
    /// # Errors
    /// It has none of them, or cannot be started.
    pub(super) fn of(ffmpeg: &Program) -> Result<Self, PrepareError> {
        let mut command = tools::command(&ffmpeg.path);
        let output = command.args(["-hide_banner", "-encoders"]).stdin(Stdio::null()).output();
        let output = output.map_err(PrepareError::run(&ffmpeg.path))?;
        first(&String::from_utf8_lossy(&output.stdout)).ok_or_else(|| {
            PrepareError::Program(format!(
                "{} can write no film: it has none of the encoders libx264, libx265 and mpeg4; install the ffmpeg of \
                 your system (`sudo apt install ffmpeg`, `brew install ffmpeg`)",
                ffmpeg.path.display()
            ))
        })
    }

    /// Its arguments, with another quality if one is given: smaller is better.
    pub(super) fn arguments(self, quality: Option<u8>) -> Vec<String> {
        let mut arguments: Vec<String> = self.arguments.iter().map(ToString::to_string).collect();
        if let (Some(quality), true) = (quality, self.name != "mpeg4") {
            arguments[1] = quality.to_string();
        }
        [vec!["-c:v".into(), self.name.into()], arguments].concat()
    }

    /// The unit of time stamps that it writes for a film with this one.
    pub(super) fn time_base(self, unit: Fraction) -> Fraction {
        if self.name == "mpeg4" && unit.under > MPEG4_PARTS {
            return Fraction { over: 1, under: 60_000 };
        }
        unit
    }

    /// A remark if it is not the usual one.
    pub(super) fn remark(self) -> Option<String> {
        (self != ENCODERS[0]).then(|| {
            format!(
                "this ffmpeg has no libx264: the film is written with {}, which fewer players know",
                self.name
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_encoder_is_taken_and_others_are_named() {
        let line = |name: &str| format!(" V....D {name}   {name} of libx264\n");
        let all = [line("mpeg4"), line("libx265"), line("libx264")].concat();
        let best = first(&all).unwrap();
        assert_eq!((best.name, best.remark()), ("libx264", None));
        assert_eq!(best.arguments(Some(20))[..4], ["-c:v", "libx264", "-crf", "20"]);
        let last = first(&line("mpeg4")).unwrap();
        assert!(last.remark().unwrap().contains("mpeg4"));
        assert_eq!(last.arguments(Some(20)), ["-c:v", "mpeg4", "-qscale:v", "2"]);
        assert_eq!(last.time_base(Fraction { over: 1, under: 90_000 }).under, 60_000);
        assert_eq!(first(&line("libx264rgb")), None);
    }
}
