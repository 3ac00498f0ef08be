//! Measures the speed of drawing a scene.
//!
//! Protocol: all views are drawn at their full size, one at a time, on all threads of the pool. Two passes
//! over the views fill caches and buffers and do not count. Then whole passes are timed, until there are at
//! least three and five seconds have passed. The figure is the median over all timed views; frames per second
//! are 1000 over its milliseconds. Drawing is everything from the camera to an image in memory (projection,
//! sorting, water, compositing); loading the scene and writing files are not part of it.
//!
//! Times depend on the machine and its load, so they never become part of an artifact.

use std::time::{Duration, Instant};

use serde::Serialize;
use use3d_capture::Camera;
use use3d_render::{Mode, RenderError, SceneRenderer};

/// Number of passes that do not count.
const WARM_UP: usize = 2;
/// Fewest passes that count.
const PASSES: usize = 3;
/// Shortest total time of the passes that count.
pub const SHORTEST: Duration = Duration::from_secs(5);

/// The measured times.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Speed {
    /// `reconstruction`, `clear`, `enhanced` or `enhanced-clear`.
    pub mode: &'static str,
    /// Frames per second: 1000 over `milliseconds`.
    pub fps: f64,
    /// The median time of a view, milliseconds.
    pub milliseconds: f64,
    /// The fastest view.
    pub fastest: f64,
    /// The slowest view.
    pub slowest: f64,
    /// Passes over all views that were timed.
    pub passes: usize,
}

/// Times the drawing of every camera's view, for at least the time `shortest`: [`SHORTEST`] for a benchmark,
/// zero for a figure in a table. `None` without cameras, or when `stop` returned true.
///
/// # Errors
/// Returns the errors of the renderer's device.
pub fn measure(
    renderer: &mut SceneRenderer<'_>,
    cameras: &[Camera],
    mode: Mode,
    shortest: Duration,
    stop: &dyn Fn() -> bool,
) -> Result<Option<Speed>, RenderError> {
    if cameras.is_empty() {
        return Ok(None);
    }
    let mut times = Vec::new();
    let (mut passes, mut begin) = (0, Instant::now());
    while passes < WARM_UP + PASSES || begin.elapsed() < shortest {
        if passes == WARM_UP {
            times.clear();
            begin = Instant::now();
        }
        for camera in cameras {
            if stop() {
                return Ok(None);
            }
            let start = Instant::now();
            std::hint::black_box(renderer.draw(camera, mode)?);
            times.push(1e3 * start.elapsed().as_secs_f64());
        }
        passes += 1;
    }
    times.sort_unstable_by(f64::total_cmp);
    let milliseconds = times[times.len() / 2];
    Ok(Some(Speed {
        mode: mode.name(),
        fps: 1e3 / milliseconds,
        milliseconds,
        fastest: times[0],
        slowest: times[times.len() - 1],
        passes: passes - WARM_UP,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Frame, Intrinsics, Pose};
    use use3d_medium::MediumModel;
    use use3d_scene::Scene;
    use use3d_splat::Gaussians;

    fn scene() -> Scene {
        let gaussians = Gaussians {
            sh_degree: 0,
            means: vec![[0.0, 0.0, 2.0]],
            log_scales: vec![[-2.0; 3]],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![2.0],
            sh: vec![[[0.5; 3]; 16]],
        };
        Scene {
            gaussians,
            frame: Frame::IDENTITY,
            medium: MediumModel::None,
            medium_degree: 0,
            enhancement: None,
        }
    }

    #[test]
    fn three_passes_are_timed_and_the_drawn_image_is_the_rendered_one() {
        let intrinsics = Intrinsics { width: 16, height: 12, fx: 12.0, fy: 12.0, cx: 8.0, cy: 6.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let scene = scene();
        let mut renderer = SceneRenderer::new(&scene, 1.0).unwrap();
        let speed = measure(&mut renderer, &[camera; 2], Mode::Reconstruction, Duration::ZERO, &|| false)
            .unwrap()
            .unwrap();
        assert_eq!((speed.mode, speed.passes), ("reconstruction", PASSES));
        assert!(speed.fastest <= speed.milliseconds && speed.milliseconds <= speed.slowest);
        assert_eq!(speed.fps, 1e3 / speed.milliseconds);
        let drawn = renderer.draw(&camera, Mode::Reconstruction).unwrap().clone();
        assert_eq!(drawn, renderer.color(&camera, Mode::Reconstruction).unwrap());
        assert!(drawn.data().iter().any(|v| *v > 0.1), "the Gaussian is in the picture");
        assert_eq!(
            measure(&mut renderer, &[camera], Mode::Reconstruction, SHORTEST, &|| true).unwrap(),
            None
        );
        assert_eq!(measure(&mut renderer, &[], Mode::Reconstruction, SHORTEST, &|| false).unwrap(), None);
    }
}
