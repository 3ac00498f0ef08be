//! Enhances the held-out photographs of a capture by its scene: `grade SCENE CAPTURE OUT`.

use std::path::Path;

use use3d_capture::{Camera, Image};
use use3d_import::{ImportParams, import};
use use3d_io_image::{write_png, write_png_map};
use use3d_photographs::{Grid, Photographer};
use use3d_render::{Mode, SceneRenderer};
use use3d_scene::Scene;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [scene, capture, out] = &args[..] else { return Err("usage: grade SCENE CAPTURE OUT".into()) };
    let scene = Scene::load(Path::new(scene))?;
    let imported = import(Path::new(capture), &ImportParams::default())?;
    let training: Vec<Camera> = imported.capture.training_views().map(|view| view.camera).collect();
    let renderer = || SceneRenderer::new(&scene, 1.0);
    let photographer = Photographer::new(renderer()?, renderer()?, Mode::opening(&scene));
    let mut photographer = photographer.covered_by(&training)?;
    for &index in &imported.capture.split.test {
        let view = &imported.capture.views[index];
        let photograph = imported.view(index)?.pixels.to_image();
        let (w, h) = (photograph.width(), photograph.height());
        let graded = photographer.grade(&photograph, &Grid::pinhole(view.camera), None, None)?;
        let mut pixels = photograph.to_interleaved();
        graded.grade.map.apply(&mut pixels, w);
        let image = Image::from_interleaved(w, h, &pixels).unwrap_or(photograph);
        let file = format!("{}.png", view.flat_stem());
        write_png(&Path::new(out).join(&file), &image)?;
        write_png_map(&Path::new(out).join("known").join(&file), &graded.grade.known)?;
    }
    Ok(())
}
