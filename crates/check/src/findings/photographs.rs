//! The rules on the photographs: their files, masks, light and sharpness, and the water in them.

use use3d_capture::{Reach, Side, shown};
use use3d_import::ImportReport;
use use3d_numerics::order::median;

use super::{HIDE, Rules, UNMASKED, WaterSight, are, hardly, names, sentence, serious_if};
use crate::measure::{Figures, ViewFigures};
use crate::report::{Finding, Severity};

/// A view whose sharpness is below this share of its neighbours' is blurred.
const BLURRED: f64 = 0.4;
/// Changes of exposure that are seen, and that spoil a scene, stops.
const EXPOSURE: (f64, f64) = (0.4, 1.2);
/// The same between cameras and folders, where the water of many pairs of views averages out.
const RIG: (f64, f64) = (0.25, 0.5);
/// The same for white balance, as a share.
const BALANCE: (f64, f64) = (0.06, 0.2);
/// A change of exposure along the swim that is said, stops.
const DRIFT: f64 = 0.8;
/// The share of points seen from different distances below which the water can hardly be measured.
const RANGED: f64 = 0.1;
/// Contrasts of the usual picture that are low, and too low, display range.
const CONTRAST: (f64, f64) = (0.18, 0.1);
/// Brightness of a picture in which little can be seen, display range.
const DARK: f64 = 0.06;
/// Shares of a picture without any track that lose something, and that spoil the scene.
const BARE: (f64, f64) = (0.1, 0.25);
/// Bits of 16-bit files that use only their lower bits.
const FEW_BITS: std::ops::RangeInclusive<u32> = 8..=14;
/// The fewest views through which something moves, and their share of the views that could be compared.
const PASSED: (usize, f64) = (2, 0.05);
/// Serious findings that make a photograph differ from the views around it everywhere.
const OTHERWISE: [&str; 4] = ["photographs", "zoom", "cameras", "error"];
/// A mask that hides more than this share of a view's points hides the scene.
const HIDDEN: f64 = 0.5;

/// The views that are blurred beside their neighbours.
pub(super) fn blurred(views: &[ViewFigures]) -> Vec<String> {
    names(views, |v| v.sharpness.is_some_and(|s| s < BLURRED))
}

impl Rules {
    /// 16-bit files that use only their lower bits.
    pub(super) fn range(&mut self, figures: &Figures) {
        let Some(bits) = figures.largest_sample.map(|most| 16 - most.leading_zeros()) else { return };
        // Black pictures are another fault.
        if !FEW_BITS.contains(&bits) {
            return;
        }
        let factor = 1u32 << (16 - bits);
        let text = format!(
            "The photographs have 16 bits and use only the lower {bits}, so they look {factor} times too dark."
        );
        let remedy =
            format!("multiply all of them by {factor} (`magick mogrify -evaluate Multiply {factor}`)");
        self.minor("range", text, &remedy);
    }

    /// Masks that hide what the model saw.
    pub(super) fn inverted(&mut self, views: &[ViewFigures]) {
        let all: Vec<f64> = views.iter().filter_map(|v| v.hidden_points).collect();
        let hiding = |v: &ViewFigures| v.hidden_points.is_some_and(|share| share > HIDDEN);
        let list = names(views, hiding);
        // Masks that leave nothing have a finding of their own.
        let black = views.iter().filter(|v| v.unmasked.is_some_and(|share| share < UNMASKED)).count();
        if 2 * list.len() <= all.len() || 2 * black > all.len() {
            return;
        }
        let text = format!(
            "The masks (pictures that are black on fish and divers) hide {:.0} % of what photographs have in common: black \
             and white are probably exchanged.",
            100.0 * all.iter().sum::<f64>() / all.len() as f64
        );
        let remedy = "a mask is black on fish and divers, and white elsewhere: exchange black and white \
            (`magick mogrify -negate masks/*.png`)";
        self.add(Severity::Serious, "inverted", text, remedy, list);
    }

    /// Fish and divers without masks.
    pub(super) fn passers(&mut self, views: &[ViewFigures]) {
        let compared = views.iter().filter(|v| v.passed_points.is_some()).count();
        let mut worst: Vec<(usize, &str)> = views
            .iter()
            .filter_map(|v| Some((v.passed_points.filter(|points| *points > 0)?, v.name.as_str())))
            .collect();
        let (count, least) = (worst.len(), PASSED.1 * compared as f64);
        let serious = |f: &Finding| f.severity == Severity::Serious && OTHERWISE.contains(&f.subject);
        if count < PASSED.0 || (count as f64) < least || self.found.iter().any(serious) {
            return;
        }
        worst.sort_by_key(|(points, _)| std::cmp::Reverse(*points));
        let most: Vec<_> = worst.iter().take(3).map(|(_, name)| shown(name)).collect();
        let text = format!(
            "Something moves through {count} of {compared} photographs (most in {}), probably fish or divers. In the scene it becomes haze.",
            most.join(", ")
        );
        let remedy = HIDE;
        let list = names(views, |v| v.passed_points.is_some_and(|points| points > 0));
        self.add(Severity::Minor, "moving", text, remedy, list);
    }

    /// The exposure of cameras and folders against each other, and along the swim.
    pub(super) fn exposures(&mut self, figures: &Figures) {
        if let Some(group) = figures.groups.iter().find(|group| group.stops.abs() > RIG.0) {
            let brighter = if group.stops > 0.0 { "brighter" } else { "darker" };
            let text = format!(
                "The photographs of {} are {:.1} stops {brighter} than those of {} of the same points.",
                shown(&group.name),
                group.stops.abs(),
                shown(&group.other)
            );
            let remedy = "develop both with the same brightness before the run, or run one of them alone; give both \
                cameras the same exposure on the next dive";
            self.add(serious_if(group.stops.abs() > RIG.1), "rig_exposure", text, remedy, Vec::new());
        }
        let jumps =
            self.found.iter().any(|f| f.severity <= Severity::Minor && f.subject.ends_with("exposure"));
        if let Some(drift) = figures.drift.filter(|drift| drift.abs() > DRIFT && !jumps) {
            let way = if drift > 0.0 { "brighter" } else { "darker" };
            let text = format!(
                "The photographs become {:.1} stops {way} along the swim, little by little.",
                drift.abs()
            );
            let remedy = "run with `--set reconstruct.exposure=per-view`, which allows for it; lock the exposure on the next dive";
            self.minor("drift", text, remedy);
        }
    }

    /// Parts of the pictures that no track reaches.
    pub(super) fn reach(&mut self, reaches: &[Reach], import: &ImportReport) {
        let Some(worst) = Reach::worst(reaches) else { return };
        // No point can be found where something lies over the pictures.
        let covered = import.overlay.map_or(0.0, |overlay| overlay.share);
        if worst.bare < BARE.0 + covered {
            self.good("reach", "Known points cover the pictures up to their edges.");
            return;
        }
        let share = 100.0 * worst.bare;
        let wide: Vec<(Side, f64)> =
            worst.borders.iter().copied().filter(|(_, width)| *width >= BARE.0).collect();
        let severe = worst.has_bare_side(BARE.0);
        let part = |(side, width): &(Side, f64)| {
            let name = match side {
                Side::Left => "left",
                Side::Right => "right",
                Side::Top => "upper",
                Side::Bottom => "lower",
            };
            format!("the {name} {:.0} %", 100.0 * width)
        };
        let place = match wide.is_empty() {
            true => format!("About {share:.0} %"),
            false => sentence(&wide.iter().map(part).collect::<Vec<_>>().join(" and ")),
        };
        let severity = serious_if(severe && worst.bare >= BARE.1);
        let camera = match reaches.len() {
            1 => String::new(),
            _ => format!(" of the camera with {}x{} pixels", worst.size[0], worst.size[1]),
        };
        let shows = if wide.len() > 1 { "show" } else { "shows" };
        let text = format!(
            "{place} of the picture area{camera} {shows} nothing that another photograph shows too ({} photographs were \
             looked at). The scene cannot be learnt there and will look like fog.",
            worst.views
        );
        let mut remedy = String::from(
            "nothing, if only open water or sky is there; otherwise find the cameras again from the whole pictures, \
             without masks (`use3d prepare`), or cut that part off all pictures",
        );
        if worst.is_too_wide() {
            remedy += &format!(
                ". By this model the camera sees {:.0}° from left to right. If it sees less, give its focal length F \
                 and the centre CX,CY of the photographs, in pixels: `use3d prepare PHOTOS --lens SIMPLE_PINHOLE \
                 --calibration F,CX,CY`. For a usual lens F is about the width of the photographs",
                worst.angle
            );
        }
        self.add(severity, "reach", text, &remedy, Vec::new());
    }

    pub(super) fn pixels(&mut self, views: &[ViewFigures]) {
        if views.iter().all(|v| v.brightness.is_none()) {
            return;
        }
        let steps = |of: fn(&ViewFigures) -> Option<f64>, limits: (f64, f64)| {
            let largest = views.iter().filter_map(of).fold(0.0f64, |m, s| m.max(s.abs()));
            let list = names(views, |v| of(v).is_some_and(|s| s.abs() > limits.0));
            (largest, list)
        };
        let (largest, list) = steps(|v| v.exposure_step, EXPOSURE);
        if !list.is_empty() {
            let often = self.share(list.len()) > 0.2;
            let text =
                format!("The exposure changes from one photograph to the next, by up to {largest:.1} stops.");
            let remedy = "run with `--set reconstruct.exposure=per-view`, which allows for it; lock the exposure on the next dive";
            self.add(serious_if(largest > EXPOSURE.1 || often), "exposure", text, remedy, list);
        } else if views.iter().any(|v| v.exposure_step.is_some()) {
            self.good("exposure", "The exposure is steady.");
        }
        let (largest, list) = steps(|v| v.balance_step, BALANCE);
        if !list.is_empty() {
            let text = format!(
                "The white balance changes from one photograph to the next, by up to {:.0} %.",
                100.0 * largest
            );
            let remedy = "run with `--set reconstruct.exposure=per-view`, which allows for it; set a fixed white balance on the next dive";
            self.add(serious_if(largest > BALANCE.1), "balance", text, remedy, list);
        } else if views.iter().any(|v| v.balance_step.is_some()) {
            self.good("balance", "The white balance is steady.");
        }
        let blurred = blurred(views);
        if !blurred.is_empty() {
            let (count, all) = (blurred.len(), self.views);
            let text = format!(
                "{count} of {all} photographs {} blurred, compared with those before and after.",
                are(count)
            );
            let remedy = "remove them from the folder of images; swim slower, with 1/240 s or shorter";
            self.add(serious_if(self.share(blurred.len()) > 0.1), "blur", text, remedy, blurred);
        } else {
            self.good("blur", "No photograph is much less sharp than those before and after it.");
        }
        // Files that use few of their bits are flat, too.
        let few_bits = self.found.iter().any(|finding| finding.subject == "range");
        let usual = median(views.iter().filter_map(|v| v.contrast)).filter(|_| !few_bits);
        if let Some(contrast) = usual.filter(|contrast| *contrast < CONTRAST.0) {
            let text = format!(
                "The photographs are flat: their brightness uses only {:.0} % of the range from black to white.",
                100.0 * contrast
            );
            let remedy = "go nearer, or dive when the water is clearer: what the haze has swallowed cannot be given back";
            self.add(serious_if(contrast < CONTRAST.1), "contrast", text, remedy, Vec::new());
        }
        let dark = names(views, |v| v.brightness.is_some_and(|b| b < DARK));
        if !dark.is_empty() {
            let text = format!("{} of {} photographs {} very dark.", dark.len(), self.views, are(dark.len()));
            self.add(Severity::Minor, "dark", text, "expose longer, or remove them", dark);
        }
    }

    pub(super) fn water(&mut self, figures: &Figures, water: Option<WaterSight<'_>>) {
        let ranged = figures.seen_from_distances;
        let share = format!("{:.0} % of the points are seen from near and from far.", 100.0 * ranged);
        match water {
            Some(WaterSight::Found(words)) => {
                self.good("water", format!("{}. {share}", sentence(words)));
            }
            // A change of exposure hides the change with the distance.
            Some(WaterSight::None(_)) if self.light_changes() => {
                let text =
                    "No water was found, but exposure or white balance change so much that this says little.";
                let remedy = "nothing for these photographs: the training learns the water from them; on the next dive lock \
                    exposure and white balance";
                self.minor("water", text, remedy);
            }
            Some(WaterSight::Lamps(words)) => {
                let text = format!("{}. {share}", sentence(words));
                let remedy = "nothing for these photographs: the training learns the water from them; in daylight leave the \
                    lamps off";
                self.minor("water", text, remedy);
            }
            Some(WaterSight::None(words)) => {
                self.good("water", format!("{}.", sentence(words)));
            }
            // The finding on the tracks says it.
            Some(WaterSight::Unknown(_)) if figures.track_length == 0.0 => {}
            Some(WaterSight::Unknown(words)) => {
                let remedy = if ranged < 2.0 * RANGED {
                    "photograph the same things from near and from far, for example from 1 and from 4 metres"
                } else {
                    "`use3d water` shows each colour; lock exposure and white balance on the next dive"
                };
                self.minor("water", format!("{}. {share}", sentence(words)), remedy);
            }
            None if ranged < RANGED && figures.track_length > 0.0 => {
                let text = format!(
                    "{} of the points are seen from near and from far, so the water can hardly be measured.",
                    hardly(ranged)
                );
                let remedy = "photograph the same things from near and from far";
                self.minor("water", text, remedy);
            }
            None => {}
        }
    }

    /// True if exposure or white balance change so much that the scene suffers.
    fn light_changes(&self) -> bool {
        let light = ["exposure", "balance"];
        self.found.iter().any(|f| f.severity == Severity::Serious && light.contains(&f.subject))
    }
}
