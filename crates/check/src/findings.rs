//! The rules: each compares a figure with a limit and says what it means and what to do.

mod photographs;

use use3d_capture::shown;
use use3d_import::ImportReport;
use use3d_numerics::order::median;

use crate::agreement::{ModelAgreement, ViewAgreement, ViewOverlap};
use crate::depth::{DepthAgreement, STEPS};
use crate::measure::{Figures, ViewFigures};
use crate::report::{CheckReport, Finding, Severity};
use crate::shown::Exchanged;

/// The result of the estimate of the water, in its own words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WaterSight<'a> {
    /// The water is known.
    Found(&'a str),
    /// There is none.
    None(&'a str),
    /// It cannot be told from the light of lamps.
    Lamps(&'a str),
    /// It cannot be used or is not known.
    Unknown(&'a str),
}

/// The remedy for fish and divers.
const HIDE: &str = "hide them with masks: black-and-white pictures in the folder masks/, black on fish and divers \
    (docs/guide/pictures.md)";
/// Forms of models that never have tracks, and one that has them in a file of their own, as an import reports
/// them.
const WITHOUT_TRACKS: [&str; 4] = ["Agisoft XML", "transforms.json", "RealityScan CSV", "RealityScan XMP"];
const OPENSFM: &str = "OpenSfM";
/// A view that sees fewer points, or has fewer neighbours, hardly has a place.
const LONELY: (usize, usize) = (50, 2);
/// Reprojection errors above which a lens model is doubtful, and wrong, pixels.
const ERROR: (f64, f64) = (1.0, 1.5);
/// A measured error above this many times the stated one, and this many pixels more, is of another model.
const CHANGED: (f64, f64) = (1.1, 0.02);
/// A view whose error is this many times the usual one, and this many pixels more, is misplaced.
const MISPLACED: (f64, f64) = (4.0, 1.0);
/// The share of points in view below which points and cameras do not belong together.
const IN_VIEW: f64 = 0.5;
/// Shares of points in three views below which a scene has holes, and below which it is spoilt.
const COVERED: (f64, f64) = (0.35, 0.15);
/// The median angle of points below which distances are hardly determined, degrees.
const ANGLE: f64 = 1.0;
/// The likeness below which a photograph is not that of its camera, with tracks and without.
const LIKE: (f64, f64) = (0.6, 0.4);
/// A photograph with more grain than this, as a share of white, is named.
const GRAIN: f64 = 0.04;
/// A side above which a training takes very long, pixels.
const LARGE: usize = 2000;
/// A mask that leaves less than this share of a picture leaves nothing to learn from.
const UNMASKED: f64 = 0.01;
/// Steps along the sight and breadth of the positions at which distances are hardly determined.
const TUNNEL: (f64, f64) = (0.9, 0.1);

/// Examines a capture. `metres` is the length of one unit of its model, if it is known.
pub fn examine(
    import: &ImportReport,
    figures: Figures,
    water: Option<WaterSight<'_>>,
    metres: Option<f64>,
) -> CheckReport {
    let mut rules = Rules { found: Vec::new(), views: figures.views.len() };
    rules.images(import);
    rules.split(import);
    rules.cameras(import);
    rules.model(import, &figures, water);
    if let Some(agreement) = &figures.agreement {
        rules.agreement(import, agreement, &photographs::blurred(&figures.views));
        rules.coverage(agreement);
    }
    rules.reach(&figures.reach, import);
    rules.range(&figures);
    rules.inverted(&figures.views);
    rules.passers(&figures.views);
    rules.pixels(&figures.views);
    rules.exposures(&figures);
    rules.water(&figures, water);
    rules.extras(import, &figures, metres);
    if let Some(agreement) = &figures.agreement {
        rules.depth_maps(&agreement.depth);
    }
    for text in &import.faults {
        rules.minor("import", sentence(text), "");
    }
    for text in &import.notes {
        rules.note("import", sentence(text), "");
    }
    let mut findings = rules.found;
    // The order of the rules is that of their weight among equals.
    findings.sort_by_key(|f| f.severity);
    CheckReport { capture: import.name.clone(), findings, figures }
}

struct Rules {
    found: Vec<Finding>,
    views: usize,
}

fn serious_if(serious: bool) -> Severity {
    if serious { Severity::Serious } else { Severity::Minor }
}

fn are(count: usize) -> &'static str {
    if count == 1 { "is" } else { "are" }
}

fn names(views: &[ViewFigures], those: impl Fn(&ViewFigures) -> bool) -> Vec<String> {
    views.iter().filter(|v| those(v)).map(|v| v.name.clone()).collect()
}

impl Rules {
    fn add(
        &mut self,
        severity: Severity,
        subject: &'static str,
        text: impl Into<String>,
        remedy: &str,
        views: Vec<String>,
    ) {
        let (text, remedy) = (text.into(), remedy.into());
        self.found.push(Finding { severity, subject, text, remedy, views });
    }

    fn good(&mut self, subject: &'static str, text: impl Into<String>) {
        self.add(Severity::Good, subject, text, "", Vec::new());
    }

    fn note(&mut self, subject: &'static str, text: impl Into<String>, remedy: &str) {
        self.add(Severity::Note, subject, text, remedy, Vec::new());
    }

    /// Adds a minor finding that is about no views.
    fn minor(&mut self, subject: &'static str, text: impl Into<String>, remedy: &str) {
        self.add(Severity::Minor, subject, text, remedy, Vec::new());
    }

    fn share(&self, part: usize) -> f64 {
        part as f64 / self.views.max(1) as f64
    }

    /// Photographs without a place, and models that are not used.
    fn images(&mut self, import: &ImportReport) {
        let all = self.views + import.extra.len();
        let without = import.extra.len() as f64 / all.max(1) as f64;
        if !import.extra.is_empty() {
            let text =
                format!("For {} of {all} photographs no camera position is known.", import.extra.len());
            let remedy = "find the cameras again with `use3d prepare`, which says what helps, or take more photographs \
                in between";
            self.add(serious_if(without > 1.0 / 3.0), "unplaced", text, remedy, import.extra.clone());
        } else {
            self.good("unplaced", format!("All {all} photographs have a camera position."));
        }
        if !import.missing.is_empty() {
            let count = import.missing.len();
            let (s, them) = if count == 1 { ("", "it") } else { ("s", "them") };
            let text = format!(
                "{count} photograph{s} {} not in the folder, but the list of cameras names {them}.",
                are(count)
            );
            let remedy = "put the missing files back, under the names that the list has";
            self.add(
                serious_if(import.missing.len() > self.views),
                "missing",
                text,
                remedy,
                import.missing.clone(),
            );
        }
        if !import.unusable.is_empty() {
            let count = import.unusable.len();
            let all = self.views + count;
            let reasons: Vec<String> = import
                .unusable
                .iter()
                .take(3)
                .map(|(name, why)| format!("{} ({})", shown(name), shown(why)))
                .collect();
            let more = if count > reasons.len() { ", …" } else { "" };
            let verb = if count == 1 { "is left out, because it" } else { "are left out, because they" };
            let text =
                format!("{count} of {all} photographs {verb} cannot be used: {}{more}.", reasons.join(", "));
            let remedy = "copy these files again from the camera, or do without them";
            let names = import.unusable.keys().cloned().collect();
            self.add(serious_if(self.share(count) > 1.0 / 3.0), "unusable", text, remedy, names);
        }
        if import.exr > 0 {
            let text = format!(
                "{} photographs are EXR files. Their values are used as those of a display, but most programs store \
                 linear light in them, which looks too dark.",
                import.exr
            );
            let remedy = "nothing, if they look right; otherwise write them as 16-bit PNG or TIFF in sRGB";
            self.minor("linear", text, remedy);
        }
        if !import.stray.is_empty() {
            let count = import.stray.len();
            let text = format!(
                "The model places {count} of {} photographs far away from all others, so {} left out.",
                self.views + count,
                if count == 1 { "it is" } else { "they are" }
            );
            let remedy = "nothing, if you can do without them; otherwise find the cameras again with more photographs in \
                between";
            self.add(serious_if(self.share(count) > 0.1), "stray", text, remedy, import.stray.clone());
        }
        if !import.other_models.is_empty() {
            let names: Vec<_> = import.other_models.iter().map(|name| shown(name)).collect();
            let text = format!("The folder has more models, which are not used: {}.", names.join(", "));
            let remedy = "if they show other parts of the dive, photograph the way between the parts, or run them as \
                captures of their own";
            self.minor("groups", text, remedy);
        }
    }

    /// The overlap of the photographs.
    fn coverage(&mut self, agreement: &ModelAgreement) {
        let remedy =
            "take photographs that overlap by 70 % or more, so that each place is in three of them at least";
        if self.views <= 3 {
            let text = format!("{} photographs are too few for a scene.", self.views);
            self.add(Severity::Serious, "few", text, remedy, Vec::new());
            return;
        }
        let Some(ViewOverlap { share, angle }) = agreement.coverage else { return };
        if share < COVERED.0 {
            let text = format!(
                "{} of the points are in three photographs or more: new views between the photographs will have holes.",
                hardly(share)
            );
            self.add(serious_if(share < COVERED.1), "few", text, remedy, Vec::new());
        } else if angle < ANGLE {
            let text = "The photographs see each point from nearly the same place, so distances can hardly be measured.";
            let remedy = "move the camera sideways between photographs, by a tenth of the distance or more";
            self.add(Severity::Serious, "few", text, remedy, Vec::new());
        } else {
            self.good(
                "few",
                format!("{:.0} % of the points are seen in three photographs or more.", 100.0 * share),
            );
        }
    }

    fn split(&mut self, import: &ImportReport) {
        let (train, test) = (import.train.len(), import.test.len());
        if test == 0 {
            let remedy = "leave `split.every` at 8, unless you need every photograph for the scene";
            let text = "No photograph is kept back, so the scene cannot be tested.";
            self.minor("split", text, remedy);
        } else if train < 8 {
            let left = if train == 1 { "photograph is" } else { "photographs are" };
            let text = format!(
                "Only {train} {left} left to learn from, and {test} {} kept back for the test.",
                are(test)
            );
            let remedy = "take more photographs, or keep none back (`--set import.split.every=0`; then nothing says how \
                good the scene is), or shorten test_list.txt";
            self.add(Severity::Serious, "split", text, remedy, import.test.clone());
        } else {
            let text = format!(
                "{test} of {} photographs {} kept back: the scene is tested with them, and not learnt from them.",
                train + test,
                are(test)
            );
            self.good("split", text);
        }
    }

    fn cameras(&mut self, import: &ImportReport) {
        let sizes: std::collections::BTreeSet<[usize; 2]> = import.cameras.iter().map(|c| c.size).collect();
        if sizes.len() > 1 {
            let list: Vec<String> = sizes.iter().map(|[w, h]| format!("{w}x{h}")).collect();
            let text = format!("The photographs have {} sizes: {}.", sizes.len(), list.join(", "));
            self.minor("sizes", text, "make all of them one size with `--max-side` or `--size`");
        }
        let large = sizes.iter().flatten().copied().max().unwrap_or(0);
        if large > LARGE {
            let text =
                format!("The photographs have {large} pixels on the longer side, so a run takes many hours.");
            self.minor("large", text, "begin with `--max-side 1280`");
        }
        let undistorted = import.cameras.iter().filter_map(|c| {
            let [w, h] = c.undistorted_size?;
            Some((w * h) as f64 / (c.file_size[0] * c.file_size[1]).max(1) as f64)
        });
        if let Some(least) = undistorted.reduce(f64::min) {
            let lens = import.cameras.first().map_or("", |c| &c.model);
            let text =
                format!("The lens bends straight lines ({lens}), so the photographs are straightened here.");
            if least < 0.6 {
                let text = format!("{text} {:.0} % of their pixels are left.", 100.0 * least);
                let remedy = "check the lens model of the cameras; a fisheye loses its edges in any case";
                self.minor("lens", text, remedy);
            } else {
                self.good("lens", text);
            }
        }
    }

    fn model(&mut self, import: &ImportReport, figures: &Figures, water: Option<WaterSight<'_>>) {
        let lonely = names(&figures.views, |v| v.points < LONELY.0 || v.neighbours < LONELY.1);
        if figures.track_length == 0.0 {
            let text = "The model does not say which photograph sees which point (it has no tracks), so the cameras and \
                their overlap cannot be checked.";
            // In air, nothing is lost by that, and some programs export no tracks.
            let dry = matches!(water, Some(WaterSight::None(_)));
            let never = WITHOUT_TRACKS.contains(&&*import.model_form);
            let remedy = match &*import.model_form {
                _ if never => {
                    "nothing: this program's files have no tracks, so the training learns the water from the \
                    photographs"
                }
                OPENSFM => "put `tracks.csv` beside `reconstruction.json`",
                _ => {
                    "export the cameras again, together with the tie points; without them the water cannot be measured \
                    beforehand"
                }
            };
            let severity = if dry || never { Severity::Note } else { Severity::Serious };
            self.add(severity, "tracks", text, remedy, Vec::new());
            return;
        }
        if figures.points < 1000 {
            let text = format!(
                "Only {} points of the scene are known, and the scene starts from them.",
                figures.points
            );
            let remedy =
                "find the cameras again with `use3d prepare --features 8000`, which finds more points";
            self.add(Severity::Serious, "points", text, remedy, Vec::new());
        }
        if !lonely.is_empty() {
            let (count, all) = (lonely.len(), self.views);
            let text = match count {
                1 => format!(
                    "1 of {all} photographs shares few points with the others, so its camera position is uncertain."
                ),
                _ => format!(
                    "{count} of {all} photographs share few points with the others, so their camera positions are \
                     uncertain."
                ),
            };
            let remedy = "take more photographs on the way to them, or remove them from the folder of images";
            self.add(serious_if(self.share(lonely.len()) > 0.1), "lonely", text, remedy, lonely);
        }
        if let [_, _, ..] = figures.parts.as_slice() {
            let sizes: Vec<String> = figures.parts.iter().map(usize::to_string).collect();
            let text = format!(
                "The photographs fall into {} groups that share no points (of {} photographs), so it is not known how far \
                 the groups are apart.",
                sizes.len(),
                sizes.join(" and ")
            );
            let remedy = "photograph the way between the groups, or put each group into a folder of its own and run both";
            self.add(Severity::Serious, "parts", text, remedy, Vec::new());
        }
        if figures.track_length < 3.0 {
            let text = format!("On average a point is seen in only {:.1} photographs.", figures.track_length);
            let remedy = "let neighbouring photographs overlap by 70 % or more";
            self.minor("overlap", text, remedy);
        }
        if let (Some(forward), Some(breadth)) = (figures.forward, figures.breadth)
            && forward > TUNNEL.0
            && breadth < TUNNEL.1
        {
            let text = "The camera swims straight ahead in the direction in which it looks, so distances can hardly be \
                measured.";
            self.add(Severity::Serious, "path", text, "swim sideways along the scene as well", Vec::new());
        }
    }

    /// The model against its tracks, and the photographs against the model.
    fn agreement(&mut self, import: &ImportReport, agreement: &ModelAgreement, blurred: &[String]) {
        if let Some(share) = agreement.in_view.filter(|share| *share < IN_VIEW) {
            let text = format!(
                "{} of the points lie in any photograph: the points and the cameras of {} do not belong together.",
                hardly(share),
                shown(&import.model)
            );
            let text = match agreement.instead {
                Some(instead) => format!("{text} Most points would be in view {instead}."),
                None => text,
            };
            let remedy = match &*import.model_form {
                "transforms.json" => {
                    "write poses from the camera to the world with OpenGL's camera axes (x right, y up, z backward), and \
                     the points in the same coordinates"
                }
                _ => {
                    "export cameras and points again, both from the same project and in the same coordinates"
                }
            };
            self.add(Severity::Serious, "points_in_view", text, remedy, Vec::new());
            return;
        }
        if let Some(error) = agreement.error {
            self.error(error, agreement, &import.model);
        }
        if agreement.outside > 0 {
            let (count, lie) = (agreement.outside, if agreement.outside == 1 { "lies" } else { "lie" });
            let text = format!("{count} of the model's points {lie} far outside of the scene.");
            self.note("points_outside", text, "nothing: the scene is measured without them");
        }
        match agreement.exchanged {
            Some(Exchanged::Photographs) => {
                let text = "The photographs have red and blue exchanged: the points of the model have them the other way round.";
                let remedy = "exchange them back (`magick mogrify -channel-fx \"red<=>blue\"`)";
                self.add(Severity::Serious, "colours", text, remedy, Vec::new());
            }
            Some(Exchanged::Points) => {
                let text = "The colours of the model's points have red and blue exchanged.";
                self.note("colours", text, "nothing: the training corrects the colours of the points");
            }
            None => {}
        }
        let limit = if agreement.tracked { LIKE.0 } else { LIKE.1 };
        let list = |those: &dyn Fn(&ViewAgreement) -> bool| -> Vec<String> {
            agreement.views.iter().filter(|v| those(v)).map(|v| v.name.clone()).collect()
        };
        if let Some(zoom) = agreement.zoom {
            let (percent, border) = match zoom > 1.0 {
                true => {
                    (zoom - 1.0, "{} % larger or more, as if a border had been cut off and the rest enlarged")
                }
                false => (1.0 / zoom - 1.0, "{} % smaller or more, as if a border had been added"),
            };
            let text = format!(
                "The photographs are not those from which the camera positions were computed: they look {}.",
                border.replace("{}", &format!("{:.0}", 100.0 * percent))
            );
            let remedy =
                "use the original photographs, or find the camera positions of these with `use3d prepare`";
            self.add(Severity::Serious, "zoom", text, remedy, Vec::new());
        }
        let grainy = list(&|v| v.grain.is_some_and(|grain| grain > GRAIN));
        if !grainy.is_empty() {
            let most = agreement.views.iter().filter_map(|v| v.grain).fold(0.0, f64::max);
            let text = format!(
                "{} of {} photographs {} strong grain (noise), up to {:.0} % of the range from black to white. The \
                 scene learns the grain in place of small things.",
                grainy.len(),
                list(&|v| v.grain.is_some()).len(),
                if grainy.len() == 1 { "has" } else { "have" },
                100.0 * most
            );
            let remedy = "take the noise out of all photographs with the same program and the same setting, before the \
                run; on the next dive give more light, or a lower ISO";
            self.add(Severity::Minor, "grain", text, remedy, grainy);
        }
        let read = list(&|v| v.likeness.is_some()).len();
        // Blur hides the details, too, and has a finding of its own.
        let unlike = |v: &ViewAgreement| v.likeness.is_some_and(|like| like < limit);
        let others = list(&|v| unlike(v) && !blurred.contains(&v.name));
        if !others.is_empty() {
            let text = format!(
                "{} of {read} photographs do not show what can be seen from their places: they are turned, or have wrong \
                 names, or the places are wrong.",
                others.len()
            );
            let remedy = "see if these were turned or renamed, and put the originals back, or find the places of the camera again \
                with `use3d prepare`";
            self.add(Severity::Serious, "photographs", text, remedy, others);
        } else if read > 0 {
            self.good("photographs", "The photographs show what can be seen from their places.");
        }
    }

    /// The depth maps against the points of their views.
    fn depth_maps(&mut self, maps: &[DepthAgreement]) {
        let list = |those: fn(&DepthAgreement) -> bool| -> Vec<String> {
            maps.iter().filter(|map| those(map)).map(|map| map.name.clone()).collect()
        };
        let (others, all) = (list(DepthAgreement::is_other), maps.len());
        if !others.is_empty() {
            let text = format!(
                "The depth maps of {} of {all} views do not show the distances of their points: they belong to other \
                 photographs.",
                others.len()
            );
            let remedy = "give each map the name of its photograph, write them again, or remove the folder of depth maps";
            self.add(Severity::Serious, "depth", text, remedy, others);
        }
        let coarse = list(DepthAgreement::is_coarse);
        if !coarse.is_empty() {
            let text = format!(
                "The depth maps of {} of {all} views have fewer than {STEPS} different values.",
                coarse.len()
            );
            let remedy = "write them with 16 bits, from the whole range of the network that made them";
            self.add(Severity::Minor, "depth", text, remedy, coarse);
        }
    }

    /// The error of the sightings, and the cameras that cause it.
    fn error(&mut self, error: f64, agreement: &ModelAgreement, model: &str) {
        let text = format!(
            "the places of the camera: points lie {error:.2} pixels beside where the photographs show them; below {:.0} is good",
            ERROR.0
        );
        let changed = agreement.stated.filter(|stated| error > CHANGED.0 * stated + CHANGED.1);
        if agreement.states_none {
            let text = "The model's file states errors near zero, which nobody can have measured, so they are not used.";
            self.note("stated", text, "");
        }
        if let Some(stated) = changed {
            let text = format!(
                "The photographs do not fit {text}. The file with these places ({}) says {stated:.2}, so something in it was \
                 changed afterwards: cameras, lens or points.",
                shown(model)
            );
            let remedy =
                "find the places again with `use3d prepare`, or take the file as its program wrote it";
            self.add(Severity::Serious, "error", text, remedy, Vec::new());
        } else if error > ERROR.0 {
            let text = format!("The photographs do not fit {text}. The lens model fits badly.");
            let remedy = "another lens model (`use3d prepare --lens`), zoom and stabilisation off, sharper \
                photographs";
            self.add(serious_if(error > ERROR.1), "error", text, remedy, Vec::new());
        } else {
            self.good("error", format!("The photographs fit {text}."));
        }
        let usual = median(agreement.views.iter().filter_map(|v| v.error)).unwrap_or(0.0);
        let misplaced: Vec<String> = agreement
            .views
            .iter()
            .filter(|v| {
                v.error.is_some_and(|e| e > MISPLACED.0 * usual + MISPLACED.1)
                    || v.in_view.is_some_and(|share| share < IN_VIEW)
            })
            .map(|v| v.name.clone())
            .collect();
        if !misplaced.is_empty() && usual.is_finite() {
            let text = format!(
                "The camera positions of {} of {} photographs do not fit what these show.",
                misplaced.len(),
                self.views
            );
            let remedy = "remove these photographs from the folder of images, or find the cameras again";
            self.add(Severity::Serious, "cameras", text, remedy, misplaced);
        }
    }

    fn extras(&mut self, import: &ImportReport, figures: &Figures, metres: Option<f64>) {
        match metres {
            Some(metres) => {
                self.good("scale", format!("The scale is known: one unit of the model is {metres:.4} m."));
            }
            None => {
                let text = "It is not known how long a metre is in the scene.";
                let remedy =
                    "nothing, if you measure nothing; otherwise give one known length (docs/guide/metres.md)";
                self.note("scale", text, remedy);
            }
        }
        if let Some(overlay) = &import.overlay {
            let remedy = "look at the masks that `use3d import CAPTURE --out DIR` writes to DIR/masks (black is hidden); if \
                they are right, do nothing; if not, correct them in a picture editor and put them into masks/ of the \
                capture; `--set import.hide_overlay=false` hides nothing";
            self.note("overlay", overlay.to_string(), remedy);
        }
        // Maps that are there and left out have a finding of their own.
        if import.depth_priors == 0 && import.depth_folder.is_none() {
            let text = "There are no depth maps. They are optional.";
            let remedy =
                "nothing; a network can make them, which helps a little (`use3d models` says how to get it)";
            self.note("depth", text, remedy);
        }
        let hidden = names(&figures.views, |v| v.unmasked.is_some_and(|share| share < UNMASKED));
        if !hidden.is_empty() {
            let (count, all) = (hidden.len(), self.views);
            let text = format!("The masks hide nearly everything in {count} of {all} photographs.");
            let remedy = "a mask is black on fish and divers, and white elsewhere: exchange black and white, or remove them";
            self.add(serious_if(self.share(hidden.len()) > 0.1), "masks", text, remedy, hidden);
        }
        if let Some(text) = import.misnamed_masks() {
            let remedy = "give each mask the name of its photograph (docs/reference/captures.md)";
            self.add(Severity::Serious, "misnamed", text, remedy, Vec::new());
        } else if !import.unmasked.is_empty() {
            let (count, all) = (import.unmasked.len(), self.views);
            let have = if count == 1 { "has" } else { "have" };
            let text = format!("{count} of {all} photographs {have} no mask, so nothing in them is hidden.");
            let remedy =
                "give them a mask too, with the name of the photograph, if a fish or a diver is in them";
            self.add(Severity::Minor, "unmasked", text, remedy, import.unmasked.clone());
        } else if import.masks + import.alpha_masks == 0 {
            let text = "There are no masks: fish and divers will leave ghosts, if there are any.";
            self.note("masks", text, HIDE);
        }
    }
}

/// A small share in words.
fn hardly(share: f64) -> String {
    if share < 0.005 { "None".into() } else { format!("Only {:.0} %", 100.0 * share) }
}

/// Words with a capital letter at their beginning, unless they begin with the name of a file.
fn sentence(words: &str) -> String {
    if words.split(' ').next().is_some_and(|first| first.contains(['.', '/', '_'])) {
        return words.into();
    }
    let mut letters = words.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}
