//! The choices and actions of an import, printed and stored.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};
use use3d_capture::shown;

/// The report of an import.
///
/// The stored part follows from the files that are read. Information on other files in the folder, and the
/// folder's name, are printed and not stored, so that equal captures give equal bytes at any place.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ImportReport {
    /// The capture's name, which is its folder's name. Not stored.
    #[serde(skip_serializing, default)]
    pub name: String,
    /// The model's folder or file, relative to the capture.
    pub model: String,
    /// `binary` or `text` for a model of COLMAP, or else the form of another program, such as `Agisoft XML`.
    pub model_form: String,
    /// Other models in the capture that are not used, with their numbers of images. Not stored.
    #[serde(skip_serializing, default)]
    pub other_models: Vec<String>,
    /// The image folder, relative to the capture.
    pub image_folder: String,
    /// Other image folders in the capture that are not used. Not stored.
    #[serde(skip_serializing, default)]
    pub other_image_folders: Vec<String>,
    /// Number of images that the model lists.
    pub registered: usize,
    /// Number of views: listed images that exist.
    pub views: usize,
    /// Listed images that do not exist and are skipped.
    pub missing: Vec<String>,
    /// Listed images that are left out because the model places them far away from all others.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub stray: Vec<String>,
    /// Listed images that are left out because their files cannot be used, with the reasons.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", default)]
    pub unusable: BTreeMap<String, String>,
    /// Number of photographs that are EXR files. Not stored.
    #[serde(skip_serializing, default)]
    pub exr: usize,
    /// Images in the folder that the model does not list and that are not used. Not stored.
    #[serde(skip_serializing, default)]
    pub extra: Vec<String>,
    /// Cameras by lens and image size.
    pub cameras: Vec<CameraReport>,
    /// Number of sparse points.
    pub points: usize,
    /// Number of views with a mask file.
    pub masks: usize,
    /// Number of views whose alpha channel serves as a mask.
    pub alpha_masks: usize,
    /// The mask folder, relative to the capture, if there is one. Not stored.
    #[serde(skip_serializing, default)]
    pub mask_folder: Option<String>,
    /// Files in the mask folder that are masks of no photograph. Not stored.
    #[serde(skip_serializing, default)]
    pub stray_masks: Vec<String>,
    /// Views without a mask, if other views have one. Not stored.
    #[serde(skip_serializing, default)]
    pub unmasked: Vec<String>,
    /// Number of views with a depth prior.
    pub depth_priors: usize,
    /// The folder of the depth priors, if there is one.
    pub depth_folder: Option<String>,
    /// The rule by which the split was made.
    pub split_rule: String,
    /// Names of the training views.
    pub train: Vec<String>,
    /// Names of the test views.
    pub test: Vec<String>,
    /// True if the frame was normalised.
    pub normalised: bool,
    /// The scale of the frame, `x_normalised = scale R x + t`.
    pub scale: f64,
    /// The overlay of the photographs, once they were looked at; `None` without one.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub overlay: Option<OverlayReport>,
    /// Gains of the white balance for R, G, B, once computed.
    pub white_balance: Option<[f32; 3]>,
    /// Faults that cost something and stop nothing, each with its next step.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub faults: Vec<String>,
    /// Further remarks.
    pub notes: Vec<String>,
}

/// One camera of the model with one size of image file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CameraReport {
    /// The camera's id in the model.
    pub id: u32,
    /// The lens model, by the name that the program has for it.
    pub model: String,
    /// Number of views taken with it.
    pub views: usize,
    /// The image size in the model.
    pub model_size: [usize; 2],
    /// The size of the files.
    pub file_size: [usize; 2],
    /// The size after undistortion, if there was any.
    pub undistorted_size: Option<[usize; 2]>,
    /// The final size.
    pub size: [usize; 2],
}

/// The overlay of the photographs of one camera or several, which a mask hides.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct OverlayReport {
    /// Number of views that it lies over.
    pub views: usize,
    /// The largest share of a picture that it hides, 0 to 1.
    pub share: f64,
}

impl OverlayReport {
    /// The line in the log of an import.
    pub fn note(&self) -> String {
        format!("note: {self} `--set import.hide_overlay=false` shows it")
    }
}

/// A sentence on it.
impl fmt::Display for OverlayReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} photographs show the same thing in the same place, such as bars, text or a part of the ROV. A mask hides \
             it: {:.1} % of the picture.",
            self.views,
            100.0 * self.share
        )
    }
}

/// Names, made safe for printing.
fn list<S: AsRef<str>>(names: &[S]) -> String {
    names.iter().map(|n| shown(n.as_ref())).collect::<Vec<_>>().join(", ")
}

/// The first few names, and the number of the others.
pub(crate) fn some<S: AsRef<str>>(names: &[S]) -> String {
    let first = list(&names[..names.len().min(6)]);
    match names.len().saturating_sub(6) {
        0 => first,
        more => format!("{first} and {more} more"),
    }
}

/// A number with its noun and verb.
fn counted(count: usize, one: &str, several: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { several })
}

impl ImportReport {
    /// A sentence on the files in the mask folder, if they are masks of no photograph and so have no effect.
    pub fn misnamed_masks(&self) -> Option<String> {
        if self.masks > 0 || self.stray_masks.is_empty() {
            return None;
        }
        let folder = shown(self.mask_folder.as_deref().unwrap_or_default());
        let (files, none) = match self.stray_masks.len() {
            1 => ("1 file".into(), "it does not have"),
            count => (format!("{count} files"), "none of them has"),
        };
        let masks = some(&self.stray_masks);
        let name = self.train.iter().chain(&self.test).min().map_or("", String::as_str);
        Some(format!(
            "{folder}/ holds {files} ({masks}), and {none} the name of a photograph (such as {}).",
            shown(name)
        ))
    }
}

impl ImportReport {
    /// The report in lines, each with true if it is a detail for experts.
    pub fn lines(&self) -> Vec<(bool, String)> {
        const DETAIL: bool = true;
        let (model, form) = (shown(&self.model), shown(&self.model_form));
        let mut lines = vec![(
            !DETAIL,
            format!(
                "{}: it is known for {} where the camera was, and {} points of the scene are known from them",
                shown(&self.name),
                counted(self.views, "photograph", "photographs"),
                self.points
            ),
        )];
        let mut add = |detail: bool, text: String| lines.push((detail, text));
        let others = |names: &[String], what: &str| match names {
            [] => String::new(),
            names => format!("; {what}: {}", list(names)),
        };
        let unused = others(&self.other_models, "other models, not used");
        add(DETAIL, format!("model {model} ({form}), {} images listed{unused}", self.registered));
        let unused = others(&self.other_image_folders, "not used");
        add(DETAIL, format!("images from {}{unused}", shown(&self.image_folder)));
        if !self.missing.is_empty() {
            let count =
                counted(self.missing.len(), "photograph of the model is", "photographs of the model are");
            add(!DETAIL, format!("{count} not in the folder, so left out: {}", some(&self.missing)));
        }
        if !self.stray.is_empty() {
            let count = counted(self.stray.len(), "photograph", "photographs");
            let far = "stands far away from all others in the model, so left out";
            add(!DETAIL, format!("{count}: {far}: {}", some(&self.stray)));
        }
        for (name, reason) in self.unusable.iter().take(6) {
            add(!DETAIL, format!("left out: {}: {}", shown(name), shown(reason)));
        }
        if self.unusable.len() > 6 {
            add(!DETAIL, format!("and {} more photographs that cannot be used", self.unusable.len() - 6));
        }
        if !self.extra.is_empty() {
            let count = counted(self.extra.len(), "photograph is", "photographs are");
            let why = "left out, because it is not known where the camera was";
            add(!DETAIL, format!("{count} {why}: {}", some(&self.extra)));
        }
        for camera in self.cameras.iter().take(6) {
            add(DETAIL, camera.to_string());
        }
        if self.cameras.len() > 6 {
            add(DETAIL, format!("and {} more cameras", self.cameras.len() - 6));
        }
        if let Some(CameraReport { size: [w, h], .. }) =
            self.cameras.iter().find(|camera| camera.is_resized())
        {
            add(!DETAIL, format!("the photographs are used at a size of {w} × {h} pixels"));
        }
        if self.masks + self.alpha_masks > 0 {
            let masks =
                counted(self.masks + self.alpha_masks, "photograph has a mask", "photographs have a mask");
            add(!DETAIL, masks);
        }
        if !self.unmasked.is_empty() {
            let count = counted(self.unmasked.len(), "photograph has", "photographs have");
            add(!DETAIL, format!("note: {count} no mask: {}", some(&self.unmasked)));
        }
        if let Some(misnamed) = self.misnamed_masks() {
            add(!DETAIL, format!("note: {misnamed} Give each mask the name of its photograph"));
        }
        if let Some(folder) = &self.depth_folder {
            let (folder, with) = (shown(folder), self.depth_priors);
            add(DETAIL, format!("depth maps: {with} of {} photographs have one, from {folder}", self.views));
        }
        let (train, test) = (self.train.len(), self.test.len());
        add(DETAIL, format!("split: {}: {train} train, {test} test", shown(&self.split_rule)));
        let kept_back = match test {
            0 => "no photograph is kept back, so the scene cannot be tested".into(),
            n => format!(
                "{} kept back: the scene is not learnt from them, but tested with them: {}",
                counted(n, "photograph is", "photographs are"),
                some(&self.test)
            ),
        };
        add(!DETAIL, kept_back);
        let unit = if form == "binary" || form == "text" { "COLMAP unit" } else { "unit of the model" };
        add(
            DETAIL,
            match self.normalised {
                true => format!("frame: normalised, 1 {unit} is {:.6}", self.scale),
                false => "frame: as in the model".into(),
            },
        );
        if let Some(overlay) = &self.overlay {
            add(!DETAIL, overlay.note());
        }
        if let Some([r, g, b]) = self.white_balance {
            add(DETAIL, format!("white balance: R x {r:.3}, G x {g:.3}, B x {b:.3}"));
        }
        for note in self.faults.iter().chain(&self.notes) {
            add(!DETAIL, format!("note: {}", shown(note)));
        }
        lines
    }
}

impl fmt::Display for ImportReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.lines().iter().try_for_each(|(_, line)| writeln!(f, "{line}"))
    }
}

impl CameraReport {
    /// True if its photographs are used at another size than that of their files.
    fn is_resized(&self) -> bool {
        self.undistorted_size.unwrap_or(self.file_size) != self.size
    }
}

impl fmt::Display for CameraReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { id, model, views, model_size: [mw, mh], file_size: [w, h], size: [ow, oh], .. } = self;
        write!(f, "camera {id}: {views} views, {} {mw}x{mh}", shown(model))?;
        if self.model_size != self.file_size {
            write!(f, ", files {w}x{h} (intrinsics scaled)")?;
        }
        if let Some([uw, uh]) = self.undistorted_size {
            write!(f, ", undistorted to {uw}x{uh}")?;
        }
        if self.is_resized() {
            write!(f, ", resized to {ow}x{oh}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_that_are_not_used_are_not_called_the_largest() {
        let other_models = vec!["sparse/1 (3 images)".into(), "cameras.xml (Metashape)".into()];
        let text = ImportReport { other_models, ..ImportReport::default() }.to_string();
        let part = "; other models, not used: sparse/1 (3 images), cameras.xml (Metashape)\n";
        assert!(text.contains(part), "{text}");
    }

    #[test]
    fn one_file_is_not_called_many() {
        let report = |extra: &[&str], missing: &[&str]| {
            let names = |list: &[&str]| list.iter().map(|name| (*name).to_string()).collect();
            ImportReport { extra: names(extra), missing: names(missing), ..ImportReport::default() }
                .to_string()
        };
        let text = report(&["a.jpg"], &["b.jpg"]);
        assert!(
            text.contains("1 photograph is left out, because it is not known where the camera was: a.jpg"),
            "{text}"
        );
        assert!(
            text.contains("1 photograph of the model is not in the folder, so left out: b.jpg"),
            "{text}"
        );
        let text = report(&["a.jpg", "c.jpg"], &["b.jpg", "d.jpg"]);
        assert!(
            text.contains(
                "2 photographs are left out, because it is not known where the camera was: a.jpg, c.jpg"
            ),
            "{text}"
        );
        assert!(
            text.contains("2 photographs of the model are not in the folder, so left out: b.jpg, d.jpg"),
            "{text}"
        );
    }
}
