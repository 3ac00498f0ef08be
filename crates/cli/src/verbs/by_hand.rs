//! One stage by hand, without a pipeline file: import, reconstruct, calibrate, targets, enhance.

use std::path::Path;
use std::time::Instant;

use use3d_config::LoadOptions;
use use3d_pipeline::by_hand::{ByHand, HandWork, IMPORT};
use use3d_pipeline::destination::{check_file, check_folder, copy_file, copy_folder, path_text, word};
use use3d_pipeline::scene_views::scene_name;
use use3d_pipeline::spelled::Spelled;
use use3d_stages::{CALIBRATOR, TARGETS};
use use3d_workflow::Event;
use use3d_workflow::machine::{bytes, seconds};

use crate::App;
use crate::args::{CalibrateArgs, EnhanceArgs, ImportArgs, ReconstructArgs, TargetsArgs};
use crate::error::{Done, WorkError};
use crate::verbs::view::watched;

/// Runs a stage whose result goes to `out`, and prints path, size and duration of the result, and the next
/// step. `work` gets the folder for the work of the stage.
fn made(app: &App, out: &Path, next: &str, work: impl FnOnce(&Path) -> Done) -> Done {
    let (started, hidden) = (Instant::now(), HandWork::beside(out));
    let done = work(&hidden.folder);
    if hidden.end(done.is_ok()) {
        remark!(
            app,
            "{}: kept checkpoints of a run with other parameters or inputs; delete the folder if you will \
             not resume it",
            path_text(&hidden.folder)
        );
    }
    done?;
    let time = seconds(started.elapsed().as_secs_f64());
    remark!(app, "{}: {}, in {time}; next: {next}", path_text(out), bytes(size(out)));
    Ok(())
}

/// The bytes of a file, or of all files in a folder.
fn size(path: &Path) -> u64 {
    match std::fs::read_dir(path) {
        Ok(entries) => entries.filter_map(Result::ok).map(|entry| size(&entry.path())).sum(),
        Err(_) => std::fs::metadata(path).map_or(0, |file| file.len()),
    }
}

/// The same app, which also prints the time of each part of a stage on stdout.
fn profiling(app: &App) -> App {
    app.heard_by(|event| {
        if let Event::Profile { text, .. } = event {
            print!("{text}");
        }
    })
}

pub(crate) fn import(app: &App, args: &ImportArgs) -> Done {
    let force = args.replace.force;
    check_folder(&args.out, force)?;
    let hand = ByHand {
        flags: args.settings.spelled(args.size.spelled()),
        options: args.settings.options(None),
        ..ByHand::on(&args.capture, IMPORT)
    };
    let next = format!("use3d run {}", word(&args.out));
    made(app, &args.out, &next, |work| {
        copy_folder(&hand.imported(&app.host, work, None, false)?, &args.out, force)
    })
}

pub(crate) fn reconstruct(app: &App, args: &ReconstructArgs) -> Done {
    let force = args.replace.force;
    check_folder(&args.out, force)?;
    let mut flags = args.settings.spelled(args.common.spelled());
    flags.extend(args.engine.choice().map(|e| Spelled::new("--engine", "reconstruct", "engine", e)));
    let options = args.settings.options(args.models.as_ref());
    let hand = ByHand { flags, options, ..ByHand::on(&args.capture, "reconstruct") };
    let app = if args.profile { &profiling(app) } else { app };
    let (scene, capture) = (word(&args.out), word(&args.capture));
    let next =
        format!("use3d render {scene} --cameras {capture} --out renders/ --modes reconstruction,clear");
    made(app, &args.out, &next, |work| {
        watched(app, &args.watch, Some(&scene_name(&args.out)), |app| {
            hand.imported(&app.host, work, None, false)?;
            copy_folder(&hand.run(&app.host, work)?, &args.out, force)
        })
    })
}

pub(crate) fn calibrate(app: &App, args: &CalibrateArgs) -> Done {
    check_file("--out", &args.out, args.replace.force, &[])?;
    let proposer = args.proposer.iter().map(|name| Spelled::new("--proposer", "pairs", "proposer", name));
    let pairs = Some((args.input.clone(), args.target.clone()));
    let hand = ByHand {
        stage: "calibrate",
        flags: args.settings.spelled(proposer.collect()),
        options: LoadOptions { pairs, ..args.settings.options(args.models.as_ref()) },
        ..ByHand::default()
    };
    let calibrator = word(&args.out);
    let next = format!("use3d targets SCENE CAPTURE --calibrator {calibrator} --out targets.safetensors");
    made(app, &args.out, &next, |work| {
        copy_file("--out", &hand.run(&app.host, work)?.join(CALIBRATOR), &args.out)
    })
}

pub(crate) fn targets(app: &App, args: &TargetsArgs) -> Done {
    let force = args.replace.force;
    check_file("--out", &args.out, force, &[])?;
    // The pictures that show the reason for consensus are written beside the file.
    let previews = args.out.with_extension("previews");
    check_folder(&previews, force)?;
    let calibrator = args.calibrator.clone();
    let options = LoadOptions { calibrator, ..args.settings.options(args.models.as_ref()) };
    let flags = args.settings.spelled(args.size.spelled());
    let mut hand = ByHand { flags, options, ..ByHand::on(&args.capture, "targets") };
    hand.given.insert("scene", Some(args.scene.clone()));
    let (scene, capture, targets) = (word(&args.scene), word(&args.capture), word(&args.out));
    let next = format!("use3d enhance {scene} {capture} --targets {targets} --out enhanced-scene/");
    made(app, &args.out, &next, |work| {
        hand.imported(&app.host, work, Some(&args.scene), false)?;
        if args.calibrator.is_none() && hand.needs("calibrate", work)? {
            return Err(WorkError::input(
                "calibrated = true needs a calibrator: give --calibrator FILE (`use3d calibrate` makes one)",
            ));
        }
        let made = hand.run(&app.host, work)?;
        if made.join("previews").is_dir() {
            copy_folder(&made.join("previews"), &previews, force)?;
        }
        copy_file("--out", &made.join(TARGETS), &args.out)
    })
}

pub(crate) fn enhance(app: &App, args: &EnhanceArgs) -> Done {
    let force = args.replace.force;
    check_folder(&args.out, force)?;
    let mut flags = args.settings.spelled(args.size.spelled());
    flags.extend(args.iterations.map(|n| Spelled::new("--iterations", "enhance", "iterations", n)));
    flags.extend(args.engine.choice().map(|e| Spelled::new("--engine", "enhance", "engine", e)));
    let options = args.settings.options(args.models.as_ref());
    let mut hand = ByHand { flags, options, ..ByHand::on(&args.capture, "enhance") };
    hand.given.insert("scene", Some(args.scene.clone()));
    hand.given.insert("targets", Some(args.targets.clone()));
    let app = if args.profile { &profiling(app) } else { app };
    let (scene, capture) = (word(&args.out), word(&args.capture));
    let next = format!("use3d render {scene} --cameras {capture} --out renders/ --modes enhanced");
    made(app, &args.out, &next, |work| {
        hand.imported(&app.host, work, Some(&args.scene), false)?;
        copy_folder(&hand.run(&app.host, work)?, &args.out, force)
    })
}
