//! Grades photographs by a scene: draws their views and combines them.

use use3d_capture::{Camera, Image, Lattice, Map};
use use3d_render::{Mode, RenderError, Rendering, SceneRenderer};

use crate::coverage::Coverage;
use crate::development::ColourPairs;
use crate::grade::{Grade, Seen, ViewMap, grade, own_map};
use crate::grid::Grid;

/// Longer side of the pictures of the answer to light, pixels. They are smooth, and the photograph guides
/// them to its edges.
const FACTORS: usize = 480;

/// Longer side of the pictures of a whole view's change, pixels.
const OVERVIEW: usize = 192;

/// A photograph that cannot be graded.
#[derive(Debug, thiserror::Error)]
pub enum PhotographError {
    /// The scene cannot be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The share of the shot's own light is outside `[0, 1]`.
    #[error(
        "the share of the photograph's own light is {0}; expected 0 (the scene's light) to 1 (all of its own)"
    )]
    KeepLight(f32),
    /// The photograph is not of the size of its grid.
    #[error("the small photograph has {found:?} pixels and its grid {expected:?}")]
    Size {
        /// Width and height of the photograph.
        found: (usize, usize),
        /// Width and height of the grid.
        expected: (usize, usize),
    },
}

/// A graded photograph with the distances in it.
#[derive(Clone, Debug)]
pub struct Graded {
    /// The change of its colours.
    pub grade: Grade,
    /// Expected depth along the optical axis for each pixel of the grid, scene units; 0 without a surface.
    pub depth: Map,
}

/// Grades photographs in one look of a scene.
pub struct Photographer<'s> {
    /// Draws stage 1 in all of its water.
    plain: SceneRenderer<'s>,
    /// Draws the look, with its strength, water and white balance.
    look: SceneRenderer<'s>,
    mode: Mode,
    keep_light: f32,
    coverage: Option<Coverage>,
}

impl<'s> Photographer<'s> {
    /// A photographer for the look `mode`. `plain` draws the scene in all of its water; `look` draws the
    /// look.
    pub fn new(plain: SceneRenderer<'s>, look: SceneRenderer<'s>, mode: Mode) -> Self {
        Self { plain, look, mode, keep_light: 0.0, coverage: None }
    }

    /// Leaves a share in `[0, 1]` of each shot's own light; it is 0 at first.
    ///
    /// # Errors
    /// The share is outside that range.
    pub fn with_light(mut self, share: f32) -> Result<Self, PhotographError> {
        if !(0.0..=1.0).contains(&share) {
            return Err(PhotographError::KeepLight(share));
        }
        self.keep_light = share;
        Ok(self)
    }

    /// Trusts only surfaces that the training views saw.
    ///
    /// # Errors
    /// The error of the renderer's device.
    pub fn covered_by(mut self, training: &[Camera]) -> Result<Self, PhotographError> {
        self.coverage = Some(Coverage::new(&mut self.plain, training)?);
        Ok(self)
    }

    /// ColourPairs of colours of a photograph of another development and the scene.
    ///
    /// # Errors
    /// The renderer's device failed, or the photograph has another size than the grid.
    pub fn pairs(&mut self, photograph: &Image, grid: &Grid) -> Result<ColourPairs, PhotographError> {
        fits(photograph, grid)?;
        let render = self.plain.color(&grid.camera, Mode::Reconstruction)?;
        Ok(ColourPairs::of(photograph, &grid.read(&render)))
    }

    /// The change of a view as a whole, from the scene alone: of a photograph that equals its render.
    ///
    /// # Errors
    /// The renderer's device failed.
    pub fn own(&mut self, camera: &Camera) -> Result<ViewMap, PhotographError> {
        let camera = camera.no_larger_than(OVERVIEW);
        let render = self.plain.color(&camera, Mode::Reconstruction)?;
        let look = self.look.color(&camera, self.mode)?;
        let rows = own_map(&render, &look, &vec![1.0; render.pixels()]);
        Ok(ViewMap { rows })
    }

    /// The change of colours of a photograph at the size of its grid. `own` is its place among the training
    /// views, if it is one. `mask` (of the grid's size) is 0 where the scene was not learnt.
    ///
    /// # Errors
    /// The renderer's device failed, or the photograph has another size than the grid.
    pub fn grade(
        &mut self,
        photograph: &Image,
        grid: &Grid,
        own: Option<usize>,
        mask: Option<&Map>,
    ) -> Result<Graded, PhotographError> {
        fits(photograph, grid)?;
        let camera = &grid.camera;
        let [render, depth] = pair(self.plain.render(camera, &[Mode::Reconstruction, Mode::Depth])?);
        let (render, drawn) = (grid.read(&color(render)), scalar(depth));
        let look = grid.read(&self.look.color(camera, self.mode)?);
        let covered = self.coverage.as_ref().map(|coverage| grid.read(&coverage.of(camera, &drawn, own)));
        let coverage = times(times(covered, grid.field()), mask);
        let coarse = camera.no_larger_than(FACTORS);
        let lattice = Lattice::full(&coarse.intrinsics);
        let mut response = self.look.response(&coarse, &lattice, self.mode)?;
        response.arriving = grid.read(&response.arriving);
        response.columns = response.columns.map(|column| grid.read(&column));
        let seen = Seen {
            photograph,
            render: &render,
            look: &look,
            coverage: coverage.as_ref(),
            response: &response,
            // Without its water, a picture is for measuring.
            soft: self.mode.is_enhanced(),
        };
        let grade = grade(&seen, self.keep_light);
        Ok(Graded { grade, depth: grid.read(&drawn) })
    }
}

/// Checks that a small photograph has the size of its grid.
fn fits(photograph: &Image, grid: &Grid) -> Result<(), PhotographError> {
    let (found, expected) = ((photograph.width(), photograph.height()), grid.size());
    if found == expected { Ok(()) } else { Err(PhotographError::Size { found, expected }) }
}

/// The two results of a drawing of two modes.
fn pair(frames: Vec<Rendering>) -> [Option<Rendering>; 2] {
    let mut frames = frames.into_iter();
    [frames.next(), frames.next()]
}

fn color(frame: Option<Rendering>) -> Image {
    if let Some(Rendering::Color(image)) = frame { image } else { Image::new(0, 0) }
}

fn scalar(frame: Option<Rendering>) -> Map {
    if let Some(Rendering::Scalar(map)) = frame { map } else { Map::new(0, 0) }
}

/// The product of two maps, where both are there.
fn times(map: Option<Map>, by: Option<&Map>) -> Option<Map> {
    match (map, by) {
        (Some(mut map), Some(by)) => {
            map.data_mut().iter_mut().zip(by.data()).for_each(|(v, b)| *v *= b);
            Some(map)
        }
        (map, by) => map.or_else(|| by.cloned()),
    }
}
