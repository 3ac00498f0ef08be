//! The white balance of a scene: measures the choices of `--white` in the scene, and `use3d white` stores the
//! result beside the scene for every later command.

use std::path::Path;

use use3d_capture::{Camera, FileName, stem};
use use3d_import::read_cameras;
use use3d_render::SceneRenderer;
use use3d_render::white::{Surfaces, gains_of_patches, patch};
use use3d_scene::white::{Click, Gains, Method};
use use3d_scene::{Scene, White};
use use3d_workflow::error::nearest;

use crate::App;
use crate::args::{KeepWhiteArgs, Place, WhiteArgs, WhiteChoice};
use crate::destination::{check_file, path_text, word};
use crate::error::{CliError, Done};
use crate::verbs::drawing::placed;
use crate::verbs::found::{capture_in, scene_in};

/// The cameras of a capture by name, in the frame of a scene.
fn cameras_of(capture: Option<&Path>, scene: &Scene) -> Result<Vec<(FileName, Camera)>, CliError> {
    let Some(capture) = capture else {
        return Err(CliError::input(
            "a white balance by pixels, reef or grey is measured in the photographs of the capture: name it \
             with --cameras CAPTURE",
        ));
    };
    placed(capture, &scene.frame)
}

/// Converts a pixel position in a picture of another size to the camera's own size. One picture is the other
/// one scaled to cover it and cropped centrally, as in the import; the larger one is the whole.
fn rescaled(place: &Place, camera: &Camera) -> (f64, f64) {
    let Some((width, height)) = place.size else { return (place.x, place.y) };
    let (w, h) = (camera.intrinsics.width as f64, camera.intrinsics.height as f64);
    let (sx, sy) = (w / width as f64, h / height as f64);
    let scale = if w * h >= (width * height) as f64 { sx.min(sy) } else { sx.max(sy) };
    let along = |at: f64, from: f64, to: f64| (at + 0.5 - from / 2.0) * scale + to / 2.0 - 0.5;
    // A position up to half a pixel beyond the edge belongs to the edge pixel.
    let inside = |at: f64, side: f64| if (-0.5..0.0).contains(&at) { 0.0 } else { at.min(side - 0.5) };
    (inside(along(place.x, width as f64, w), w), inside(along(place.y, height as f64, h), h))
}

/// The camera of the photograph of a place: the one of exactly this name, or else the only one of this name
/// apart from the extension.
fn camera_of<'c>(
    place: &Place,
    cameras: &'c [(FileName, Camera)],
) -> Result<&'c (FileName, Camera), CliError> {
    let refused = |what: String| CliError::Input(format!("--white {}: {what}", place.text()));
    if let Some(found) = cameras.iter().find(|(name, _)| *name == place.view) {
        return Ok(found);
    }
    let mut fitting = cameras.iter().filter(|(name, _)| name.stem() == stem(&place.view));
    match (fitting.next(), fitting.next()) {
        (Some(found), None) => Ok(found),
        (Some((first, _)), Some((second, _))) => {
            Err(refused(format!("{first} and {second} are both meant; give the whole name")))
        }
        (None, _) => {
            let mut names = cameras.iter().map(|(name, _)| name.as_str());
            let near = nearest(&place.view, names.clone()).or(names.next()).unwrap_or("none");
            Err(refused(format!("there is no photograph of this name; did you mean {near}?")))
        }
    }
}

/// Measures the places that the user clicked on.
fn by_places(
    places: &[&Place],
    cameras: &[(FileName, Camera)],
    scene: &Scene,
    renderer: &mut SceneRenderer<'_>,
) -> Result<White, CliError> {
    let (mut patches, mut clicks) = (Vec::new(), Vec::new());
    for place in places {
        let (name, camera) = camera_of(place, cameras)?;
        let (x, y) = rescaled(place, camera);
        let found = patch(renderer, camera, x, y)
            .map_err(|error| CliError::Input(format!("--white {}: {error}", place.text())))?;
        clicks.push(Click { view: name.to_string(), x, y, distance: Some(found.depth / scene.frame.scale) });
        patches.push(found);
    }
    let gains = gains_of_patches(&patches, scene.enhancement.is_some()).map_err(|error| {
        let typed: Vec<String> = places.iter().map(|place| place.text()).collect();
        CliError::Input(format!("--white {}: {error}", typed.join(" ")))
    })?;
    Ok(White::new(Method::Patch, clicks, gains))
}

/// The pixels among the choices.
fn places(choices: &[WhiteChoice]) -> Vec<&Place> {
    choices
        .iter()
        .filter_map(|choice| if let WhiteChoice::Place(place) = choice { Some(place) } else { None })
        .collect()
}

/// The gains of the choices, measured if necessary; `None` for `off`.
fn measured(
    choices: &[WhiteChoice],
    scene: &Scene,
    cameras: Option<&Path>,
) -> Result<Option<White>, CliError> {
    let places = places(choices);
    if choices.len() > 1 && places.len() < choices.len() {
        return Err(CliError::input(
            "--white: give several pixels, or only one of off, reef, grey and a file",
        ));
    }
    let renderer = || SceneRenderer::new(scene, 1.0).map_err(CliError::failed);
    match &choices[0] {
        WhiteChoice::Off => Ok(None),
        WhiteChoice::File(path) => read(path).map(Some),
        WhiteChoice::Place(_) => {
            by_places(&places, &cameras_of(cameras, scene)?, scene, &mut renderer()?).map(Some)
        }
        rule => {
            let cameras: Vec<Camera> =
                cameras_of(cameras, scene)?.into_iter().map(|(_, camera)| camera).collect();
            let surfaces = Surfaces::seen_by(&mut renderer()?, &cameras);
            let found = surfaces.and_then(|surfaces| match rule {
                WhiteChoice::Reef => Ok((Method::Reef, surfaces.reef()?)),
                _ => Ok((Method::Grey, surfaces.grey()?)),
            });
            let (method, gains) = found.map_err(|error| CliError::Input(format!("--white: {error}")))?;
            Ok(Some(White::new(method, Vec::new(), gains)))
        }
    }
}

/// The white balance with which a verb shows a scene: from `--white`, or the stored one.
pub(crate) fn of(
    app: &App,
    args: &WhiteArgs,
    folder: &Path,
    scene: &Scene,
    cameras: Option<&Path>,
) -> Result<Option<White>, CliError> {
    if !args.choices.is_empty() {
        let white = measured(&args.choices, scene, cameras)?;
        white.iter().for_each(|white| tell(app, white, scene));
        return Ok(white);
    }
    let Some(white) = White::beside(folder).map_err(CliError::input)? else { return Ok(None) };
    let place = path_text(&White::place(folder));
    if white.is_outdated(folder) {
        eprintln!(
            "{place} was measured in an earlier scene and is left out; measure it again with `use3d white {}`",
            word(folder)
        );
        return Ok(None);
    }
    remark!(app, "white balance: {place} (--white off leaves the colours unchanged)");
    Ok(Some(white))
}

/// Prints the effect of a white balance, and its range.
fn tell(app: &App, white: &White, scene: &Scene) {
    let text = |[r, _, b]: [f32; 3]| format!("red ×{r:.2}, blue ×{b:.2}");
    let Gains { clear, enhanced, enhanced_clear } = white.gains;
    let mut looks = vec![format!("clear: {}", text(clear))];
    if scene.enhancement.is_some() {
        looks.push(format!("enhanced: {}", text(enhanced)));
        looks.push(format!("enhanced-clear: {}", text(enhanced_clear)));
    }
    remark!(app, "white balance by {}: {}", white.method.name(), looks.join("; "));
    let distances: Vec<f64> = white.clicks.iter().filter_map(|click| click.distance).collect();
    if !distances.is_empty() {
        let distances: Vec<String> = distances.iter().map(|d| format!("{d:.2}")).collect();
        remark!(
            app,
            "measured at a distance of {} units and correct there; nearer or farther surfaces may keep a \
             cast",
            distances.join(" and ")
        );
    }
}

/// Reads a file with a white balance.
fn read(path: &Path) -> Result<White, CliError> {
    let next = "expected a white balance that `use3d white SCENE --out FILE.json` wrote";
    White::read(path).map_err(|error| CliError::Input(format!("--white {error}; {next}")))
}

/// Fails, before anything is trained, if a place names a photograph that the capture does not have, or if a
/// file with a white balance cannot be read.
pub(crate) fn check(choices: &[WhiteChoice], capture: &Path) -> Done {
    for choice in choices {
        if let WhiteChoice::File(path) = choice {
            read(path)?;
        }
    }
    let places = places(choices);
    if places.is_empty() {
        return Ok(());
    }
    let cameras = read_cameras(capture).map_err(CliError::input)?;
    places.into_iter().try_for_each(|place| camera_of(place, &cameras).map(drop))
}

/// Measures a scene of a run, and stores the result beside it.
pub(crate) fn keep_for(app: &App, choices: &[WhiteChoice], folder: &Path, capture: &Path) -> Done {
    let scene = Scene::load(folder).map_err(CliError::input)?;
    let white = measured(choices, &scene, Some(capture))?;
    keep(app, white.as_ref(), folder)?;
    white.iter().for_each(|white| tell(app, white, &scene));
    Ok(())
}

/// Stores a white balance beside a scene, or removes the stored one. Nothing else is ever replaced.
fn keep(app: &App, white: Option<&White>, folder: &Path) -> Done {
    let place = White::place(folder);
    let there = White::beside(folder)
        .map_err(|error| CliError::Input(format!("{error}; this file is not replaced: move it away")))?;
    if let (Some(_), Some(there)) = (white, &there) {
        remark!(app, "the earlier white balance by {} is replaced", there.method.name());
    }
    match (white, there) {
        (Some(white), _) => white.clone().of_scene(folder).write(&place).map_err(CliError::failed),
        (None, Some(_)) => std::fs::remove_file(&place)
            .map_err(|error| CliError::Failed(format!("{}: {error}", path_text(&place)))),
        (None, None) => Ok(()),
    }
}

/// `use3d white`.
pub(crate) fn run(app: &App, args: &KeepWhiteArgs) -> Done {
    let folder = scene_in(app, &args.scene)?;
    if let Some(out) = &args.out {
        check_file("--out", out, args.replace.force, &["json"])?;
    }
    let scene = Scene::load(&folder).map_err(CliError::input)?;
    let (white, place) = if args.choices.is_empty() {
        let stored = White::beside(&folder).map_err(CliError::input)?;
        match (&args.out, &stored) {
            (Some(out), Some(white)) => white.write(out).map_err(CliError::failed)?,
            (Some(_), None) => {
                return Err(CliError::input(
                    "--out: the scene has no white balance to write; give a choice, such as VIEW:X,Y",
                ));
            }
            (None, _) => {}
        }
        (stored, args.out.clone().unwrap_or_else(|| White::place(&folder)))
    } else {
        let cameras = args.cameras.clone().or_else(|| capture_in(&args.scene));
        let white = measured(&args.choices, &scene, cameras.as_deref())?;
        match (&args.out, &white) {
            (Some(out), Some(white)) => white.write(out).map_err(CliError::failed)?,
            (Some(_), None) => return Err(CliError::input("off writes no file: leave out --out")),
            (None, white) => keep(app, white.as_ref(), &folder)?,
        }
        (white, args.out.clone().unwrap_or_else(|| White::place(&folder)))
    };
    if args.json {
        return crate::output::json(&white);
    }
    match &white {
        Some(white) => {
            println!("{}", path_text(&place));
            tell(app, white, &scene);
        }
        None => remark!(app, "no white balance: colours unchanged"),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Intrinsics, Pose};

    #[test]
    fn a_pixel_of_another_size_is_found_again() {
        let camera = |width, height| Camera {
            intrinsics: Intrinsics { width, height, fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0 },
            pose: Pose::IDENTITY,
        };
        let place = |x, y, size| Place { view: "a".into(), x, y, size };
        assert_eq!(rescaled(&place(3.0, 4.0, None), &camera(10, 10)), (3.0, 4.0));
        // Twice the size.
        assert_eq!(rescaled(&place(3.0, 4.0, Some((10, 10))), &camera(20, 20)), (6.5, 8.5));
        // A picture of 40x20 was scaled by half and cropped to 10x10: 5 pixels are missing on the left.
        assert_eq!(rescaled(&place(0.0, 0.0, Some((10, 10))), &camera(40, 20)), (10.5, 0.5));
        // The inverse.
        assert_eq!(rescaled(&place(10.5, 0.5, Some((40, 20))), &camera(10, 10)), (0.0, 0.0));
    }

    #[test]
    fn a_photograph_is_the_one_that_was_named() {
        let camera = Camera {
            intrinsics: Intrinsics { width: 8, height: 8, fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0 },
            pose: Pose::IDENTITY,
        };
        let names = ["reef.jpg", "reef.png", "cam.1/a", "cam.1/b", "f_1.jpg"];
        let cameras: Vec<_> = names.iter().map(|name| (FileName::new(name).unwrap(), camera)).collect();
        let found = |view: &str| {
            let place = Place { view: view.into(), x: 0.0, y: 0.0, size: None };
            camera_of(&place, &cameras).map(|(name, _)| name.to_string()).map_err(|error| match error {
                CliError::Input(message) => message,
                _ => String::new(),
            })
        };
        assert_eq!(found("reef.png").as_deref(), Ok("reef.png"));
        assert_eq!(found("cam.1/b").as_deref(), Ok("cam.1/b"));
        assert_eq!(found("f_1").as_deref(), Ok("f_1.jpg"), "the page names photographs without an extension");
        assert!(found("reef").unwrap_err().contains("reef.jpg and reef.png"));
        assert!(found("g_1.jpg").unwrap_err().contains("did you mean f_1.jpg"));
    }
}
