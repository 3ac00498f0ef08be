//! `use3d view`: a scene, a capture or a training that another process does, in a browser; and
//! what `--view` adds to a training.

mod follow;
mod points;
mod watch;

pub(crate) use watch::Watched;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use use3d_import::{ImportParams, Imported, import};
use use3d_pipeline::scene_page::{self, ScenePageError};
use use3d_scene::{Origin, Scene};
use use3d_viewer::{Live, Server, Shown};
use use3d_web::PageView;

use crate::App;
use crate::args::{ViewArgs, ViewerArgs};
use crate::error::{CliError, Done};
use crate::verbs::web::{saved_views, scene_name, views};

/// How often one who waits looks whether to end.
const WAIT: Duration = Duration::from_millis(200);

/// `use3d view`.
pub(crate) fn run(app: &App, args: &ViewArgs) -> Done {
    if let Some(metres) = args.metres_per_unit.filter(|m| !(m.is_finite() && *m > 0.0)) {
        return Err(CliError::Input(format!("--metres-per-unit {metres}: expected a positive number")));
    }
    let live = Arc::new(Live::new("Opening the scene…", None));
    if let Some(followed) = &args.follow {
        return follow::run(app, args, followed, &live);
    }
    let Some(target) = &args.target else {
        return Err(CliError::Input("say what to look at: a scene, a capture, or --follow FILE".into()));
    };
    let shown = shown(target, args)?;
    let _server = serve(app, &args.viewer, &live, Told::Result)?;
    live.hand_over(shown).map_err(CliError::input)?;
    while !app.stop.load(Ordering::Relaxed) {
        std::thread::sleep(WAIT);
    }
    Ok(())
}

/// What a folder shows.
fn shown(target: &Path, args: &ViewArgs) -> Result<Shown, CliError> {
    let metres_per_unit = args.metres_per_unit;
    let saved = saved_views(args.views.as_deref())?.map(Arc::new);
    if Scene::is_scene(target) {
        let scene = Scene::load(target).map_err(CliError::input)?;
        let views = match &args.cameras {
            Some(cameras) => views(cameras, target, &scene)?,
            None => Vec::new(),
        };
        let name = scene_name(target);
        return Ok(Shown {
            name,
            scene: Arc::new(scene),
            views: Arc::new(views),
            metres_per_unit,
            saved,
            step: None,
        });
    }
    if !target.is_dir() {
        let there = if target.exists() { "this is a file" } else { "there is no such folder" };
        let what = format!(
            "{there}; expected the folder of a scene (`use3d reconstruct` makes one) or of a capture"
        );
        return Err(CliError::Input(format!("{}: {what}", target.display())));
    }
    if args.cameras.is_some() {
        return Err(CliError::Input("--cameras goes with a scene; a capture has its own cameras".into()));
    }
    let imported = import(target, &ImportParams::default()).map_err(CliError::input)?;
    let scene = points::scene(&imported.capture)
        .map_err(|what| CliError::Input(format!("{}: {what}", target.display())))?;
    let origin = Origin::of(&imported.capture);
    let views: Vec<PageView> =
        scene_page::views(&scene, Some(&origin), &imported).map_err(CliError::input)?;
    let name = imported.capture.name;
    Ok(Shown { name, scene: Arc::new(scene), views: Arc::new(views), metres_per_unit, saved, step: None })
}

/// The places of an imported capture, held-out ones first: those are what one looks
/// at to see how good a scene is.
fn places(scene: &Scene, imported: &Imported) -> Result<Vec<PageView>, ScenePageError> {
    let origin = Origin::of(&imported.capture);
    let mut views = scene_page::views(scene, Some(&origin), imported)?;
    views.sort_by_key(|view| !view.held_out);
    Ok(views)
}

/// Where the address is printed: it is what `use3d view` gives, and a remark beside what a training gives.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Told {
    Result,
    Remark,
}

/// A server that runs, until it is dropped.
struct Serving {
    _server: Server,
    /// The page that leads a browser to it.
    _leads_there: Option<tempfile::NamedTempFile>,
}

/// Starts the server, says where it is, and opens a browser where there is a screen.
fn serve(app: &App, args: &ViewerArgs, live: &Arc<Live>, told: Told) -> Result<Serving, CliError> {
    let server = Server::start(args.port, live).map_err(CliError::input)?;
    let (address, port) = (server.address(), server.port());
    if told == Told::Result {
        println!("{address}");
        // Whoever reads it through a pipe waits for it.
        let _ = std::io::stdout().flush();
    } else {
        eprintln!("{address}");
    }
    if !app.quiet {
        eprintln!(
            "open this address in a browser (all of it: what follows # is the key); from another machine after `ssh -L {port}:localhost:{port} HOST`; \
             Ctrl-C ends it"
        );
    }
    let leads_there = if args.no_open { None } else { open(&address) };
    Ok(Serving { _server: server, _leads_there: leads_there })
}

/// What the name of a page that leads to a server begins with.
const LEADS_THERE: &str = "use3d-view-";

/// A page that leads to an address, which only this user can read: every user of a machine reads the words of
/// its commands, and the address ends with the key.
fn page_to(address: &str) -> std::io::Result<tempfile::NamedTempFile> {
    let own = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|folder| folder.is_dir());
    let folder = own.unwrap_or_else(std::env::temp_dir);
    use3d_files::sweep(&folder, LEADS_THERE, |_| true);
    let prefix = format!("{LEADS_THERE}{}-", use3d_files::unique());
    let mut page = tempfile::Builder::new().prefix(&prefix).suffix(".html").tempfile_in(folder)?;
    write!(
        page,
        "<!doctype html>\n<meta charset=\"utf-8\">\n<meta name=\"referrer\" content=\"no-referrer\">\n\
         <meta http-equiv=\"refresh\" content=\"0; url={address}\">\n<title>3D-USE</title>\n\
         <p><a href=\"{address}\">Open the viewer</a></p>\n"
    )?;
    page.flush()?;
    Ok(page)
}

/// Asks the system to open an address; the page by which it does. The address is printed in any case, so it
/// does not matter if there is no browser.
fn open(address: &str) -> Option<tempfile::NamedTempFile> {
    let screen = ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some());
    let (program, arguments): (&str, &[&str]) = if cfg!(target_os = "macos") {
        ("open", &[])
    } else if cfg!(windows) {
        ("cmd", &["/c", "start", ""])
    } else if screen {
        ("xdg-open", &[])
    } else {
        return None;
    };
    let page = match page_to(address) {
        Ok(page) => page,
        Err(error) => {
            tracing::debug!("no page that leads a browser to the viewer: {error}");
            return None;
        }
    };
    let quiet = || Stdio::null();
    let started = Command::new(program)
        .args(arguments)
        .arg(page.path())
        .stdin(quiet())
        .stdout(quiet())
        .stderr(quiet())
        .spawn();
    match started {
        // It is waited for beside, so that it leaves nothing behind.
        Ok(mut child) => drop(std::thread::spawn(move || child.wait())),
        Err(error) => tracing::debug!("{program}: {error}"),
    }
    Some(page)
}
