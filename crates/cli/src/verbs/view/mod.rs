//! `use3d view`: shows a scene, a capture or a training of another process in a browser; also the part of
//! `--view` that a training uses.

mod follow;
mod watch;

pub(crate) use watch::watched;

use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use use3d_import::{ImportParams, import};
use use3d_pipeline::found::capture_in;
use use3d_pipeline::points;
use use3d_pipeline::scene_page;
use use3d_pipeline::scene_views::{metres, saved_views, scene_name};
use use3d_scene::{Origin, Scene};
use use3d_viewer::{Live, Redirect, Server, Shown, browser};

use crate::App;
use crate::args::ViewArgs;
use crate::error::{Done, WorkError};
use crate::verbs::web::{check_metres, views};
use crate::verbs::white;

/// Time between two checks of the stop flag while waiting.
const WAIT: Duration = Duration::from_millis(200);

/// `use3d view`.
pub(crate) fn run(app: &App, args: &ViewArgs) -> Done {
    check_metres(args.metres_per_unit)?;
    let live = Arc::new(Live::new("Opening the scene…", None));
    if let Some(followed) = &args.follow {
        return follow::run(app, args, followed, &live);
    }
    let Some(target) = &args.target else {
        return Err(WorkError::input("name what to show: a scene, a capture, or --follow FILE"));
    };
    let cameras = args.cameras.clone().or_else(|| capture_in(target));
    // A capture is shown also where results were made of it.
    let is_capture = use3d_import::check_layout(target).is_ok();
    let target = if is_capture { target.clone() } else { app.scene_in(target)? };
    let shown = shown(app, &target, cameras.as_deref(), args)?;
    let _server = serve(app, args.port, args.no_open, &live, Stream::Result)?;
    live.hand_over(shown).map_err(WorkError::input)?;
    while !app.host.stops() {
        std::thread::sleep(WAIT);
    }
    Ok(())
}

/// The scene or capture in a folder.
fn shown(app: &App, target: &Path, cameras: Option<&Path>, args: &ViewArgs) -> Result<Shown, WorkError> {
    let saved = saved_views(args.views.as_deref())?.map(Arc::new);
    if Scene::is_scene(target) {
        let scene = Scene::load(target).map_err(WorkError::input)?;
        let views = views(cameras, target, &scene)?;
        let metres_per_unit = metres(args.metres_per_unit, saved.as_deref(), target)?;
        let white = white::of(app, &args.white, target, &scene, cameras)?.map(Arc::new);
        let shown = Shown::new(scene_name(target), scene, views, None);
        return Ok(Shown { metres_per_unit, saved, white, ..shown });
    }
    if !target.is_dir() {
        let there = if target.exists() { "this is a file" } else { "there is no such folder" };
        let what = format!("{there}; expected the folder of a scene, of a run's results or of a capture");
        return Err(WorkError::Input(format!("{}: {what}", target.display())));
    }
    if args.cameras.is_some() {
        return Err(WorkError::input("--cameras is for a scene; a capture has its own cameras"));
    }
    let imported = import(target, &ImportParams::default()).map_err(WorkError::input)?;
    let scene = points::scene(&imported.capture)
        .map_err(|what| WorkError::Input(format!("{}: {what}", target.display())))?;
    let origin = Origin::of(&imported.capture);
    let views = scene_page::views(&scene, Some(&origin), &imported).map_err(WorkError::input)?;
    let given = args.metres_per_unit.or_else(|| saved.as_ref()?.metres_per_unit);
    let known = imported.model.world.as_ref().map(|world| world.metres_per_unit);
    let shown = Shown::new(imported.capture.name, scene, views, None);
    Ok(Shown { metres_per_unit: given.or(known), saved, points: true, ..shown })
}

/// The stream for the address: stdout for `use3d view`, whose result it is, and stderr for a training.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stream {
    Result,
    Remark,
}

/// Starts the server, prints its address, and opens a browser if there is a screen. The server, and the page
/// that leads a browser to it, end when they are dropped.
fn serve(
    app: &App,
    port: Option<u16>,
    no_open: bool,
    live: &Arc<Live>,
    stream: Stream,
) -> Result<(Server, Option<Redirect>), WorkError> {
    let server = Server::start(port, live).map_err(WorkError::input)?;
    let (address, port) = (server.address(), server.port());
    if stream == Stream::Result {
        println!("{address}");
        // A program that reads it through a pipe needs it at once.
        let _ = std::io::stdout().flush();
    } else {
        eprintln!("{address}");
    }
    remark!(
        app,
        "open this whole address in a browser (the part after # is the key); on another machine, first \
         run `ssh -L {port}:localhost:{port} HOST` there; Ctrl-C ends the viewer"
    );
    let redirect = if no_open { None } else { browser::open(&address) };
    Ok((server, redirect))
}
