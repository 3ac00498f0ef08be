//! The answer of a look to light is the derivative of its picture by the light of all surfaces.

mod common;

use common::{mini, taught};
use use3d_capture::{Lattice, MediumMaps};
use use3d_render::{Mode, SceneRenderer};
use use3d_scene::{Compositor, Scene};
use use3d_splat::{Options, Rendered};

/// The picture of a look if the stage-1 colours of all Gaussians have `more` light.
fn brighter(scene: &Scene, view: &use3d_capture::Camera, mode: Mode, more: [f32; 3]) -> Rendered {
    let lattice = Lattice::full(&view.intrinsics);
    let enhancement = scene.enhancement.as_ref().filter(|_| mode.is_enhanced());
    let g = &scene.gaussians;
    let grades = enhancement.map(|e| e.objects(&g.means, g.sh.iter().map(|sh| sh[0]), 1.0));
    let (mut compositor, mut out) = (Compositor::default(), Rendered::new());
    compositor.prepare(scene, view, &lattice, |colors| {
        for color in colors.iter_mut() {
            (0..3).for_each(|c| color[c] += more[c]);
        }
        if let Some(grades) = &grades {
            grades.apply(colors);
        }
    });
    let mut maps = MediumMaps::zeros(0, 0);
    scene.look_through(view, &lattice, &mut maps);
    if let Some(enhancement) = enhancement {
        maps = enhancement.water(view.pose.center().as_vec3().to_array(), maps, 1.0);
    }
    let dry = matches!(mode, Mode::Clear | Mode::EnhancedClear);
    compositor.draw((!dry).then_some(&maps), &Options::default(), &mut out);
    out
}

#[test]
fn the_answer_is_the_derivative_by_light_in_every_look() {
    let (scene, views) = mini();
    let scene = taught(&scene);
    let camera = &views[0].camera;
    let lattice = Lattice::full(&camera.intrinsics);
    let mut renderer = SceneRenderer::new(&scene, 1.0).unwrap();
    let h = 0.25f32;
    for mode in [Mode::Reconstruction, Mode::Clear, Mode::Enhanced, Mode::EnhancedClear] {
        let response = renderer.response(camera, &lattice, mode).unwrap();
        let base = brighter(&scene, camera, mode, [0.0; 3]);
        for j in 0..3 {
            let more = std::array::from_fn(|c| if c == j { h } else { 0.0 });
            let moved = brighter(&scene, camera, mode, more);
            let found = response.columns[j].data();
            let difference = moved.image.data().iter().zip(base.image.data()).map(|(a, b)| (a - b) / h);
            let worst = difference.zip(found).map(|(d, f)| (d - f).abs()).fold(0.0f32, f32::max);
            assert!(worst < 2e-5, "{} {j}: {worst}", mode.name());
        }
        // A look in stage 1's own water answers with the light that arrives.
        if mode == Mode::Reconstruction {
            for j in 0..3 {
                assert_eq!(response.columns[j].plane(j), response.arriving.plane(j));
                assert!(response.columns[j].plane((j + 1) % 3).iter().all(|v| *v == 0.0));
            }
        }
    }
}
