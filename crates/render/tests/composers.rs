//! Another composer than the processor's can be used in a renderer through public names alone.

mod common;

use std::sync::atomic::{AtomicUsize, Ordering};

use common::{mini, taught};
use use3d_render::{Composer, Composition, Look, Mode, Processor, RenderError, Renderer, SceneRenderer};
use use3d_splat::Rendered;

/// A composer that draws like the processor, counts its drawings, and fails after some of them.
struct Lent<'s> {
    own: Processor<'s>,
    asked: &'s AtomicUsize,
    lost_after: usize,
}

impl Composer for Lent<'_> {
    fn compose(&mut self, view: &Composition<'_>, out: &mut Rendered) -> Result<(), RenderError> {
        if self.asked.fetch_add(1, Ordering::Relaxed) >= self.lost_after {
            return Err(RenderError::Device { device: "lent".into(), problem: "it is lost".into() });
        }
        self.own.compose(view, out)
    }
}

#[test]
fn a_composer_of_another_crate_draws_every_mode_and_its_loss_is_told() {
    let (scene, views) = mini();
    let scene = taught(&scene);
    let asked = AtomicUsize::new(0);
    let on = |look, lost_after| {
        let lent = Lent { own: Processor::new(&scene), asked: &asked, lost_after };
        Renderer::on(Box::new(lent), &scene, look).unwrap()
    };
    let looks = [Look::Reconstruction, Look::Enhanced { strength: 1.0 }];
    let [plain, enhanced] = looks.map(|look| on(look, 4));
    let mut lent = SceneRenderer::on(plain, Some(enhanced));
    let mut own = SceneRenderer::new(&scene, 1.0).unwrap();
    for view in &views[..2] {
        assert_eq!(
            lent.render(&view.camera, &Mode::ALL).unwrap(),
            own.render(&view.camera, &Mode::ALL).unwrap()
        );
    }
    assert_eq!(asked.load(Ordering::Relaxed), 4, "two looks of two views, however many modes");
    let lost = lent.draw(&views[0].camera, Mode::Clear).unwrap_err();
    assert!(matches!(&lost, RenderError::Device { device, .. } if device == "lent"));
    assert!(lost.to_string().contains("it is lost"), "{lost}");
}
