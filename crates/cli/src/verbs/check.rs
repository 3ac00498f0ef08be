//! `use3d check`: says before a run what will go wrong with a capture, and what to do about it.

use std::path::Path;

use use3d_capture::{FileName, Image8, Map, View};
use use3d_check::{CheckReport, Gallery, Picture, WaterSight, examine, few_figures, figures, page};
use use3d_import::{
    ImportParams, Imported, capture_name, import, is_prepared, load_mask, load_pixels, load_prepared,
};
use use3d_io_image::{jpeg_address, read_image, shrunk};
use use3d_pipeline::by_hand::{ByHand, scratch};
use use3d_pipeline::destination::{check_file, path_text, word, write_text};
use use3d_pipeline::spelled::Spelled;
use use3d_prepare::{LeftCause, LeftFrame, LookedFilm, looked_films};
use use3d_stages::water::{Judgement, from_tracks};
use use3d_water::WaterParams;

use crate::App;
use crate::args::CheckArgs;
use crate::error::{Done, WorkError};
use crate::interrupt;
use crate::output::show;

/// The longer side of a small picture, pixels.
const SMALL: usize = 320;
/// The longer side of the pictures that only show what there is, pixels, and the most photographs of these.
const TINY: usize = 160;
const PHOTOGRAPHS: usize = 60;
/// The JPEG quality of a small picture.
const QUALITY: u8 = 80;

/// The length of one unit of a capture's model in metres, if it is known.
fn metres(imported: &Imported) -> Option<f64> {
    imported.model.world.as_ref().map(|world| world.metres_per_unit)
}

pub(crate) fn run(app: &App, args: &CheckArgs) -> Done {
    if let Some(file) = &args.html {
        check_file("--html", file, args.replace.force, &["html", "htm"])?;
    }
    let hand = ByHand {
        flags: args.settings.spelled(vec![Spelled::new("--max-side", "import", "max_side", args.max_side)]),
        options: args.settings.options(None),
        ..ByHand::import_of(&args.capture)
    };
    let scratch = scratch()?;
    let folder = hand.imported(&app.host, scratch.path(), None, false)?;
    let capture = load_prepared(&folder).map_err(WorkError::input)?;
    // An import stores neither the capture's name nor the files that it does not use, and its pictures are no
    // longer those of the model.
    let params = match is_prepared(&args.capture) {
        true => ImportParams::default(),
        false => ImportParams { max_side: 0, ..hand.parameters(scratch.path())? },
    };
    let original = import(&args.capture, &params).map_err(WorkError::input)?;
    let mut listed = original.report.clone();
    listed.name = capture_name(&args.capture);
    listed.overlay = capture.report.overlay;
    let (capture, water, figures) = interrupt::unless_stopped(move || {
        let water = from_tracks(&folder, &capture, &WaterParams::default());
        let figures = figures(&capture, &original);
        (capture, water, figures)
    })?;
    let (_, judgement) = water.map_err(WorkError::input)?;
    let words = judgement.to_string();
    let water = match judgement {
        Judgement::Found => WaterSight::Found("the water can be measured in these photographs"),
        Judgement::Lamps => WaterSight::Lamps(
            "far things are dark as in the light of lamps, so the water cannot be measured beforehand",
        ),
        Judgement::Unknown => WaterSight::Unknown(
            "the water cannot be measured in every colour beforehand; it is learnt together with the scene",
        ),
        Judgement::Dry | Judgement::Sky | Judgement::Air => WaterSight::None(&words),
    };
    let report = examine(&listed, figures.map_err(WorkError::input)?, Some(water), metres(&capture));
    if let Some(file) = &args.html {
        let folder = args.capture.join(&listed.image_folder);
        let galleries = galleries(&args.capture, &capture)?;
        let html = page(&report, &pictures(&report, &capture, &folder)?, &capture.capture, &galleries);
        write_text("--html", file, &html)?;
    }
    show(&report, args.json)?;
    if let Some(file) = args.html.as_ref().filter(|_| !args.json) {
        remark!(app, "the page: {}", path_text(file));
    }
    Ok(())
}

/// The gravest faults of a capture that its model and a few of its photographs show, in lines, before a run.
/// An error of the capture gives no line: the run itself reports it.
pub(crate) fn before_run(capture: &Path, params: &ImportParams) -> Vec<String> {
    const MOST: usize = 3;
    let Ok(imported) = import(capture, params) else { return Vec::new() };
    let mut lines = examine(&imported.report, few_figures(&imported), None, metres(&imported)).gravest(MOST);
    if !lines.is_empty() {
        lines.push(format!("`use3d check {}` says more, and looks at all photographs", word(capture)));
    }
    lines
}

/// The photographs with a camera, and frames of films that were left out.
fn galleries(folder: &Path, capture: &Imported) -> Result<Vec<Gallery>, WorkError> {
    let views = &capture.capture.views;
    let shown = views.len().min(PHOTOGRAPHS);
    let small = |view: &View| -> Result<Picture, WorkError> {
        let mut image = shrunk(&load_pixels(view).map_err(WorkError::input)?.to_image(), TINY);
        if let Some(mask) = load_mask(view).map_err(WorkError::input)? {
            redden(&mut image, &mask);
        }
        let address = jpeg_address(&image, QUALITY).map_err(WorkError::failed)?;
        Ok(Picture { name: view.name.to_string(), address })
    };
    let pictures: Result<_, _> = (0..shown).map(|i| small(&views[i * views.len() / shown])).collect();
    let some = if shown < views.len() { format!("; {shown} of them are shown") } else { String::new() };
    let mut galleries = vec![Gallery {
        title: "Photographs".into(),
        text: format!("{} photographs have a camera{some}. What masks hide is red.", views.len()),
        pictures: pictures?,
    }];
    for LookedFilm { film, looked_at, taken, dark, left_out } in looked_films(folder) {
        let picture = |left: &LeftFrame| -> Option<Picture> {
            let address =
                jpeg_address(&shrunk(&read_image(&folder.join(&left.picture)).ok()?, TINY), QUALITY).ok()?;
            let file = Path::new(&left.picture).file_stem()?.to_string_lossy().into_owned();
            let cause = if left.cause == LeftCause::Dark { "all black or white" } else { "too alike" };
            Some(Picture { name: format!("{file}: {cause}"), address })
        };
        galleries.push(Gallery {
            title: format!("Frames of {film} that were left out"),
            text: format!(
                "{looked_at} frames were looked at, and {taken} of them were taken. {dark} are all black or all white. The others \
                 show nearly the same as a frame that was taken, or are less sharp. Some of them:"
            ),
            pictures: left_out.iter().filter_map(picture).collect(),
        });
    }
    Ok(galleries)
}

/// Makes what a mask hides red.
fn redden(image: &mut Image8, mask: &Map) {
    let (w, h) = (image.width(), image.height());
    for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
        if mask.pixel(x * mask.width() / w, y * mask.height() / h)[0] < 0.5 {
            let [r, g, b] = image.pixel(x, y);
            image.set_pixel(x, y, [r / 2 + 127, g / 2, b / 2]);
        }
    }
}

/// Small pictures of the views that the page shows, and of photographs without a camera, from `folder`.
fn pictures(report: &CheckReport, capture: &Imported, folder: &Path) -> Result<Vec<Picture>, WorkError> {
    let mut pictures = Vec::new();
    for name in report.pictured() {
        let image = match capture.capture.views.iter().find(|view| view.name == name) {
            Some(view) => Some(load_pixels(view).map_err(WorkError::input)?.to_image()),
            // One that cannot be read, or is not there, is shown by its name alone.
            None => FileName::new(&name).ok().and_then(|name| read_image(&name.below(folder)).ok()),
        };
        if let Some(image) = image {
            let address = jpeg_address(&shrunk(&image, SMALL), QUALITY).map_err(WorkError::failed)?;
            pictures.push(Picture { name, address });
        }
    }
    Ok(pictures)
}
