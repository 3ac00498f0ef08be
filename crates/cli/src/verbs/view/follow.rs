//! `use3d view --follow`: shows a training of another process by its files.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use use3d_pipeline::follow::Follower;
use use3d_pipeline::scene_views::saved_views;
use use3d_viewer::{Live, Shown};

use super::{Stream, WAIT, serve};
use crate::App;
use crate::args::ViewArgs;
use crate::error::{Done, WorkError};

pub(super) fn run(app: &App, args: &ViewArgs, target: &Path, live: &Arc<Live>) -> Done {
    let mut request = args.cache.request(target);
    request.options.sets.clone_from(&args.set);
    let mut follower = Follower::find(&request, args.scene.as_deref(), args.cameras.as_deref())?;
    let name = follower.name();
    let saved = saved_views(args.views.as_deref())?.map(Arc::new);
    live.wait_for(&format!("Waiting for the first checkpoint of {name}"));
    let _server = serve(app, args.port, args.no_open, live, Stream::Result)?;
    if let Some(wanted) = follower.wanted() {
        remark!(app, "nothing to show yet; waiting for {wanted}");
    }
    let mut looked: Option<Instant> = None;
    while !app.host.stops() {
        if looked.is_some_and(|at| at.elapsed() < follower.interval()) {
            std::thread::sleep(WAIT);
            continue;
        }
        looked = Some(Instant::now());
        match follower.look() {
            Ok(None) => {}
            Ok(Some(news)) => {
                let what =
                    news.step.map_or_else(|| "the finished scene".to_string(), |step| format!("step {step}"));
                remark!(app, "{name}: {what}, {} Gaussians", news.scene.gaussians.len());
                let state = Shown::new(name.clone(), news.scene, news.views, news.step);
                live.show(Shown { metres_per_unit: args.metres_per_unit, saved: saved.clone(), ..state });
            }
            Err(WorkError::Failed(error)) => {
                live.wait_for(&error);
                tracing::warn!("{error}");
            }
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
