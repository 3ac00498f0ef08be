//! Findings on a capture that is good, and on the same one with one fault after another.

use std::convert::Infallible;

use glam::{DMat3, DVec3};
use use3d_capture::{
    Camera, Capture, FileName, Frame, Image, Intrinsics, Pose, Sighting, SparsePoint, Split, Track, View,
};
use use3d_check::{
    CheckReport, Gallery, ModelAgreement, Picture, Severity, WaterSight, examine, measure, page,
};
use use3d_import::ImportReport;

const W: usize = 96;
const H: usize = 64;
const VIEWS: usize = 24;

/// A capture of a wall with points, and cameras that pass it sideways, one of every four from farther away.
struct Reef {
    capture: Capture,
    tracks: Vec<Track>,
    images: Vec<Image>,
    report: ImportReport,
}

/// An even pattern with detail, which every view shows at its points.
fn texture(x: i64, y: i64) -> f32 {
    let mut h = (x * 374_761_393 + y * 668_265_263) as u64;
    h = (h ^ h >> 13).wrapping_mul(1_274_126_177);
    0.3 + 0.3 * ((h >> 20 & 0xFF) as f32 / 255.0)
}

impl Reef {
    fn new() -> Self {
        let intrinsics =
            Intrinsics { width: W, height: H, fx: 80.0, fy: 80.0, cx: W as f64 / 2.0, cy: H as f64 / 2.0 };
        let views: Vec<View> = (0..VIEWS)
            .map(|i| {
                let back = if i % 4 == 0 { 1.5 } else { 0.0 };
                let centre = DVec3::new(0.1 * i as f64, 0.3 * ((i % 3) as f64), -back);
                let camera = Camera { intrinsics, pose: Pose::from_center(DMat3::IDENTITY, centre) };
                let name = FileName::new(&format!("v_{i:02}.png")).unwrap();
                View { name, id: i as u32, image: "none".into(), mask: None, depth_prior: None, camera }
            })
            .collect();
        let mut tracks = Vec::new();
        for i in 0..1500 {
            let (column, row) = (i % 50, i / 50);
            let position = DVec3::new(-1.0 + 0.09 * column as f64, -1.2 + 0.1 * row as f64, 3.0);
            let sightings: Vec<Sighting> = views
                .iter()
                .enumerate()
                .filter_map(|(view, v)| {
                    let p = v.camera.pose.rotation * position + v.camera.pose.translation;
                    let (x, y) = (80.0 * p.x / p.z + 48.0, 80.0 * p.y / p.z + 32.0);
                    let inside = (2.0..W as f64 - 2.0).contains(&x) && (2.0..H as f64 - 2.0).contains(&y);
                    inside.then_some(Sighting { view, x, y })
                })
                .collect();
            tracks.push(Track { position, sightings });
        }
        let points = tracks
            .iter()
            .map(|t| SparsePoint {
                position: t.position,
                color: [100, 110, 120],
                error: 0.5,
                track_length: t.sightings.len() as u32,
            })
            .collect();
        let split = Split::every(VIEWS, 8);
        let names = |list: &[usize]| list.iter().map(|&i| views[i].name.to_string()).collect();
        let report = ImportReport {
            name: "reef".into(),
            train: names(&split.train),
            test: names(&split.test),
            views: VIEWS,
            depth_priors: VIEWS,
            masks: 1,
            ..ImportReport::default()
        };
        let image = || {
            let values: Vec<f32> =
                (0..3 * W * H).map(|i| texture((i % W) as i64, (i / W % H) as i64)).collect();
            Image::from_planes(W, H, values).unwrap()
        };
        let images = (0..VIEWS).map(|_| image()).collect();
        let capture = Capture { name: "reef".into(), views, split, points, frame: Frame::IDENTITY };
        Self { capture, tracks, images, report }
    }

    fn examine(&self) -> CheckReport {
        let mut load = |view: usize| Ok::<_, Infallible>(self.images[view].clone());
        let Ok(figures) = measure(&self.capture, &self.tracks, Some(&mut load));
        examine(&self.report, figures, Some(WaterSight::Found("water found")), Some(0.5))
    }
}

/// The severity of the finding on a subject, with the views that it names.
fn of(report: &CheckReport, subject: &str) -> (Severity, Vec<String>) {
    let found = report.findings.iter().find(|f| f.subject == subject);
    let found = found.unwrap_or_else(|| panic!("no finding on {subject}: {report}"));
    (found.severity, found.views.clone())
}

#[test]
fn a_good_capture_has_no_faults() {
    let report = Reef::new().examine();
    assert_eq!(report.faults().count(), 0, "{report}");
    assert!(report.summary().contains("nothing stands in the way"));
    assert!(
        report.figures.seen_from_distances > 0.5 && report.figures.track_length > 3.0,
        "{:?}",
        report.figures
    );
}

#[test]
fn blurred_and_dark_views_are_named() {
    let mut reef = Reef::new();
    let flat = Image::filled(W, H, 0.45);
    reef.images[7] = flat;
    reef.images[11] = reef.images[11].map(|v| 0.05 * v);
    // A darker exposure is not blurred.
    reef.images[15] = reef.images[15].map(|v| 0.45 * v);
    let report = reef.examine();
    assert_eq!(of(&report, "blur").0, Severity::Minor);
    assert!(of(&report, "blur").1.contains(&"v_07.png".to_string()), "{report}");
    assert!(!of(&report, "blur").1.contains(&"v_15.png".to_string()), "{report}");
    assert_eq!(of(&report, "dark").1, ["v_11.png"]);
}

#[test]
fn few_views_for_training_get_advice_that_changes_something() {
    let mut reef = Reef::new();
    reef.report.train.truncate(7);
    let report = reef.examine();
    let found = report.findings.iter().find(|f| f.subject == "split").unwrap();
    assert_eq!(found.severity, Severity::Serious);
    for advice in ["take more photographs", "`--set import.split.every=0`", "shorten test_list.txt"] {
        assert!(found.remedy.contains(advice), "{}", found.remedy);
    }
    reef.report.test.truncate(1);
    let said = reef.examine().to_string();
    assert!(
        said.contains("Only 7 photographs are left to learn from, and 1 is kept back for the test."),
        "{said}"
    );
    let mut reef = Reef::new();
    reef.report.test.truncate(1);
    reef.report.missing = vec!["v_99.png".into()];
    let said = reef.examine().to_string();
    for part in [
        "1 of 22 photographs is kept back",
        "1 photograph is not in the folder, but the list of cameras names it.",
    ] {
        assert!(said.contains(part), "{said} lacks {part}");
    }
    // One view in 8 is held out without any setting.
    assert!(!found.remedy.contains("every=8"), "{}", found.remedy);
}

#[test]
fn a_wide_lens_is_suspected_where_a_side_has_no_points() {
    let mut reef = Reef::new();
    reef.tracks.iter_mut().for_each(|t| t.sightings.retain(|s| s.x < 0.6 * W as f64));
    let remedy = |reef: &Reef| {
        let found = reef.examine().findings.into_iter().find(|f| f.subject == "reach");
        found.map(|f| (f.severity, f.remedy)).unwrap()
    };
    // 62° from left to right are usual for a lens.
    let (severity, usual) = remedy(&reef);
    assert!(severity == Severity::Serious && !usual.contains("--calibration"), "{usual}");
    for view in &mut reef.capture.views {
        view.camera.intrinsics.fx = 40.0;
    }
    let (severity, wide) = remedy(&reef);
    assert!(severity == Severity::Serious && wide.starts_with(&usual), "{wide}");
    assert!(wide.contains("100° from left to right") && wide.contains("--calibration F,CX,CY"), "{wide}");
    // Open water above says nothing about the lens.
    let mut above = Reef::new();
    above.tracks.iter_mut().for_each(|t| t.sightings.retain(|s| s.y > 0.4 * H as f64));
    above.capture.views.iter_mut().for_each(|view| view.camera.intrinsics.fx = 40.0);
    assert!(!remedy(&above).1.contains("--calibration"));
}

#[test]
fn the_water_is_not_called_absent_while_the_exposure_jumps() {
    let mut reef = Reef::new();
    let dry = |reef: &Reef| {
        let mut load = |view: usize| Ok::<_, Infallible>(reef.images[view].clone());
        let Ok(figures) = measure(&reef.capture, &reef.tracks, Some(&mut load));
        examine(&reef.report, figures, Some(WaterSight::None("no water found")), Some(0.5))
    };
    assert_eq!(of(&dry(&reef), "water").0, Severity::Good);
    for view in [6, 13, 20] {
        reef.images[view] = reef.images[view].map(|v| 0.45 * v);
    }
    let report = dry(&reef);
    assert_eq!((of(&report, "exposure").0, of(&report, "water").0), (Severity::Serious, Severity::Minor));
    // In air, a model without tracks loses nothing.
    reef.tracks.iter_mut().for_each(|t| t.sightings.clear());
    assert_eq!(of(&dry(&reef), "tracks").0, Severity::Note);
}

#[test]
fn masks_that_leave_nothing_and_formats_without_tracks_are_said() {
    let mut reef = Reef::new();
    let with = |reef: &Reef, unmasked: &dyn Fn(usize) -> Option<f64>, water: WaterSight<'_>| {
        let mut load = |view: usize| Ok::<_, Infallible>(reef.images[view].clone());
        let Ok(mut figures) = measure(&reef.capture, &reef.tracks, Some(&mut load));
        (0..VIEWS).for_each(|view| figures.views[view].unmasked = unmasked(view));
        examine(&reef.report, figures, Some(water), Some(0.5))
    };
    let unknown = WaterSight::Unknown("the water cannot be measured");
    let one = with(&reef, &|view| Some(if view == 3 { 0.0 } else { 0.8 }), unknown);
    assert_eq!(of(&one, "masks"), (Severity::Minor, vec!["v_03.png".to_string()]));
    assert_eq!(of(&with(&reef, &|_| Some(0.0), unknown), "masks").0, Severity::Serious);
    reef.tracks.iter_mut().for_each(|t| t.sightings.clear());
    for (form, expected) in [("binary", Severity::Serious), ("Agisoft XML", Severity::Note)] {
        reef.report.model_form = form.into();
        let report = with(&reef, &|_| None, unknown);
        assert_eq!(of(&report, "tracks").0, expected, "{form}");
        assert!(report.findings.iter().all(|f| f.subject != "water"), "{report}");
    }
}

#[test]
fn masks_with_other_names_than_the_photographs_and_views_without_a_mask_are_said() {
    let mut reef = Reef::new();
    reef.report.unmasked = vec!["v_04.png".into(), "v_09.png".into()];
    let report = reef.examine();
    assert_eq!(of(&report, "unmasked").0, Severity::Minor);
    let text = report.to_string();
    assert!(
        text.contains("2 of 24 photographs have no mask") && text.contains("photographs: v_04.png, v_09.png"),
        "{text}"
    );
    assert!(report.gravest(3).is_empty(), "a picture does not suffer from it");

    reef.report.unmasked.clear();
    reef.report.masks = 0;
    reef.report.mask_folder = Some("masks".into());
    reef.report.stray_masks = (0..8).map(|i| format!("fish_{i}.png")).collect();
    let report = reef.examine();
    assert_eq!(of(&report, "misnamed").0, Severity::Serious);
    assert!(report.findings.iter().all(|f| f.subject != "masks"), "{report}");
    let said = report.gravest(3).join("\n");
    for part in [
        "masks/ holds 8 files (fish_0.png, ",
        "and 2 more)",
        "none of them has the name of a photograph (such as v_00.png)",
        "give each mask the name of its photograph",
    ] {
        assert!(said.contains(part), "{said} lacks {part}");
    }
}

#[test]
fn changes_of_exposure_and_white_balance_are_measured_on_shared_points() {
    let mut reef = Reef::new();
    // Half a stop less light: sRGB is near a power of 2.2 in these middle tones.
    let darker = |v: f32| 0.854 * v;
    for view in 12..VIEWS {
        reef.images[view] = reef.images[view].map(darker);
    }
    let report = reef.examine();
    assert_eq!(of(&report, "exposure"), (Severity::Minor, vec!["v_12.png".to_string()]), "{report}");
    let measured = report.figures.views[12].exposure_step.unwrap();
    assert!((measured + 0.5).abs() < 0.1, "{measured}");
    assert_eq!(of(&report, "balance").0, Severity::Good);

    let mut reef = Reef::new();
    for view in 9..VIEWS {
        let n = W * H;
        reef.images[view].data_mut()[..n].iter_mut().for_each(|v| *v *= 0.7);
    }
    let report = reef.examine();
    assert_eq!(of(&report, "balance"), (Severity::Serious, vec!["v_09.png".to_string()]), "{report}");
}

#[test]
fn lonely_views_and_bad_models_are_serious() {
    let mut reef = Reef::new();
    for track in &mut reef.tracks {
        track.sightings.retain(|s| s.view != 5 && s.view != 6 && s.view != 20);
    }
    let report = reef.examine();
    assert_eq!(of(&report, "lonely").0, Severity::Serious);
    assert_eq!(of(&report, "lonely").1, ["v_05.png", "v_06.png", "v_20.png"]);

    let mut reef = Reef::new();
    reef.report.extra = (0..20).map(|i| format!("x_{i}.png")).collect();
    let report = reef.examine();
    assert_eq!(of(&report, "unplaced").0, Severity::Serious);
    // The gravest come first, in the order of the rules.
    assert_eq!(report.findings[0].subject, "unplaced", "{report}");
    assert!(report.to_string().contains("do this: "), "{report}");

    reef.tracks.iter_mut().for_each(|t| t.sightings.clear());
    assert_eq!(of(&reef.examine(), "tracks").0, Severity::Serious);
}

#[test]
fn a_swim_along_the_sight_is_noticed() {
    let mut reef = Reef::new();
    for (i, view) in reef.capture.views.iter_mut().enumerate() {
        view.camera.pose = Pose::from_center(DMat3::IDENTITY, DVec3::new(0.0, 0.0, 0.05 * i as f64));
    }
    assert_eq!(of(&reef.examine(), "path").0, Severity::Serious);
}

#[test]
fn the_page_escapes_names_and_shows_pictures() {
    let mut reef = Reef::new();
    reef.report.name = "<b>reef</b>".into();
    reef.images[7] = Image::filled(W, H, 0.45);
    let report = reef.examine();
    assert!(report.pictured().contains("v_07.png"));
    let picture = Picture { name: "v_07.png".into(), address: "data:image/jpeg;base64,AAAA".into() };
    let gallery = Gallery { title: "a < b".into(), text: "Few.".into(), pictures: vec![picture.clone()] };
    let html = page(&report, &[picture], &reef.capture, &[gallery]);
    assert!(html.contains("<h2>a &lt; b</h2>") && html.matches("AAAA").count() == 2, "{html}");
    assert!(html.contains("<h2>The path of the camera</h2>") && html.contains("<polyline"), "{html}");
    assert!(!html.contains("<b>reef") && html.contains("&lt;b&gt;reef"), "{html}");
    assert!(html.contains("src=\"data:image/jpeg;base64,AAAA\"") && html.contains("Do this: "));
    // A photograph without a picture is shown by its name, and commands are marked as such.
    reef.report.extra = vec!["v_99.png".into()];
    let html = page(&reef.examine(), &[], &reef.capture, &[]);
    assert!(
        html.contains("<figure class=\"view\">v_99.png</figure>")
            && html.contains("<code>use3d prepare</code>"),
        "{html}"
    );
}

#[test]
fn what_moves_through_two_views_is_named() {
    let reef = Reef::new();
    let with = |passed: &dyn Fn(usize) -> Option<usize>, error: Option<f64>| {
        let mut load = |view: usize| Ok::<_, Infallible>(reef.images[view].clone());
        let Ok(mut figures) = measure(&reef.capture, &reef.tracks, Some(&mut load));
        (0..VIEWS).for_each(|view| figures.views[view].passed_points = passed(view));
        figures.agreement = error.map(|error| ModelAgreement {
            tracked: true,
            error: Some(error),
            ..ModelAgreement::default()
        });
        examine(&reef.report, figures, Some(WaterSight::Found("water found")), Some(0.5))
    };
    let two = |view: usize| (view != 0).then_some(if view % 10 == 7 { view } else { 0 });
    let report = with(&two, None);
    assert_eq!(
        of(&report, "moving"),
        (Severity::Minor, vec!["v_07.png".to_string(), "v_17.png".to_string()])
    );
    let text = report.to_string();
    assert!(text.contains("through 2 of 23 photographs (most in v_17.png, v_07.png)"), "{text}");
    let none = |report: &CheckReport| report.findings.iter().all(|f| f.subject != "moving");
    assert!(none(&with(&|view| Some(usize::from(view == 7)), None)));
    assert!(none(&with(&|_| None, None)));
    // Wrong cameras make every view differ.
    assert!(!none(&with(&two, Some(0.5))) && none(&with(&two, Some(9.0))));
}
