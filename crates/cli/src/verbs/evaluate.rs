//! Scores of a scene's held-out views, or of plain folders of images.

use std::path::Path;

use use3d_judge::scores::SceneScores;
use use3d_pipeline::by_hand::{ByHand, scratch};
use use3d_pipeline::scored::ScoreRows;
use use3d_stages::{SCORES, read_json};

use crate::App;
use crate::args::{EvaluateArgs, TableFormat};
use crate::error::{Done, WorkError};
use crate::output;

pub(crate) fn run(app: &App, args: &EvaluateArgs) -> Done {
    let rows = match (&args.images, &args.scene, &args.capture) {
        (Some(images), _, _) => {
            let (reference, models) = (args.reference.as_deref(), args.models.as_deref());
            let mut warn = |text: String| eprintln!("{text}");
            ScoreRows::of_folders(images, reference, models, &app.host.stop, &mut warn)?
        }
        (None, Some(scene), Some(capture)) => scene_rows(app, args, scene, capture)?,
        _ => return Err(WorkError::input("evaluate needs SCENE_DIR and CAPTURE_DIR, or --images DIR")),
    };
    match if args.json { TableFormat::Json } else { args.format } {
        TableFormat::Json => return output::json(&rows),
        TableFormat::Csv => print!("{}", rows.csv()),
        TableFormat::Table => print!("{rows}"),
    }
    rows.reasons().iter().for_each(|reason| eprintln!("{reason}"));
    Ok(())
}

fn scene_rows(app: &App, args: &EvaluateArgs, scene: &Path, capture: &Path) -> Result<ScoreRows, WorkError> {
    let mut hand = ByHand {
        flags: args.settings.spelled(args.size.spelled()),
        options: args.settings.options(args.models.as_ref()),
        ..ByHand::on(capture, "evaluate")
    };
    let is_enhanced = scene.join("ubaf.safetensors").is_file();
    hand.given.extend([
        ("scene", Some(scene.to_path_buf())),
        ("enhanced", is_enhanced.then(|| scene.to_path_buf())),
        ("reference", args.warp_by.clone()),
        ("proposals", None),
        ("photographs", None),
    ]);
    let scratch = scratch()?;
    hand.imported(&app.host, scratch.path(), Some(scene), true)?;
    let out = hand.run(&app.host, scratch.path())?;
    let scores: SceneScores = read_json(&out.join(SCORES)).map_err(WorkError::failed)?;
    Ok(ScoreRows::of_scene(&scores))
}
