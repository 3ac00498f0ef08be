//! Another backend than the processor's can be used in a renderer through public names alone.

mod common;

use std::sync::atomic::{AtomicUsize, Ordering};

use common::{mini, taught};
use use3d_capture::MediumMaps;
use use3d_render::{Backend, Cpu, Look, Mode, RenderError, Renderer, Request, SceneRenderer};
use use3d_splat::Rendered;

/// A backend that draws like the processor, counts its requests, and fails after some drawings.
struct Lent<'s> {
    cpu: Cpu<'s>,
    asked: &'s AtomicUsize,
    lost_after: usize,
}

impl Backend for Lent<'_> {
    fn draw(&mut self, request: &Request<'_>, out: &mut Rendered) -> Result<(), RenderError> {
        if self.asked.fetch_add(1, Ordering::Relaxed) >= self.lost_after {
            return Err(RenderError::Device { device: "lent".into(), problem: "it is lost".into() });
        }
        self.cpu.draw(request, out)
    }

    fn respond(
        &mut self,
        request: &Request<'_>,
        channel: Option<usize>,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        self.cpu.respond(request, channel, out)
    }

    fn medium(&self) -> Option<&MediumMaps> {
        self.cpu.medium()
    }
}

#[test]
fn a_backend_of_another_crate_draws_every_mode_and_its_loss_is_told() {
    let (scene, views) = mini();
    let scene = taught(&scene);
    let asked = AtomicUsize::new(0);
    let on = |look, lost_after| {
        let cpu = Cpu::new(&scene, look).unwrap();
        Renderer::on(Box::new(Lent { cpu, asked: &asked, lost_after }))
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
