//! Shows a training while it runs: the events of the stages also go to the page, and the page may pause them.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};

use use3d_import::load_prepared;
use use3d_pipeline::scene_views::held_out_first;
use use3d_scene::Scene;
use use3d_viewer::{Live, Shown};
use use3d_web::PageView;
use use3d_workflow::Event;

use super::{Stream, serve};
use crate::App;
use crate::args::WatchArgs;
use crate::error::{Done, WorkError};

/// Runs stages by `work`, with an app whose stages are shown in a viewer if the arguments request one. `name`
/// is the scene's name if there is only one.
pub(crate) fn watched(
    app: &App,
    args: &WatchArgs,
    name: Option<&str>,
    work: impl FnOnce(&App) -> Done,
) -> Done {
    if !args.view {
        return work(app);
    }
    let live = Arc::new(Live::new("Waiting for the training to begin", Some(app.host.stop.clone())));
    let _server = serve(app, args.port, args.no_open, &live, Stream::Remark)?;
    let name = name.map(str::to_string);
    let watcher = Arc::new(Watcher { live: live.clone(), name, known: Mutex::default() });
    let done = work(&app.heard_by(move |event| watcher.hear(event)));
    live.end(&match &done {
        Ok(()) => "Done.".to_string(),
        Err(_) if app.host.stops() => {
            "Stopped. Run the same command to continue from the checkpoint.".to_string()
        }
        Err(error) => format!("Failed: {error}"),
    });
    live.let_them_know();
    done
}

/// The state of the stage that is shown.
#[derive(Default)]
struct Known {
    label: String,
    /// The folder of its photographs.
    import: Option<PathBuf>,
    /// Its camera positions; `None` while they are being read.
    views: Option<Arc<Vec<PageView>>>,
    /// The last scene shown, and its step.
    scene: Option<(Arc<Scene>, u64)>,
}

struct Watcher {
    live: Arc<Live>,
    name: Option<String>,
    known: Mutex<Known>,
}

impl Watcher {
    fn hear(self: &Arc<Self>, event: &Event<'_>) {
        match event {
            Event::Started { label, .. } => self.live.wait_for(&format!("{label} is running")),
            Event::Progress { label, done, total, unit, .. } => {
                self.live.wait_for(&format!("{label}: {done} of {total} {unit}"));
            }
            Event::Figures { label, step, steps, figures } => {
                self.live.figures(label, *step, *steps, figures);
            }
            Event::AsksForView { label, wanted } => {
                if self.live.wants_copy(label) {
                    wanted.store(true, Ordering::Relaxed);
                } else {
                    self.live.hold();
                }
            }
            Event::View { label, inputs, view } => {
                self.live.copied();
                if let Ok(scene) = Arc::clone(view).downcast::<Scene>() {
                    let import = inputs.iter().find(|input| input.role == "import").map(|i| i.path.clone());
                    self.see(label, import, scene);
                }
                self.live.hold();
            }
            Event::Done { label, .. } | Event::Failed { label, .. } => self.live.over(label),
            _ => {}
        }
    }

    /// Shows a scene; its photographs are read once, in parallel with the training.
    fn see(self: &Arc<Self>, label: &str, import: Option<PathBuf>, scene: Arc<Scene>) {
        let step = self.live.step();
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let same_places = known.import == import && !known.label.is_empty();
        (known.label, known.scene) = (label.into(), Some((scene.clone(), step)));
        if same_places {
            drop(known);
            self.show();
            return;
        }
        (known.import, known.views) = (import.clone(), None);
        drop(known);
        let this = self.clone();
        let reading = std::thread::Builder::new().name("viewer photographs".into()).spawn(move || {
            let views = import.as_deref().map_or_else(|| Ok(Vec::new()), |import| places_of(import, &scene));
            let views = views.unwrap_or_else(|error| {
                tracing::warn!("the viewer shows no photographs: {error}");
                Vec::new()
            });
            let mut known = this.known.lock().unwrap_or_else(PoisonError::into_inner);
            if known.import == import {
                known.views = Some(Arc::new(views));
                drop(known);
                this.show();
            }
        });
        if let Err(error) = reading {
            tracing::warn!("the viewer cannot read photographs: {error}");
        }
    }

    fn show(&self) {
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let (Some(views), Some((scene, step))) = (known.views.clone(), known.scene.clone()) {
            let name = self.name.clone().unwrap_or_else(|| known.label.clone());
            drop(known);
            self.live.show(Shown::new(name, scene, views, Some(step)));
        }
    }
}

/// The camera positions of the import in a folder.
fn places_of(import: &Path, scene: &Scene) -> Result<Vec<PageView>, WorkError> {
    let imported = load_prepared(import).map_err(WorkError::input)?;
    held_out_first(scene, &imported).map_err(WorkError::input)
}
