//! Reads the scene in a checkpoint, for an observer outside: another process, or another machine with the
//! same disk.

use std::path::Path;

use use3d_capture::Frame;
use use3d_scene::Scene;
use use3d_training::{CheckpointError, CheckpointFile};

use crate::report::LogEntry;
use crate::run::RunState;

/// The scene after the returned number of steps, as the checkpoint file at `path` stores it; `None` if
/// there is no such file (any more). A checkpoint does not contain the frame: `frame` is the capture's.
///
/// Every band of the water is read, because those that are not learnt yet are zero. A water that does not
/// consist of harmonics is read to the degree of the last line of the log until all of its numbers have
/// moved.
///
/// # Errors
/// The file cannot be read, is damaged, or has another version.
pub fn scene_in_checkpoint(path: &Path, frame: Frame) -> Result<Option<(u64, Scene)>, CheckpointError> {
    let Some(state) = CheckpointFile::at(path.to_path_buf()).load::<RunState<'_>>()? else { return Ok(None) };
    let mut engine = state.engine.into_owned();
    engine
        .check(engine.exposures.log_gains.views().max(engine.colors.views))
        .map_err(|error| CheckpointError::Damaged { path: path.to_path_buf(), reason: error.to_string() })?;
    let logged = state.log.iter().rev().find_map(|entry| match entry {
        LogEntry::Steps { degree, .. } => Some(*degree),
        _ => None,
    });
    engine.colors.settle(&mut engine.gaussians);
    let moved = engine.medium_moments[1].iter().all(|moment| *moment > 0.0);
    let bands = engine.medium.is_none() || engine.medium.harmonics().is_some() || moved;
    let medium_degree = if bands { 3 } else { logged.unwrap_or(0) };
    let scene =
        Scene { gaussians: engine.gaussians, frame, medium: engine.medium, medium_degree, enhancement: None };
    Ok(Some((state.step, scene)))
}
