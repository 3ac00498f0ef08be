//! `use3d white`: stores the white balance of a scene beside it, and shows it in the page of its results.

use std::path::Path;

use use3d_pipeline::destination::{check_file, path_text, word};
use use3d_pipeline::found::capture_in;
use use3d_pipeline::history;
use use3d_pipeline::white::measured;
use use3d_scene::{Scene, White};

use crate::App;
use crate::args::KeepWhiteArgs;
use crate::error::{Done, WorkError};
use crate::verbs::run;
use crate::verbs::white::{keep, tell};

/// Writes the page beside a scene among results again, so that it opens with the scene's white balance.
fn renew_page(app: &App, folder: &Path) {
    let page = folder.with_file_name("view.html");
    let results = folder.parent().and_then(Path::parent);
    let (true, Some(results)) = (page.is_file(), results) else { return };
    let Some(record) = history::of_results(results) else { return };
    match run::again(app, &record, results, true) {
        Ok(()) => remark!(app, "{} opens with these colours now", path_text(&page)),
        Err(error) => remark!(
            app,
            "{} keeps its earlier colours ({error}); `use3d export {} --web PAGE.html` writes a page with these",
            path_text(&page),
            word(folder)
        ),
    }
}

/// `use3d white`.
pub(crate) fn run(app: &App, args: &KeepWhiteArgs) -> Done {
    let folder = app.scene_in(&args.scene)?;
    if let Some(out) = &args.out {
        check_file("--out", out, args.replace.force, &["json"])?;
    }
    let scene = Scene::load(&folder).map_err(WorkError::input)?;
    let (white, place) = if args.choices.is_empty() {
        let stored = White::beside(&folder).map_err(WorkError::input)?;
        match (&args.out, &stored) {
            (Some(out), Some(white)) => white.write(out).map_err(WorkError::failed)?,
            (Some(_), None) => {
                return Err(WorkError::input(
                    "--out: the scene has no white balance to write; give a choice, such as VIEW:X,Y",
                ));
            }
            (None, _) => {}
        }
        (stored, args.out.clone().unwrap_or_else(|| White::place(&folder)))
    } else {
        let cameras = args.cameras.clone().or_else(|| capture_in(&args.scene));
        let white = measured(&args.choices, &scene, cameras.as_deref())?;
        match (&args.out, &white) {
            (Some(out), Some(white)) => white.write(out).map_err(WorkError::failed)?,
            (Some(_), None) => return Err(WorkError::input("off writes no file: leave out --out")),
            (None, white) => {
                keep(app, white.as_ref(), &folder)?;
                renew_page(app, &folder);
            }
        }
        (white, args.out.clone().unwrap_or_else(|| White::place(&folder)))
    };
    if args.json {
        return crate::output::json(&white);
    }
    match &white {
        Some(white) => {
            println!("{}", path_text(&place));
            tell(app, white, &scene);
        }
        None => remark!(app, "no white balance: colours unchanged"),
    }
    Ok(())
}
