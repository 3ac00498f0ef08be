//! Cameras fitted to a picture or a scene.

use glam::DVec3;
use use3d_capture::{Camera, Intrinsics};
use use3d_numerics::order::median;
use use3d_scene::Scene;

/// A lens whose pictures are scaled to cover `width × height` pixels and cropped centrally, without
/// stretching.
pub fn cover(k: &Intrinsics, width: usize, height: usize) -> Intrinsics {
    let scale = (width as f64 / k.width as f64).max(height as f64 / k.height as f64);
    let (wide, high) = (scale * k.width as f64, scale * k.height as f64);
    let whole = k.scaled(scale, scale, wide.round() as usize, high.round() as usize);
    whole.cropped((wide - width as f64) / 2.0, (high - height as f64) / 2.0, width, height)
}

/// The distance of the scene from a camera in its frame: the median depth of the Gaussians in front of it,
/// scene units; 1 if there are none.
pub fn focus(scene: &Scene, camera: &Camera) -> f64 {
    let point = |m: &[f32; 3]| DVec3::new(m[0].into(), m[1].into(), m[2].into());
    let depths = scene.gaussians.means.iter().filter_map(|m| camera.project(point(m)).map(|(_, z)| z));
    median(depths).filter(|d| d.is_finite() && *d > 0.0).unwrap_or(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_aspect_is_cropped_and_never_stretched() {
        let k = Intrinsics { width: 1600, height: 900, fx: 1000.0, fy: 1000.0, cx: 800.0, cy: 450.0 };
        let square = cover(&k, 450, 450);
        assert_eq!((square.width, square.height), (450, 450));
        assert_eq!((square.fx, square.fy), (500.0, 500.0));
        assert_eq!((square.cx, square.cy), (225.0, 225.0));
        let half = cover(&k, 800, 450);
        assert_eq!((half.fx, half.fy, half.cx, half.cy), (500.0, 500.0, 400.0, 225.0));
    }
}
