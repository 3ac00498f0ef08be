//! `bench scene`: the cost of a training step on a trained scene.

use serde::Serialize;
use use3d_import::load_prepared;
use use3d_lab::scene::{Limit, SceneRecord, Subject, measure};
use use3d_pipeline::by_hand::{ByHand, scratch};
use use3d_pipeline::found::scene_in;
use use3d_scene::{Origin, Scene};

use crate::App;
use crate::args::BenchSceneArgs;
use crate::error::{Done, WorkError};
use crate::output::json;

/// The made scene's size, and its number of Gaussians.
const MADE: (usize, (usize, usize)) = (122_000, (640, 360));

/// The figures and the limit beside which they stand.
#[derive(Serialize)]
struct SceneCost {
    limit: Limit,
    scene: SceneRecord,
}

/// The scene of the command line.
fn subject(app: &App, args: &BenchSceneArgs) -> Result<Subject, WorkError> {
    let (Some(scene), Some(capture)) = (&args.scene, &args.capture) else {
        return Subject::made(MADE.0, MADE.1).map_err(WorkError::failed);
    };
    let folder = scene_in(scene)?;
    let loaded = Scene::load(&folder).map_err(WorkError::input)?;
    let hand = ByHand {
        flags: args.settings.spelled(args.size.spelled()),
        options: args.settings.options(None),
        ..ByHand::import_of(capture)
    };
    let scratch = scratch()?;
    let imported = hand.imported(&app.host, scratch.path(), None, false)?;
    let capture = load_prepared(&imported).map_err(WorkError::input)?.capture;
    if let Some(origin) = Origin::read(&folder).map_err(WorkError::input)? {
        origin.check_capture(&folder, &capture).map_err(WorkError::input)?;
    }
    let name = folder.display().to_string();
    Subject::trained(&name, loaded, &capture, args.views).map_err(WorkError::input)
}

pub(crate) fn run(app: &App, args: &BenchSceneArgs) -> Done {
    let subject = subject(app, args)?;
    let Some(limit) = Limit::measure() else {
        return Err(WorkError::Failed("no thread can be started to measure the limit".into()));
    };
    let scene = measure(&subject, args.rounds, &limit).map_err(WorkError::failed)?;
    let measured = SceneCost { limit, scene };
    if args.json {
        return json(&measured);
    }
    print(&measured);
    Ok(())
}

fn print(SceneCost { limit, scene }: &SceneCost) {
    println!(
        "limit of one thread ({}): the compositor takes {:.2} ns a pair in water, {:.2} ns without, where every \
         Gaussian covers every pixel",
        limit.instructions, limit.water, limit.dry
    );
    println!(
        "{}: {} Gaussians, {} views, {} threads\na pixel: {:.1} contributing pairs, {:.1} tested ({:.0} % live), \
         {:.2} entries",
        scene.name,
        scene.gaussians,
        scene.views,
        scene.threads,
        scene.contributing,
        scene.tested,
        100.0 * scene.contributing / scene.tested,
        scene.entries
    );
    for (part, ms) in scene.parts.iter().filter(|(_, ms)| *ms > 0.0) {
        println!("{part:>17} {ms:>8.2} ms {:>5.1} %", 100.0 * ms / scene.step);
    }
    println!("{:>17} {:>8.2} ms; compositor: {:.0} % of the limit", "step", scene.step, 100.0 * scene.share);
}
