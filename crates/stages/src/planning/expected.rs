//! The likely time and disk of stages that never ran: views times pixels times what a part costs.
//!
//! Times are those of docs/science/networks.md and docs/science/performance.md, on two processors. The number
//! of views is that of the capture's pictures, or of the frames that a film will give.

use std::cell::RefCell;
use std::path::{Path, PathBuf};

use use3d_import::ImportParams;
use use3d_prepare::{PrepareParams, Recipe, is_film, is_photograph};
use use3d_workflow::{AllParameters, Expected, Named, StageInput};

use crate::planning::memory::{extent, size};

/// Seconds for a megapixel: Nu2Net at full detail, RAFT, URanker, MUSIQ, LPIPS.
const NU2NET: f64 = 2.6;
const RAFT: f64 = 10.0;
const URANKER: f64 = 7.4;
const MUSIQ: f64 = 0.9;
const LPIPS: f64 = 0.4;
/// Seconds for a picture, whatever its size: the largest Depth Anything V2.
const DEPTH: f64 = 13.0;
/// Pictures of a view that are scored and compared: those of photographs, and those of a scene.
const PHOTOGRAPHS: f64 = 2.0;
const LOOKS: f64 = 5.0;
/// Seconds of a step of stage 1 for a megapixel.
const STEP: f64 = 0.3;
/// The share of that for a step of stage 2, which sees a part of the pixels.
pub(crate) const STAGE_2: f64 = 0.2;
/// Bytes for a pixel of a stored picture, and of a scene for a pixel of a view.
const PICTURE: f64 = 2.5;
const SCENE: f64 = 90.0;
/// Pictures of a scene whose files say no number.
const USUAL: usize = 25;

/// The views of a scene.
struct Views {
    count: f64,
    /// Pixels of a view, in millions.
    mega: f64,
}

impl Views {
    fn of(all: &AllParameters, named: &Named, inputs: &[StageInput]) -> Option<Self> {
        if let Some(extent) = extent(inputs) {
            let pixels = size(&extent).largest;
            return Some(Self { count: extent.sizes.len() as f64, mega: pixels as f64 / 1e6 });
        }
        let import = all.of::<ImportParams>()?;
        let place = named.path("capture").or_else(|| named.path("footage"))?;
        let (count, first) = pictures(place, all.of::<PrepareParams>()?);
        let [width, height] = match (import.size, first) {
            (Some(size), _) => [size.width, size.height],
            (None, Some((width, height))) => [width, height],
            (None, None) => [1920, 1080],
        };
        Some(Self { count: count as f64, mega: (width * height) as f64 / 1e6 })
    }
}

/// The number of pictures of a place, and the size of one.
type Pictures = (usize, Option<(usize, usize)>);

thread_local! {
    /// The place that was looked at last: the stages and variants of a scene are planned one after the other.
    static LAST: RefCell<Option<(PathBuf, usize, Pictures)>> = const { RefCell::new(None) };
}

/// The pictures that a place has or will give.
fn pictures(place: &Path, params: &PrepareParams) -> Pictures {
    LAST.with_borrow_mut(|last| match last {
        Some((known, frames, found)) if known == place && *frames == params.frames => *found,
        _ => {
            let found = looked_at(place, params);
            *last = Some((place.to_path_buf(), params.frames, found));
            found
        }
    })
}

fn looked_at(place: &Path, params: &PrepareParams) -> Pictures {
    let of_films = params.origin.as_ref().is_some_and(|origin| origin.recipe == Recipe::Druva);
    if place.is_file() {
        return (if of_films || is_film(place) { params.frames } else { USUAL }, None);
    }
    let inner = ["images", "images_wb", "Images_wb", "input"].map(|name| place.join(name));
    let folder = inner.into_iter().find(|folder| folder.is_dir()).unwrap_or_else(|| place.to_path_buf());
    let files = walkdir::WalkDir::new(folder).max_depth(2).into_iter().filter_map(Result::ok);
    let mut found = files.map(walkdir::DirEntry::into_path).filter(|path| is_photograph(path));
    let Some(first) = found.next() else { return (params.frames, None) };
    (1 + found.count(), use3d_io_image::image_size(&first).ok())
}

/// Cameras of a film or of photographs: comparisons of pictures, and their copies.
pub(crate) fn of_prepare(all: &AllParameters, named: &Named, inputs: &[StageInput]) -> Option<Expected> {
    let Views { count, mega } = Views::of(all, named, inputs)?;
    Some(Expected { seconds: 4.0 * count, bytes: 0.7e6 * count * mega })
}

/// Pictures at the size of the training.
pub(crate) fn of_import(all: &AllParameters, named: &Named, inputs: &[StageInput]) -> Option<Expected> {
    let Views { count, mega } = Views::of(all, named, inputs)?;
    Some(Expected { seconds: 0.3 * count * mega, bytes: 1e6 * PICTURE * count * mega })
}

/// Depth priors.
pub(crate) fn of_depth(all: &AllParameters, named: &Named, inputs: &[StageInput]) -> Option<Expected> {
    let Views { count, mega } = Views::of(all, named, inputs)?;
    Some(Expected { seconds: DEPTH * count, bytes: 2e6 * count * mega })
}

/// A training of `steps` steps, each at `share` of the cost of a step of stage 1.
pub(crate) fn of_training(
    (steps, share): (u64, f64),
    (all, named): (&AllParameters, &Named),
    inputs: &[StageInput],
) -> Option<Expected> {
    let Views { mega, .. } = Views::of(all, named, inputs)?;
    Some(Expected { seconds: STEP * steps as f64 * mega * share, bytes: 1e6 * SCENE * mega })
}

/// The numbers of a scene's views and pairs that an evaluation looks at.
struct ToJudge {
    views: f64,
    held_out: f64,
    neighbours: f64,
    path: f64,
}

impl ToJudge {
    /// The numbers for `count` views, with at most these pairs of neighbours and of frames.
    fn new(count: f64, neighbours: f64, path: f64) -> Self {
        let (neighbours, held_out) = (neighbours.min(count - 1.0).max(0.0), (count / 8.0).ceil());
        Self { views: (2.0 * neighbours + held_out).min(count), held_out, neighbours, path }
    }

    fn of(all: &AllParameters, count: f64) -> Option<Self> {
        let own = all.get("evaluate")?.json();
        let [neighbours, path] =
            ["neighbour_pairs", "path_pairs"].map(|name| own[name].as_f64().unwrap_or_default());
        Some(Self::new(count, neighbours, path))
    }

    /// Seconds for a megapixel of the networks on photographs: each is enhanced once, and the flow of each
    /// pair of views and of frames is computed once in both directions.
    fn on_photographs(&self) -> f64 {
        let Self { views, held_out, neighbours, path } = self;
        let flow = 2.0 * RAFT * (neighbours + path) + PHOTOGRAPHS * LPIPS * neighbours;
        NU2NET * views + flow + held_out * (PHOTOGRAPHS * (URANKER + MUSIQ) + LPIPS)
    }

    /// Seconds for a megapixel of the networks on a scene: each view is enhanced once, as a render.
    fn on_scene(&self) -> f64 {
        let Self { views, held_out, neighbours, path } = self;
        let frames = if *path > 0.0 { path + 1.0 } else { 0.0 };
        let compared = LPIPS * LOOKS * (neighbours + path);
        NU2NET * (views + frames) + compared + held_out * LOOKS * (URANKER + MUSIQ + LPIPS)
    }
}

/// The networks on photographs, once for all variants.
pub(crate) fn of_baseline(all: &AllParameters, named: &Named, inputs: &[StageInput]) -> Option<Expected> {
    let Views { count, mega } = Views::of(all, named, inputs)?;
    let looked = ToJudge::of(all, count)?;
    let pictures = 2.0 * looked.views + looked.neighbours + looked.path;
    Some(Expected { seconds: mega * looked.on_photographs(), bytes: 1e6 * PICTURE * pictures * mega })
}

/// The networks of an evaluation.
pub(crate) fn of_evaluation(all: &AllParameters, named: &Named, inputs: &[StageInput]) -> Option<Expected> {
    named.path("models")?;
    let Views { count, mega } = Views::of(all, named, inputs)?;
    let looked = ToJudge::of(all, count)?;
    Some(Expected { seconds: mega * looked.on_scene(), bytes: 1e6 * PICTURE * looked.held_out * mega })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn films_give_frames_and_folders_the_pictures_that_they_have() {
        let dir = tempfile::tempdir().unwrap();
        let params = PrepareParams { frames: 120, ..PrepareParams::default() };
        let film = dir.path().join("a.mp4");
        std::fs::write(&film, "film").unwrap();
        assert_eq!(looked_at(&film, &params), (120, None));
        let folder = dir.path().join("images_wb");
        for name in ["a.png", "b.png"] {
            let image = use3d_capture::Raster::<u16, 3>::new(8, 4);
            use3d_io_image::write_png16(&folder.join(name), &image).unwrap();
        }
        assert_eq!(pictures(dir.path(), &params), (2, Some((8, 4))));
        assert_eq!(pictures(&film, &params), (120, None), "another place");
    }

    /// The hours of docs/science/results.md.
    #[test]
    fn photographs_judged_once_save_most_hours_of_networks() {
        let hours = |counts: &[f64], mega: f64, of: fn(&ToJudge) -> f64| {
            let each = counts.iter().map(|count| mega * of(&ToJudge::new(*count, 1e4, 8.0)));
            each.sum::<f64>() / 3600.0
        };
        let (seathru, mega) = ([29.0, 18.0, 20.0, 20.0], 1.4 * 0.933);
        let photographs = hours(&seathru, mega, ToJudge::on_photographs);
        let scene = hours(&seathru, mega, ToJudge::on_scene);
        let (once, each) = (photographs + 9.0 * scene, 9.0 * (photographs + scene));
        println!(
            "SeaThru-NeRF: {photographs:.1} h, {scene:.1} h for a variant; {once:.1} h, not {each:.1} h"
        );
        assert_eq!(format!("{photographs:.1} {scene:.1} {once:.1} {each:.1}"), "1.0 0.4 4.7 12.8");
        let druva =
            [ToJudge::on_photographs, ToJudge::on_scene].map(|of| hours(&[120.0; 20], 1.92 * 1.08, of));
        println!("DRUVA: {:.0} h of photographs, {:.0} h of scenes", druva[0], druva[1]);
        assert_eq!(format!("{:.0} {:.0}", druva[0], druva[0] + druva[1]), "37 51");
    }
}
