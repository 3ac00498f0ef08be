//! Faults of names: the model and the folder call a photograph by two names that people take for one.

use super::folder::{Done, Spoiler};
use crate::error::SynthError;

pub(super) fn leading_folder(s: &Spoiler<'_>) -> Done {
    s.rename_in_model(|_, name| format!("images/{name}"))
}

pub(super) fn card_folder(s: &Spoiler<'_>) -> Done {
    s.rename_in_model(|_, name| format!("100GOPRO/{name}"))
}

pub(super) fn full_path(s: &Spoiler<'_>) -> Done {
    s.rename_in_model(|_, name| format!("Users/diver/Pictures/2026 reef/{name}"))
}

pub(super) fn extension(s: &Spoiler<'_>) -> Done {
    s.rename_in_model(|_, name| format!("{}.JPG", use3d_capture::stem(name)))
}

pub(super) fn letter_case(s: &Spoiler<'_>) -> Done {
    s.rename_in_model(|_, name| name.to_uppercase())
}

/// The umlaut is one character in the model and two in the files.
pub(super) fn unicode_form(s: &Spoiler<'_>) -> Done {
    s.rename_photographs(|i, _| format!("Ho\u{308}hle_{:04}.png", i + 1))?;
    s.rename_in_model(|i, _| format!("H\u{f6}hle_{:04}.png", i + 1))
}

pub(super) fn no_zeros(s: &Spoiler<'_>) -> Done {
    s.rename_photographs(|i, _| format!("{}.png", i + 1))
}

pub(super) fn patterns(s: &Spoiler<'_>) -> Done {
    s.rename_photographs(|i, _| format!("my%20dive %d_{:04}.png", i + 1))
}

/// Two folders with equal names, and a model that names no folder.
pub(super) fn ambiguous(s: &Spoiler<'_>) -> Done {
    for path in s.photographs()? {
        let name = path.file_name().unwrap_or_default();
        let copy = s.path("images/right").join(name);
        s.rename(&path, &s.path("images/left").join(name))?;
        std::fs::create_dir_all(s.path("images/right")).map_err(SynthError::io(s.dir))?;
        std::fs::copy(s.path("images/left").join(name), &copy).map_err(SynthError::io(&copy))?;
    }
    Ok(())
}
