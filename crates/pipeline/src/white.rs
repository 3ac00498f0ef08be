//! The white balance of a scene: reads the choices of `--white`, measures them in the scene, and stores the
//! result beside it for every later command.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use use3d_capture::{Camera, FileName, stem};
use use3d_import::read_cameras;
use use3d_render::SceneRenderer;
use use3d_render::white::{LONGEST, PATCH, Surfaces, gains_of_patches, patch};
use use3d_scene::white::{Click, Gains, Method};
use use3d_scene::{Scene, White};
use use3d_workflow::error::nearest;

use crate::WorkError;
use crate::destination::path_text;
use crate::scene_views::placed;

/// One way to balance the colours.
#[derive(Clone, Debug, PartialEq)]
pub enum WhiteChoice {
    /// No white balance.
    Off,
    /// The mean colour of reefs; only a part of the cast is corrected.
    Reef,
    /// All clear surfaces together.
    Grey,
    /// A pixel of a photograph that shows something grey.
    Place(Place),
    /// A file of gains.
    File(PathBuf),
}

/// A pixel of a photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// The photograph's name, with or without the part after the last dot.
    pub view: String,
    /// Column from the left; the first one is 0.
    pub x: f64,
    /// Row from the top; the first one is 0.
    pub y: f64,
    /// The size of the picture whose pixels are meant, if it is not the camera's own.
    pub size: Option<(usize, usize)>,
}

impl Place {
    /// Parses the form in which it is typed.
    fn typed(text: &str) -> Option<Self> {
        let (view, rest) = text.rsplit_once(':').filter(|(view, _)| !view.is_empty())?;
        let (pixel, size) = match rest.split_once('@') {
            Some((pixel, size)) => (pixel, Some(size.split_once('x')?)),
            None => (rest, None),
        };
        let side = |text: &str| text.parse::<usize>().ok().filter(|n| *n > 0);
        let size = match size {
            Some((w, h)) => Some((side(w)?, side(h)?)),
            None => None,
        };
        let (x, y) = pixel.split_once(',')?;
        let number = |text: &str| text.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0);
        Some(Self { view: view.into(), x: number(x)?, y: number(y)?, size })
    }

    /// The form in which it is typed.
    pub fn text(&self) -> String {
        let size = self.size.map_or_else(String::new, |(w, h)| format!("@{w}x{h}"));
        format!("{}:{},{}{size}", self.view, self.x, self.y)
    }
}

/// The list of choices, for messages.
const EXPECTED: &str = "expected off, reef, grey, a pixel of a photograph that shows something grey or white \
                        (f_0001.jpg:812,430), or a file (white.json)";

impl FromStr for WhiteChoice {
    type Err = WorkError;

    fn from_str(text: &str) -> Result<Self, WorkError> {
        match text {
            "off" => Ok(Self::Off),
            "reef" => Ok(Self::Reef),
            "grey" | "gray" => Ok(Self::Grey),
            "patch" => Err(WorkError::input(
                "give a pixel of a photograph that is grey or white, e.g. f_0001.jpg:812,430",
            )),
            file if file.to_lowercase().ends_with(".json") => Ok(Self::File(file.into())),
            place => Place::typed(place).map(Self::Place).ok_or_else(|| WorkError::input(EXPECTED)),
        }
    }
}

/// The cameras of a capture by name, in the frame of a scene.
fn cameras_of(capture: Option<&Path>, scene: &Scene) -> Result<Vec<(FileName, Camera)>, WorkError> {
    let Some(capture) = capture else {
        return Err(WorkError::input(
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
) -> Result<&'c (FileName, Camera), WorkError> {
    let refused = |what: String| WorkError::Input(format!("--white {}: {what}", place.text()));
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
            let next = match (nearest(&place.view, names.clone()), names.next()) {
                (Some(near), _) => format!("; did you mean {near}?"),
                (None, Some(first)) => format!("; the capture has {}, the first is {first}", cameras.len()),
                (None, None) => String::new(),
            };
            Err(refused(format!("there is no photograph of this name{next}")))
        }
    }
}

/// Measures the places that the user clicked on.
fn by_places(
    places: &[&Place],
    cameras: &[(FileName, Camera)],
    scene: &Scene,
    renderer: &mut SceneRenderer<'_>,
) -> Result<White, WorkError> {
    let (mut patches, mut clicks) = (Vec::new(), Vec::new());
    for place in places {
        let (name, camera) = camera_of(place, cameras)?;
        let (x, y) = rescaled(place, camera);
        let found = patch(renderer, camera, x, y)
            .map_err(|error| WorkError::Input(format!("--white {}: {error}", place.text())))?;
        clicks.push(Click { view: name.to_string(), x, y, distance: Some(found.depth / scene.frame.scale) });
        patches.push(found);
    }
    let gains = gains_of_patches(&patches, scene.enhancement.is_some()).map_err(|error| {
        let typed: Vec<String> = places.iter().map(|place| place.text()).collect();
        WorkError::Input(format!("--white {}: {error}", typed.join(" ")))
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

/// The white balance of the choices, which are not empty; measured if necessary, in the views of the capture
/// at `cameras`. `None` for `off`.
///
/// # Errors
/// The choices exclude each other, the capture is not known, or nothing grey is found at a pixel.
pub fn measured(
    choices: &[WhiteChoice],
    scene: &Scene,
    cameras: Option<&Path>,
) -> Result<Option<White>, WorkError> {
    let places = places(choices);
    if choices.len() > 1 && places.len() < choices.len() {
        return Err(WorkError::input(
            "--white: give several pixels, or only one of off, reef, grey and a file",
        ));
    }
    let renderer = || SceneRenderer::new(scene, 1.0).map_err(WorkError::failed);
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
            let (method, gains) = found.map_err(|error| WorkError::Input(format!("--white: {error}")))?;
            Ok(Some(White::new(method, Vec::new(), gains)))
        }
    }
}

/// Reads a file with a white balance.
fn read(path: &Path) -> Result<White, WorkError> {
    let next = "expected a white balance that `use3d white SCENE --out FILE.json` wrote";
    White::read(path).map_err(|error| WorkError::Input(format!("--white {error}; {next}")))
}

/// Fails, before anything is trained, if a place names a photograph that the capture does not have, or if a
/// file with a white balance cannot be read.
///
/// # Errors
/// The name or the file, with the most similar name.
pub fn check(choices: &[WhiteChoice], capture: &Path) -> Result<(), WorkError> {
    for choice in choices {
        if let WhiteChoice::File(path) = choice {
            read(path)?;
        }
    }
    let places = places(choices);
    if places.is_empty() {
        return Ok(());
    }
    let cameras = read_cameras(capture).map_err(WorkError::input)?;
    places.into_iter().try_for_each(|place| camera_of(place, &cameras).map(drop))
}

/// Stores a white balance beside a scene, or removes the stored one, which is returned. Nothing else is ever
/// replaced.
///
/// # Errors
/// The file beside the scene is no white balance, or cannot be written.
pub fn keep(white: Option<&White>, folder: &Path) -> Result<Option<White>, WorkError> {
    let place = White::place(folder);
    let there = White::beside(folder)
        .map_err(|error| WorkError::Input(format!("{error}; this file is not replaced: move it away")))?;
    match (white, &there) {
        (Some(white), _) => white.clone().of_scene(folder).write(&place).map_err(WorkError::failed)?,
        (None, Some(_)) => std::fs::remove_file(&place)
            .map_err(|error| WorkError::Failed(format!("{}: {error}", path_text(&place))))?,
        (None, None) => {}
    }
    Ok(there)
}

/// The effect of a white balance on the looks of a scene, and its range, in lines.
pub fn lines(white: &White, scene: &Scene) -> Vec<String> {
    let text = |[r, _, b]: [f32; 3]| format!("red ×{r:.2}, blue ×{b:.2}");
    let Gains { clear, enhanced, .. } = white.gains;
    let mut looks = vec![format!("clear: {}", text(clear))];
    if scene.enhancement.is_some() {
        looks.push(format!("enhanced: {}", text(enhanced)));
    }
    let mut lines = vec![format!("white balance by {}: {}", white.method.name(), looks.join("; "))];
    let distances: Vec<f64> = white.clicks.iter().filter_map(|click| click.distance).collect();
    if !distances.is_empty() {
        tracing::info!(
            "a click is the median of {PATCH} by {PATCH} pixels, of a picture at most {LONGEST} pixels wide"
        );
        let distances: Vec<String> = distances.iter().map(|d| format!("{d:.2}")).collect();
        lines.push(format!(
            "measured {} units away: the colour is right there, and nearer or farther things may keep a tint",
            distances.join(" and ")
        ));
    }
    let belief = match white.method {
        Method::Patch => return lines,
        Method::Grey => "took the whole scene together for grey",
        Method::Reef => "took the surfaces for those of a usual reef",
    };
    let name = white.method.name();
    lines.push(format!(
        "{name} {belief}: over coloured sand or a wall of one colour it makes the picture worse; then click on something \
         grey instead (`use3d white RESULTS PHOTOGRAPH:X,Y`), or take the balance back with `off`"
    ));
    lines
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
                WorkError::Input(message) => message,
                _ => String::new(),
            })
        };
        assert_eq!(found("reef.png").as_deref(), Ok("reef.png"));
        assert_eq!(found("cam.1/b").as_deref(), Ok("cam.1/b"));
        assert_eq!(found("f_1").as_deref(), Ok("f_1.jpg"), "the page names photographs without an extension");
        assert!(found("reef").unwrap_err().contains("reef.jpg and reef.png"));
        assert!(found("g_1.jpg").unwrap_err().contains("did you mean f_1.jpg"));
        let strange = found("nofoto.jpg").unwrap_err();
        assert!(strange.ends_with("of this name; the capture has 5, the first is reef.jpg"), "{strange}");
    }

    #[test]
    fn choices_are_read_as_they_are_typed() {
        let read = |text: &str| WhiteChoice::from_str(text).ok();
        assert_eq!(read("off"), Some(WhiteChoice::Off));
        assert_eq!(read("gray"), Some(WhiteChoice::Grey));
        assert_eq!(read("a/white.json"), Some(WhiteChoice::File("a/white.json".into())));
        let place = |view: &str, size| Place { view: view.into(), x: 812.0, y: 430.5, size };
        assert_eq!(read("f_0001.jpg:812,430.5"), Some(WhiteChoice::Place(place("f_0001.jpg", None))));
        let sized = place("a:b", Some((640, 360)));
        assert_eq!(read("a:b:812,430.5@640x360"), Some(WhiteChoice::Place(sized.clone())));
        assert_eq!(read(&sized.text()), Some(WhiteChoice::Place(sized)));
        for wrong in [
            "patch",
            "f_0001.jpg",
            "f.jpg:812",
            ":1,2",
            "f.jpg:-1,2",
            "f.jpg:nan,2",
            "f.jpg:1,2@0x9",
            "reefs",
        ] {
            assert!(read(wrong).is_none(), "{wrong}");
        }
    }
}
